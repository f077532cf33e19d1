"""The folder of results: filled aside and put in place whole, so that nothing half-written is ever seen."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rtcomp.errors import RequestError


@contextmanager
def staged(out: Path) -> Iterator[Path]:
    """A folder to write into; what is in it replaces its namesakes in `out` when the block ends well.

    Raises RequestError at once where `out` could not be written to, so that no long work is done in vain.
    """
    try:
        if out.exists() and not out.is_dir():
            raise NotADirectoryError(20, "a file of that name is in the way")
        home = next(p for p in (out.resolve(), *out.resolve().parents) if p.is_dir())
        folder = Path(tempfile.mkdtemp(dir=home, prefix=f".{out.name}."))
    except (OSError, StopIteration) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such place"
        raise RequestError(
            f"cannot write to folder {out}: {reason}; give a folder that can be written to"
        ) from error
    try:
        yield folder
        _publish(folder, out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _publish(folder: Path, out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        for item in sorted(folder.iterdir()):
            target = out / item.name
            if item.is_dir():
                shutil.rmtree(target, ignore_errors=True)
            os.replace(item, target)
    except OSError as error:
        raise RequestError(
            f"cannot write to folder {out}: {error.strerror}; give a folder that can be written to"
        ) from error
