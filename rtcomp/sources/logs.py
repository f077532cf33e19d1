"""Logs of every format as FRAME arrays: candump by our own reader, the others by python-can's."""

import gzip
import logging
import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from importlib.util import find_spec
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from numpy.typing import NDArray

from rtcomp.errors import RequestError
from rtcomp.sources.blf import blf_reader
from rtcomp.sources.candump import open_log, read_candump
from rtcomp.sources.messages import to_frames
from rtcomp.sources.python_can import import_can, mf4_reader

if TYPE_CHECKING:
    from can.io.generic import MessageReader

log = logging.getLogger(__name__)

BATCH = 512  # messages of one array; more of them at once wake the garbage collector
HEADER_LINES = 100  # of an .asc log, in which its dates are looked for
ASC_DATES = (("date ", 2), ("Begin Triggerblock ", 3))
FORMATS = (".log", ".asc", ".blf", ".trc", ".mf4", ".csv", ".db")


def log_format(path: Path) -> str:
    """The log's format, told by its suffix (before `.gz`), or by its first bytes where that says nothing."""
    suffixes = [suffix.lower() for suffix in path.suffixes[-2:]]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    suffix = suffixes[-1] if suffixes else ""
    if suffix in FORMATS:
        return suffix
    with open_log(path) as file:
        try:
            start = file.read(64).lstrip()
        except (EOFError, zlib.error, gzip.BadGzipFile):
            start = b""
    if start[:1] == b"(" and start[1:2].isdigit():
        return ".log"
    raise RequestError(
        f"{path}: unknown log format {suffix or 'without a suffix'!r}; wanted one of {', '.join(FORMATS)}, "
        "each also as .gz where its reader can"
    )


def read_log(path: str | os.PathLike[str]) -> Iterator[NDArray[Any]]:
    """Read a CAN log of any format as FRAME arrays in bounded memory.

    Formats: candump `.log`, `.asc`, `.blf`, `.trc`, `.mf4` (needs asammdf), `.csv`, `.db`; gzip of the text
    formats. Times are UNIX ns where the log knows them (`.asc` through its date), exact for candump, and as
    exact as python-can's float seconds (0.2 µs) for the others.
    Raises RequestError for a file that is missing, of no known format, damaged, truncated or without frames;
    the frames before the damage are passed on first.
    """
    path = Path(path)
    open_log(path).close()  # a missing file is refused here, not at the first array
    kind = log_format(path)
    return read_candump(path) if kind == ".log" else _read_by_python_can(path, kind)


def _read_by_python_can(path: Path, kind: str) -> Iterator[NDArray[Any]]:
    count, missing = 0, 0
    try:
        with open_log(path) as file:
            reader = _reader(path, kind, file)
            with reader:
                messages = iter(reader)
                while batch := list(islice(messages, BATCH)):
                    yield to_frames(batch)
                    count += len(batch)
            if kind == ".blf":  # its reader does not mind a missing end
                missing = getattr(reader, "file_size", 0) - path.stat().st_size
    except _damage(kind) as error:
        reason = f"{error}" or type(error).__name__
        raise RequestError(
            f"{path}: unreadable as {kind} after {count} frames ({reason}); wanted a complete {kind} log: "
            "copy it again, or give it the suffix of its format"
        ) from error
    if missing > 0 and path.suffix.lower() != ".gz":
        raise RequestError(
            f"{path}: {missing} bytes shorter than its header says, {count} frames read; wanted a complete "
            f"{kind} log: copy it again"
        )
    if count == 0:
        raise RequestError(f"{path}: holds no CAN frame; wanted a {kind} log with at least one")


def _reader(path: Path, kind: str, file: BinaryIO) -> "MessageReader":
    """python-can's reader over our open file, with absolute times where the format leaves a choice."""
    can = import_can()
    if kind == ".mf4":
        return _mf4_reader(path, file)
    if kind == ".db":
        return can.SqliteReader(path)
    if kind == ".blf":
        return blf_reader(file)
    text = TextIOWrapper(file, encoding="utf-8", errors="replace")
    if kind == ".asc":
        return can.ASCReader(text, relative_timestamp=not _asc_date_is_known(path))
    return can.TRCReader(text) if kind == ".trc" else can.CSVReader(text)


def _mf4_reader(path: Path, file: BinaryIO) -> "MessageReader":
    if find_spec("asammdf") is None:
        raise RequestError(f"{path}: reading .mf4 needs asammdf; install it with `pip install 'rtcomp[mf4]'`")
    if file.read(3) != b"MDF":  # asammdf says so too, but leaves a half-made object behind
        raise ValueError("it does not begin with MDF")
    file.seek(0)
    return mf4_reader()(path if path.suffix.lower() == ".mf4" else file)


def _asc_date_is_known(path: Path) -> bool:
    """Whether python-can can make a start time of the log's dates; it stops at one it cannot."""
    can = import_can()
    with open_log(path) as file:
        lines = [line.decode(errors="replace").strip() for line in islice(file, HEADER_LINES)]
    dates = [
        line.split(maxsplit=skip)[-1] for line in lines for start, skip in ASC_DATES if line.startswith(start)
    ]
    try:
        for date in dates:
            can.ASCReader._datetime_to_timestamp(date)
    except ValueError:
        log.warning("%s: unknown form of its date %r; times count from the log's start", path, dates)
        return False
    return True


def _damage(kind: str) -> tuple[type[Exception], ...]:
    """What python-can's reader of this format raises on a damaged or foreign file."""
    can = import_can()
    from can.io.blf import BLFParseError

    numbers = (ValueError, OverflowError, IndexError, KeyError)
    text = (*numbers, EOFError, zlib.error, OSError, struct.error, can.CanError)
    if kind == ".blf":
        return (*text, BLFParseError)
    if kind == ".db":
        return (*text, sqlite3.Error, TypeError)
    if kind == ".mf4":
        from asammdf.blocks.utils import MdfException

        return (*text, MdfException, AttributeError, TypeError, AssertionError, RecursionError)
    return text
