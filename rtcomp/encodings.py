"""How a corrected sample looks on the wire: the packed struct, JSON, or ROS 2's sensor_msgs/msg/Imu in CDR."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from rtcomp.frames import CORRECTED, Flag

RAD = math.pi / 180.0
AXES = {"roll": 0, "pitch": 1, "yaw": 2}
UNKNOWN = -1.0  # sensor_msgs/msg/Imu: covariance[0] of a quantity that is not measured

SIZE = CORRECTED.itemsize
Encoder = Callable[[bytes, bytes, Sequence[str]], Iterable[bytes]]
"""Packed samples, the channel of each, and the channels' names; a payload per sample, in order."""


def struct_payloads(content: bytes, channel: bytes, names: Sequence[str]) -> Iterable[bytes]:
    """The samples as they are: `CORRECTED`, packed, little-endian."""
    return [content[start : start + SIZE] for start in range(0, len(content), SIZE)]


def json_payloads(content: bytes, channel: bytes, names: Sequence[str]) -> Iterator[bytes]:
    """One JSON object a sample: the struct's fields by name (null for what is not a number) and flags by name."""
    fields = CORRECTED.names or ()
    for row in np.frombuffer(content, CORRECTED).tolist():
        values = dict(zip(fields, row, strict=True))
        document = {
            k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()
        }
        flags = Flag(values["flags"])
        yield json.dumps(document | {"flag_names": [str(flag.name).lower() for flag in flags]}).encode()


def imu_dtype(frame_id: str) -> np.dtype:
    """sensor_msgs/msg/Imu in CDR: a string is its size (with the closing zero) and bytes, doubles are 8-aligned."""
    size = len(frame_id.encode()) + 1
    return np.dtype(
        [
            ("encapsulation", "u1", (4,)),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("frame_id_size", "<u4"),
            ("frame_id", f"S{size}"),
            ("padding", "u1", (-(12 + size) % 8,)),
            ("quaternion", "<f8", (4,)),
            ("orientation_covariance", "<f8", (9,)),
            ("angular_velocity", "<f8", (3,)),
            ("angular_velocity_covariance", "<f8", (9,)),
            ("linear_acceleration", "<f8", (3,)),
            ("linear_acceleration_covariance", "<f8", (9,)),
        ]
    )


def cdr_payloads(content: bytes, channel: bytes, names: Sequence[str]) -> Iterable[bytes]:
    """sensor_msgs/msg/Imu [rad/s]: the rate on the channel's axis (yaw where its name says nothing)."""
    samples, channels = np.frombuffer(content, CORRECTED), np.frombuffer(channel, np.uint8)
    payloads = [b""] * len(samples)
    for index in set(channel):
        rows = np.flatnonzero(channels == index)
        for row, payload in zip(rows, _imu_payloads(samples[rows], names[index]), strict=True):
            payloads[row] = payload
    return payloads


def _imu_payloads(samples: np.ndarray, name: str) -> Iterator[bytes]:
    axis = AXES.get(name, 2)
    imu = np.zeros(len(samples), imu_dtype(name))
    imu["encapsulation"] = (0, 1, 0, 0)  # CDR, little-endian
    imu["sec"], imu["nanosec"] = np.divmod(samples["t_ns"], 1_000_000_000)
    imu["frame_id"] = name.encode()
    imu["frame_id_size"] = len(name.encode()) + 1
    imu["quaternion"][:, 3] = 1.0
    imu["orientation_covariance"][:, 0] = UNKNOWN
    imu["linear_acceleration_covariance"][:, 0] = UNKNOWN
    imu["angular_velocity"][:, axis] = samples["rate_dps"] * RAD
    variance = np.square(samples["sigma_dps"].astype(np.float64) * RAD)
    imu["angular_velocity_covariance"][:, 4 * axis] = np.where(np.isfinite(variance), variance, 0.0)
    view, size = imu.view(np.uint8).data, imu.itemsize
    for start in range(0, len(view), size):
        yield bytes(view[start : start + size])


ENCODERS: dict[str, Encoder] = {"struct": struct_payloads, "json": json_payloads, "cdr": cdr_payloads}
"""By the name of the `--encoding` option."""
MIME = {
    "struct": "application/octet-stream;rtcomp.corrected/1",
    "json": "application/json",
    "cdr": "application/cdr",
}
"""The zenoh encoding that goes with each."""
