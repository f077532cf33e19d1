"""Samples: written with the truth about them as their frames come, corrected by the block before anything changes."""

from typing import NamedTuple

import numpy as np

from rtcomp.frame_checks import payload_raw
from rtcomp.frames import CORRECTED, Flag
from rtcomp.jit import hot_kernel
from rtcomp.loop_state import SAMPLES
from rtcomp.plan import COIL, REFERENCE, TEMPERATURE
from rtcomp.plausibility import doubt_flags, rate_flags
from rtcomp.step import predict_rows, sigma
from rtcomp.thermal import NEVER, ONE, T_THERMAL

MISSING, STALE = int(Flag.TEMPERATURE_MISSING), int(Flag.TEMPERATURE_STALE)
STEP, GAP = int(Flag.CLOCK_STEP), int(Flag.GAP_BEFORE)
NO_MODEL, SATURATED, FAULT = int(Flag.NO_MODEL), int(Flag.SATURATED), int(Flag.SENSOR_FAULT)


class Output(NamedTuple):
    """Room for samples."""

    corrected: np.ndarray  # CORRECTED (room)
    channel: np.ndarray  # uint8 (room)
    waiting: np.ndarray  # uint64 (1): the first sample that is not corrected yet


def new_output(room: int) -> Output:
    """Room for `room` samples."""
    return Output(np.zeros(room, CORRECTED), np.zeros(room, np.uint8), np.zeros(1, np.uint64))


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
    if c.group_start[ch] == c.group_start[ch + ONE]:
        flags |= NO_MODEL
    taken = loop.times[ch, TEMPERATURE]
    sample = out.corrected[row]
    sample["t_ns"] = t_ns
    sample["t_pub_ns"] = 0
    sample["seq"] = loop.seq[ch]
    sample["rate_raw_dps"] = rate
    sample["rate_dps"] = rate
    sample["correction_dps"] = 0.0
    sample["temp_degC"] = loop.values[ch, TEMPERATURE]
    sample["sigma_dps"] = np.nan
    sample["temp_age_s"] = np.nan if taken == NEVER else (t_ns - taken) * 1e-9
    sample["flags"] = flags
    sample["ref_rate_dps"] = loop.values[ch, REFERENCE]
    out.channel[row] = ch
    loop.seq[ch] += ONE


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


@hot_kernel
def correct_waiting(c, s, loop, rows, out, written):
    """Correct the samples written since the last time, before a state changes or when a block is full."""
    first = out.waiting[0]
    if first == written:
        return
    for ch in range(c.needs.shape[0]):
        channel = np.uint64(ch)
        if c.group_start[channel] != c.group_start[channel + ONE]:
            correct_channel(c, s, rows, channel, out, first, written)
    count_samples(loop, out, first, written)
    out.waiting[0] = written


@hot_kernel
def correct_channel(c, s, rows, ch, out, first, written):
    """Of these samples those of one channel: gathered, predicted together, and put back."""
    count = np.int64(0)  # of one type from the start: a literal 0 would be compiled for by itself
    for row in range(first, written):
        if out.channel[row] == ch:
            rows.t_ns[count] = out.corrected[row]["t_ns"]
            rows.rate[count] = out.corrected[row]["rate_raw_dps"]
            rows.row[count] = row
            count += 1
    predict_rows(c, s, rows, ch, count)
    for k in range(count):
        sample = out.corrected[rows.row[k]]
        sample["rate_dps"] = rows.rate[k] - rows.error[k]
        sample["correction_dps"] = rows.error[k]
        sample["sigma_dps"] = sigma(c, s, ch, rows.rate[k])
        sample["flags"] |= np.uint32(rows.flags[k])


@hot_kernel
def count_samples(loop, out, first, written):
    """Totals, samples per flag, and squared errors where a reference is known."""
    loop.totals[SAMPLES] += np.int64(written - first)
    same, since = out.corrected[first]["flags"], first
    for row in range(first, written):
        sample = out.corrected[row]
        if sample["flags"] != same:
            count_flags(loop, same, row - since)
            same, since = sample["flags"], row
        reference = sample["ref_rate_dps"]
        if not np.isnan(reference):
            ch = np.uint64(out.channel[row])
            loop.scores[ch, 0] += 1.0
            loop.scores[ch, 1] += (sample["rate_raw_dps"] - reference) ** 2
            loop.scores[ch, 2] += (sample["rate_dps"] - reference) ** 2
    count_flags(loop, same, written - since)


@hot_kernel
def count_flags(loop, flags, count):
    """`count` more samples with each of these flags."""
    bit = 0
    while flags:
        if flags & np.uint32(1):
            loop.flag_counts[bit] += np.int64(count)
        flags >>= np.uint32(1)
        bit += 1
