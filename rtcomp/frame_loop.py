"""The frame loop: FRAME array in, CORRECTED array out, one compiled pass with explicit state.

A frame that is bad in any way changes nothing but a count, and marks what follows. Live, replay and offline
call the same loop; how frames are cut into arrays makes no difference to a single bit.
"""

import numpy as np

from rtcomp.decode import physical_value
from rtcomp.frame_checks import check_frame, find_message
from rtcomp.frames import CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW, Flag, FrameFlag
from rtcomp.jit import hot_kernel, kernel, rare_kernel
from rtcomp.loop_state import (
    CLOCK_STEPS,
    ERROR_FRAME,
    FRAMES,
    GOOD,
    ID_KIND,
    IGNORED,
    IGNORED_FRAMES,
    IMPLAUSIBLE,
    LOST_FRAMES,
    NOT_AVAILABLE,
)
from rtcomp.plan import COIL, RATE, REFERENCE, TEMPERATURE
from rtcomp.plausibility import is_plausible
from rtcomp.samples import correct_waiting, put_sample
from rtcomp.step import BLOCK
from rtcomp.thermal import LAST_COIL, ONE, thermal_update

EXTENDED, ERROR = int(FrameFlag.EXTENDED), int(FrameFlag.ERROR)
BAD_BEFORE, STEP, LOST = int(Flag.BAD_FRAME_BEFORE), int(Flag.CLOCK_STEP), int(Flag.FRAMES_LOST)
FULL = np.uint64(BLOCK)


@kernel
def run_loop(plan, c, s, loop, rows, frames, words, start, out):
    """Take frames from `start` on until all are taken or `out` could overflow.

    Samples wait to be corrected until a message comes that may change a thermal state, or their block is full.
    Returns the index of the first frame not taken and the number of samples written to `out`.
    """
    written = np.uint64(0)
    out.waiting[0] = written
    room = np.uint64(out.corrected.shape[0] - plan.channels.shape[0])
    i, stop = np.uint64(start), np.uint64(frames.shape[0])
    while True:
        done = i >= stop or written > room
        found = (
            IGNORED if done else find_message(plan, frames[i]["can_id"], (frames[i]["flags"] & EXTENDED) != 0)
        )
        if done or brings_temperature(plan, found) or written - out.waiting[0] >= FULL:
            correct_waiting(c, s, loop, rows, out, written)
        if done:
            return np.int64(i), np.int64(written)
        written = take_frame(plan, c, s, loop, frames, words, i, found, out, written)
        i += ONE


@hot_kernel
def brings_temperature(plan, found):
    """Whether the message changes a thermal state: its first use is not of a rate or a reference."""
    if found < 0:
        return False
    m = np.uint64(found)
    first = plan.messages[m]["first_use"]
    return first < plan.messages[m]["last_use"] and plan.uses[first]["role"] < REFERENCE


@hot_kernel
def take_frame(plan, c, s, loop, frames, words, i, found, out, written):
    """One frame of the message `found`; returns how many samples are in `out` after it."""
    if frames[i]["flags"] & ERROR:
        take_error_frame(loop, frames, i)
        return written
    loop.totals[FRAMES] += 1
    if found == IGNORED:
        loop.totals[IGNORED_FRAMES] += 1
        return written
    m = np.uint64(found if found >= 0 else -3 - found)
    cause = check_frame(plan, loop, frames, words, i, m) if found >= 0 else ID_KIND
    if cause != GOOD:
        loop.rejected[cause] += 1
        mark_message(plan, loop, m, BAD_BEFORE)
        return written
    return take_message(plan, c, s, loop, frames, words, i, m, out, written)


@rare_kernel
def take_error_frame(loop, frames, i):
    """The receiver's own events, and what the controller reports: nothing of it is data, all of it marks."""
    if frames[i]["can_id"] == 0:
        loop.totals[CLOCK_STEPS] += 1
        mark_all(loop, STEP)
        return
    if frames[i]["can_id"] & CAN_ERR_CRTL and frames[i]["data"][1] & CAN_ERR_CRTL_RX_OVERFLOW:
        lost = 0
        for k in range(4):
            lost |= np.int64(frames[i]["data"][2 + k]) << (8 * k)
        loop.totals[LOST_FRAMES] += lost
        mark_all(loop, LOST)
        return
    loop.totals[FRAMES] += 1
    loop.rejected[ERROR_FRAME] += 1
    mark_all(loop, BAD_BEFORE)


@hot_kernel
def mark_all(loop, bit):
    """Flag the next sample of every channel."""
    for ch in range(loop.marks.shape[0]):
        loop.marks[ch] |= bit


@hot_kernel
def mark_message(plan, loop, m, bit):
    """Flag the next sample of every channel that message m feeds."""
    for k in range(plan.messages[m]["first_use"], plan.messages[m]["last_use"]):
        loop.marks[np.uint64(plan.uses[k]["channel"])] |= bit


@hot_kernel
def take_message(plan, c, s, loop, frames, words, i, m, out, written):
    """Hand every signal of a good frame to its channel: temperatures first, then references, then rates."""
    t_ns = frames[i]["t_ns"]
    for k in range(plan.messages[m]["first_use"], plan.messages[m]["last_use"]):
        ch, role = np.uint64(plan.uses[k]["channel"]), np.uint64(plan.uses[k]["role"])
        index, payloads = np.uint64(plan.uses[k]["signal"]), frames["data"]
        value = physical_value(
            words, payloads, i, plan.signals, index, plan.mux_ranges, plan.na_ranges, plan.scratch
        )
        if role == RATE:
            if np.isnan(value):
                loop.rejected[NOT_AVAILABLE] += 1
                loop.marks[ch] |= BAD_BEFORE
                continue
            put_sample(plan, c, s, loop, frames, words, i, ch, t_ns, value, out, written)
            written += ONE
        elif not np.isnan(value):
            take_slow(plan, c, s, loop, ch, role, t_ns, value)
    return written


@hot_kernel
def take_slow(plan, c, s, loop, ch, role, t_ns, value):
    """A temperature or a reference: held, with its time."""
    if role != REFERENCE and not is_plausible(plan, c, s, loop, ch, role, t_ns, value):
        loop.rejected[IMPLAUSIBLE] += 1
        return
    loop.values[ch, role] = value
    loop.times[ch, role] = t_ns
    if role == TEMPERATURE:
        thermal_update(c, s, ch, t_ns, value, loop.values[ch, COIL])
    elif role == COIL:
        s.values[ch, LAST_COIL] = value
