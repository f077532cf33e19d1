"""What a soak measures of a process from outside, and what it makes of it."""

import contextlib
import re
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

WARM_UP = 4  # one part in this many
FLAT_MB_PER_H = 5.0
ALLOCATOR_MB = 2.0  # what an allocator and a fuller queue may still take after the warm-up
RUNTIME_THREAD = re.compile(r"(app|acc|net|tx|rx)-\d+")  # zenoh's; it starts one where one is blocked …
RUNTIMES = 5  # … in any of its runtimes, and lets it go when it has been idle


class Reading(NamedTuple):
    """One look at a process."""

    t_s: float
    rss_mb: float
    uss_mb: float  # of it, what nobody shares
    descriptors: int
    threads: int  # without those of zenoh's runtimes
    runtime_threads: int
    p99_us: float


class Watched:
    """A process from outside."""

    def __init__(self, pid: int) -> None:
        import psutil

        self._process = psutil.Process(pid)
        self._started = time.monotonic()
        self.rows: list[Reading] = []

    def read(self, p99_us: float) -> None:
        """Take a row."""
        memory, names = self._process.memory_full_info(), self.thread_names()
        of_runtime = sum(count for name, count in names.items() if RUNTIME_THREAD.fullmatch(name))
        self.rows.append(
            Reading(
                time.monotonic() - self._started,
                memory.rss / 1e6,
                memory.uss / 1e6,
                self._process.num_fds(),
                sum(names.values()) - of_runtime,
                of_runtime,
                p99_us,
            )
        )

    def listens(self) -> bool:
        """Whether it can be reached over TCP."""
        return any(link.status == "LISTEN" for link in self._process.net_connections("tcp"))

    def thread_names(self) -> Counter[str]:
        """How many threads there are of each name."""
        names: Counter[str] = Counter()
        for task in Path(f"/proc/{self._process.pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError):  # it has ended meanwhile
                names[(task / "comm").read_text().strip()] += 1
        return names


def slope_per_h(t_s: np.ndarray, values: np.ndarray) -> dict[str, Any]:
    """Theil-Sen slope per hour with its 95 % interval."""
    from scipy.stats import theilslopes

    found: Any = theilslopes(values, t_s / 3600.0, 0.95)
    return {"value": float(found.slope), "ci95": [float(found.low_slope), float(found.high_slope)]}


def growth(counts: np.ndarray) -> int:
    """By how much the least of the last third is above the most of the first: 0 for whatever only comes and goes."""
    third = max(1, len(counts) // 3)
    return max(0, int(counts[-third:].min() - counts[:third].max()))


def judge(rows: list[Reading]) -> tuple[dict[str, Any], dict[str, bool]]:
    """Figures of a watched process after its warm-up, and verdicts."""
    table: Any = Reading(*np.array(rows[len(rows) // WARM_UP :]).T)  # a column in each field
    memory, is_flat = judge_memory(table.t_s, table.rss_mb)
    counts = {name: getattr(table, name) for name in ("descriptors", "threads", "runtime_threads")}
    grown = {name: growth(column) for name, column in counts.items()}
    latency, is_steady = judge_latency(table.t_s, table.p99_us)
    figures = {
        **memory,
        "uss_slope_mb_per_h": slope_per_h(table.t_s, table.uss_mb),
        **{name: [int(column.min()), int(column.max())] for name, column in counts.items()},
        "grown": grown,
        **latency,
    }
    return figures, {
        "memory is flat": is_flat,
        "descriptors do not grow": not grown["descriptors"],
        "threads do not grow": not grown["threads"] and grown["runtime_threads"] <= RUNTIMES,
        "p99 is steady": is_steady,
    }


def judge_memory(t_s: np.ndarray, rss_mb: np.ndarray) -> tuple[dict[str, Any], bool]:
    """Slope, growth from first to last tenth, and whether memory is flat.

    A long run must show it by the slope's interval. In one of minutes a single step of an allocator makes that interval
    wider than any limit: there the growth itself is judged.
    """
    slope, tenth = slope_per_h(t_s, rss_mb), max(1, len(rss_mb) // 10)
    grown_mb = float(np.median(rss_mb[-tenth:]) - np.median(rss_mb[:tenth]))
    figures = {
        "rss_mb": [float(rss_mb[0]), float(rss_mb[-1])],
        "rss_slope_mb_per_h": slope,
        "rss_grown_mb": grown_mb,
    }
    if float(np.ptp(t_s)) / 3600.0 * FLAT_MB_PER_H < ALLOCATOR_MB:
        return figures, grown_mb < ALLOCATOR_MB
    return figures, slope["ci95"][0] <= 0.0 or slope["ci95"][1] < FLAT_MB_PER_H


def judge_latency(t_s: np.ndarray, p99_us: np.ndarray) -> tuple[dict[str, Any], bool]:
    """Medians of the first and last third, slope, and whether it rises by less than the worst of the first third.

    A machine with other work to do makes it rough; only what rises, as a queue that grows makes it, is judged.
    """
    known = np.isfinite(p99_us)
    if known.sum() < 3:
        return {"p99_us": None, "p99_slope_us_per_h": None}, True
    t_s, p99_us = t_s[known], p99_us[known]
    slope, third = slope_per_h(t_s, p99_us), len(p99_us) // 3
    figures = {
        "p99_us": [float(np.median(part)) for part in (p99_us[:third], p99_us[-third:])],
        "p99_slope_us_per_h": slope,
    }
    return figures, slope["ci95"][0] * float(np.ptp(t_s)) / 3600.0 < float(p99_us[:third].max())
