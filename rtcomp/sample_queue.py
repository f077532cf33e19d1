"""The bounded queue between the thread that corrects and the one that publishes.

Two of a kind: `BatchQueue` for samples that come out of Python, on any system, and `SampleRing`, which compiled code
fills without the GIL and whose reader sleeps on an eventfd. The eventfd counts the samples, so no counter is shared
that the two threads could see in another order than the samples themselves. The queue knows when each sample passed:
taking fills in the publication time, and whoever comes back for more has put what was taken before.
"""

import os
import time
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol

import numpy as np

from rtcomp import latency
from rtcomp.frames import CORRECTED
from rtcomp.jit import kernel
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.libc import CLOCK_MONOTONIC, clock_gettime, poll, read, write

ROOM = 1 << 16  # samples that may wait to be published
WORDS = CORRECTED.itemsize // 4
T_PUB = CORRECTED.names.index("t_pub_ns") * 2  # the word of a sample where its publication time begins
POLLIN, EVENT_BYTES, LOW, NANO = 0x1, 8, 0xFFFFFFFF, 1_000_000_000
ENDED = 1 << 40  # what the eventfd counts for the end, far beyond any number of samples
(HEAD, TAIL, LOST, WAIT, SENT, SEEN, SECONDS, NANOS) = range(8)  # words of a ring


class Batch(NamedTuple):
    """Samples on their way out, and their channels, each of shape `(n,)`."""

    corrected: np.ndarray
    channel: np.ndarray


NOTHING = Batch(np.zeros(0, CORRECTED), np.zeros(0, np.uint8))


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

        Their `t_pub_ns` is filled in, and what was taken before counts as put from now on. The arrays are good until
        `passed`; more may be taken before.
        """
        ...

    def passed(self) -> np.ndarray:
        """When all that was taken since the last call passed (see `rtcomp.latency`), `(n, 5)` ns; its room is free."""
        ...

    def close(self) -> None:
        """Give back what the system lent; both threads are through with it."""
        ...


class BatchQueue:
    """Arrays of samples through a queue of the standard library."""

    def __init__(self, clock: SteadyClock | None = None) -> None:
        self.lost = 0  # it drops nothing by itself
        self._clock = clock or SteadyClock()
        self._queue: SimpleQueue[tuple[Batch, np.ndarray] | None] = SimpleQueue()
        self._put = self._done = 0
        self._taken: list[np.ndarray] = []
        self._going: np.ndarray | None = None

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
        self._queue.put((Batch(corrected.copy(), channel.copy()), passages))
        return True

    def end(self) -> None:
        """See `SampleQueue`."""
        self._queue.put(None)

    def take(self, timeout_s: float) -> Batch | None:
        """See `SampleQueue`."""
        self._gone()
        try:
            came = self._queue.get(timeout=max(timeout_s, 0.0))
        except Empty:
            return NOTHING
        if came is None:
            return None
        batch, passages = came
        batch.corrected["t_pub_ns"] = passages[:, latency.PUT] = self._clock.now_ns()
        self._going = passages
        self._taken.append(passages)
        return batch

    def _gone(self) -> None:
        if self._going is not None:
            self._going[:, latency.OUT] = self._clock.now_ns()
            self._going = None

    def passed(self) -> np.ndarray:
        """See `SampleQueue`."""
        self._gone()
        passages = np.concatenate(self._taken) if self._taken else np.zeros((0, 5), np.int64)
        self._taken.clear()
        self._done += len(passages)
        return passages

    def close(self) -> None:
        """See `SampleQueue`."""


class SampleRing:
    """Samples in a ring that `push` fills from compiled code; Linux only."""

    def __init__(self, room: int = ROOM, clock: SteadyClock | None = None) -> None:
        self.room = room
        self.samples = np.zeros(room, CORRECTED)
        self.sample_words = self.samples.view(np.uint32).reshape(room, WORDS)
        self.channel = np.zeros(room, np.uint8)
        self.passages = np.zeros((room, 5), np.int64)
        self.words = np.zeros(8, np.int64)
        self.address = self.words.ctypes.data
        self._offset_ns = (clock or SteadyClock()).offset_ns
        self._descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.words[WAIT] = self._descriptor | POLLIN << 32
        self._waiting = self._taken = self._out = 0
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
        if not self._waiting:
            if self._ended:
                return None
            timeout_ms = 0 if self._ended or timeout_s <= 0.0 else int(timeout_s * 1000.0 + 0.5)
            came = wait(self.words, self.address, self.sample_words, self.passages, self._offset_ns,
                        self._out, self._taken, timeout_ms)  # fmt: skip
            self._out = self._taken
            self._ended = came >= ENDED
            self._waiting = came % ENDED
            if not self._waiting:
                return None if self._ended else NOTHING
        first = self._taken % self.room
        last = min(first + self._waiting, self.room)
        self._waiting -= last - first
        self._taken += last - first
        return Batch(self.samples[first:last], self.channel[first:last])

    def passed(self) -> np.ndarray:
        """See `SampleQueue`."""
        tail = int(self.words[TAIL])
        passages = self.passages[np.arange(tail, self._taken) % self.room]
        passages[self._out - tail :, latency.OUT] = time.monotonic_ns() + self._offset_ns
        self._out = self._taken
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
    return write(ring[WAIT] & LOW, address + 8 * SENT, EVENT_BYTES) == EVENT_BYTES


@kernel
def wait(ring, address, to_words, passages, offset_ns, out, taken, timeout_ms):
    """Sleep until something comes, at most `timeout_ms`; how many samples, and `ENDED` more after the end.

    Before, the samples from `out` up to `taken` are noted as put; after, those that came as about to be put.
    """
    room = to_words.shape[0]
    if out < taken:
        now = _now(ring, address) + offset_ns
        for k in range(out, taken):
            passages[k % room, latency.OUT] = now
    ring[WAIT] &= LOW | POLLIN << 32
    if poll(address + 8 * WAIT, 1, timeout_ms) <= 0:
        return 0
    if read(ring[WAIT] & LOW, address + 8 * SEEN, EVENT_BYTES) != EVENT_BYTES:
        return 0
    now = _now(ring, address) + offset_ns
    for k in range(taken, taken + ring[SEEN] % ENDED):
        passages[k % room, latency.PUT] = now
        to_words[k % room, T_PUB] = now & LOW
        to_words[k % room, T_PUB + 1] = now >> 32
    return ring[SEEN]


@kernel
def _now(ring, address):
    clock_gettime(CLOCK_MONOTONIC, address + 8 * SECONDS)
    return ring[SECONDS] * NANO + ring[NANOS]
