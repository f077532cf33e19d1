"""Between python-can's messages and FRAME arrays, a batch at a time."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import FRAME, FrameFlag
from rtcomp.jit import kernel
from rtcomp.sources.events import CAN_ERR_BUSERROR
from rtcomp.sources.python_can import import_can

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
SPECIAL = FrameFlag.REMOTE | FrameFlag.ERROR
LARGEST_ID = 0x1FFFFFFF
LATEST_S = 9.2e9  # beyond, int64 ns end


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

    Each field is one comprehension, which the interpreter specialises: half of what `attrgetter` takes.
    """
    count = len(messages)
    rows = frames[:count]
    payloads = [message.data for message in messages]
    lengths = np.fromiter(map(len, payloads), np.int64, count)
    flags = _flag_bytes(messages)
    rows["can_id"] = np.fromiter([message.arbitration_id for message in messages], np.uint32, count)
    rows["flags"] = flags
    rows["length"] = np.minimum(lengths, 64)
    rows["reserved"] = 0
    _spread_payloads(np.frombuffer(b"".join(payloads), np.uint8), lengths, rows["data"])
    for row in np.flatnonzero(flags & SPECIAL).tolist():
        _finish_special(rows[row], messages[row].dlc)
    return np.fromiter([message.timestamp for message in messages], np.float64, count)


def _flag_bytes(messages: Sequence["can.Message"]) -> NDArray[np.uint8]:
    """FrameFlag bytes; what no message of a batch has costs next to nothing."""
    columns = [
        (FrameFlag.EXTENDED, [message.is_extended_id for message in messages]),
        (FrameFlag.FD, [message.is_fd for message in messages]),
        (FrameFlag.ERROR, [message.is_error_frame for message in messages]),
        (FrameFlag.REMOTE, [message.is_remote_frame for message in messages]),
    ]
    if True in columns[1][1]:
        columns.append((FrameFlag.BITRATE_SWITCH, [message.bitrate_switch for message in messages]))
        columns.append((FrameFlag.ERROR_STATE, [message.error_state_indicator for message in messages]))
    flags = np.zeros(len(messages), np.uint8)
    for flag, states in columns:
        if True in states:
            flags |= np.fromiter(states, np.bool_, len(messages)).astype(np.uint8) * np.uint8(flag)
    flags[flags & FrameFlag.ERROR != 0] = FrameFlag.ERROR  # that, and nothing else its message may say
    return flags


def _finish_special(row: Any, dlc: int) -> None:
    if row["flags"] & FrameFlag.REMOTE:
        row["length"] = min(dlc, 8)
    elif row["can_id"] == 0 and row["length"] < 8:  # logs that know only "error frame", not of which class
        row["can_id"] = CAN_ERR_BUSERROR


def to_frames(messages: Sequence["can.Message"]) -> NDArray[Any]:
    """Messages of a log as a new FRAME array with the log's times.

    The float seconds become ns by whole seconds and rest, so that only the float's own rounding is left.

    Raises ValueError for a time or an id that no frame can have.
    """
    frames = np.empty(len(messages), FRAME)
    if len(messages):
        times = fill_frames(messages, frames)
        if not (np.abs(times) < LATEST_S).all():
            raise ValueError(f"a time that is none: {times[~(np.abs(times) < LATEST_S)][0]} s")
        if frames["can_id"].max() > LARGEST_ID:
            raise ValueError(f"a CAN id of more than 29 bits: 0x{frames['can_id'].max():X}")
        seconds = np.floor(times)
        rest_ns = np.rint((times - seconds) * 1e9).astype(np.int64)
        frames["t_ns"] = seconds.astype(np.int64) * 1_000_000_000 + rest_ns
    return frames


def to_message(frame: Any) -> "can.Message":
    """One row of FRAME as a python-can message to send."""
    can = import_can()
    flags, length = int(frame["flags"]), int(frame["length"])
    return can.Message(
        timestamp=int(frame["t_ns"]) / 1e9,
        arbitration_id=int(frame["can_id"]),
        dlc=length,
        data=None if flags & FrameFlag.REMOTE else frame["data"][:length].tobytes(),
        **{name: bool(flags & flag) for name, flag in _FLAG_FIELDS.items()},
    )
