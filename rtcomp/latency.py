"""Latency per stage, in bounded memory: samples are gathered in arrays and folded into HDR histograms once a second."""

from typing import Any

import numpy as np

HIGHEST_NS = 60_000_000_000
DIGITS = 3
STAGES = ("receive", "correct", "publish", "total")
"""From the kernel's time stamp to the hand-over of a batch, from there to corrected, from there to put out; and the
whole way, from the kernel until it goes out. A subscriber may add `received` (`rtcomp.probe`)."""
PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


class Stage:
    """Latencies of one stage [ns]; `add` from one thread only."""

    def __init__(self, room: int = 16384) -> None:
        from hdrh.histogram import HdrHistogram

        self._histogram: Any = HdrHistogram(1, HIGHEST_NS, DIGITS)
        self._buffer = np.zeros(room, np.int64)
        self._used = 0

    def add(self, latencies_ns: np.ndarray) -> None:
        """Take in latencies [ns]."""
        for start in range(0, len(latencies_ns), len(self._buffer)):
            part = latencies_ns[start : start + len(self._buffer)]
            if self._used + len(part) > len(self._buffer):
                self.fold()
            self._buffer[self._used : self._used + len(part)] = part
            self._used += len(part)

    def fold(self) -> None:
        """Move what was gathered into the histogram; equal microseconds count as one value."""
        kept = np.clip(self._buffer[: self._used] // 1000 * 1000, 1, HIGHEST_NS)
        for value, count in zip(*np.unique(kept, return_counts=True), strict=True):
            self._histogram.record_value(int(value), int(count))
        self._used = 0

    def summary_us(self) -> dict[str, float] | None:
        """Percentiles [µs] of everything so far; None when there is nothing."""
        self.fold()
        if not self._histogram.get_total_count():
            return None
        return {name: self._histogram.get_value_at_percentile(p) / 1000.0 for name, p in PERCENTILES.items()}
