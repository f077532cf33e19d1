"""The working view of one recording: block means at a slow rate, and the orthogonal transform that whitens it.

Slow physics needs no 100 Hz: measured rate, simulation and every regressor are averaged over the same blocks, the
regressors after they were computed at full rate where they are not linear in the rate.  Block means of a linear
model are a linear model of block means, so nothing is lost but the noise above the working rate.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from training.diagnose.spectrum import band_edges, band_frequencies, shapes

FloatArray = NDArray[np.float64]


def dct(values: FloatArray) -> FloatArray:
    """Orthonormal DCT-II down the first axis."""
    return np.asarray(fft.dct(values, type=2, axis=0, norm="ortho"))


def inverse_dct(values: FloatArray) -> FloatArray:
    """Inverse of `dct`."""
    return np.asarray(fft.idct(values, type=2, axis=0, norm="ortho"))


@dataclass
class Work:
    """One recording ready for regression; arrays have shape `(n,)`, one value per block or soaked point.

    `t` [s] since power-on (row number for points), `y` [dps] measured − simulated, `w` [dps] true rate, `temp` and
    `slow_temp` [degC] smoothed enough for the temperature's value and for its slope, `spread` noise scale per block (1
    where the noise is the same everywhere).  `elsewhere`, where the simulation is a surface over temperature and rate,
    gives its error at other temperatures `(n,)` less that at `temp`, per ppm/K of its slope.
    """

    name: str
    t: FloatArray
    y: FloatArray
    w: FloatArray
    temp: FloatArray
    slow_temp: FloatArray
    step_s: float
    points: bool
    power_on_known: bool
    average: Callable[[FloatArray], FloatArray]
    full: dict[str, FloatArray]
    keep: NDArray[np.bool_]
    extra: dict[str, FloatArray] = field(default_factory=dict)
    spread: FloatArray = field(default_factory=lambda: np.ones(1))
    clusters: NDArray[np.int64] | None = None
    index: int = 0
    rate_noise_dps: float = 0.0
    elsewhere: Callable[[FloatArray], FloatArray] | None = None

    def __len__(self) -> int:
        return len(self.y)

    def per_block(self, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Block means of a function of the full-rate true rate."""
        return self.average(function(self.full["w"]))

    def transform(self, columns: NDArray[Any]) -> NDArray[Any]:
        """Orthonormal transform of columns `(n, k)` in which the noise is independent from row to row."""
        weighted = columns / self.spread.reshape(-1, 1).astype(columns.dtype)
        if self.points:
            return _soak_rotation(weighted, self.w, self._labels())
        return dct(weighted)

    def _labels(self) -> NDArray[np.int64]:
        return self.clusters if self.clusters is not None else np.zeros(len(self), dtype=np.int64)

    def bands(self) -> NDArray[np.int64]:
        """Edges of the bands of rows that share one noise variance."""
        if not self.points:
            return band_edges(len(self))
        soaks = int(self._labels().max()) + 1
        return np.asarray([0, soaks, 2 * soaks, len(self)], dtype=np.int64)

    def noise_shapes(self) -> FloatArray:
        """φ_j per band; for points: reading noise, common scale error of a soak, common bias of a soak."""
        edges = self.bands()
        if not self.points:
            return shapes(band_frequencies(edges, len(self)), len(self))
        phi = np.zeros((len(shapes(np.ones(1), 2)), 3))
        phi[0], phi[1, 0], phi[2, 1] = 1.0, 1.0, 1.0
        return phi


def _soak_rotation(columns: FloatArray, w: FloatArray, labels: NDArray[np.int64]) -> FloatArray:
    """Rotate every soak so that rows 0..s−1 carry its common scale error, s..2s−1 its common bias, the rest neither."""
    soaks = int(labels.max()) + 1
    scale_rows, bias_rows, rest = [], [], []
    for soak in range(soaks):
        members = np.flatnonzero(labels == soak)
        plane = np.stack([w[members], np.ones(len(members))], axis=1)
        basis, _ = np.linalg.qr(np.concatenate([plane, np.eye(len(members))], axis=1)[:, : len(members) + 2])
        turned = basis.T @ columns[members]
        scale_rows.append(turned[0])
        bias_rows.append(turned[1])
        rest.append(turned[2:])
    return np.concatenate([np.stack(scale_rows), np.stack(bias_rows), *rest])


def block_average(
    labels: NDArray[np.int64], valid: NDArray[np.bool_], blocks: int
) -> Callable[[FloatArray], FloatArray]:
    """A function giving the mean over the valid samples of every block (`labels` (n_full,) are block numbers)."""
    keep = np.flatnonzero(valid)
    kept = labels[keep]
    counts = np.bincount(kept, minlength=blocks).astype(float)
    counts[counts == 0] = np.nan
    ordered = bool(np.all(np.diff(kept) >= 0))
    starts = np.flatnonzero(np.diff(kept, prepend=-1)) if ordered else np.empty(0, dtype=np.int64)

    def mean(values: FloatArray) -> FloatArray:
        if not ordered:
            return np.bincount(kept, weights=values[keep], minlength=blocks) / counts
        sums = np.full(blocks, np.nan)
        sums[kept[starts]] = np.add.reduceat(values[keep], starts)
        return sums / counts

    return mean


def smooth(values: FloatArray, step_s: float, width_s: float) -> FloatArray:
    """Zero-phase Gaussian smoothing that keeps a straight line straight at both ends."""
    sigma = width_s / step_s
    if sigma < 0.3 or len(values) < 5:
        return values
    line = np.linspace(values[0], values[-1], len(values))
    return line + ndimage.gaussian_filter1d(values - line, sigma, mode="nearest")
