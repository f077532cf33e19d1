"""Latency per stage in bounded memory: times are gathered, folded into HDR histograms a few times a second.

The thread that publishes does this beside its work, so every piece of it is short: noting a batch copies nothing,
folding takes one stage in turn, and percentiles are read from the histogram's counts without a loop.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

HIGHEST_NS = 60_000_000_000
DIGITS = 2
MANTISSA_BITS = 8  # values alike in these are one value to a histogram of two decimal digits
STAGES = ("receive", "correct", "publish", "total")
"""From the kernel's time stamp to the hand-over of a batch, from there to corrected, from there to put out; and the
whole way, from the kernel until it goes out. A subscriber may add `received` (`rtcomp.probe`)."""
PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


class Stage:
    """Latencies of one stage [ns]; `add` from one thread only."""

    def __init__(self, room: int = 16384) -> None:
        from hdrh.histogram import HdrHistogram

        self._histogram: Any = HdrHistogram(1, HIGHEST_NS, DIGITS)
        self._counts = np.ctypeslib.as_array(self._histogram.counts)
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
        """Move what was gathered into the histogram."""
        kept = np.clip(self._buffer[: self._used], 1, HIGHEST_NS)
        shift = np.maximum(np.frexp(kept.astype(np.float64))[1] - MANTISSA_BITS, 0)
        for value, count in zip(*np.unique(kept >> shift << shift, return_counts=True), strict=True):
            self._histogram.record_value(int(value), int(count))
        self._used = 0

    def summary_us(self) -> dict[str, float] | None:
        """Percentiles [µs] of everything folded so far; None when there is nothing."""
        if not self._histogram.get_total_count():
            return None
        reached = np.cumsum(self._counts)
        found = {}
        for name, percentile in PERCENTILES.items():
            index = int(np.searchsorted(reached, self._histogram.get_target_count_at_percentile(percentile)))
            value = self._histogram.get_value_from_index(index)
            found[name] = self._histogram.get_highest_equivalent_value(value) / 1000.0
        return found


class Passage(NamedTuple):
    """When the samples of one batch, `(n,)`, passed: their frames, taken, corrected [ns]; they went out between two."""

    t_ns: np.ndarray
    t_received_ns: np.ndarray
    t_corrected_ns: np.ndarray
    t_put_ns: int
    t_out_ns: int


class Timeline:
    """When samples passed each stage [ns]; to be used from one thread only."""

    def __init__(self) -> None:
        self.stages = {name: Stage() for name in STAGES}
        self._noted: list[Passage] = []
        self._next = 0

    def note(self, passage: Passage) -> None:
        """One batch went out; its arrays are not copied, they have to stay as they are until `spread`."""
        self._noted.append(passage)

    def spread(self) -> None:
        """Give the stages what was noted."""
        if not self._noted:
            return
        frames, takens, correcteds, puts, outs = zip(*self._noted, strict=True)
        frame, taken, corrected = np.concatenate(frames), np.concatenate(takens), np.concatenate(correcteds)
        sizes = [len(t_ns) for t_ns in frames]
        self.stages["receive"].add(taken - frame)
        self.stages["correct"].add(corrected - taken)
        self.stages["publish"].add(np.repeat(outs, sizes) - corrected)
        self.stages["total"].add(np.repeat(puts, sizes) - frame)
        self._noted.clear()

    def turn(self) -> None:
        """Fold one stage, the next in turn, so that no sample waits for all of them."""
        self.stages[STAGES[self._next]].fold()
        self._next = (self._next + 1) % len(STAGES)

    def fold(self) -> None:
        """Fold everything."""
        self.spread()
        for stage in self.stages.values():
            stage.fold()

    def summary_us(self) -> Mapping[str, dict[str, float] | None]:
        """Percentiles per stage [µs] of everything folded so far."""
        return {name: stage.summary_us() for name, stage in self.stages.items()}
