"""Mean errors per cell of temperature and rate, gathered while samples stream by, in fixed room."""

import numpy as np

from rtcomp.view.scene import Box
from rtcomp.view.surface import Grid

CELLS = 32


class Cells:
    """Sums per cell over a box; state `(CELLS, CELLS, 2)`: before and after compensation. `add` in any order."""

    def __init__(self, box: Box) -> None:
        self.box = box
        self._edges = [np.linspace(*limits, CELLS + 1) for limits in (box.temp_degC, box.rate_dps)]
        self._sums = np.zeros((2, CELLS, CELLS))
        self._counts = np.zeros((CELLS, CELLS))

    def add(self, temp_degC: np.ndarray, rate_dps: np.ndarray, errors_dps: np.ndarray) -> None:
        """Take in errors `(n, 2)` [°/s] at temperatures and rates `(n,)`; rows with a NaN or outside are left out."""
        points = np.stack([temp_degC, rate_dps], axis=-1)
        known = np.isfinite(errors_dps).all(axis=1) & np.isfinite(points).all(axis=1)
        for k in range(2):
            self._sums[k] += np.histogramdd(points[known], self._edges, weights=errors_dps[known, k])[0]
        self._counts += np.histogramdd(points[known], self._edges)[0]

    def __len__(self) -> int:
        """Number of cells seen."""
        return int(np.count_nonzero(self._counts))

    def means(self) -> tuple[Grid, Grid]:
        """Mean errors before and after, NaN where nothing was seen; axes are the cells' centres."""
        temp, rate = [(edges[1:] + edges[:-1]) / 2.0 for edges in self._edges]
        means = np.full(self._sums.shape, np.nan)
        np.divide(self._sums, self._counts, out=means, where=self._counts > 0)
        return Grid(temp, rate, means[0]), Grid(temp, rate, means[1])
