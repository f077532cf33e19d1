"""Sending FRAME arrays to a bus with their timing, and how well the timing was kept."""

import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtcomp.errors import RequestError
from rtcomp.frames import FRAME, FrameFlag
from rtcomp.sources.messages import to_message

if TYPE_CHECKING:
    import can

SLICE_NS = 100_000_000  # how long a stop may wait
MAX_ERROR_US = 100_000  # errors beyond are counted as this in the percentiles; the largest is kept exactly
BATCH = 64  # frames of one system call


@dataclass(frozen=True)
class ReplayReport:
    """What a replay did. The timing error is that of the time between two frames, absent at full speed."""

    sent: int
    failed: int
    skipped: int
    seconds: float
    frames_per_s: float
    gap_error_us: dict[str, float | None]
    late_us: dict[str, float | None]


class _Errors:
    """Percentiles of time errors in bounded memory, to 1 µs."""

    def __init__(self) -> None:
        self._counts = np.zeros(MAX_ERROR_US + 1, np.int64)
        self._largest_us = 0.0

    def add(self, errors_ns: NDArray[np.int64]) -> None:
        if len(errors_ns):
            magnitude = np.abs(errors_ns)
            self._largest_us = max(self._largest_us, float(magnitude.max()) / 1e3)
            places = np.minimum((magnitude + 500) // 1000, MAX_ERROR_US)
            self._counts += np.bincount(places, minlength=MAX_ERROR_US + 1)

    def summary(self) -> dict[str, float | None]:
        total = self._counts.cumsum()
        if total[-1] == 0:
            return {"p50": None, "p99": None, "max": None}
        p50, p99 = (float(np.searchsorted(total, share * total[-1])) for share in (0.5, 0.99))
        return {"p50": p50, "p99": p99, "max": round(self._largest_us, 1)}


class Sender(Protocol):
    """Sends frames at absolute times."""

    def send(
        self, frames: NDArray[Any], deadlines: NDArray[np.int64], stop: threading.Event
    ) -> NDArray[np.int64]:
        """Send frames at their deadlines (monotonic ns); returns when each went, -1 where it failed.

        Stopped early, it returns fewer.
        """
        ...


class _MessageSender:
    """Sends through python-can, one message at a time."""

    def __init__(self, bus: "can.BusABC"):
        self._bus = bus

    def send(
        self, frames: NDArray[Any], deadlines: NDArray[np.int64], stop: threading.Event
    ) -> NDArray[np.int64]:
        import can

        sent_at = np.full(len(frames), -1, np.int64)
        for i, deadline in enumerate(deadlines.tolist()):
            message = to_message(frames[i])
            while (wait_ns := deadline - time.monotonic_ns()) > 0 and not stop.is_set():
                time.sleep(min(wait_ns, SLICE_NS) / 1e9)
            if stop.is_set():
                return sent_at[:i]
            now = time.monotonic_ns()
            try:
                self._bus.send(message)
            except can.CanOperationError:
                continue
            sent_at[i] = now
        return sent_at


class _SocketSender:
    """Sends through a socket of struct can_frame, what is due in one system call, without the GIL."""

    def __init__(self, sock: socket.socket):
        from rtcomp.sources import batch_send

        self._sock = sock
        self._words = batch_send.send_words(BATCH)
        self._address = self._words.ctypes.data
        self._send_paced = batch_send.send_paced
        self.send(np.zeros(0, FRAME), np.zeros(0, np.int64), threading.Event())  # compile before time counts

    def send(
        self, frames: NDArray[Any], deadlines: NDArray[np.int64], stop: threading.Event
    ) -> NDArray[np.int64]:
        words = np.ascontiguousarray(frames).view(np.int64).reshape(-1, FRAME.itemsize // 8)
        sent_at = np.full(len(frames), -1, np.int64)
        descriptor, done = self._sock.fileno(), 0
        while not stop.is_set():
            end = time.monotonic_ns() + SLICE_NS
            done = self._send_paced(
                self._words, self._address, descriptor, words, deadlines, sent_at, done, end
            )
            if done == len(frames):
                break
        return sent_at[:done]


def sender_for(bus: "can.BusABC | socket.socket") -> Sender:
    """The fastest way to send on a bus."""
    if isinstance(bus, socket.socket):
        return _SocketSender(bus)
    if type(bus).__name__ != "SocketcanBus":
        return _MessageSender(bus)
    from rtcomp.sources.socketcan import raw_socket, send_only

    sock = raw_socket(bus)
    send_only(sock)
    return _SocketSender(sock)


def _ahead(arrays: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """The same arrays, each made while the one before is sent: reading a log must not delay a frame."""
    iterator = iter(arrays)
    with ThreadPoolExecutor(1, thread_name_prefix="read ahead") as reader:
        coming = reader.submit(next, iterator, None)
        while (array := coming.result()) is not None:
            coming = reader.submit(next, iterator, None)
            yield array


def replay(
    frames: Iterable[NDArray[Any]],
    bus: "can.BusABC | socket.socket",
    speed: float = 1.0,
    stop: threading.Event | None = None,
    error_frames: bool = False,
) -> ReplayReport:
    """Send a log's frames with its timing.

    Every frame has an absolute deadline, counted from the first: a late one does not delay those after it, and
    nothing drifts. A time that goes back in the log counts as no pause.

    Args:
        frames: FRAME arrays in the order of sending, as `read_log` gives them.
        bus: a python-can bus, or a datagram socket carrying struct can_frame.
        speed: 2 is twice as fast as recorded; 0 as fast as the bus takes it.
        stop: set it from elsewhere to end within a tenth of a second.
        error_frames: send error frames too (only virtual buses let them through); else they are skipped.

    Raises:
        RequestError: `speed` is negative or not finite.
    """
    if not 0 <= speed < float("inf"):
        raise RequestError(f"speed {speed}: wanted a number above 0, or 0 for as fast as possible")
    stop = stop or threading.Event()
    sender = sender_for(bus)
    tally = _Tally(speed)
    for array in _ahead(frames):
        chosen = array if error_frames else array[array["flags"] & FrameFlag.ERROR == 0]
        tally.skipped += len(array) - len(chosen)
        for begin in range(0, len(chosen), 4096):
            part = chosen[begin : begin + 4096]
            deadlines = tally.deadlines(part["t_ns"])
            tally.add(deadlines, sender.send(part, deadlines, stop))
            if stop.is_set():
                return tally.report()
    return tally.report()


def repeated(read: Callable[[], Iterable[NDArray[Any]]], times: int) -> Iterator[NDArray[Any]]:
    """A log's arrays `times` over, each pass going on where the last ended, one mean gap later."""
    shift, first, last, count = 0, None, 0, 0
    for _ in range(times):
        for array in read():
            if first is None:
                first = int(array["t_ns"][0])
            last = int(array["t_ns"][-1])
            count += len(array)
            shifted = array.copy()
            shifted["t_ns"] += shift
            yield shifted
        if first is not None:
            shift += last - first + (last - first) // max(1, count - 1)
            first, count = None, 0


class _Tally:
    """Deadlines going out, times of sending coming back."""

    def __init__(self, speed: float):
        self.skipped = 0
        self._speed = speed
        self._sent = self._failed = 0
        self._gaps, self._late = _Errors(), _Errors()
        self._start = 0
        self._last_time: int | None = None
        self._log_time = 0  # since the first frame, never going back
        self._last_deadline = self._last_sent = -1

    def deadlines(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """When to send frames recorded at `t_ns`, monotonic ns."""
        if self._last_time is None:
            self._start, self._last_time = time.monotonic_ns(), int(t_ns[0])
        gaps = np.maximum(np.diff(t_ns, prepend=self._last_time), 0)
        log_times = self._log_time + np.cumsum(gaps)
        self._last_time, self._log_time = int(t_ns[-1]), int(log_times[-1])
        if self._speed == 0:
            return np.full(len(t_ns), self._start, np.int64)
        return self._start + np.rint(log_times / self._speed).astype(np.int64)

    def add(self, deadlines: NDArray[np.int64], sent_at: NDArray[np.int64]) -> None:
        went = sent_at >= 0
        self._sent += int(went.sum())
        self._failed += int((~went).sum())
        if self._speed == 0 or not went.any():
            return
        due, sent = deadlines[: len(sent_at)][went], sent_at[went]
        self._late.add(sent - due)
        if self._last_sent >= 0:
            due_before, sent_before = self._last_deadline, self._last_sent
            self._gaps.add(np.diff(sent, prepend=sent_before) - np.diff(due, prepend=due_before))
        else:
            self._gaps.add(np.diff(sent) - np.diff(due))
        self._last_deadline, self._last_sent = int(due[-1]), int(sent[-1])

    def report(self) -> ReplayReport:
        seconds = (time.monotonic_ns() - self._start) / 1e9 if self._start else 0.0
        return ReplayReport(
            sent=self._sent,
            failed=self._failed,
            skipped=self.skipped,
            seconds=round(seconds, 6),
            frames_per_s=round(self._sent / seconds, 3) if seconds > 0 else 0.0,
            gap_error_us=self._gaps.summary(),
            late_us=self._late.summary(),
        )
