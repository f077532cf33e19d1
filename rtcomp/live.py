"""The way of a live frame in one compiled call: wait, take, correct, hand over, again, without the GIL.

Python is asked for nothing while frames come and are good: it gets its turn ten times a second, and at once when
there is an error frame to put into words, an interface that went down, or somebody waking the run. So neither the
interpreter nor the publisher can delay a frame. The loops called are those of `rtcomp.sources.batch_receive` and
`rtcomp.frame_loop`, the same as for any other source, with the same bits.
"""

import numpy as np

from rtcomp.decode import frame_words
from rtcomp.frame_loop import run_loop
from rtcomp.jit import kernel
from rtcomp.pipeline import Pipeline
from rtcomp.sample_queue import LOST, WORDS, SampleRing, push
from rtcomp.samples import new_output
from rtcomp.sources.batch_receive import (
    LAST_BATCH,
    LAST_TIME,
    OFFSET,
    ROWS,
    Workspace,
    monotonic_ns,
    receive_batch,
)
from rtcomp.step import new_rows

MILLI = 1_000_000
OUT = 1024  # samples corrected before they are handed over


class LiveLoop:
    """Receives for a pipeline into a ring; call it in place of `sources.socketcan.take_once`."""

    def __init__(self, pipeline: Pipeline, ring: SampleRing, each_batch: bool = False) -> None:
        """`each_batch` comes back after every batch of frames, for whoever wants to keep them."""
        self.pipeline, self.ring, self.each_batch = pipeline, ring, each_batch
        self.last_t_ns = 0  # of the last frame taken
        self._out = new_output(OUT + len(pipeline.names))
        self._out_words = self._out.corrected.view(np.uint32).reshape(-1, WORDS)
        self._rows = new_rows()

    def __call__(self, space: Workspace, timeout_ms: int) -> int:
        """Go on for `timeout_ms`, or until there is something for Python; what the last `receive_batch` returned."""
        pipeline, ring = self.pipeline, self.ring
        result = receive_and_correct(
            (space.words, space.address, space.frame_words, space.frames, frame_words(space.frames)),
            (pipeline.map.plan, pipeline.compiled, pipeline.state, pipeline.loop, self._rows),
            (self._out, self._out_words),
            (ring.words, ring.address, ring.sample_words, ring.channel, ring.passages),
            timeout_ms,
            self.each_batch,
        )
        self.last_t_ns = int(space.words[LAST_TIME])
        return result


@kernel
def receive_and_correct(space, correction, out, ring, timeout_ms, each_batch):
    """See `LiveLoop`; the arguments are the parts of workspace, pipeline, scratch and ring."""
    words, address, frames, _, _ = space
    end = monotonic_ns(words, address) + words[OFFSET] + timeout_ms * MILLI
    left = timeout_ms
    while True:
        result = receive_batch(words, address, frames, left)
        rows = result & ROWS
        if rows > 0:
            correct_rows(space, correction, out, ring, rows)
        now = words[LAST_BATCH]
        if result != rows or rows == 0 or each_batch or now >= end:
            return result
        left = (end - now) // MILLI + 1


@kernel
def correct_rows(space, correction, out, ring, rows):
    """Correct the first `rows` frames and hand their samples over; those without room are lost and counted."""
    words, address, _, frames, words_of_frames = space
    plan, compiled, state, loop, waiting = correction
    samples, sample_words = out
    ring_words, ring_address, to_words, to_channel, passages = ring
    received, done = words[LAST_BATCH], 0
    while done < rows:
        done, count = run_loop(
            plan, compiled, state, loop, waiting, frames[:rows], words_of_frames[:rows], done, samples
        )
        if count > 0:
            corrected = monotonic_ns(words, address) + words[OFFSET]
            if not push(ring_words, ring_address, to_words, to_channel, passages,
                        sample_words, samples.channel, count, received, corrected):  # fmt: skip
                ring_words[LOST] += count
