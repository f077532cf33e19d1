"""The two records of the project: a received CAN frame and a corrected sample."""

from enum import IntFlag
from typing import Any

import numpy as np

FRAME = np.dtype(
    [
        ("t_ns", "<i8"),  # reception, ns UNIX, on a clock that never steps
        ("can_id", "<u4"),  # 11 or 29 bits; for an error frame its class bits
        ("flags", "u1"),  # FrameFlag
        ("length", "u1"),  # payload bytes, 0…64 (what an RTR frame asks for)
        ("reserved", "<u2"),
        ("data", "u1", (64,)),
    ]
)
"""One received frame; every source fills arrays of it and nothing after the source knows where frames came from."""


class FrameFlag(IntFlag):
    """Bits of `FRAME["flags"]`."""

    EXTENDED = 1
    FD = 2
    ERROR = 4
    REMOTE = 8
    BITRATE_SWITCH = 16
    ERROR_STATE = 32


# What happens to the receiver travels in band as error frames, so that a recording keeps it
# and an offline run over that recording gives the same bits as the live one.
CAN_ERR_CRTL = 0x0004  # linux/can/error.h: controller problems, data[1]
CAN_ERR_CRTL_RX_OVERFLOW = 0x01  # … receive buffer overflow; data[2:6] holds how many frames, little-endian
CLOCK_STEP_ID = 0x0000  # an error frame of no class: the host's clock stepped by data[0:8] ns (int64)


CORRECTED = np.dtype(
    [
        ("t_ns", "<i8"),
        ("t_pub_ns", "<i8"),
        ("seq", "<u8"),
        ("rate_raw_dps", "<f8"),
        ("rate_dps", "<f8"),
        ("correction_dps", "<f8"),
        ("temp_degC", "<f8"),
        ("sigma_dps", "<f4"),
        ("temp_age_s", "<f4"),
        ("flags", "<u4"),
        ("ref_rate_dps", "<f8"),
    ]
)
"""One corrected sample, as it goes over the wire (packed, little-endian)."""


class Flag(IntFlag):
    """Bits of `CORRECTED["flags"]`."""

    TEMPERATURE_MISSING = 1 << 0
    TEMPERATURE_STALE = 1 << 1
    EXTRAPOLATING = 1 << 2
    UNSETTLED = 1 << 3
    SATURATED = 1 << 4
    BAD_FRAME_BEFORE = 1 << 5
    CLOCK_STEP = 1 << 6
    NO_MODEL = 1 << 7
    FRAMES_LOST = 1 << 8
    SENSOR_FAULT = 1 << 9
    GAP_BEFORE = 1 << 10
    MODEL_SWAPPED = 1 << 11
    TEMPERATURE_IMPLAUSIBLE = 1 << 12  # the latest jumped more than the map allows and was not taken
    TEMPERATURE_STUCK = 1 << 13
    RATE_IMPLAUSIBLE = 1 << 14
    RATE_STUCK = 1 << 15


def schema() -> dict[str, Any]:
    """The corrected sample's layout, as served at `<prefix>/<channel>/schema`."""
    fields: Any = CORRECTED.fields
    return {
        "schema": "rtcomp.corrected/1",
        "size": CORRECTED.itemsize,
        "fields": [[name, fields[name][0].str, fields[name][1]] for name in CORRECTED.names or ()],
        "flags": {flag.name.lower(): int(flag).bit_length() - 1 for flag in Flag if flag.name},
    }


def c_declaration() -> str:
    """The corrected sample as a packed C structure."""
    kinds = {"<i8": "int64_t", "<u8": "uint64_t", "<f8": "double", "<f4": "float", "<u4": "uint32_t"}
    lines = [f"    {kinds[kind]} {name};" for name, kind, _ in schema()["fields"]]
    return "\n".join(["struct __attribute__((packed)) rtcomp_corrected {", *lines, "};"])
