"""Files are written whole or not at all."""

import os
import tempfile
from pathlib import Path

from rtcomp.errors import RequestError

_UMASK = os.umask(0)  # it can only be read by setting it, which must not happen beside other threads
os.umask(_UMASK)


def write_atomically(path: str | Path, content: bytes) -> None:
    """Write a file so that a reader sees the old one or the new one, whole; an old one's mode is kept.

    What is no regular file (`/dev/stdout`, a pipe) is written to as it is: replacing it would take it away.

    Raises RequestError when it cannot be written.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(content)
        else:
            _replace(path, content)
    except OSError as error:
        raise RequestError(
            f"cannot write {path}: {error.strerror}; give a file in a folder that exists and has room"
        ) from error


def _replace(path: Path, content: bytes) -> None:
    mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_UMASK
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, mode)
        os.replace(temporary, path)
    except OSError:
        Path(temporary).unlink(missing_ok=True)
        raise
