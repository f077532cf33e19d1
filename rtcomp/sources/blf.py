"""python-can's BLF reader, kept from standing still on a damaged file."""

import re
import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, BinaryIO

from rtcomp.sources.python_can import import_can

SIZE = struct.Struct("<8xI")  # of an object, behind its mark and the header's own size and version
NO_SIZE = re.compile(rb"LOBJ.{4}\0{4}", re.DOTALL)
PADDING = 8  # bytes within which the next object begins, as python-can looks for it


def blf_reader(file: BinaryIO) -> Any:
    """A reader of messages; BLFParseError where an object has no length, which python-can would read for ever."""
    return _reader_class()(file)


@cache
def _reader_class() -> Any:
    can = import_can()
    from can.io.blf import BLFParseError

    class Reader(can.BLFReader):
        def _parse_container(self, data: bytes) -> Iterator[Any]:
            whole = self._tail + data
            if NO_SIZE.search(whole) and stands_still(whole):
                raise BLFParseError("an object of no length")
            return super()._parse_container(data)

    return Reader


def stands_still(data: bytes) -> bool:
    """Whether an object on the way through a container says that it has no length; bytes that look so are none."""
    at = 0
    while (at := data.find(b"LOBJ", at, at + PADDING)) >= 0 and at + SIZE.size <= len(data):
        (size,) = SIZE.unpack_from(data, at)
        if size == 0:
            return True
        at += size
    return False
