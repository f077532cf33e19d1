"""Noise of a gyro: angle random walk N, bias instability B, rate random walk R, and noise growing with rate.

One-sided PSD of the rate (IEEE Std 952, PHYSICS.md F1), in (°/s)²/Hz:
    S(f) = 2·[(N/60)² + (B/3600)²/(2πf) + (R/216000)²/(2πf)²],  N in °/√h, B in °/h, R in °/h/√h
with the Allan variance σ²(τ) = N²/τ + (2 ln 2/π)·B² + R²·τ/3.
"""

from types import SimpleNamespace

import numpy as np
from scipy.signal import fftconvolve

from training.effects.base import NoiseEffect, amplitude, parameters
from training.effects.truth import Truth
from training.effects.units import PPM

DPS_PER_ARW = 1.0 / 60.0
DPS_PER_BIAS_INSTABILITY = 1.0 / 3600.0
DPS_PER_RRW = 1.0 / (3600.0 * 60.0)


def white(n: int, dt_s: float, arw_deg_rt_h: float, generator: np.random.Generator) -> np.ndarray:
    """Draw angle random walk [°/s]: independent samples of variance (N/60)²/Δt, shape `(n,)`."""
    return arw_deg_rt_h * DPS_PER_ARW / np.sqrt(dt_s) * generator.standard_normal(n)


def flicker(n: int, bias_instability_deg_h: float, generator: np.random.Generator) -> np.ndarray:
    """Draw 1/f noise [°/s] that starts at power-on, shape `(n,)`.

    Kasdin's half integrator (Proc. IEEE 83 (1995) 802): white noise through h₀ = 1, h_k = h_{k−1}·(k − ½)/k,
    whose |H|² = 1/(2 sin(πfΔt)) gives the PSD above for any sampling interval.
    """
    k = np.arange(1, n)
    impulse = np.concatenate(([1.0], np.cumprod((k - 0.5) / k)))
    drive = generator.standard_normal(n)
    return bias_instability_deg_h * DPS_PER_BIAS_INSTABILITY * fftconvolve(drive, impulse)[:n]


def random_walk(n: int, dt_s: float, rrw_deg_h_rt_h: float, generator: np.random.Generator) -> np.ndarray:
    """Draw rate random walk [°/s] from 0 at power-on, shape `(n,)`."""
    step = rrw_deg_h_rt_h * DPS_PER_RRW * np.sqrt(dt_s)
    return step * np.cumsum(generator.standard_normal(n))


def gyro_noise(
    n: int, dt_s: float, density: tuple[float, float, float], generator: np.random.Generator
) -> np.ndarray:
    """Draw the sum of the three, `density` = (N °/√h, B °/h, R °/h/√h); result [°/s], shape `(n,)`."""
    arw, bias_instability, rrw = density
    total = white(n, dt_s, arw, generator)
    if bias_instability > 0.0:
        total += flicker(n, bias_instability, generator)
    if rrw > 0.0:
        total += random_walk(n, dt_s, rrw, generator)
    return total


def psd(f_hz: np.ndarray, density: tuple[float, float, float]) -> np.ndarray:
    """Return the one-sided PSD [(°/s)²/Hz] of the equation above at frequencies over 0."""
    omega = 2.0 * np.pi * f_hz
    n, b, r = (
        value * unit
        for value, unit in zip(density, (DPS_PER_ARW, DPS_PER_BIAS_INSTABILITY, DPS_PER_RRW), strict=True)
    )
    return 2.0 * (n**2 + b**2 / omega + r**2 / omega**2)


class NoiseLevel(NoiseEffect):
    """The gyro is noisier than the simulation says: more shot and excess noise, 1/f noise or wandering."""

    id = "noise_level"
    title = "Noise above the simulation's"
    section = "F1"
    equation = "S(f) = 2·[N² + B²/(2πf) + R²/(2πf)²] added in power"
    parameters = parameters(
        arw_deg_rt_h=amplitude("deg/√h", 0.05, 0.1, default=0.0),
        bias_instability_deg_h=amplitude("deg/h", 0.5, 1.0, default=0.0),
        rrw_deg_h_rt_h=amplitude("deg/h/√h", 1.0, 2.0, default=0.0),
    )
    drivers = ()
    excitation = "an hour or more at standstill and constant temperature"
    source = "IEEE Std 952; PHYSICS.md F1"

    def _sample(self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator) -> np.ndarray:
        density = (p.arw_deg_rt_h, p.bias_instability_deg_h, p.rrw_deg_h_rt_h)
        return gyro_noise(truth.t_s.size, truth.dt_s, density, generator)


class MultiplicativeNoise(NoiseEffect):
    """Excess noise of the source and noise of the gain scale with the signal, hence with the rate."""

    id = "multiplicative_noise"
    title = "Noise proportional to the rate"
    section = "B7"
    equation = "var(e) = (10⁻⁶·σ)²·ω² per sample"
    parameters = parameters(sigma_ppm=amplitude("ppm", 200.0, 1000.0))
    drivers = ("rate",)
    excitation = "constant rates of several levels, each for minutes"
    source = "PHYSICS.md B7 [K]"

    def _sample(self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator) -> np.ndarray:
        return PPM * p.sigma_ppm * truth.rate_dps * generator.standard_normal(truth.t_s.size)
