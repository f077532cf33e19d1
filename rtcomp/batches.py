"""`…/batch`: every sample once more, a tenth of a second of them in one message, for whoever watches or keeps them.

A subscriber of `…/rate` costs the publisher a message and a write to a socket per sample, one of `…/batch` a fraction
of that; nothing is gathered while nobody subscribes. A batch is always the packed struct, whatever `…/rate` is.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from rtcomp.frames import CORRECTED

INTERVAL_S = 0.1
LARGEST = 1 << 19  # bytes at which a batch goes early (a log is replayed faster than it was recorded)


class Batches:
    """Gathers the samples of every channel. `add` what was published, `flush` often, both from one thread."""

    def __init__(self, publishers: Sequence[Any]) -> None:
        """`publishers`: zenoh publishers of the channels' batches."""
        self._publishers = publishers
        self._gathered = [bytearray() for _ in publishers]
        self._watched = [False] * len(publishers)
        self._anybody = False
        # Channels take turns, so that no sample waits for the batches of all of them.
        self._turn, self._due = 0, time.monotonic()
        self._step_s = INTERVAL_S / len(publishers)

    def watched(self) -> list[bool]:
        """See, and return, which channels' batches have a subscriber."""
        self._watched = [publisher.matching_status.matching for publisher in self._publishers]
        self._anybody = any(self._watched)
        return self._watched

    def add(self, content: bytes, channel: bytes) -> None:
        """Take in packed samples and the channel of each."""
        if not self._anybody:
            return
        samples, channels = np.frombuffer(content, CORRECTED), np.frombuffer(channel, np.uint8)
        for index, watched in enumerate(self._watched):
            if watched:
                self._gathered[index] += samples[channels == index].tobytes()
                if len(self._gathered[index]) >= LARGEST:
                    self._send(index)

    def flush(self, now: float) -> float:
        """Send what is due at `now` (monotonic) and see who watches; returns when to call again at the latest."""
        while now >= self._due:
            index = self._turn
            self._send(index)
            self._watched[index] = self._publishers[index].matching_status.matching
            self._anybody = any(self._watched)
            self._turn = (index + 1) % len(self._publishers)
            self._due += self._step_s
            if now - self._due > INTERVAL_S:
                self._due = now
        return self._due

    def close(self) -> None:
        """Send what is left and undeclare."""
        for index, publisher in enumerate(self._publishers):
            self._send(index)
            publisher.undeclare()

    def _send(self, index: int) -> None:
        if self._gathered[index]:
            self._publishers[index].put(bytes(self._gathered[index]))
            self._gathered[index].clear()
