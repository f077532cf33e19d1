"""The true rate as regressors need it: the reference with its own noise taken out, movable in time.

A reference's white noise ν is in the residual as −ν.  A regressor made of the raw reference would find itself there
and name a bandwidth or a dead band that does not exist.  In the uppermost quarter of the spectrum motion is over:
what the residual shares with the reference there (covariance −σ²) measures ν, and a Wiener filter removes it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import interpolate, ndimage

from training.diagnose.spectrum import band_edges
from training.diagnose.work import FloatArray, dct, inverse_dct

TOP_SHARE = 0.5
MIN_NOISY = 0.25
LARGEST = 4.0


@dataclass(frozen=True)
class Reference:
    """Smoothed true rate [dps] on the recording's rows, a spline through it, and its white noise [dps].

    `noise_dps` is the deviation per sample as recorded, `left_dps` what the smoothing leaves of it.
    """

    rate: FloatArray
    noise_dps: float
    left_dps: float
    gain: FloatArray
    spline: interpolate.CubicSpline

    def moved(self, t: FloatArray, delay_s: FloatArray | float) -> FloatArray:
        """The rate as a channel that is late by `delay_s` shows it, ω(t − τ)."""
        return self.spline(np.clip(t - delay_s, t[0], t[-1]))


def reference(t: FloatArray, ref: FloatArray, residual: FloatArray) -> Reference:
    """Smooth a reference `(n,)` on times `(n,)` by what the residual `(n,)` says of its noise."""
    noise = _shared_noise(ref, residual)
    rate, gain = _wiener(ref, noise) if noise > 0.0 else (ref, np.ones(len(ref)))
    left = float(np.sqrt(noise * np.mean(gain**2)))
    return Reference(rate, float(np.sqrt(noise)), left, gain, interpolate.CubicSpline(t, rate))


def unbiased(ref: Reference, moved: FloatArray, residual: FloatArray) -> tuple[FloatArray, float]:
    """The moved true rate with the reference's noise estimated from the residual, and the deviation that is left.

    The residual is n − ν (gyro noise less reference noise).  Wiener's estimate of ν from it, filtered by
    S_ν/S_residual at every frequency, leaves a rate whose error is uncorrelated with the residual: regressors made
    of it cannot find the reference's noise in the residual.  The estimate is bounded, so that a large effect stays.
    """
    if ref.noise_dps <= 0.0:
        return moved, 0.0
    design = np.stack([np.ones(len(moved)), moved], axis=1)
    left = residual - design @ np.linalg.lstsq(design, residual, rcond=None)[0]
    spectrum = dct(left)
    edges = band_edges(len(left))
    power = np.repeat(np.add.reduceat(spectrum**2, edges[:-1]) / np.diff(edges), np.diff(edges))
    share = np.minimum(ref.noise_dps**2 / np.maximum(power, 1e-300), 1.2)
    estimate = np.clip(
        inverse_dct(spectrum * share * ref.gain), -LARGEST * ref.noise_dps, LARGEST * ref.noise_dps
    )
    return moved + estimate, ref.left_dps


def _shared_noise(ref: FloatArray, residual: FloatArray) -> float:
    """Variance of white noise per sample that the reference has and the residual mirrors; 0 where there is none."""
    if np.ptp(ref) == 0.0 or len(ref) < 200:
        return 0.0
    first = int((1.0 - TOP_SHARE) * len(ref))
    a = dct(ref)[first:]
    b = dct(residual)[first:]
    variance = float(np.mean(a * a))
    shared = -float(np.mean(a * b))
    sigma = np.sqrt(variance * float(np.mean(b * b)) / len(a))
    return shared if variance > 0.0 and shared > MIN_NOISY * variance and shared > 4.0 * sigma else 0.0


def _wiener(ref: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """(smoothed reference, gain of the filter per DCT coefficient)."""
    line = np.linspace(ref[0], ref[-1], len(ref))
    spectrum = dct(ref - line)
    width = max(5, len(ref) // 2000)
    power = ndimage.uniform_filter1d(spectrum**2, width, mode="nearest")
    gain = np.clip(1.0 - 1.5 * noise / np.maximum(power, 1e-300), 0.0, 1.0)
    return line + inverse_dct(spectrum * gain), gain
