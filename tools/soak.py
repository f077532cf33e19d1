"""Long runs under load: `python -m tools.soak --minutes 60 --json`.

`rtcomp run` in a process of its own takes a full bus with temperature ramps for as long as it is told, while
subscribers come and go over TCP and models, good and broken, are put to the swap key, all from this process
(`tools.soak_load`). Judged of the run's process, after a warm-up of a quarter: its memory (robust slope with its 95 %
interval), its file descriptors and threads, the latency's p99 over time, and whether every frame sent is a sample or
counted as lost. Frames are simulated, seed 7. They go over a datagram socket of this machine that carries struct
can_frame (`tools.soak_run`), or with `--bus socketcan:vcan0` over a real bus.
"""

import contextlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from rtcomp.model import save_model
from tools.faults.runs import peer_config, wait_for
from tools.faults.trace import make_model
from tools.soak_load import PARTS, Load, datagram_pair, free_endpoint

WINDOWS = 60
WARM_UP = 4  # one part in this many
START_S = 300.0  # a first start compiles, perhaps on a busy machine
FLAT_MB_PER_H = 5.0
ALLOCATOR_MB = (
    2.0  # what an allocator may still take by itself after the warm-up; a short run resolves no less
)
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
    memory = slope_per_h(table.t_s, table.rss_mb)
    limit = max(FLAT_MB_PER_H, ALLOCATOR_MB * 3600.0 / float(np.ptp(table.t_s)))
    counts = {name: getattr(table, name) for name in ("descriptors", "threads", "runtime_threads")}
    grown = {name: growth(column) for name, column in counts.items()}
    latency, is_steady = judge_latency(table.t_s, table.p99_us)
    figures = {
        "rss_mb": [float(table.rss_mb[0]), float(table.rss_mb[-1])],
        "rss_slope_mb_per_h": memory,
        "rss_slope_limit_mb_per_h": limit,
        "uss_slope_mb_per_h": slope_per_h(table.t_s, table.uss_mb),
        **{name: [int(column.min()), int(column.max())] for name, column in counts.items()},
        "grown": grown,
        **latency,
    }
    return figures, {
        "memory is flat": memory["ci95"][0] <= 0.0 or memory["ci95"][1] < limit,
        "descriptors do not grow": not grown["descriptors"],
        "threads do not grow": not grown["threads"] and grown["runtime_threads"] <= RUNTIMES,
        "p99 is steady": is_steady,
    }


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


@contextlib.contextmanager
def running(folder: Path, endpoint: str, bus: str | None) -> Iterator[tuple[Any, Any]]:
    """The run's process and where its frames go to; killed if it is still there at the end."""
    save_model(make_model(), folder / "model.json")
    (folder / "run.json5").write_text(json.dumps(peer_config({"listen": {"endpoints": [endpoint]}})))
    options = ["--model", str(folder / "model.json"), "--state", str(folder / "state.json"), "--allow-swap",
               "--zenoh", str(folder / "run.json5"), "--json"]  # fmt: skip
    with contextlib.ExitStack() as stack:
        descriptors: list[int] = []
        if bus is None:
            theirs, ours = (stack.enter_context(end) for end in datagram_pair())
            descriptors = [theirs.fileno()]
            command = ["tools.soak_run", str(theirs.fileno()), *options]
        else:
            from rtcomp.sources.bus import open_can

            ours = stack.enter_context(open_can(bus))
            command = ["rtcomp", "run", "--bus", bus, *options]
        said = stack.enter_context((folder / "said.txt").open("w"))
        process = subprocess.Popen(
            [sys.executable, "-m", *command],
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            pass_fds=descriptors,
        )
        try:
            yield process, ours
        finally:
            process.kill()
            process.communicate()


def soak(
    seconds: float, rate_hz: int, bus: str | None = None, parts: tuple[str, ...] = PARTS
) -> dict[str, Any]:
    """One soak: figures and verdicts."""
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory(prefix="rtcomp-soak-") as name:
        folder = Path(name)
        with running(folder, endpoint, bus) as (process, ours):
            watched = Watched(process.pid)
            if (
                not wait_for(lambda: process.poll() is not None or watched.listens(), START_S)
                or process.poll()
            ):
                raise click.ClickException(
                    f"the run did not come up: {(folder / 'said.txt').read_text()[-500:]}"
                )
            load = Load(folder, ours, endpoint, rate_hz, parts)
            load.start()
            watch(watched, load, seconds)
            threads = watched.thread_names()
            load.finish()
            process.send_signal(signal.SIGTERM)
            out, _ = process.communicate(timeout=60)
            load.close()
    summary = json.loads(out.splitlines()[-1])
    figures, verdicts = judge(watched.rows)
    counted, complete = account(load, summary)
    return {
        "seconds": seconds,
        "status": process.returncode,
        **counted,
        **figures,
        "thread_names": threads,
        "verdicts": verdicts | complete | {"it ends well": process.returncode == 0},
        "rows": [list(row) for row in watched.rows],
    }


def watch(watched: Watched, load: Load, seconds: float) -> None:
    """Take a row at the end of every window; the warm-up is lived through in a hurry."""
    started = time.monotonic()
    for window in range(1, WINDOWS + 1):
        if window > WINDOWS // WARM_UP:
            load.pace = 1.0
        time.sleep(max(0.0, started + seconds * window / WINDOWS - time.monotonic()))
        watched.read(load.listener.p99_us())


def account(load: Load, summary: dict[str, Any]) -> tuple[dict[str, Any], dict[str, bool]]:
    """What was sent and what became of it."""
    listener = load.listener
    uncounted = {
        "frames": load.sent - summary["frames"] - summary["losses"]["receiver"],
        "samples": summary["samples"] - summary["published"] - summary["losses"]["queue"],
        "received": summary["published"] - listener.received - listener.gaps,
    }
    figures = {
        "sent": load.sent,
        "frames": summary["frames"],
        "samples": summary["samples"],
        "received": listener.received,
        "losses": summary["losses"] | {"transport": listener.gaps},
        "uncounted": uncounted,
        "swaps": summary["swaps"],
        "visitors": load.visitors,
        "states_written": summary["state"]["written"],
    }
    return figures, {
        "every loss is counted": not any(uncounted.values()),
        "every swap is counted": summary["swaps"] == load.swaps,
    }


@click.command()
@click.option("--minutes", default=60.0, show_default=True, help="How long.")
@click.option("--rate-hz", default=9000, show_default=True, help="Rate frames per second.")
@click.option(
    "--bus", help="python-can interface and channel to go over.  [default: a socket of this machine]"
)
@click.option("--without", multiple=True, type=click.Choice(PARTS), help="Leave a part of the load out.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def main(minutes: float, rate_hz: int, bus: str | None, without: tuple[str, ...], as_json: bool) -> None:
    """Soak; exit status 1 when a verdict is negative."""
    from rich.console import Console

    report = soak(minutes * 60.0, rate_hz, bus, tuple(part for part in PARTS if part not in without))
    if as_json:
        click.echo(json.dumps(report))
    else:
        Console(highlight=False).print_json(
            data={key: value for key, value in report.items() if key != "rows"}
        )
    sys.exit(not all(report["verdicts"].values()))


if __name__ == "__main__":
    main()
