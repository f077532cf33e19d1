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
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from rtcomp.errors import WorkError
from rtcomp.model import save_model
from tools.faults.runs import peer_config, wait_for
from tools.faults.trace import make_model
from tools.soak_judge import WARM_UP, Watched, judge
from tools.soak_load import PARTS, Load, datagram_pair, free_endpoint

WINDOWS = 60
START_S, END_S = 300.0, 300.0  # a first start compiles, perhaps on a busy machine
FORGOTTEN_S = 900.0  # beyond its time, after which a run ends that nobody is left to end


@contextlib.contextmanager
def running(folder: Path, endpoint: str, bus: str | None, longest_s: float) -> Iterator[tuple[Any, Any]]:
    """The run's process and where its frames go to; killed at the end, and it ends by itself after `longest_s`."""
    save_model(make_model(), folder / "model.json")
    (folder / "run.json5").write_text(json.dumps(peer_config({"listen": {"endpoints": [endpoint]}})))
    options = ["--model", str(folder / "model.json"), "--state", str(folder / "state.json"), "--allow-swap",
               "--zenoh", str(folder / "run.json5"), "--seconds", str(longest_s), "--json"]  # fmt: skip
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
    """One soak: figures and verdicts. Raises click.ClickException when the run ends before it is told to."""
    import psutil

    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory(prefix="rtcomp-soak-") as name:
        folder = Path(name)
        with running(folder, endpoint, bus, seconds + FORGOTTEN_S) as (process, ours):
            try:
                watched = Watched(process.pid)
                wait_for(watched.listens, START_S)
                load = Load(folder, ours, endpoint, rate_hz, parts)
                load.start()
                watch(watched, load, seconds)
                threads = watched.thread_names()
            except (psutil.Error, WorkError) as error:
                said = (folder / "said.txt").read_text()[-1000:]
                raise click.ClickException(f"the run ended or cannot be reached: {error}\n{said}") from error
            load.finish()
            process.send_signal(signal.SIGTERM)
            out, _ = process.communicate(timeout=END_S)
            load.close()
    return report(watched, load, json.loads(out.splitlines()[-1]), process.returncode) | {
        "seconds": seconds,
        "thread_names": threads,
    }


def report(watched: Watched, load: Load, summary: dict[str, Any], status: int) -> dict[str, Any]:
    """The document of `--json`."""
    figures, verdicts = judge(watched.rows)
    counted, complete = account(load, summary)
    return {
        "status": status,
        **counted,
        **figures,
        "verdicts": verdicts | complete | {"it ends well": status == 0},
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
        "received": summary["samples"] - listener.received - listener.gaps,  # numbered before our queue
    }
    lost = summary["losses"]
    figures = {
        "sent": load.sent,
        "frames": summary["frames"],
        "samples": summary["samples"],
        "received": listener.received,
        "losses": lost | {"transport": listener.gaps - lost["queue"]},
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

    found = soak(minutes * 60.0, rate_hz, bus, tuple(part for part in PARTS if part not in without))
    if as_json:
        click.echo(json.dumps(found))
    else:
        Console(highlight=False).print_json(
            data={key: value for key, value in found.items() if key != "rows"}
        )
    sys.exit(not all(found["verdicts"].values()))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends the run too
    main()
