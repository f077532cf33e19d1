"""Effects that map the output itself, from the loop to the firmware: PHYSICS.md C1–C5, D7, D11."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from rtcomp.jit import kernel
from training.effects.base import ErrorEffect, OutputEffect, amplitude, parameters, shape
from training.effects.truth import Truth


class Bandwidth(OutputEffect):
    """The sensor's loop and digital filter pass slow rates and delay and weaken quick ones."""

    id = "bandwidth"
    title = "Sensor bandwidth"
    section = "C3"
    equation = "m = H(s)·ω, second-order Butterworth: H = 1/(1 + √2·s/ω0 + (s/ω0)²), ω0 = 2π·f_c"
    parameters = parameters(cutoff_hz=shape("Hz", 50.0, 5.0))
    drivers = ("angular_acceleration",)
    excitation = "a chirp from 0.1 to 0.5 of the sampling rate, reference sampled ten times faster"
    source = "PHYSICS.md C3; Butterworth 1930"
    order = 10

    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        # First-order hold, not the bilinear map: it is exact for an input linear between samples and
        # holds for cut-offs at or above half the sampling rate (50 Hz at 100 Hz), where the latter fails.
        corner = 2.0 * np.pi * p.cutoff_hz
        analog = ([corner**2], [1.0, np.sqrt(2.0) * corner, corner**2])
        discrete: Any = cont2discrete(analog, truth.dt_s, method="foh")
        b, a = np.ravel(discrete[0]), np.ravel(discrete[1])
        return lfilter(b, a, output_dps, zi=lfilter_zi(b, a) * output_dps[0])[0]


class DeadBand(OutputEffect):
    """Cross-talk of the feedback holds the loop at a false null, so that small rates do not come out."""

    id = "dead_band"
    title = "Dead band, lock near zero"
    section = "C1"
    equation = (
        "m = sign(ω)·(|ω|ⁿ − ω_Lⁿ)^(1/n) above ω_L, 0 below; n = 2 is Adler's lock-in, large n a hard zone"
    )
    parameters = parameters(lock_dps=shape("dps", 0.002, 0.1), order=shape("1", 2.0, 2.0, default=2.0))
    drivers = ("rate",)
    excitation = "a slow sweep through zero (parking creep, Earth-rate turntable)"
    source = "Adler, Proc. IRE 34 (1946) 351; PHYSICS.md C1 [S14, S15]"
    order = 20

    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        ratio = np.minimum(p.lock_dps / np.maximum(np.abs(output_dps), 1e-300), 1.0)
        return output_dps * (1.0 - ratio**p.order) ** (1.0 / p.order)


class SupplyRipple(ErrorEffect):
    """Alternator, converter or engine leak into the output; rectified, they shift the zero."""

    id = "supply_ripple"
    title = "Supply ripple and interference"
    section = "C5"
    equation = "e = A·cos(2πft + φ) + A_r, sampled, so f folds to |f − k·f_s|"
    parameters = parameters(
        amplitude_dps=amplitude("dps", 0.005, 0.05),
        frequency_hz=shape("Hz", 33.3, 103.0),
        phase_rad=shape("rad", 0.0, 0.0, default=0.0),
        rectified_dps=amplitude("dps", 0.0, 0.0, default=0.0),
    )
    drivers = ("time",)
    excitation = "standstill with the engine running at several speeds and with load steps at one speed"
    source = "PHYSICS.md C5 [K]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        phase = 2.0 * np.pi * p.frequency_hz * truth.t_s + p.phase_rad
        return p.amplitude_dps * np.cos(phase) + p.rectified_dps


class Saturation(OutputEffect):
    """Amplifier, converter or signal range ends."""

    id = "saturation"
    title = "Saturation, clipping"
    section = "C2"
    equation = "m = sign(ω)·(L − k + k·tanh((|ω| − L + k)/k)) above L − k, else ω; k = 0 clips at L"
    parameters = parameters(
        limit_dps=shape("dps", 200.0, 120.0), knee_dps=shape("dps", 0.0, 20.0, default=0.0)
    )
    drivers = ("rate",)
    excitation = "1 % of the samples or more above the knee, and levels just below it"
    source = "PHYSICS.md C2"
    order = 60

    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        knee = max(p.knee_dps, 0.0)
        if knee == 0.0:
            return np.clip(output_dps, -p.limit_dps, p.limit_dps)
        over = np.maximum(np.abs(output_dps) - (p.limit_dps - knee), 0.0)
        bent = knee * np.tanh(
            np.minimum(over, 40.0 * knee) / knee
        )  # tanh 40 is 1; a tiny knee must not overflow
        return output_dps - np.sign(output_dps) * (over - bent)


class AutoZero(OutputEffect):
    """Vehicle firmware learns its zero at every standstill, and takes slow creeping for one."""

    id = "auto_zero"
    title = "Auto-zero of the firmware"
    section = "D11"
    equation = "m = ω + zero − ẑ; ẑ = mean of the last stretch with |m − ẑ| < threshold for hold_s or longer"
    parameters = parameters(
        zero_dps=shape("dps", 0.02, 0.2),
        threshold_dps=shape("dps", 0.1, 0.3),
        hold_s=shape("s", 2.0, 2.0, default=2.0),
    )
    drivers = ("time", "rate")
    excitation = "many stops and starts at constant temperature, then a long creep below the threshold"
    source = "PHYSICS.md D11 [K]"
    order = 70

    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        raw = output_dps + p.zero_dps
        moving = truth.speed_mps > 0.2 if truth.speed_mps.size else np.zeros(raw.size, np.bool_)
        hold = max(round(p.hold_s / truth.dt_s), 1)
        return raw - learned_zero(raw, moving, p.threshold_dps + abs(p.zero_dps), hold)


@kernel
def learned_zero(raw: np.ndarray, moving: np.ndarray, threshold: float, hold: int) -> np.ndarray:
    """Return the zero that is subtracted at each sample, learned at the end of each stop, shape `(n,)`."""
    zero = np.zeros(raw.size)
    learned, total, count = 0.0, 0.0, 0
    for i in range(raw.size):
        if abs(raw[i]) < threshold and not moving[i]:
            total += raw[i]
            count += 1
        else:
            if count >= hold:
                learned = total / count
            total, count = 0.0, 0
        zero[i] = learned
    return zero


class UnitError(OutputEffect):
    """Byte order, scaling, sign or unit of the signal is read wrongly."""

    id = "unit_error"
    title = "Wrong unit, scaling or sign"
    section = "D7"
    equation = "m = factor·ω"
    parameters = parameters(factor=shape("1", np.pi / 180.0, -1.0))
    drivers = ("rate",)
    excitation = "any turning against a reference"
    source = "PHYSICS.md D7"
    order = 80

    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return output_dps * p.factor


class Quantization(OutputEffect):
    """The rate signal has a least significant bit."""

    id = "quantization"
    title = "Quantisation"
    section = "C4"
    equation = "m = q·round(ω/q); variance q²/12 where noise dithers it"
    parameters = parameters(lsb_dps=shape("dps", 0.01, 0.05))
    drivers = ("rate",)
    excitation = "slow ramps of rate"
    source = "PHYSICS.md C4 [D]; Widrow, quantisation noise"
    order = 90

    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return np.round(output_dps / p.lsb_dps) * p.lsb_dps
