"""Between python-can's messages and FRAME arrays, a batch at a time."""

from collections.abc import Iterable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import FRAME, FrameFlag
from rtcomp.jit import kernel
from rtcomp.sources.events import CAN_ERR_BUSERROR

if TYPE_CHECKING:
    import can

_ALWAYS = {
    "is_extended_id": FrameFlag.EXTENDED,
    "is_fd": FrameFlag.FD,
    "is_error_frame": FrameFlag.ERROR,
    "is_remote_frame": FrameFlag.REMOTE,
}
_ONLY_FD = {"bitrate_switch": FrameFlag.BITRATE_SWITCH, "error_state_indicator": FrameFlag.ERROR_STATE}
_read = attrgetter("timestamp", "arbitration_id", "data", *_ALWAYS)
_read_fd = attrgetter(*_ONLY_FD)
SPECIAL = FrameFlag.REMOTE | FrameFlag.ERROR


@kernel
def _spread_payloads(payload, lengths, data):
    """Put consecutive payloads into the rows of `data`, zeros behind them; what is beyond 64 bytes is cut."""
    begin = 0
    for row in range(len(lengths)):
        length = min(lengths[row], 64)
        for k in range(length):
            data[row, k] = payload[begin + k]
        for k in range(length, 64):
            data[row, k] = 0
        begin += lengths[row]


def fill_frames(messages: Sequence["can.Message"], frames: NDArray[Any]) -> NDArray[np.float64]:
    """Write messages into the first rows of `frames`, all fields but the time; returns their float times [s].

    The fields are read as columns: per message that is a third of a microsecond.
    """
    count = len(messages)
    rows = frames[:count]
    times, ids, payloads, *states = zip(*map(_read, messages), strict=True)
    lengths = np.fromiter(map(len, payloads), np.int64, count)
    flags = _flag_bytes(states, _ALWAYS.values(), count)
    if np.any(flags & FrameFlag.FD):
        flags |= _flag_bytes(zip(*map(_read_fd, messages), strict=True), _ONLY_FD.values(), count)
    flags[flags & FrameFlag.ERROR != 0] = FrameFlag.ERROR  # that, and nothing else its message may say
    rows["can_id"] = np.fromiter(ids, np.uint32, count)
    rows["flags"] = flags
    rows["length"] = np.minimum(lengths, 64)
    rows["reserved"] = 0
    _spread_payloads(np.frombuffer(b"".join(payloads), np.uint8), lengths, rows["data"])
    for row in np.flatnonzero(flags & SPECIAL).tolist():
        _finish_special(rows[row], messages[row].dlc)
    return np.array(times, np.float64)


def _flag_bytes(
    states: Iterable[tuple[bool, ...]], flags: Iterable[FrameFlag], count: int
) -> NDArray[np.uint8]:
    """FrameFlag bytes of columns of truth values; most columns are all false and cost next to nothing."""
    byte = np.zeros(count, np.uint8)
    for state, flag in zip(states, flags, strict=True):
        if any(state):
            byte |= np.fromiter(state, np.bool_, count).astype(np.uint8) * np.uint8(flag)
    return byte


def _finish_special(row: Any, dlc: int) -> None:
    if row["flags"] & FrameFlag.REMOTE:
        row["length"] = min(dlc, 8)
    elif row["can_id"] == 0 and row["length"] < 8:  # logs that know only "error frame", not of which class
        row["can_id"] = CAN_ERR_BUSERROR


def to_frames(messages: Sequence["can.Message"]) -> NDArray[Any]:
    """Messages of a log as a new FRAME array with the log's times.

    The float seconds become ns by whole seconds and rest, so that only the float's own rounding is left.
    """
    frames = np.empty(len(messages), FRAME)
    if len(messages):
        times = fill_frames(messages, frames)
        seconds = np.floor(times)
        rest_ns = np.rint((times - seconds) * 1e9).astype(np.int64)
        frames["t_ns"] = seconds.astype(np.int64) * 1_000_000_000 + rest_ns
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
        **{name: bool(flags & flag) for name, flag in (_ALWAYS | _ONLY_FD).items()},
    )
