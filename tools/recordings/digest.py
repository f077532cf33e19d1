"""What a converted file is known by: the sha256 of its numbers, whoever packed it and however."""

import hashlib
from collections.abc import Sequence

import numpy as np

from tools.recordings.convert import Columns, Frames

TIMES = ("t_s", "t")


def table_digest(columns: Columns, decimals: Sequence[int]) -> str:
    """SHA-256 of the header and of every column but the time as integers of its last decimal."""
    found = hashlib.sha256(",".join(columns).encode())
    for (name, values), digits in zip(columns.items(), decimals, strict=True):
        if name not in TIMES:
            found.update(np.rint(np.asarray(values, float) * 10.0**digits).astype("<i8").tobytes())
    return found.hexdigest()


def time_marks(columns: Columns) -> tuple[float, float, float]:
    """First, last and mean time [s]; times end half way between two last decimals, so that no hash would hold."""
    t = columns[next(name for name in TIMES if name in columns)]
    return float(t[0]), float(t[-1]), float(np.mean(t))


def frames_digest(frames: Frames) -> str:
    """SHA-256 of times in whole µs, ids, lengths and payloads of the frames, in their order."""
    found = hashlib.sha256(np.rint(frames["t_ns"] / 1000.0).astype("<i8").tobytes())
    for name, kind in (("can_id", "<u4"), ("length", "u1")):
        found.update(frames[name].astype(kind).tobytes())
    found.update(np.ascontiguousarray(frames["data"][:, :8]).tobytes())
    return found.hexdigest()
