"""The bounded queue between the thread that corrects and the one that publishes.

Two of a kind: `BatchQueue` for samples that come out of Python, on any system, and `SampleRing`, which compiled code
fills without the GIL and whose reader sleeps on an eventfd. The eventfd counts the samples, so no counter is shared
that the two threads could see in another order than the samples themselves. The queue knows when each sample passed:
taking fills in the publication time, and whoever comes back for more has put what was taken before.

What is taken is bytes: no array is made on the way of a sample.
"""

import os
import select
import struct
from queue import Empty, SimpleQueue
from typing import Protocol

import numpy as np

from rtcomp import latency
from rtcomp.frames import CORRECTED
from rtcomp.jit import kernel
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.libc import write

ROOM = 1 << 16  # samples that may wait to be published
SIZE = CORRECTED.itemsize
WORDS = SIZE // 4
T_PUB = 8  # where a sample's publication time is, after the eight bytes of t_ns
EVENT_BYTES = 8
ENDED = 1 << 40  # what the eventfd counts for the end, far beyond any number of samples
(HEAD, TAIL, LOST, DESCRIPTOR, SENT) = range(5)  # words of a ring

Batch = tuple[bytes, bytes]
"""Samples on their way out, packed one after the other, and the channel of each."""
NOTHING: Batch = b"", b""
_put_time = struct.Struct("<q").pack_into


class SampleQueue(Protocol):
    """One thread puts, one takes."""

    @property
    def lost(self) -> int:
        """Samples that found no room, where the queue itself had to drop them."""
        ...

    def put(
        self, corrected: np.ndarray, channel: np.ndarray, t_received_ns: int, t_corrected_ns: int
    ) -> bool:
        """Copy samples in; False when there is no room for all of them, and none was taken then."""
        ...

    def end(self) -> None:
        """Nothing more comes."""
        ...

    def take(self, timeout_s: float) -> Batch | None:
        """What has come, waiting at most `timeout_s` for it; `NOTHING` then, None after the end.

        Their `t_pub_ns` is filled in, and what was taken before counts as put from now on.
        """
        ...

    def passed(self) -> np.ndarray:
        """When all that was taken since the last call passed (see `rtcomp.latency`), `(n, 5)` ns; its room is free."""
        ...

    def close(self) -> None:
        """Give back what the system lent; both threads are through with it."""
        ...


class _Takings:
    """How many samples were taken at once, and when those were put."""

    def __init__(self, clock: SteadyClock) -> None:
        self._now_ns = clock.now_ns
        self._counts: list[int] = []
        self._put_ns: list[int] = []
        self._out_ns: list[int] = []

    def taken(self, count: int) -> int:
        """So many were taken; returns the time."""
        self._counts.append(count)
        self._put_ns.append(now := self._now_ns())
        return now

    def put(self) -> None:
        """What was taken last has been put."""
        if len(self._out_ns) < len(self._put_ns):
            self._out_ns.append(self._now_ns())

    def fill(self, passages: np.ndarray) -> None:
        """Write the times to all that was taken since the last call, `(n, 5)`."""
        self.put()
        passages[:, latency.PUT] = np.repeat(self._put_ns, self._counts)
        passages[:, latency.OUT] = np.repeat(self._out_ns, self._counts)
        for times in (self._counts, self._put_ns, self._out_ns):
            times.clear()


class BatchQueue:
    """Arrays of samples through a queue of the standard library."""

    def __init__(self, clock: SteadyClock | None = None) -> None:
        self.lost = 0  # it drops nothing by itself
        self._queue: SimpleQueue[tuple[np.ndarray, bytes, np.ndarray] | None] = SimpleQueue()
        self._takings = _Takings(clock or SteadyClock())
        self._put = self._done = 0
        self._taken: list[np.ndarray] = []

    def put(
        self, corrected: np.ndarray, channel: np.ndarray, t_received_ns: int, t_corrected_ns: int
    ) -> bool:
        """See `SampleQueue`."""
        count = len(corrected)
        if self._put - self._done + count > ROOM:
            return False
        self._put += count
        passages = np.empty((count, 5), np.int64)
        passages[:, latency.FRAME] = corrected["t_ns"]
        passages[:, latency.TAKEN], passages[:, latency.DONE] = t_received_ns, t_corrected_ns
        self._queue.put((corrected.copy(), channel.tobytes(), passages))
        return True

    def end(self) -> None:
        """See `SampleQueue`."""
        self._queue.put(None)

    def take(self, timeout_s: float) -> Batch | None:
        """See `SampleQueue`."""
        self._takings.put()
        try:
            came = self._queue.get(timeout=max(timeout_s, 0.0))
        except Empty:
            return NOTHING
        if came is None:
            return None
        corrected, channel, passages = came
        self._taken.append(passages)
        corrected["t_pub_ns"] = self._takings.taken(len(channel))
        return corrected.tobytes(), channel

    def passed(self) -> np.ndarray:
        """See `SampleQueue`."""
        passages = np.concatenate(self._taken) if self._taken else np.zeros((0, 5), np.int64)
        self._takings.fill(passages)
        self._taken.clear()
        self._done += len(passages)
        return passages

    def close(self) -> None:
        """See `SampleQueue`."""


class SampleRing:
    """Samples in a ring that `push` fills from compiled code; Linux only."""

    def __init__(self, room: int = ROOM, clock: SteadyClock | None = None) -> None:
        self.room = room
        self.sample_words = np.zeros((room, WORDS), np.uint32)
        self.channel = np.zeros(room, np.uint8)
        self.passages = np.zeros((room, 5), np.int64)
        self.words = np.zeros(5, np.int64)
        self.address = self.words.ctypes.data
        self._content, self._channels = self.sample_words.data.cast("B"), self.channel.data
        self._takings = _Takings(clock or SteadyClock())
        self._descriptor = self.words[DESCRIPTOR] = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)
        self._waiting = self._taken = 0
        self._ended = False

    @property
    def lost(self) -> int:
        """Samples for which compiled code found no room."""
        return int(self.words[LOST])

    def put(
        self, corrected: np.ndarray, channel: np.ndarray, t_received_ns: int, t_corrected_ns: int
    ) -> bool:
        """See `SampleQueue`."""
        words = np.ascontiguousarray(corrected).view(np.uint32).reshape(-1, WORDS)
        times = np.int64(t_received_ns), np.int64(t_corrected_ns)
        return bool(push(self.words, self.address, self.sample_words, self.channel, self.passages,
                         words, channel, np.int64(len(corrected)), *times))  # fmt: skip

    def end(self) -> None:
        """See `SampleQueue`."""
        os.eventfd_write(self._descriptor, ENDED)

    def take(self, timeout_s: float) -> Batch | None:
        """See `SampleQueue`."""
        self._takings.put()
        if not self._waiting:
            if self._ended:
                return None
            if not self._poll.poll(timeout_s * 1000.0 if timeout_s > 0.0 else 0):
                return NOTHING
            came = os.eventfd_read(self._descriptor)
            if came >= ENDED:
                self._ended = True
                came -= ENDED
            if not came:
                return None
            self._waiting = came
        first = self._taken % self.room
        count = min(self._waiting, self.room - first)
        self._waiting -= count
        self._taken += count
        now_ns = self._takings.taken(count)
        start, end = first * SIZE, (first + count) * SIZE
        for time in range(start + T_PUB, end, SIZE):
            _put_time(self._content, time, now_ns)
        return self._content[start:end].tobytes(), self._channels[first : first + count].tobytes()

    def passed(self) -> np.ndarray:
        """See `SampleQueue`."""
        passages = self.passages[np.arange(self.words[TAIL], self._taken) % self.room]
        self._takings.fill(passages)
        self.words[TAIL] = self._taken
        return passages

    def close(self) -> None:
        """See `SampleQueue`."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


@kernel
def push(ring, address, to_words, to_channel, passages, words, channel, count, t_received, t_corrected):
    """Copy `count` samples into a ring and wake its reader; False when there is no room for them."""
    room, head = to_words.shape[0], ring[HEAD]
    if head - ring[TAIL] + count > room:
        return False
    for k in range(count):
        row = (head + k) % room
        for j in range(WORDS):
            to_words[row, j] = words[k, j]
        to_channel[row] = channel[k]
        passages[row, latency.FRAME] = np.int64(words[k, 0]) | np.int64(words[k, 1]) << 32
        passages[row, latency.TAKEN] = t_received
        passages[row, latency.DONE] = t_corrected
    ring[HEAD] = head + count
    ring[SENT] = count
    return write(ring[DESCRIPTOR], address + 8 * SENT, EVENT_BYTES) == EVENT_BYTES
