"""What a prediction is worth: residual standard deviation per region from held-out groups, and its coverage."""

from collections.abc import Callable

import numpy as np
from scipy.stats import t as student

from rtcomp.model import ResidualTable
from training.ts import fold_of_groups

SUM_TEMPERATURE = 3  # regions over temperature
SUM_RATE = 3  # regions over |rate|; both signs share one figure
FEWEST = 20  # samples a region needs for a figure of its own
NOMINAL = 1.959963984540054  # half width of a 95 % interval, in σ


def held_out_residuals(
    groups: np.ndarray, train_and_predict: Callable[[np.ndarray, np.ndarray], np.ndarray], error: np.ndarray
) -> np.ndarray:
    """Residual [°/s] of every row under a model trained without its group.

    `train_and_predict(train, test)` takes two masks `(n_samples,)` and returns predictions for the test rows.
    Raises RequestError for a single group.
    """
    fold = fold_of_groups(groups, 10, 0)
    left = np.empty(len(error))
    for k in np.unique(fold):
        test = fold == k
        left[test] = error[test] - train_and_predict(~test, test)
    return left


def residual_table(
    temp_degC: np.ndarray, rate_dps: np.ndarray, left_dps: np.ndarray, groups: np.ndarray
) -> ResidualTable:
    """Standard deviation [°/s] per region of temperature and |rate|, from held-out residuals `(n_samples,)`.

    Few groups make the figure itself uncertain: it is widened so that 1.96 of it is the 95 % point of Student's t
    with groups − 1 degrees of freedom. A region with fewer than FEWEST samples takes the figure of the whole.
    """
    temp_edges = _edges(temp_degC, SUM_TEMPERATURE)
    half = _edges(np.abs(rate_dps), SUM_RATE)[1:]
    rate_edges = np.concatenate([-half[::-1], [0.0], half])
    row = np.clip(np.searchsorted(temp_edges, temp_degC, "right") - 1, 0, len(temp_edges) - 2)
    band = np.clip(np.searchsorted(half, np.abs(rate_dps), "left"), 0, len(half) - 1)
    whole = _spread(left_dps, groups)
    std = np.full((len(temp_edges) - 1, len(half)), whole)
    for i in range(std.shape[0]):
        for j in range(std.shape[1]):
            inside = (row == i) & (band == j)
            if inside.sum() >= FEWEST:
                std[i, j] = _spread(left_dps[inside], groups[inside], len(np.unique(groups)))
    both = np.hstack([std[:, ::-1], std])
    return ResidualTable(temp_degC=temp_edges.tolist(), rate_dps=rate_edges.tolist(), std_dps=both.tolist())


def _edges(values: np.ndarray, parts: int) -> np.ndarray:
    """Rising edges of equally filled parts; fewer where the values do not differ enough."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, parts + 1)))
    return edges if len(edges) > 1 else np.array([edges[0] - 0.5, edges[0] + 0.5])


def _spread(left: np.ndarray, groups: np.ndarray, count: int | None = None) -> float:
    count = count or len(np.unique(groups))
    widen = student.ppf(0.975, max(count - 1, 1)) / NOMINAL
    return float(np.sqrt(np.mean(left**2)) * widen)


def coverage(left_dps: np.ndarray, sigma_dps: np.ndarray) -> float:
    """Share of residuals within 1.96 of the stated σ; 0.95 is nominal."""
    return float(np.mean(np.abs(left_dps) <= NOMINAL * sigma_dps))
