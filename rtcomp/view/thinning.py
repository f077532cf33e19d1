"""Bounded numbers of rows: peaks survive in what is thinned, and the whole past fits into a fixed room."""

import numpy as np


def thin(values: np.ndarray, rows: int) -> np.ndarray:
    """Indices of at most `rows` samples that keep the extremes: the lowest and highest of equal pieces."""
    n = len(values)
    if n <= rows:
        return np.arange(n)
    pieces = max(rows // 2, 1)
    length = -(-n // pieces)
    padded = np.full(pieces * length, np.nan)
    padded[:n] = values
    table = padded.reshape(pieces, length)
    kept = table[~np.isnan(table).all(axis=1)]
    start = np.flatnonzero(~np.isnan(table).all(axis=1)) * length
    return np.unique(np.concatenate([start + np.nanargmin(kept, axis=1), start + np.nanargmax(kept, axis=1)]))


class History:
    """Sums per interval over the whole past, in a fixed number of rows: when they are full, neighbours are merged.

    Call `add` with every batch in order of time; `rows` is all there is. Settings: `room` rows, first interval [s].
    """

    def __init__(self, series: int, room: int = 2048, interval_s: float = 1.0) -> None:
        self.interval_ns = round(interval_s * 1e9)
        self._t = np.zeros(room, np.int64)
        self._sums = np.zeros((room, series))
        self._counts = np.zeros((room, series))
        self._used = 0

    def add(self, t_ns: np.ndarray, values: np.ndarray) -> None:
        """Take in `values` `(rows, series)` at `t_ns` `(rows,)`; NaN counts as absent."""
        slots = t_ns // self.interval_ns * self.interval_ns
        starts = np.flatnonzero(np.diff(slots, prepend=slots[:1] - 1))
        sums = np.add.reduceat(np.nan_to_num(values), starts, axis=0)
        counts = np.add.reduceat(np.isfinite(values).astype(float), starts, axis=0)
        for t, total, count in zip(slots[starts], sums, counts, strict=True):
            self._add(int(t), total, count)

    def _add(self, t_ns: int, total: np.ndarray, count: np.ndarray) -> None:
        if not self._used or self._t[self._used - 1] != t_ns:
            if self._used == len(self._t):
                self._merge()
                t_ns = t_ns // self.interval_ns * self.interval_ns
                if self._t[self._used - 1] == t_ns:
                    self._used -= 1
            self._t[self._used] = t_ns
            self._used += 1
        self._sums[self._used - 1] += total
        self._counts[self._used - 1] += count

    def _merge(self) -> None:
        """Double the interval and add up what falls together."""
        self.interval_ns *= 2
        slots = self._t // self.interval_ns * self.interval_ns
        starts = np.flatnonzero(np.diff(slots, prepend=slots[:1] - 1))
        used = len(starts)
        for table in (self._sums, self._counts):
            table[:used] = np.add.reduceat(table, starts, axis=0)
            table[used:] = 0.0
        self._t[:used] = slots[starts]
        self._used = used

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Times `(rows,)` [ns] and means `(rows, series)`; NaN where an interval has none."""
        used = self._used
        means = np.full((used, self._sums.shape[1]), np.nan)
        np.divide(self._sums[:used], self._counts[:used], out=means, where=self._counts[:used] > 0)
        return self._t[:used].copy(), means
