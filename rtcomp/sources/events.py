"""What happens to the receiver, as error frames in the stream, and error frames in words.

Bits and names follow linux/can/error.h.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW, CLOCK_STEP_ID, FRAME, FrameFlag

CAN_ERR_PROT = 0x008
CAN_ERR_BUSERROR = 0x080

CLASSES = {
    0x001: "transmit timeout",
    0x002: "lost arbitration",
    0x004: "controller problem",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement",
    0x040: "bus-off",
    0x080: "bus error",
    0x100: "restarted",
}
CONTROLLER = {  # data[1] of a controller problem
    0x01: "receive overflow",
    0x02: "transmit overflow",
    0x04: "error-warning (receive)",
    0x08: "error-warning (transmit)",
    0x10: "error-passive (receive)",
    0x20: "error-passive (transmit)",
    0x40: "error-active",
}
PROTOCOL = {  # data[2] of a protocol violation
    0x01: "single bit",
    0x02: "frame format",
    0x04: "bit stuffing",
    0x08: "bit 0",
    0x10: "bit 1",
    0x20: "bus overload",
    0x40: "active error announcement",
    0x80: "on transmission",
}


def event(t_ns: int, can_id: int, data: bytes) -> NDArray[Any]:
    """One in-band event as a FRAME array of shape `(1,)`."""
    frames = np.zeros(1, FRAME)
    frames["t_ns"] = t_ns
    frames["can_id"] = can_id
    frames["flags"] = FrameFlag.ERROR
    frames["length"] = 8
    frames["data"][0, : len(data)] = np.frombuffer(data, np.uint8)
    return frames


def clock_step(t_ns: int, step_ns: int) -> NDArray[Any]:
    """The host's clock stepped by `step_ns` (it did not reach `t_ns`)."""
    return event(t_ns, CLOCK_STEP_ID, step_ns.to_bytes(8, "little", signed=True))


def overflow(t_ns: int, count: int) -> NDArray[Any]:
    """`count` frames were lost before this moment because nobody took them in time."""
    return event(t_ns, CAN_ERR_CRTL, bytes([0, CAN_ERR_CRTL_RX_OVERFLOW]) + count.to_bytes(4, "little"))


def _named(bits: int, names: dict[int, str]) -> list[str]:
    return [name for bit, name in names.items() if bits & bit]


def describe_error(frame: Any) -> list[str]:
    """An error frame (one row of FRAME) in words, like `["bus-off"]`; empty for a frame that is none."""
    if not int(frame["flags"]) & FrameFlag.ERROR:
        return []
    can_id, data = int(frame["can_id"]), frame["data"]
    if can_id == CLOCK_STEP_ID:
        step_ns = int.from_bytes(data[:8].tobytes(), "little", signed=True)
        return [f"the host's clock stepped by {step_ns / 1e9:+.3f} s"]
    words = _named(can_id, CLASSES)
    if can_id & CAN_ERR_CRTL:
        words += _named(int(data[1]), CONTROLLER)
    if can_id & CAN_ERR_PROT:
        words += _named(int(data[2]), PROTOCOL)
    return words or [f"error class 0x{can_id:X}"]
