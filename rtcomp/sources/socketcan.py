"""SocketCAN: python-can opens and configures the interface, compiled code takes the frames off its socket."""

import errno
import fcntl
import logging
import os
import socket
import struct
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from rtcomp.errors import RequestError, WorkError
from rtcomp.frames import FrameFlag
from rtcomp.sources import batch_receive as kernels
from rtcomp.sources import events
from rtcomp.sources.batch_receive import Workspace, receive_batch
from rtcomp.sources.clock import SteadyClock

if TYPE_CHECKING:
    import can

log = logging.getLogger(__name__)

BATCH = 256  # frames of one system call
RECEIVE_BUFFER = 8 << 20  # bytes; the default holds 30 ms of a full 1 Mbit/s bus
REOPEN_S = 0.5  # pause between attempts to get an unplugged interface back
SO_RCVBUFFORCE, SO_TIMESTAMPNS, SO_TIMESTAMPING, SO_RXQ_OVFL = 33, 35, 37, 40
CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h
TIMESTAMPING = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 6  # receive in hardware and software, report both
SIOCETHTOOL, ETHTOOL_GET_TS_INFO = 0x8946, 0x41
HARDWARE_RECEIVE = 1 << 2
LOGGED_ERRORS = 20  # error frames put into words in the log; a bad bus has thousands a second


def check_interface(channel: str | None) -> None:
    """Raise OSError for an interface that is not there, before a socket is made for it."""
    if not hasattr(socket, "AF_CAN"):
        raise OSError("this system has no SocketCAN")
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    if channel:
        socket.if_nametoindex(channel)


def stamps_in_hardware(channel: str) -> bool:
    """Whether the interface stamps received frames itself (`ethtool -T`)."""
    info = bytearray(struct.pack("=I", ETHTOOL_GET_TS_INFO).ljust(44, b"\0"))
    buffer = np.frombuffer(info, np.uint8)
    request = struct.pack("16sP", channel.encode(), buffer.ctypes.data).ljust(40, b"\0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        try:
            fcntl.ioctl(control, SIOCETHTOOL, request)
        except OSError:
            return False
    return bool(struct.unpack_from("=I", info, 4)[0] & HARDWARE_RECEIVE)


def configure_socket(
    sock: socket.socket, receive_buffer: int = RECEIVE_BUFFER, hardware: bool = False
) -> None:
    """Ask for time stamps, drop counts and a large buffer; what a socket family lacks is left out."""
    for option in (SO_RCVBUFFORCE, socket.SO_RCVBUF):  # beyond the system's limit where we may
        try:
            sock.setsockopt(socket.SOL_SOCKET, option, receive_buffer)
            break
        except PermissionError:
            continue
    for option, value in ((SO_TIMESTAMPNS, 1), (SO_RXQ_OVFL, 1)):
        try:
            sock.setsockopt(socket.SOL_SOCKET, option, value)
        except OSError as error:
            log.debug("socket option %d: %s", option, error)
    if hardware:
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, TIMESTAMPING)


Taker = Callable[[Workspace, int], int]


def take_once(space: Workspace, timeout_ms: int) -> int:
    """Wait at most `timeout_ms` for one batch; what `receive_batch` returns."""
    return receive_batch(space.words, space.address, space.frame_words, timeout_ms)


class SocketReceiver:
    """Frames of one datagram socket that carries struct can_frame and canfd_frame, in batches.

    It does not own the socket. `lost` counts the socket's drops (`SO_RXQ_OVFL`, and `SO_MEMINFO` when it is
    silent, so that the count of a burst's end does not wait for the next frame).
    """

    def __init__(self, sock: socket.socket, clock: SteadyClock | None = None, batch: int = BATCH):
        self.sock = sock
        self.clock = clock or SteadyClock()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._space = Workspace(batch, sock.fileno(), self._wake, self.clock)
        self.error_seen = False  # whether the last batch holds error frames

    @property
    def lost(self) -> int:
        """Frames that the socket's buffer had no room for."""
        return int(self._space.words[kernels.LOST])

    @property
    def last_t_ns(self) -> int:
        """Time of the last frame taken, of any batch."""
        return int(self._space.words[kernels.LAST_TIME])

    @property
    def malformed(self) -> int:
        """Datagrams that were no CAN frame."""
        return int(self._space.words[kernels.MALFORMED])

    def receive(self, timeout_s: float, take: Taker = take_once) -> NDArray[Any]:
        """Wait at most `timeout_s` for frames; see `Source`. Raises OSError with what the socket reported.

        `take` is what is called on the workspace: `take_once`, or a loop of its kind that does more with each
        batch before it returns; the frames given back are those of the last.
        """
        space = self._space
        result = take(space, max(0, round(timeout_s * 1000)))
        self.error_seen = result & kernels.ERROR_SEEN != 0
        if result & kernels.TROUBLE:
            self._deal_with_trouble()
        return space.frames[: result & kernels.ROWS]

    def _deal_with_trouble(self) -> None:
        words = self._space.words
        if words[kernels.WAKE_POLL] >> 48:
            os.eventfd_read(self._wake)
        code = int(words[kernels.ERRNO])
        if code not in (0, errno.EAGAIN, errno.EINTR):
            raise OSError(code, os.strerror(code))

    def wake(self) -> None:
        """Let a waiting `receive` return at once."""
        os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        """Give the wake-up descriptor back (the socket is its owner's)."""
        if self._wake >= 0:
            os.close(self._wake)
            self._wake = -1


class SocketCanSource:
    """A SocketCAN interface as a `Source`.

    It outlives the interface: going down and coming up are logged and counted in `downs`, and an interface
    that is unplugged is opened again when it is back.
    """

    def __init__(
        self,
        opened: Callable[[], "can.BusABC"],
        name: str,
        clock: SteadyClock | None = None,
        batch: int = BATCH,
    ):
        self.downs = 0
        self._open = opened
        self._name = name
        self._batch = batch
        self._clock = clock or SteadyClock()
        self._lost_before = 0
        self._is_down = False
        self._errors_told = 0
        self._bus: can.BusABC | None = None
        self._receiver: SocketReceiver | None = None
        self._connect()

    def _connect(self) -> None:
        self._bus = bus = self._open()
        try:
            sock = raw_socket(bus)
            hardware = stamps_in_hardware(str(getattr(bus, "channel", "")))
            configure_socket(sock, hardware=hardware)
            self._receiver = SocketReceiver(sock, self._clock, self._batch)
        except OSError:
            bus.shutdown()
            raise

    def _disconnect(self) -> None:
        if self._receiver is not None:
            self._lost_before += self._receiver.lost
            self._receiver.close()
        if self._bus is not None:
            self._bus.shutdown()
        self._receiver = self._bus = None

    @property
    def lost(self) -> int:
        """Frames that the socket's buffer had no room for."""
        return self._lost_before + (self._receiver.lost if self._receiver else 0)

    def receive(self, timeout_s: float, take: Taker = take_once) -> NDArray[Any]:
        """Wait at most `timeout_s` for frames; see `Source`, and `SocketReceiver.receive` for `take`."""
        if self._receiver is None:
            return self._reconnect(timeout_s)
        before = self._receiver.last_t_ns
        try:
            frames = self._receiver.receive(timeout_s, take)
        except OSError as error:
            return self._interface_trouble(error, timeout_s)
        if self._is_down and self._receiver.last_t_ns != before:
            self._is_down = False
            log.warning("%s: is up again", self._name)
        if self._receiver.error_seen:
            self._tell_errors(frames)
        return frames

    def _interface_trouble(self, error: OSError, timeout_s: float) -> NDArray[Any]:
        if error.errno == errno.ENETDOWN:  # the socket stays bound and works again when it is up
            self._went_down("is down; waiting for it to come up")
        elif error.errno in (errno.ENODEV, errno.ENXIO):
            self._went_down("is gone; waiting for it to come back")
            self._disconnect()
        else:
            raise WorkError(f"bus {self._name!r}: receiving failed: {error}") from error
        time.sleep(min(timeout_s, 0.01))
        return np.zeros(0, kernels.FRAME)

    def _went_down(self, what: str) -> None:
        if not self._is_down:
            self.downs += 1
            log.warning("%s: %s", self._name, what)
        self._is_down = True

    def _reconnect(self, timeout_s: float) -> NDArray[Any]:
        time.sleep(min(timeout_s, REOPEN_S))
        try:
            self._connect()
        except (OSError, RequestError) as error:
            log.debug("%s: %s", self._name, error)
        return np.zeros(0, kernels.FRAME)

    def _tell_errors(self, frames: NDArray[Any]) -> None:
        room = LOGGED_ERRORS - self._errors_told
        for frame in frames[frames["flags"] == FrameFlag.ERROR][: max(0, room)]:
            log.warning("%s: error frame: %s", self._name, ", ".join(events.describe_error(frame)))
            self._errors_told += 1
            if self._errors_told == LOGGED_ERRORS:
                log.warning("%s: further error frames are counted, not logged", self._name)

    def wake(self) -> None:
        """Let a waiting `receive` return at once."""
        if self._receiver is not None:
            self._receiver.wake()

    def close(self) -> None:
        """Shut the bus down and give every descriptor back."""
        self._disconnect()

    def describe(self) -> str:
        """The bus as given, and how it is received."""
        return f"{self._name} (batches of up to {self._batch} frames, kernel time stamps)"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def raw_socket(bus: "can.BusABC") -> socket.socket:
    """The socket of python-can's SocketCAN bus, set to carry CAN FD too."""
    sock: socket.socket = bus.socket  # pyright: ignore[reportAttributeAccessIssue]
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    return sock


def send_only(sock: socket.socket) -> None:
    """Let the kernel queue nothing for a socket that never receives."""
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
    sock.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, 0)
