"""The frame loop: FRAME array in, CORRECTED array out, one compiled pass with explicit state.

A frame that is bad in any way changes nothing but a count, and marks what follows. Live, replay and offline
call the same loop; how frames are cut into arrays makes no difference to a single bit.
"""

from typing import NamedTuple

import numpy as np

from rtcomp.decode import physical_value, raw_value
from rtcomp.e2e import profile1a_ok, profile5_ok, toyota_ok
from rtcomp.frames import CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW, Flag, FrameFlag
from rtcomp.jit import hot_kernel, kernel
from rtcomp.plan import (
    COIL,
    NO_E2E,
    PROFILE_1A,
    PROFILE_5,
    RATE,
    REFERENCE,
    STANDARD_IDS,
    TEMPERATURE,
    Plan,
)
from rtcomp.plausibility import doubt_flags, is_plausible, rate_flags
from rtcomp.step import LAST_COIL, NEVER, ONE, T_THERMAL, predict_error, sigma, thermal_update

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

EXTENDED, FD = int(FrameFlag.EXTENDED), int(FrameFlag.FD)
ERROR, REMOTE = int(FrameFlag.ERROR), int(FrameFlag.REMOTE)
MISSING, STALE = int(Flag.TEMPERATURE_MISSING), int(Flag.TEMPERATURE_STALE)
BAD_BEFORE, STEP, LOST = int(Flag.BAD_FRAME_BEFORE), int(Flag.CLOCK_STEP), int(Flag.FRAMES_LOST)
NO_MODEL, SATURATED = int(Flag.NO_MODEL), int(Flag.SATURATED)
FAULT, GAP = int(Flag.SENSOR_FAULT), int(Flag.GAP_BEFORE)


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


@kernel
def run_loop(plan, c, s, loop, frames, words, start, out, out_channel):
    """Take frames from `start` on until all are taken or `out` could overflow.

    Returns the index of the first frame not taken and the number of samples written to `out`.
    """
    written = np.uint64(0)
    room = np.uint64(out.shape[0] - plan.channels.shape[0])
    i, stop = np.uint64(start), np.uint64(frames.shape[0])
    while i < stop and written <= room:
        written = take_frame(plan, c, s, loop, frames, words, i, out, out_channel, written)
        i += ONE
    return np.int64(i), np.int64(written)


@hot_kernel
def take_frame(plan, c, s, loop, frames, words, i, out, out_channel, written):
    """One frame; returns how many samples are in `out` after it."""
    flags = frames[i]["flags"]
    if flags & ERROR:
        take_error_frame(loop, frames, i)
        return written
    loop.totals[FRAMES] += 1
    found = find_message(plan, frames[i]["can_id"], (flags & EXTENDED) != 0)
    if found == IGNORED:
        loop.totals[IGNORED_FRAMES] += 1
        return written
    m = np.uint64(found if found >= 0 else -3 - found)
    cause = check_frame(plan, loop, frames, words, i, m) if found >= 0 else ID_KIND
    if cause != GOOD:
        loop.rejected[cause] += 1
        mark_message(plan, loop, m, BAD_BEFORE)
        return written
    return take_message(plan, c, s, loop, frames, words, i, m, out, out_channel, written)


@hot_kernel
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
def find_message(plan, can_id, extended):
    """Index of the message; −3 − index when only the kind of id differs; IGNORED when nobody wants it."""
    wrong_kind = IGNORED
    if not extended and can_id < STANDARD_IDS:
        m = plan.by_standard_id[can_id & (STANDARD_IDS - 1)]
        if m >= 0:
            return np.int64(m)
    for k in range(plan.messages.shape[0]):
        if (can_id & plan.messages[k]["mask"]) == plan.messages[k]["can_id"]:
            if (plan.messages[k]["extended"] != 0) == extended:
                return k
            wrong_kind = -3 - k
    return wrong_kind


@hot_kernel
def check_frame(plan, loop, frames, words, i, m):
    """GOOD, or the cause for which the frame is rejected."""
    if frames[i]["flags"] & REMOTE:
        return REMOTE_FRAME
    length = frames[i]["length"]
    padded = (frames[i]["flags"] & FD) != 0 and length == plan.messages[m]["frame_length"]
    if length != plan.messages[m]["length"] and not padded:
        return LENGTH
    if plan.messages[m]["e2e"] != NO_E2E and not is_protected(plan, frames, i, m):
        loop.counters[m, 1] += 1  # its counter cannot be trusted, but it did take a step
        return CRC
    if plan.messages[m]["counter"] < 0:
        return GOOD
    return check_counter(plan, loop, frames, words, i, m)


@hot_kernel
def is_protected(plan, frames, i, m):
    """Whether the end-to-end checksum holds."""
    kind, data_id = plan.messages[m]["e2e"], plan.messages[m]["data_id"]
    if kind == PROFILE_1A:
        return profile1a_ok(frames[i]["data"], frames[i]["length"], data_id)
    if kind == PROFILE_5:
        return profile5_ok(frames[i]["data"], frames[i]["length"], data_id, plan.messages[m]["e2e_offset"])
    return toyota_ok(frames[i]["data"], frames[i]["length"], frames[i]["can_id"])


@hot_kernel
def check_counter(plan, loop, frames, words, i, m):
    """The counter must advance by 1…max_step, and by one more for every frame rejected since."""
    counter = np.int64(payload_raw(frames, words, i, plan.signals[np.uint64(plan.messages[m]["counter"])]))
    last = loop.counters[m, 0]
    allowed = plan.messages[m]["max_step"] + loop.counters[m, 1]
    loop.counters[m, 0] = counter
    loop.counters[m, 1] = 0
    if last < 0:
        return GOOD
    step = (counter - last) % plan.messages[m]["modulus"]
    if step == 0 and allowed < plan.messages[m]["modulus"]:
        loop.counters[m, 1] = allowed - plan.messages[m]["max_step"]
        return COUNTER_REPEAT
    return GOOD if step <= allowed else COUNTER_JUMP


@hot_kernel
def payload_raw(frames, words, i, signal):
    """Raw value of a signal in frame i."""
    return raw_value(words, frames["data"], i, signal)


@hot_kernel
def take_message(plan, c, s, loop, frames, words, i, m, out, out_channel, written):
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
            out_channel[written] = ch
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


@hot_kernel
def put_sample(plan, c, s, loop, frames, words, i, ch, t_ns, rate, out, row):
    """Write one corrected sample, with the truth about it."""
    flags = loop.marks[ch]
    loop.marks[ch] = 0
    before = loop.times[ch, 3]
    loop.times[ch, 3] = t_ns
    if before != NEVER:
        if t_ns < before:
            flags |= STEP
        elif plan.channels[ch]["gap_ns"] > 0 and t_ns - before > plan.channels[ch]["gap_ns"]:
            flags |= GAP
    if abs(rate) >= plan.channels[ch]["range_dps"]:
        flags |= SATURATED
    if plan.channels[ch]["valid"] >= 0 and not is_ok(plan, frames, words, i, ch):
        flags |= FAULT
    flags |= temperature_flags(plan, c, s, loop, ch, t_ns)
    if plan.channels[ch]["rate_stuck_ns"] > 0 or plan.channels[ch]["rate_slope"] < np.inf:
        flags |= rate_flags(plan, loop, ch, t_ns, rate)
    correction = 0.0
    std = np.nan
    if c.group_start[ch] == c.group_start[ch + ONE]:
        flags |= NO_MODEL
    else:
        correction, model_flags = predict_error(c, s, ch, t_ns, rate)
        flags |= model_flags
        std = sigma(c, s, ch, rate)
    out[row]["t_ns"] = t_ns
    out[row]["t_pub_ns"] = 0
    out[row]["seq"] = loop.seq[ch]
    out[row]["rate_raw_dps"] = rate
    out[row]["rate_dps"] = rate - correction
    out[row]["correction_dps"] = correction
    out[row]["temp_degC"] = loop.values[ch, TEMPERATURE]
    out[row]["sigma_dps"] = std
    taken = loop.times[ch, TEMPERATURE]
    out[row]["temp_age_s"] = np.nan if taken == NEVER else (t_ns - taken) * 1e-9
    out[row]["flags"] = flags
    reference = loop.values[ch, REFERENCE]
    out[row]["ref_rate_dps"] = reference
    if not np.isnan(reference):
        loop.scores[ch, 0] += 1.0
        loop.scores[ch, 1] += (rate - reference) ** 2
        loop.scores[ch, 2] += (rate - correction - reference) ** 2
    loop.seq[ch] += np.uint64(1)
    loop.totals[SAMPLES] += 1
    count_flags(loop, flags)


@hot_kernel
def count_flags(loop, flags):
    """One more sample with each of these flags."""
    bit = 0
    while flags:
        loop.flag_counts[bit] += flags & 1
        flags >>= 1
        bit += 1


@hot_kernel
def is_ok(plan, frames, words, i, ch):
    """Whether the sensor's own status is one of the good ones."""
    raw = payload_raw(frames, words, i, plan.signals[np.uint64(plan.channels[ch]["valid"])])
    start = plan.channels[ch]["ok_start"]
    good = False
    for k in range(start, start + plan.channels[ch]["ok_count"]):
        good = good or plan.ok_values[k] == raw
    return good


@hot_kernel
def temperature_flags(plan, c, s, loop, ch, t_ns):
    """Missing or stale: of the housing's temperature always, of the coil's where the model needs it."""
    taken = loop.times[ch, TEMPERATURE]
    if taken == NEVER:
        return MISSING
    max_age_ns = plan.channels[ch]["max_age_ns"]
    ahead_ns = s.times[ch, T_THERMAL] - t_ns  # above 0 while time, set back a little, has not caught up
    flags = STALE if abs(t_ns - taken) > max_age_ns or ahead_ns > max_age_ns else 0
    flags |= doubt_flags(loop, ch, TEMPERATURE, plan.channels[ch]["temp_stuck_ns"])
    if c.needs[ch, 1]:
        taken = loop.times[ch, COIL]
        if taken == NEVER:
            flags |= MISSING
        elif abs(t_ns - taken) > plan.channels[ch]["coil_max_age_ns"]:
            flags |= STALE
        flags |= doubt_flags(loop, ch, COIL, plan.channels[ch]["coil_stuck_ns"])
    return flags
