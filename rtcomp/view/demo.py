"""The viewer inside another command's process, on a zenoh session that is there already."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rtcomp.view.live import Viewer
from rtcomp.view.sinks import open_sink


@contextlib.contextmanager
def watching(
    session: Any, prefix: str, *, view: bool = False, web: bool = False, save: str | Path | None = None
) -> Iterator[Viewer]:
    """Show what is published under `prefix` while the block runs: in a window, on a page, in an .rrd file.

    Raises RequestError or WorkError before the block when that cannot be.
    """
    with open_sink(window=view, web=web, save=save, name=prefix) as sink:
        viewer = Viewer(session, prefix, sink)
        viewer.start()
        try:
            yield viewer
        finally:
            viewer.stop()
