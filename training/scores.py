"""Scores of an error that is left, with intervals clustered by soak or recording."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student


@dataclass(frozen=True)
class Score:
    """Of an error [°/s]: largest and smallest magnitude, standard deviation, RMS, and the 95 % interval of RMS."""

    max_dps: float
    min_dps: float
    std_dps: float
    rms_dps: float
    rms_ci95: tuple[float, float] | None
    samples: int
    clusters: int


def score(error_dps: np.ndarray, clusters: np.ndarray | None = None) -> Score:
    """Score an error, shape `(n_samples,)`; without `clusters` no interval is claimed."""
    magnitude = np.abs(error_dps)
    rms = float(np.sqrt(np.mean(error_dps**2)))
    interval = None if clusters is None else rms_interval(error_dps, clusters)
    return Score(
        float(magnitude.max()),
        float(magnitude.min()),
        float(error_dps.std()),
        rms,
        interval,
        len(error_dps),
        0 if clusters is None else len(np.unique(clusters)),
    )


def rms_interval(error_dps: np.ndarray, clusters: np.ndarray) -> tuple[float, float] | None:
    """95 % interval of the RMS [°/s] when samples of one cluster share their error; None for fewer than 2 clusters.

    The mean square is a ratio of cluster sums; its variance is linearised, Student's t has clusters − 1 degrees of
    freedom, and the interval is made on the logarithm, so that it cannot reach below 0.
    """
    index = np.unique(clusters, return_inverse=True)[1]
    count = int(index.max()) + 1
    sums, sizes = np.bincount(index, error_dps**2), np.bincount(index)
    mean = sums.sum() / sizes.sum()
    if count < 2 or mean <= 0:
        return None
    spread = (sums - mean * sizes) / sizes.sum()
    relative = np.sqrt(count / (count - 1) * np.sum(spread**2)) / mean
    half = student.ppf(0.975, count - 1) * relative / 2  # of ln RMS
    rms = np.sqrt(mean)
    return float(rms * np.exp(-half)), float(rms * np.exp(half))


def ratio_interval(better: np.ndarray, worse: np.ndarray, clusters: np.ndarray) -> tuple[float, float] | None:
    """95 % interval of RMS(worse)/RMS(better) on the same samples, clustered; None for fewer than 2 clusters."""
    index = np.unique(clusters, return_inverse=True)[1]
    count = int(index.max()) + 1
    a, b = np.bincount(index, worse**2), np.bincount(index, better**2)
    if count < 2 or a.sum() <= 0 or b.sum() <= 0:
        return None
    spread = a / a.sum() - b / b.sum()
    half = student.ppf(0.975, count - 1) * np.sqrt(count / (count - 1) * np.sum(spread**2)) / 2
    ratio = np.sqrt(a.sum() / b.sum())
    return float(ratio * np.exp(-half)), float(ratio * np.exp(half))


def median_interval(values: np.ndarray, seed: int = 0, draws: int = 2000) -> tuple[float, float]:
    """95 % bootstrap interval of the median over independent repetitions, shape `(n,)`."""
    rng = np.random.default_rng(seed)
    medians = np.median(values[rng.integers(0, len(values), (draws, len(values)))], axis=1)
    return float(np.quantile(medians, 0.025)), float(np.quantile(medians, 0.975))
