"""The paper's software filters: they act on the gyro's output over time, and know nothing of temperature or rate."""

from collections.abc import Callable

import numpy as np
import pywt
from scipy.ndimage import convolve1d
from scipy.signal import savgol_filter

WEIGHTS = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9.0
WAVELET = "db4"


def weighted_average(rate_dps: np.ndarray) -> np.ndarray:
    """Five-point average, the middle weighted most; time is the last axis."""
    return convolve1d(rate_dps, WEIGHTS, axis=-1, mode="nearest")


def five_point_cubic(rate_dps: np.ndarray) -> np.ndarray:
    """Five-point cubic smoothing: a cubic through every five samples (Savitzky-Golay); time is the last axis."""
    if rate_dps.shape[-1] < 5:
        return np.array(rate_dps)
    return np.asarray(savgol_filter(rate_dps, window_length=5, polyorder=3, axis=-1))


def wavelet(rate_dps: np.ndarray) -> np.ndarray:
    """Soft threshold σ√(2 ln n) on the details, σ from the median of the finest; time is the last axis."""
    n = rate_dps.shape[-1]
    levels = min(5, pywt.dwt_max_level(n, WAVELET))
    if levels < 1:
        return np.array(rate_dps)
    approximation, *details = pywt.wavedec(rate_dps, WAVELET, level=levels, axis=-1)
    sigma = np.median(np.abs(details[-1]), axis=-1, keepdims=True) / 0.6745
    threshold = np.maximum(sigma * np.sqrt(2 * np.log(n)), np.finfo(float).tiny)
    kept = [np.sign(d) * np.maximum(np.abs(d) - threshold, 0.0) for d in details]
    return pywt.waverec([approximation, *kept], WAVELET, axis=-1)[..., :n]


FILTERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "weighted_average": weighted_average,
    "five_point_cubic": five_point_cubic,
    "wavelet": wavelet,
}
"""Filter by method name: rates in [°/s], filtered rates out, same shape."""
