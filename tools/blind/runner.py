"""Runs the tool as a user would: through its command, with nothing but files, and notes how it went."""

import contextlib
import io
import json
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

LIMIT_S = 900


@dataclass(frozen=True)
class Outcome:
    """What came of one run: "done", "refused" (exit 2), "failed" (exit 1) or "timeout", the words, the document."""

    status: str
    message: str
    seconds: float
    document: dict[str, Any] | None


@contextlib.contextmanager
def _time_limit(seconds: int) -> Iterator[None]:
    def ring(*_: object) -> None:
        raise TimeoutError(f"longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def command_options() -> set[str]:
    """Long options that the diagnose command has, for switches that it may or may not offer."""
    from rtcomp.commands.diagnose import command

    return {name for parameter in command.params for name in parameter.opts}


def diagnose(
    training: Sequence[Path],
    heldout: Sequence[Path],
    out: Path,
    arguments: Sequence[str] = (),
    limit_s: int = LIMIT_S,
) -> Outcome:
    """Run `rtcomp diagnose` in this process. A crash of the tool (any other exception) is the caller's to catch."""
    from rtcomp.commands.diagnose import command
    from rtcomp.errors import RequestError, WorkError

    words = [*map(str, training), "--out", str(out), "--json", *arguments]
    for path in heldout:
        words += ["--heldout", str(path)]
    start, status, message = time.perf_counter(), "done", ""
    try:
        with _time_limit(limit_s), contextlib.redirect_stdout(io.StringIO()):
            command.main(args=words, prog_name="rtcomp diagnose", standalone_mode=False)
    except (RequestError, click.UsageError) as error:
        status, message = "refused", str(error)
    except (WorkError, click.ClickException) as error:
        status, message = "failed", str(error)
    except TimeoutError as error:
        status, message = "timeout", str(error)
    seconds = time.perf_counter() - start
    path = out / "diagnosis.json"
    document = json.loads(path.read_bytes()) if status == "done" and path.is_file() else None
    if status == "done" and document is None:
        status, message = "failed", f"no {path.name} was written"
    return Outcome(status, message, round(seconds, 3), document)


def run_case(folder: Path, arguments: Sequence[str] = (), out: str = "found") -> Outcome:
    """Run the tool on what is in FOLDER/seen."""
    seen = folder / "seen"
    training = sorted(seen.glob("recording-*.parquet"))
    heldout = sorted(seen.glob("heldout-*.parquet"))
    given = json.loads((seen / "arguments.json").read_bytes())
    return diagnose(training, heldout, folder / out, [*given, *arguments])
