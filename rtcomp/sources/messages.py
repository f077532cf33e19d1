"""Between python-can's messages and FRAME arrays, a batch at a time."""

from collections.abc import Sequence
from itertools import product
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import FRAME, FrameFlag
from rtcomp.jit import kernel
from rtcomp.sources.events import CAN_ERR_BUSERROR

if TYPE_CHECKING:
    import can

_FLAG_FIELDS = {
    "is_extended_id": FrameFlag.EXTENDED,
    "is_fd": FrameFlag.FD,
    "is_error_frame": FrameFlag.ERROR,
    "is_remote_frame": FrameFlag.REMOTE,
    "bitrate_switch": FrameFlag.BITRATE_SWITCH,
    "error_state_indicator": FrameFlag.ERROR_STATE,
}
_read_flags = attrgetter(*_FLAG_FIELDS)
_read_fields = attrgetter("arbitration_id", "dlc", "data")


def _flag_byte(states: tuple[bool, ...]) -> int:
    byte = sum(flag for state, flag in zip(states, _FLAG_FIELDS.values(), strict=True) if state)
    return int(FrameFlag.ERROR) if byte & FrameFlag.ERROR else int(byte)


# an error frame is nothing else, whatever else its message says
_FLAG_BYTES = {states: _flag_byte(states) for states in product((False, True), repeat=len(_FLAG_FIELDS))}


@kernel
def _spread_payloads(payload, lengths, data):
    """Put consecutive payloads into the rows of `data`, zeros behind them; what is beyond 64 bytes is cut."""
    begin = 0
    for row in range(len(lengths)):
        length = int(lengths[row])
        for k in range(64):
            data[row, k] = payload[begin + k] if k < length else 0
        begin += length


def fill_frames(messages: Sequence["can.Message"], frames: NDArray[Any]) -> None:
    """Write `messages` into the first rows of `frames`, all fields but the time."""
    count = len(messages)
    rows = frames[:count]
    ids, dlcs, payloads = zip(*map(_read_fields, messages), strict=True)
    lengths = np.fromiter(map(len, payloads), np.int64, count)
    flags = np.fromiter(map(_FLAG_BYTES.__getitem__, map(_read_flags, messages)), np.uint8, count)
    rows["can_id"] = np.fromiter(ids, np.uint32, count)
    rows["flags"] = flags
    rows["length"] = np.minimum(lengths, 64)
    rows["reserved"] = 0
    _spread_payloads(np.frombuffer(b"".join(payloads), np.uint8), lengths, rows["data"])
    special = np.flatnonzero(flags & (FrameFlag.REMOTE | FrameFlag.ERROR))
    for row in special:
        _finish_special(rows[row], dlcs[row])


def _finish_special(row: Any, dlc: int) -> None:
    if row["flags"] & FrameFlag.REMOTE:
        row["length"] = min(dlc, 8)
    elif row["can_id"] == 0 and row["length"] < 8:  # logs that know only "error frame", not of which class
        row["can_id"] = CAN_ERR_BUSERROR


def log_times_ns(messages: Sequence["can.Message"]) -> NDArray[np.int64]:
    """The messages' float times as ns; the seconds apart, so that only the float's own rounding is left."""
    times = np.fromiter((message.timestamp for message in messages), np.float64, len(messages))
    seconds = np.floor(times)
    return seconds.astype(np.int64) * 1_000_000_000 + np.rint((times - seconds) * 1e9).astype(np.int64)


def to_frames(messages: Sequence["can.Message"]) -> NDArray[Any]:
    """Messages of a log as a new FRAME array with the log's times."""
    frames = np.empty(len(messages), FRAME)
    if len(messages):
        fill_frames(messages, frames)
        frames["t_ns"] = log_times_ns(messages)
    return frames


def to_message(frame: Any) -> "can.Message":
    """One row of FRAME as a python-can message to send."""
    import can

    flags, length = int(frame["flags"]), int(frame["length"])
    return can.Message(
        timestamp=int(frame["t_ns"]) / 1e9,
        arbitration_id=int(frame["can_id"]),
        dlc=length,
        data=None if flags & FrameFlag.REMOTE else frame["data"][:length].tobytes(),
        **{name: bool(flags & flag) for name, flag in _FLAG_FIELDS.items()},
    )
