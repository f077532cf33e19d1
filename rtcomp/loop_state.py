"""What the frame loop remembers and counts, beside the compensator's thermal states."""

from typing import NamedTuple

import numpy as np

from rtcomp.plan import Plan
from rtcomp.thermal import NEVER

CAUSES = (
    "error_frame",
    "remote_frame",
    "id_kind",
    "length",
    "crc",
    "counter_repeat",
    "counter_jump",
    "not_available",
    "implausible",
)
"""Why a frame (the last two: one signal of it) was rejected, in the order of the counts."""
ERROR_FRAME, REMOTE_FRAME, ID_KIND, LENGTH, CRC, COUNTER_REPEAT, COUNTER_JUMP, NOT_AVAILABLE, IMPLAUSIBLE = (
    range(len(CAUSES))
)
GOOD, IGNORED = -1, -2
TOTALS = ("frames", "samples", "lost_frames", "clock_steps", "ignored")
FRAMES, SAMPLES, LOST_FRAMES, CLOCK_STEPS, IGNORED_FRAMES = range(len(TOTALS))


class LoopState(NamedTuple):
    """What the loop remembers beside the compensator's `State`."""

    counters: (
        np.ndarray
    )  # int64 (messages, 2): last counter (−1: none yet), frames it may have advanced unseen
    marks: np.ndarray  # int64 (channels): flag bits for the next sample
    values: np.ndarray  # float64 (channels, 3): temperature, coil temperature, reference rate (NaN: never)
    times: np.ndarray  # int64 (channels, 4) ns: of those three, and of the last rate frame
    seq: np.ndarray  # uint64 (channels)
    rejected: np.ndarray  # int64 (causes)
    totals: np.ndarray  # int64 (TOTALS)
    flag_counts: np.ndarray  # int64 (32): samples per flag bit
    scores: (
        np.ndarray
    )  # float64 (channels, 3): samples with a reference, sums of squared raw and corrected error
    doubts: (
        np.ndarray
    )  # int64 (channels, 2): temperatures not believed since the last that was; of housing, of coil
    rates: np.ndarray  # float64 (channels, 2): last rate, last rate that was plausible
    since: (
        np.ndarray
    )  # int64 (channels, 4) ns: housing, coil, rate have their value; the last plausible rate came


def new_loop_state(plan: Plan) -> LoopState:
    """A loop that has seen nothing."""
    channels = len(plan.channels)
    return LoopState(
        np.tile(np.array([-1, 0], np.int64), (len(plan.messages), 1)),
        np.zeros(channels, np.int64),
        np.full((channels, 3), np.nan),
        np.full((channels, 4), NEVER, np.int64),
        np.zeros(channels, np.uint64),
        np.zeros(len(CAUSES), np.int64),
        np.zeros(len(TOTALS), np.int64),
        np.zeros(32, np.int64),
        np.zeros((channels, 3)),
        np.zeros((channels, 2), np.int64),
        np.full((channels, 2), np.nan),
        np.full((channels, 4), NEVER, np.int64),
    )
