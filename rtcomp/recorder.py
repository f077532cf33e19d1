"""`run --record`: keeps the received frames, and gives way when the disk does not take them.

A full disk ends the recording, never the run: it is said once, every frame that is not on the disk is counted, and
what was written stays as `<path>.part`, so that nothing incomplete bears the name of a whole recording.
"""

import contextlib
import logging
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.errors import RequestError
from rtcomp.sources.candump import CandumpWriter, read_candump

log = logging.getLogger(__name__)


class Recorder:
    """A recording of one run. `counts`: frames kept, frames lost (together all that were offered), and why."""

    def __init__(self, path: str) -> None:
        """RequestError when the file cannot be opened."""
        self._writer = CandumpWriter(path)
        self._offered = 0
        self._kept: int | None = None  # known when a failed recording has been closed
        self.error: str | None = None

    @property
    def counts(self) -> dict[str, Any]:
        """What health and summary say; exact after `close`."""
        kept = self._writer.frames_written if self._kept is None else self._kept
        return {"frames": kept, "lost": self._offered - kept, "error": self.error}

    def append(self, frames: np.ndarray) -> None:
        """Keep frames, shape `(n,)` of FRAME, as long as the disk takes them."""
        self._offered += len(frames)
        if self.error is not None:
            return
        try:
            self._writer.append(frames)
        except OSError as error:
            self._stop(error)

    def _stop(self, error: OSError) -> None:
        self.error = error.strerror or str(error)
        self._writer.abandon()
        log.warning(
            "recording to %s stopped (%s) and what there is stays in %s; correction goes on",
            self._writer.path,
            self.error,
            self._writer.part,
        )

    def close(self) -> None:
        """Finish the recording; counts what a failed one holds."""
        if self.error is None:
            try:
                self._writer.close()
            except OSError as error:
                self._stop(error)
        if self.error is not None:
            self._kept = _frames_in(self._writer.part)


def _frames_in(path: Path) -> int:
    """Whole frames in an unfinished recording."""
    if not path.is_file():
        return 0
    reader = read_candump(path)
    with contextlib.suppress(RequestError):  # it ends early: that is why we count
        for _ in reader:
            pass
    return reader.frames_read
