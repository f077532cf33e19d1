"""Latency per stage in bounded memory: HDR histograms, filled in compiled code and read by the library.

The thread that publishes does this beside its work, so it must be short: the times of all samples since the last call
are counted at once, in the layout of the library's histogram, and percentiles are read from it without a loop.
"""

from collections.abc import Mapping
from copy import copy
from functools import lru_cache
from typing import Any

import numpy as np

from rtcomp.jit import kernel

HIGHEST_NS = 60_000_000_000
DIGITS = 2
(FRAME, TAKEN, DONE, PUT, OUT) = range(5)
"""Columns of passages, int64 ns of shape `(n, 5)`: the kernel's time stamp of the frame, taken, corrected, about to be
put, put."""
STAGES = {"receive": (FRAME, TAKEN), "correct": (TAKEN, DONE), "publish": (DONE, OUT), "total": (FRAME, PUT)}
"""From the kernel's time stamp to the hand-over of a batch, from there to corrected, from there to put out; and the
whole way, from the kernel until it goes out. A subscriber may add `received` (`rtcomp.probe`)."""
PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


@lru_cache(maxsize=1)
def _layout() -> tuple[Any, np.ndarray]:
    """An empty histogram of the library, and the lowest value of each of its counters, shape `(counters,)`."""
    from hdrh.histogram import HdrHistogram

    histogram: Any = HdrHistogram(1, HIGHEST_NS, DIGITS)
    return histogram, np.array([histogram.get_value_from_index(k) for k in range(histogram.counts_len)])


class Timeline:
    """When samples passed each stage; to be used from one thread only."""

    def __init__(self, stages: Mapping[str, tuple[int, int]] = STAGES) -> None:
        """`stages`: by name, the columns of passages where each begins and ends."""
        self._stages, self._ends = tuple(stages), np.array(list(stages.values()))
        self._histogram, self._lowest = copy(_layout()[0]), _layout()[1]
        self._counts = np.zeros((len(stages), len(self._lowest)), np.int64)
        self.add(np.zeros((0, 1 + self._ends.max()), np.int64))  # compiles

    def add(self, passages: np.ndarray) -> None:
        """Take in passages `(n, columns)` [ns]."""
        count_latencies(passages, self._ends, self._lowest, self._counts)

    def summary_us(self) -> Mapping[str, dict[str, float] | None]:
        """Percentiles per stage [µs] of everything so far; None where there is nothing."""
        return {stage: self._percentiles_us(c) for stage, c in zip(self._stages, self._counts, strict=True)}

    def _percentiles_us(self, counts: np.ndarray) -> dict[str, float] | None:
        reached = np.cumsum(counts)
        self._histogram.total_count = int(reached[-1])
        if not reached[-1]:
            return None
        found = {}
        for name, percentile in PERCENTILES.items():
            wanted = self._histogram.get_target_count_at_percentile(percentile)
            value = self._histogram.get_value_from_index(int(np.searchsorted(reached, wanted)))
            found[name] = self._histogram.get_highest_equivalent_value(value) / 1000.0
        return found


@kernel
def count_latencies(passages, ends, lowest, counts):
    """Add every passage to the counter of each stage whose lowest value is the last not beyond the latency [ns]."""
    for row in range(passages.shape[0]):
        for stage in range(ends.shape[0]):
            latency = passages[row, ends[stage, 1]] - passages[row, ends[stage, 0]]
            low, high = 0, lowest.shape[0]
            while high - low > 1:
                middle = (low + high) // 2
                if lowest[middle] <= latency:
                    low = middle
                else:
                    high = middle
            counts[stage, low] += 1
