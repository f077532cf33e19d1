"""Progress of long work: on standard error, and only when it is a terminal."""

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


class Shown:
    """A progress bar: `tick` moves it by one step (without a `total` it only says what is done)."""

    def __init__(self, what: str, total: int | None = None) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[doing]}"),
        )
        console = Console(stderr=True)
        self.bar = Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty())
        self.task = self.bar.add_task(what, total=total, doing="")

    def tick(self, doing: str = "") -> None:
        """One step further."""
        self.bar.update(self.task, advance=1, doing=doing)

    def __enter__(self) -> "Shown":
        """Start drawing."""
        self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop drawing."""
        self.bar.stop()
