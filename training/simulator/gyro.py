"""From truth to the gyro's output: optics, additive errors, loop, delay, noise, converter and firmware."""

from collections.abc import Iterator

import numpy as np

from training.effects.base import Effect, ErrorEffect, NoiseEffect, OutputEffect, TimingEffect, delayed
from training.effects.catalogue import effect
from training.effects.noise import gyro_noise
from training.effects.truth import Truth
from training.simulator.draw import Draw
from training.simulator.scenario import Gyro, Noise, Surface

_NOISE_ENTERS_AT = 50  # order of output effects: below it before the noise, above it after


def surface_output(surface: Surface, rate_dps: np.ndarray, temp_degC: np.ndarray) -> np.ndarray:
    """Return m = G(T)·sin(K(T)·ω)/K0 [°/s] (PHYSICS.md §4.2; ω in rad/s inside the sine), shape `(n,)`."""
    h = temp_degC - surface.ref_degC
    optical = surface.K0_s * (1.0 + surface.alpha_per_K * h)
    gain = 1.0 + surface.g0 + h * (surface.g1_per_K + h * surface.g2_per_K2)
    return np.degrees(gain * np.sin(optical * np.radians(rate_dps)) / surface.K0_s)


def surface_error(surface: Surface, truth: Truth) -> np.ndarray:
    """Return the optics' error [°/s] at the temperature they have, shape `(n,)`."""
    at_coil = surface.at == "coil" and not truth.soaked
    temp = truth.needs("coil_temp_degC", "gyro.surface at coil") if at_coil else truth.temp_degC
    return surface_output(surface, truth.rate_dps, temp) - truth.rate_dps


def active(gyro: Gyro) -> Iterator[tuple[Effect, dict[str, float]]]:
    """Iterate over the effects that are on, each with its parameters."""
    return ((effect(switch.effect), switch.values()) for switch in gyro.effects)


def error_waveforms(gyro: Gyro, truth: Truth) -> dict[str, np.ndarray]:
    """Return {"surface" or effect id: its error [°/s] on this truth}, each of shape `(n,)`.

    Only what adds to the output; an effect that is on twice is summed.
    """
    waves = {} if isinstance(gyro.surface, str) else {"surface": surface_error(gyro.surface, truth)}
    for entry, values in active(gyro):
        if isinstance(entry, ErrorEffect):
            waves[entry.id] = waves.get(entry.id, 0.0) + entry.error(truth, values)
    return waves


def gyro_output(gyro: Gyro, truth: Truth, draw: Draw | None) -> np.ndarray:
    """Return the gyro's rate [°/s], shape `(n,)`; without `draw` all that is random is left out."""
    output = truth.rate_dps + sum(error_waveforms(gyro, truth).values())
    output = _mapped(gyro, truth, output, before_noise=True)
    output = delayed(truth.t_s, output, total_delay(gyro, truth, draw))
    if draw is not None:
        output = output + total_noise(gyro, truth, draw)
    return _mapped(gyro, truth, output, before_noise=False)


def total_delay(gyro: Gyro, truth: Truth, draw: Draw | None) -> np.ndarray:
    """Return how much older each sample is than its stamp [s], shape `(n,)`; jitter only with `draw`."""
    delay = np.zeros_like(truth.t_s)
    for entry, values in active(gyro):
        if isinstance(entry, TimingEffect) and (draw is not None or entry.id != "timing_jitter"):
            delay += entry.delay_s(truth, values, (draw or Draw(0)).of(entry.id))
    return delay


def total_noise(gyro: Gyro, truth: Truth, draw: Draw) -> np.ndarray:
    """Draw the gyro's own noise and that of noise effects [°/s], shape `(n,)`."""
    noise = np.zeros_like(truth.t_s)
    if isinstance(gyro.noise, Noise):
        noise += gyro_noise(truth.t_s.size, truth.dt_s, gyro.noise.density, draw.of("gyro noise"))
    for entry, values in active(gyro):
        if isinstance(entry, NoiseEffect):
            noise += entry.sample(truth, values, draw.of(entry.id))
    return noise


def _mapped(gyro: Gyro, truth: Truth, output: np.ndarray, before_noise: bool) -> np.ndarray:
    """Pass the output through its mapping effects of one side of the noise, in their order."""
    chosen = [(entry, values) for entry, values in active(gyro) if isinstance(entry, OutputEffect)]
    for entry, values in sorted(chosen, key=lambda pair: pair[0].order):
        if (entry.order < _NOISE_ENTERS_AT) == before_noise:
            output = entry.apply(output, truth, values)
    return output
