"""Candump logs read and written as FRAME arrays, in bounded memory, times exact to the nanosecond."""

import contextlib
import gzip
import logging
import os
import zlib
from collections.abc import Generator, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self, cast

import numpy as np
from numpy.typing import NDArray

from rtcomp.errors import RequestError
from rtcomp.frames import FRAME
from rtcomp.sources.candump_text import LONGEST_LINE, format_lines, parse_lines

log = logging.getLogger(__name__)

CHUNK = 1 << 20  # bytes of text held at once
FIRST_SKIPPED = 10  # line numbers kept for the report
SHORTEST_LINE = 24  # typical lower bound of a line, for sizing arrays; shorter lines only mean one more round
GZIP_MAGIC = b"\x1f\x8b"


def open_log(path: Path) -> BinaryIO:
    """Open a log for reading bytes, unpacked if it is gzip (told by its content, not by its name).

    Raises RequestError where there is no such file or it cannot be opened.
    """
    try:
        file = path.open("rb")
    except FileNotFoundError:
        raise RequestError(f"{path}: no such log file; give the path of a CAN log") from None
    except OSError as error:
        raise RequestError(f"{path}: cannot be opened ({error.strerror}); give a readable CAN log") from None
    packed = file.read(2) == GZIP_MAGIC
    file.seek(0)
    if not packed:
        return file
    file.close()
    return cast(BinaryIO, gzip.open(path))


class CandumpReader(Iterator[NDArray[Any]]):
    """Iterator over the FRAME arrays of one candump log; made by `read_candump`.

    Lines that are no frames are skipped: `skipped` counts them, `first_skipped` holds the first line numbers
    (from 1). `frames_read` and `lines_read` count what has been passed on so far. The file is closed at the
    end of the iteration or by `close`.
    """

    def __init__(self, path: str | os.PathLike[str], chunk: int = CHUNK):
        self.path = Path(path)
        self.frames_read = 0
        self.lines_read = 0
        self.skipped = 0
        self.first_skipped: list[int] = []
        self._chunk = max(chunk, 256)
        open_log(self.path).close()  # refuse here what is not there; hold nothing before reading begins
        self._bad_lines = np.zeros(FIRST_SKIPPED, np.int64)
        self._arrays = self._read()

    def __next__(self) -> NDArray[Any]:
        return next(self._arrays)

    def close(self) -> None:
        """Close the file; reading ends here."""
        self._arrays.close()

    def _read(self) -> Generator[NDArray[Any], None, None]:
        with open_log(self.path) as file:
            broken = yield from self._parse_blocks(file)
        if self.skipped:
            first = ", ".join(map(str, self.first_skipped))
            log.warning("%s: skipped %d unreadable %s (line %s%s)", self.path, self.skipped,
                        "line" if self.skipped == 1 else "lines", first,
                        ", …" if self.skipped > len(self.first_skipped) else "")  # fmt: skip
        if broken:
            raise RequestError(
                f"{self.path}: {broken} after {self.frames_read} frames in {self.lines_read} lines; "
                "wanted a complete log: copy it again, or unpack what there is with `gzip -dc`"
            )
        if self.frames_read == 0:
            raise RequestError(
                f"{self.path}: none of its {self.lines_read} lines is a CAN frame; wanted candump lines like "
                "`(1436509052.249713) can0 123#11AABB`: record with `candump -L`, or name the file by format"
            )

    def _parse_blocks(self, file: BinaryIO) -> Generator[NDArray[Any], None, str]:
        """Yield arrays; returns what broke the file, or an empty string."""
        rest = b""
        overlong = False  # inside a line that is longer than a block: it cannot be a frame
        while True:
            block, broken = self._next_block(file)
            at_end = len(block) == 0
            if overlong:
                cut = block.find(b"\n")
                block, overlong = block[cut + 1 :], cut < 0 and not at_end
                if overlong:
                    continue
            text = np.frombuffer(rest + block + (b"\n" if at_end and rest else b""), np.uint8)
            used = yield from self._parse(text)
            rest = text[used:].tobytes()
            if at_end:
                return broken
            if len(rest) > self._chunk:
                self._skip_line()
                rest, overlong = b"", True

    def _next_block(self, file: BinaryIO) -> tuple[bytes, str]:
        """The next bytes, none at the end; and what broke the file there, if anything did."""
        reader = cast(Any, file)
        parts, size = [], 0
        try:
            while size < self._chunk and (part := reader.read1(self._chunk - size)):
                parts.append(part)
                size += len(part)
        except EOFError:
            broken = "the gzip stream ends early,"
        except (zlib.error, gzip.BadGzipFile) as error:
            broken = f"the gzip stream is damaged ({error})"
        else:
            return b"".join(parts), ""
        if parts:  # what came before is good; the error comes again with the next call
            return b"".join(parts), ""
        return b"", broken

    def _parse(self, text: NDArray[np.uint8]) -> Generator[NDArray[Any], None, int]:
        """Yield the frames of the whole lines of `text`; returns the position after them."""
        position = 0
        while True:
            frames = np.zeros((len(text) - position) // SHORTEST_LINE + 1, FRAME)
            position, rows, lines, bad = parse_lines(
                text, position, len(text), frames, self.lines_read, self._bad_lines
            )
            room = FIRST_SKIPPED - len(self.first_skipped)
            self.first_skipped += self._bad_lines[: min(bad, room)].tolist()
            self.skipped += bad
            self.lines_read += lines
            self.frames_read += rows
            if rows:
                yield frames[:rows]
            if rows < len(frames):
                return position

    def _skip_line(self) -> None:
        self.lines_read += 1
        self.skipped += 1
        if len(self.first_skipped) < FIRST_SKIPPED:
            self.first_skipped.append(self.lines_read)


def read_candump(path: str | os.PathLike[str], chunk: int = CHUNK) -> CandumpReader:
    """Read a candump log (gzip too) as FRAME arrays, holding about `chunk` bytes of text at once.

    Interface names and directions are read over: frames of all interfaces come in the order of the file.
    Raises RequestError for a file that is missing, ends early or is damaged (after what is good was passed
    on), or holds no frame at all. Garbage in between is skipped, counted and logged.
    """
    return CandumpReader(path, chunk)


class CandumpWriter:
    """Writes FRAME arrays as a candump log with nine decimals; `.gz` in the name packs it.

    While it is open the file is called `<path>.part`, readable as a log at any moment; `close` gives it its
    name. Error frames, so also what happened to the receiver, are kept as `2xxxxxxx#…`.
    """

    def __init__(self, path: str | os.PathLike[str], channel: str = "can0"):
        if not channel or any(character.isspace() for character in channel):
            raise RequestError(f"interface name {channel!r}: wanted a name without blanks, like can0")
        self.path = Path(path)
        self.frames_written = 0
        device = (
            self.path.exists() and not self.path.is_file()
        )  # /dev/stdout, a pipe: never replaced by a file
        self.part = self.path if device else self.path.with_name(self.path.name + ".part")
        self._channel = np.frombuffer(channel.encode(), np.uint8).copy()
        self._text = np.empty(max(1 << 16, 4 * (LONGEST_LINE + len(self._channel))), np.uint8)
        try:
            if not device:
                self.part.unlink(missing_ok=True)  # never written through a link that somebody put there
            file = self.part.open("wb" if device else "xb")
        except OSError as error:
            raise RequestError(
                f"{path}: cannot be written ({error.strerror}); give a writable path"
            ) from None
        packed = self.path.suffix == ".gz"
        self._raw = file
        self._file = gzip.GzipFile(fileobj=file, mode="wb", compresslevel=1, filename="") if packed else file

    def append(self, frames: NDArray[Any]) -> None:
        """Write frames, shape `(n,)` of FRAME."""
        done = 0
        while done < len(frames):
            done, size = format_lines(frames, done, self._channel, self._text)
            self._file.write(self._text[:size].data)
        self.frames_written += len(frames)

    def close(self) -> None:
        """Finish the file and give it its name; closing twice does no harm."""
        if self._raw.closed:
            return
        self._file.close()
        self._raw.close()
        if self.part != self.path:
            os.replace(self.part, self.path)

    def abandon(self) -> None:
        """Close as far as a disk that takes no more lets it; what was written stays in `part`."""
        for file in (self._file, self._raw):
            with contextlib.suppress(OSError):
                file.close()

    def discard(self) -> None:
        """Close without leaving a file."""
        if not self._raw.closed:
            self._file.close()
            self._raw.close()
            if self.part != self.path:
                self.part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and self.frames_written == 0:
            self.discard()
        else:
            self.close()


def write_candump(path: str | os.PathLike[str], frames: NDArray[Any], channel: str = "can0") -> None:
    """Write one FRAME array as a candump log."""
    with CandumpWriter(path, channel) as writer:
        writer.append(frames)
