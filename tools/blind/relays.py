"""Hysteresis as a population of relays (Preisach): each switches up at α and down at β, and remembers."""

import numpy as np


def preisach(drive: np.ndarray, half_width: float, spread: float, seed: int) -> np.ndarray:
    """Sum of relays with centres spread evenly over the drive's range and beyond, and scattered half-widths.

    Args:
        drive: shape (n,), the temperature in order of time.
        half_width: mean half distance between switching up and down, in units of the drive.
        spread: relative scatter (gamma distributed) of the half-widths.
        seed: of the scatter.

    Returns:
        The operator's lag behind the drive, shape (n,), in units of the drive: zero at the start, saturating at
        about ∓half_width on monotone runs. Relays start in the state that the first value leaves from neutral.
    """
    rng = np.random.default_rng(seed)
    low, high = drive.min() - 4 * half_width, drive.max() + 4 * half_width
    step = half_width / 14
    centre = np.arange(low, high, step)
    widths = rng.gamma(1 / spread**2, half_width * spread**2, 24)
    widths *= half_width / widths.mean()
    up = (centre[:, None] + widths).ravel()
    down = (centre[:, None] - widths).ravel()
    state = (np.repeat(centre, len(widths)) <= drive[0]).copy()
    count = np.empty(len(drive))
    for k, value in enumerate(drive):
        state |= value >= up
        state &= value > down
        count[k] = np.count_nonzero(state)
    return (count - count[0]) * step / len(widths) - (drive - drive[0])
