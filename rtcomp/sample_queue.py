"""The bounded queue between the thread that corrects and the one that publishes.

Two of a kind: `BatchQueue` for samples that come out of Python, on any system, and `SampleRing`, which compiled code
fills without the GIL and whose reader sleeps on an eventfd. The eventfd counts the samples, so no counter is shared
that the two threads could see in another order than the samples themselves.
"""

import os
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol

import numpy as np

from rtcomp.frames import CORRECTED
from rtcomp.jit import kernel
from rtcomp.sources.libc import poll, read, write

ROOM = 1 << 16  # samples that may wait to be published
WORDS = CORRECTED.itemsize // 4
POLLIN, EVENT_BYTES, LOW = 0x1, 8, 0xFFFFFFFF
ENDED = 1 << 40  # what the eventfd counts for the end, far beyond any number of samples
(HEAD, TAIL, LOST, WAIT, SENT, SEEN) = range(6)  # words of a ring


class Batch(NamedTuple):
    """Samples on their way out, and when their frames were taken and corrected [ns], each of shape `(n,)`."""

    corrected: np.ndarray
    channel: np.ndarray
    t_received_ns: np.ndarray
    t_corrected_ns: np.ndarray


NOTHING = Batch(np.zeros(0, CORRECTED), np.zeros(0, np.uint8), np.zeros(0, np.int64), np.zeros(0, np.int64))


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

        The arrays may be changed, and are good until `done`; more may be taken before.
        """
        ...

    def done(self, count: int) -> None:
        """The oldest `count` of the samples taken need no room any more."""
        ...

    def close(self) -> None:
        """Give back what the system lent; both threads are through with it."""
        ...


class BatchQueue:
    """Arrays of samples through a queue of the standard library."""

    def __init__(self) -> None:
        self.lost = 0  # it drops nothing by itself
        self._queue: SimpleQueue[Batch | None] = SimpleQueue()
        self._put = self._done = 0

    def put(
        self, corrected: np.ndarray, channel: np.ndarray, t_received_ns: int, t_corrected_ns: int
    ) -> bool:
        """See `SampleQueue`."""
        count = len(corrected)
        if self._put - self._done + count > ROOM:
            return False
        self._put += count
        times = (np.full(count, t_ns, np.int64) for t_ns in (t_received_ns, t_corrected_ns))
        self._queue.put(Batch(corrected.copy(), channel.copy(), *times))
        return True

    def end(self) -> None:
        """See `SampleQueue`."""
        self._queue.put(None)

    def take(self, timeout_s: float) -> Batch | None:
        """See `SampleQueue`."""
        try:
            return self._queue.get(timeout=timeout_s)
        except Empty:
            return NOTHING

    def done(self, count: int) -> None:
        """See `SampleQueue`."""
        self._done += count

    def close(self) -> None:
        """See `SampleQueue`."""


class SampleRing:
    """Samples in a ring that `push` fills from compiled code; Linux only."""

    def __init__(self, room: int = ROOM) -> None:
        self.room = room
        self.samples = np.zeros(room, CORRECTED)
        self.sample_words = self.samples.view(np.uint32).reshape(room, WORDS)
        self.channel = np.zeros(room, np.uint8)
        self.times = np.zeros((room, 2), np.int64)  # taken, corrected
        self.words = np.zeros(6, np.int64)
        self.address = self.words.ctypes.data
        self._descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.words[WAIT] = self._descriptor | POLLIN << 32
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
        return bool(push(self.words, self.address, self.sample_words, self.channel, self.times,
                         words, channel, np.int64(len(corrected)), *times))  # fmt: skip

    def end(self) -> None:
        """See `SampleQueue`."""
        os.eventfd_write(self._descriptor, ENDED)

    def take(self, timeout_s: float) -> Batch | None:
        """See `SampleQueue`."""
        if not self._waiting:
            if self._ended:
                return None
            came = int(
                wait(self.words, self.address, 0 if self._ended else max(0, int(timeout_s * 1000 + 0.5)))
            )
            self._ended = came >= ENDED
            self._waiting = came % ENDED
            if not self._waiting:
                return None if self._ended else NOTHING
        first = self._taken % self.room
        part = slice(first, first + min(self._waiting, self.room - first))
        self._waiting -= part.stop - first
        self._taken += part.stop - first
        return Batch(self.samples[part], self.channel[part], *self.times[part].T)

    def done(self, count: int) -> None:
        """See `SampleQueue`."""
        self.words[TAIL] += count

    def close(self) -> None:
        """See `SampleQueue`."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


@kernel
def push(ring, address, to_words, to_channel, to_times, words, channel, count, t_received, t_corrected):
    """Copy `count` samples into a ring and wake its reader; False when there is no room for them."""
    room, head = to_words.shape[0], ring[HEAD]
    if head - ring[TAIL] + count > room:
        return False
    for k in range(count):
        row = (head + k) % room
        for j in range(WORDS):
            to_words[row, j] = words[k, j]
        to_channel[row] = channel[k]
        to_times[row, 0] = t_received
        to_times[row, 1] = t_corrected
    ring[HEAD] = head + count
    ring[SENT] = count
    return write(ring[WAIT] & LOW, address + 8 * SENT, EVENT_BYTES) == EVENT_BYTES


@kernel
def wait(ring, address, timeout_ms):
    """Sleep until something comes, at most `timeout_ms`; how many samples, and `ENDED` more after the end."""
    ring[WAIT] &= LOW | POLLIN << 32
    if poll(address + 8 * WAIT, 1, timeout_ms) <= 0:
        return 0
    if read(ring[WAIT] & LOW, address + 8 * SEEN, EVENT_BYTES) != EVENT_BYTES:
        return 0
    return ring[SEEN]
