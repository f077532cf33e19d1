"""Whether a frame is wanted, and whether it is as it must be: id, length, end-to-end checksum, counter."""

import numpy as np

from rtcomp.decode import raw_value
from rtcomp.e2e import profile1a_ok, profile5_ok, toyota_ok
from rtcomp.frames import FrameFlag
from rtcomp.jit import hot_kernel
from rtcomp.loop_state import COUNTER_JUMP, COUNTER_REPEAT, CRC, GOOD, IGNORED, LENGTH, REMOTE_FRAME
from rtcomp.plan import NO_E2E, PROFILE_1A, PROFILE_5, STANDARD_IDS

FD, REMOTE = int(FrameFlag.FD), int(FrameFlag.REMOTE)


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
