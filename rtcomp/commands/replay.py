"""`rtcomp replay`: a log sent to a bus with its timing."""

import json
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rtcomp.sources.transmit import ReplayReport


class Speed(click.ParamType):
    """A factor above 0, or `max`."""

    name = "speed"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """`max` becomes 0."""
        try:
            speed = 0.0 if value == "max" else float(value)
        except ValueError:
            speed = -1.0
        if not (0 < speed < float("inf") or value in ("max", 0, 0.0)):
            self.fail(f"{value!r}: wanted a number above 0, like 10, or max")
        return speed


@contextmanager
def stopping_on_signals(stop: threading.Event) -> Iterator[None]:
    """Let SIGINT and SIGTERM set `stop` meanwhile."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, lambda *_: stop.set())
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_replay(
    log: Path, bus: str, speed: float = 1.0, repeat: int = 1, error_frames: bool = False,
    stop: threading.Event | None = None,
) -> "ReplayReport":  # fmt: skip
    """Replay a log on a bus; see `rtcomp.sources.transmit.replay`.

    Raises RequestError for a log or a bus that is not to be had, WorkError where no frame could be sent.
    """
    from rtcomp.errors import WorkError
    from rtcomp.sources.bus import open_can
    from rtcomp.sources.logs import read_log
    from rtcomp.sources.transmit import repeated, replay

    first_pass = read_log(log)  # before the bus: a wrong log must leave the bus alone
    passes = iter([first_pass])
    arrays = repeated(lambda: next(passes, None) or read_log(log), repeat)
    with open_can(bus) as opened:
        report = replay(arrays, opened, speed, stop, error_frames)
    if report.sent == 0 and report.failed > 0:
        raise WorkError(f"bus {bus!r} took none of {report.failed} frames; is it up, and does anyone listen?")
    return report


@click.command("replay")
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--bus", required=True, help="Where to send: interface:channel?key=value&…, like socketcan:vcan0."
)
@click.option(
    "--speed", type=Speed(), default=1.0, help="2 is twice as fast as recorded; max: as fast as possible."
)
@click.option("--repeat", type=click.IntRange(min=1), default=1, help="How many times over.")
@click.option("--error-frames", is_flag=True, help="Send the log's error frames too (virtual buses only).")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def command(log: Path, bus: str, speed: float, repeat: int, error_frames: bool, as_json: bool) -> None:
    """Replay LOG on a bus with its timing, and report how well the timing was kept.

    Every format that `rtcomp run --log` reads; absolute deadlines, so nothing drifts. Ctrl-C ends it with the
    report of what was sent.

    Example: rtcomp replay drive.log.gz --bus socketcan:vcan0 --speed 10
    """
    stop = threading.Event()
    with stopping_on_signals(stop):
        report = run_replay(log, bus, speed, repeat, error_frames, stop)
    if as_json:
        click.echo(json.dumps({"log": str(log), "bus": bus, "speed": speed or "max", **asdict(report)}))
    else:
        click.echo(_sentence(report))


def _sentence(report: "ReplayReport") -> str:
    text = f"{report.sent} frames sent in {report.seconds:.2f} s ({report.frames_per_s:.0f}/s)"
    if report.failed or report.skipped:
        text += f", {report.failed} failed, {report.skipped} error frames left out"
    if report.gap_error_us["p50"] is None:
        return text
    gap = report.gap_error_us
    return f"{text}; error of the gaps: p50 {gap['p50']:.0f}, p99 {gap['p99']:.0f}, max {gap['max']:.0f} µs"
