"""The true rate as regressors need it: the reference with its own noise taken out, movable in time.

A reference's white noise ν is in the residual as −ν.  A regressor made of the raw reference would find itself there
and name a bandwidth or a dead band that does not exist.  In the uppermost quarter of the spectrum motion is over:
what the residual shares with the reference there (covariance −σ²) measures ν, and a Wiener filter removes it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft, interpolate, ndimage

from training.diagnose.work import FloatArray

TOP_SHARE = 0.5
MIN_NOISY = 0.25


@dataclass(frozen=True)
class Reference:
    """Smoothed true rate [dps] on the recording's rows, a spline through it, and its white noise [dps].

    `noise_dps` is the deviation per sample as recorded, `left_dps` what the smoothing leaves of it.
    """

    rate: FloatArray
    noise_dps: float
    left_dps: float
    spline: interpolate.CubicSpline

    def moved(self, t: FloatArray, delay_s: FloatArray | float) -> FloatArray:
        """The rate as a channel that is late by `delay_s` shows it, ω(t − τ)."""
        return self.spline(np.clip(t - delay_s, t[0], t[-1]))


def reference(t: FloatArray, ref: FloatArray, residual: FloatArray) -> Reference:
    """Smooth a reference `(n,)` on times `(n,)` by what the residual `(n,)` says of its noise."""
    noise = _shared_noise(ref, residual)
    rate, passed = _wiener(ref, noise) if noise > 0.0 else (ref, 1.0)
    return Reference(rate, float(np.sqrt(noise)), float(np.sqrt(noise * passed)), interpolate.CubicSpline(t, rate))


def _shared_noise(ref: FloatArray, residual: FloatArray) -> float:
    """Variance of white noise per sample that the reference has and the residual mirrors; 0 where there is none."""
    if np.ptp(ref) == 0.0 or len(ref) < 200:
        return 0.0
    first = int((1.0 - TOP_SHARE) * len(ref))
    a = fft.dct(ref, norm="ortho")[first:]
    b = fft.dct(residual, norm="ortho")[first:]
    variance = float(np.mean(a * a))
    shared = -float(np.mean(a * b))
    sigma = np.sqrt(variance * float(np.mean(b * b)) / len(a))
    return shared if variance > 0.0 and shared > MIN_NOISY * variance and shared > 4.0 * sigma else 0.0


def _wiener(ref: FloatArray, noise: float) -> tuple[FloatArray, float]:
    """(smoothed reference, share of the white noise's power that is left)."""
    line = np.linspace(ref[0], ref[-1], len(ref))
    spectrum = fft.dct(ref - line, norm="ortho")
    width = max(5, len(ref) // 2000)
    power = ndimage.uniform_filter1d(spectrum**2, width, mode="nearest")
    gain = np.clip(1.0 - 1.5 * noise / np.maximum(power, 1e-300), 0.0, 1.0)
    return line + fft.idct(spectrum * gain, norm="ortho"), float(np.mean(gain**2))
