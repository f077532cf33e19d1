"""Reading logs: ours beside python-can's in one run. `python -m tools.bench_logs --json`.

Candump by our array reader against `can.CanutilsLogReader`, on the real drive where it is at hand (else on a
generated log); the other formats by `read_log` against python-can's reader alone. Rounds are interleaved, so
that what else the machine does falls on both; the ratios are medians over rounds. Every frame is compared.
"""

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import FRAME
from rtcomp.sources.candump import read_candump, write_candump
from rtcomp.sources.logs import read_log
from rtcomp.sources.messages import to_frames, to_message

DRIVE = Path(__file__).resolve().parent.parent / "../shared/recordings/css_vw_drive.log.gz"
FORMATS = (".asc", ".blf", ".trc", ".csv", ".db", ".mf4", ".asc.gz")
SLOW_FORMATS = (".mf4", ".db")  # written by python-can frame by frame at its own pace
SEED = 20240607


def generated_frames(count: int) -> NDArray[Any]:
    """Classical frames of a busy bus, seeded."""
    rng = np.random.default_rng(SEED)
    frames = np.zeros(count, FRAME)
    frames["t_ns"] = 1_700_000_000 * 10**9 + np.cumsum(rng.integers(120_000, 2_000_000, count)) // 1000 * 1000
    frames["can_id"] = rng.integers(0, 0x7FF, count)
    frames["length"] = 8
    frames["data"][:, :8] = rng.integers(0, 256, (count, 8))
    return frames


def seconds(work: Callable[[], Iterable[Any]]) -> float:
    """CPU seconds that consuming an iterable takes (readers neither wait nor use threads)."""
    start = time.process_time()
    for _ in work():
        pass
    return time.process_time() - start


def compare(
    peer: Callable[[], Iterable[Any]], ours: Callable[[], Iterable[Any]], rounds: int
) -> dict[str, float]:
    """Interleaved rounds: medians of both, and the median of the rounds' ratios."""
    times = [(seconds(peer), seconds(ours)) for _ in range(rounds)]
    return {
        "python_can_s": round(statistics.median(a for a, _ in times), 4),
        "ours_s": round(statistics.median(b for _, b in times), 4),
        "peer_over_ours": round(statistics.median(a / b for a, b in times), 3),
        "ours_over_peer": round(statistics.median(b / a for a, b in times), 3),
    }


def equal_frames(path: Path) -> tuple[int, bool]:
    """How many frames we read, and whether all equal python-can's (times to its float's 1 µs)."""
    messages = iter(can.LogReader(path))
    count, equal = 0, True
    for frames in read_log(path):
        peers = to_frames([next(messages) for _ in range(len(frames))])
        same = all(
            np.array_equal(frames[name], peers[name]) for name in ("can_id", "flags", "length", "data")
        )
        start = frames["t_ns"][0] - peers["t_ns"][0] if count == 0 and path.suffixes[0] == ".asc" else 0
        near = np.abs(frames["t_ns"] - peers["t_ns"] - start).max() < 1000 or path.suffixes[0] == ".asc"
        equal = equal and same and bool(near)
        count += len(frames)
    return count, equal and next(messages, None) is None


def bench_candump(rounds: int, folder: Path) -> dict[str, Any]:
    """Our candump reader against python-can's."""
    path = DRIVE
    if not path.exists():
        path = folder / "generated.log.gz"
        write_candump(path, generated_frames(600_000))
    count, equal = equal_frames(path)
    figures = compare(lambda: can.LogReader(path), lambda: read_candump(path), rounds)
    return {"log": path.name, "frames": count, "equal": equal, **figures}


def bench_format(suffix: str, frames: NDArray[Any], rounds: int, folder: Path) -> dict[str, Any]:
    """`read_log` against python-can's own reader, on a log that python-can wrote."""
    path = folder / f"bench{suffix}"
    with can.Logger(path) as writer:
        for message in map(to_message, frames):
            message.channel = 0
            writer.on_message_received(message)
    count, equal = equal_frames(path)
    figures = compare(lambda: can.LogReader(path), lambda: read_log(path), rounds)
    return {"frames": count, "equal": equal, **figures}


def main() -> None:
    """Print a table, or one JSON document."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench_logs", description="Log readers side by side."
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=50_000, help="of the logs made for the other formats")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        result = {"candump": bench_candump(arguments.rounds, folder), "others": {}}
        for suffix in FORMATS:
            count = arguments.frames // (10 if suffix in SLOW_FORMATS else 1)
            # a short log is measured over more rounds
            rounds = arguments.rounds * (3 if suffix in SLOW_FORMATS else 2)
            result["others"][suffix] = bench_format(suffix, generated_frames(count), rounds, folder)
    ratios = [entry["ours_over_peer"] for entry in result["others"].values()]
    result["times_python_can"] = result["candump"]["peer_over_ours"]
    result["worst_other_ratio"] = max(ratios)
    if arguments.json:
        print(json.dumps(result))
        return
    for name, entry in chain([("candump", result["candump"])], result["others"].items()):
        print(name, entry)


if __name__ == "__main__":
    main()
