"""What is on the bus in tools.bench_live: a FOG at up to 1 kHz among frames that nobody wants. Simulated frames.

Every rate frame bears its number in its rate, so that whoever receives it anywhere can be held against what was sent.
"""

import socket
import threading
from typing import Any, NamedTuple

import numpy as np

from rtcomp import fog_format
from rtcomp.frames import FRAME, FrameFlag
from rtcomp.model import Model
from rtcomp.sources.bus import open_can
from rtcomp.sources.transmit import sender_for
from tools.bench_core import bench_model

START_NS = 1_767_225_600_000_000_000
GYRO_HZ, TEMPERATURE_HZ = 1000, 10
STEP_DPS = 0.001  # of the rate from one frame to the next
LEAD_NS = 50_000_000  # between making the deadlines and the first of them
SECOND = 1_000_000_000


class Load(NamedTuple):
    """Frames per second on the bus, classical or CAN FD."""

    frames_per_s: int
    fd: bool = False

    @property
    def name(self) -> str:
        """Its key in the results."""
        return f"fd_{self.frames_per_s}" if self.fd else str(self.frames_per_s)

    @property
    def map(self) -> str:
        """The signal map of its gyro."""
        return "fog_fd" if self.fd else "fog"

    @property
    def rate_id(self) -> int:
        """The id of its rate frames."""
        return fog_format.FD_ID if self.fd else fog_format.RATE_ID


LOADS = (Load(100), Load(1000), Load(9009), Load(20_000, fd=True))
"""The last classical one is a full bus of 1 Mbit/s: 111 bits for a frame of eight bytes."""


def model() -> Model:
    """Four rules and a lag, as in tools.bench_core."""
    return bench_model()


def make_frames(load: Load, seconds: float) -> np.ndarray:
    """FRAME array, evenly spaced in time from 0 on; rate frame k has the rate (k − n/2) · STEP_DPS."""
    count = round(load.frames_per_s * seconds)
    t_ns = np.arange(count) * SECOND // load.frames_per_s
    gyro_hz = min(load.frames_per_s, GYRO_HZ)
    is_gyro = np.diff(np.arange(count + 1) * gyro_hz // load.frames_per_s) > 0
    order = np.cumsum(is_gyro) - 1
    is_slow = is_gyro & (order % (gyro_hz // TEMPERATURE_HZ) == 0) & (not load.fd)
    frames = _others(t_ns, load.fd)
    slow = t_ns[is_slow]
    if len(slow):
        temp = 20.0 + 0.1 * np.sin(np.arange(len(slow)) / 5.0)
        frames[is_slow] = fog_format.encode_temperature(slow, temp, temp)
    rate_t_ns = t_ns[is_gyro & ~is_slow]
    rate = rates(len(rate_t_ns))
    frames[is_gyro & ~is_slow] = (
        fog_format.encode_fd(rate_t_ns, rate, 20.0, 20.0)
        if load.fd
        else fog_format.encode_rate(rate_t_ns, rate)
    )
    return frames


def rates(count: int) -> np.ndarray:
    """The rates of `count` frames [°/s]."""
    return (np.arange(count) - count // 2) * STEP_DPS


def numbers(rate_dps: np.ndarray, count: int) -> np.ndarray:
    """Which of `count` rate frames these rates are of."""
    return np.rint(rate_dps / STEP_DPS).astype(np.int64) + count // 2


def _others(t_ns: np.ndarray, fd: bool) -> np.ndarray:
    random = np.random.default_rng(4)
    frames = np.zeros(len(t_ns), FRAME)
    frames["t_ns"] = t_ns
    frames["can_id"] = random.integers(0x100, 0x7FF, len(t_ns))
    frames["length"] = 8
    frames["flags"] = int(FrameFlag.FD | FrameFlag.BITRATE_SWITCH) if fd else 0
    frames["data"][:, :8] = random.integers(0, 256, (len(t_ns), 8))
    return frames


class Sent(NamedTuple):
    """What went out: when each rate frame was sent [monotonic ns, −1: not], and all frames."""

    rate_at_ns: np.ndarray
    frames: int
    seconds: float


class Traffic:
    """Sends loads on a bus with their timing, from compiled code.

    A bus that begins with a slash is the path of a datagram socket, which carries frames as a CAN interface does.
    """

    def __init__(self, bus: str) -> None:
        self._bus = None if bus.startswith("/") else open_can(f"{bus}?fd=true")
        self._path, self._socket = bus, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sender = sender_for(self._bus or self._socket)

    def send(self, frames: np.ndarray, rate_id: int) -> Sent:
        """All frames at their times; returns when the last is out."""
        import time

        if self._bus is None:
            self._socket.connect(self._path)  # whoever listens now
        start = time.monotonic_ns() + LEAD_NS
        sent_at = self._sender.send(frames, start + frames["t_ns"], threading.Event())
        seconds = (time.monotonic_ns() - start) / SECOND
        return Sent(sent_at[frames["can_id"] == rate_id], int((sent_at >= 0).sum()), seconds)

    def close(self) -> None:
        """Give the bus back."""
        if self._bus is not None:
            self._bus.shutdown()
        self._socket.close()


def options_of(load: Load) -> dict[str, Any]:
    """What a program is told of a load."""
    return {"fd": load.fd, "map": load.map, "rate_id": load.rate_id}
