"""What a good frame may still carry: temperatures that jump, values that stand still, rates no vehicle can have.

Limits are the map's, none of them set by default. A temperature that jumps is not believed; all else is only flagged,
for a wild rate is still what the sensor says.
"""

import numpy as np

from rtcomp.frames import Flag
from rtcomp.jit import hot_kernel
from rtcomp.plan import COIL
from rtcomp.thermal import NEVER, SETTLED_AT

TEMP_IMPLAUSIBLE, TEMP_STUCK = int(Flag.TEMPERATURE_IMPLAUSIBLE), int(Flag.TEMPERATURE_STUCK)
RATE_IMPLAUSIBLE, RATE_STUCK = int(Flag.RATE_IMPLAUSIBLE), int(Flag.RATE_STUCK)
SLOPE_FLOOR_S = 1.0  # a temperature may change by noise and quantum however soon the next one comes
UNCHANGED, BELIEVED = 2, 3  # columns of `LoopState.since`, after those of the temperatures


@hot_kernel
def is_plausible(plan, c, s, loop, ch, role, t_ns, value):
    """Whether a temperature may have changed so much since the last one that was believed.

    A single wild value changes nothing; a lasting one is taken when the time allows the change, its history unsettled.
    """
    before, taken = loop.values[ch, role], loop.times[ch, role]
    slope, age_ns = plan.channels[ch]["temp_slope"], plan.channels[ch]["max_age_ns"]
    if role == COIL:
        slope, age_ns = plan.channels[ch]["coil_slope"], plan.channels[ch]["coil_max_age_ns"]
    if taken != NEVER and abs(value - before) > slope * max(abs(t_ns - taken) * 1e-9, SLOPE_FLOOR_S):
        loop.doubts[ch, role] += 1
        return False
    if loop.doubts[ch, role] and abs(t_ns - taken) > age_ns:
        s.times[ch, SETTLED_AT] = t_ns + np.int64(c.settle_s[ch] * 1e9)
    loop.doubts[ch, role] = 0
    if (
        value != before or loop.since[ch, role] == NEVER or abs(t_ns - taken) > age_ns
    ):  # nobody saw it in a gap
        loop.since[ch, role] = t_ns
    return True


@hot_kernel
def rate_flags(plan, loop, ch, t_ns, rate):
    """Stuck, or changed quicker than the map allows since the last plausible rate."""
    flags = 0
    slope, stuck_ns = plan.channels[ch]["rate_slope"], plan.channels[ch]["rate_stuck_ns"]
    if loop.since[ch, UNCHANGED] == NEVER or rate != loop.rates[ch, 0]:
        loop.since[ch, UNCHANGED] = t_ns
    elif stuck_ns > 0 and t_ns - loop.since[ch, UNCHANGED] > stuck_ns:
        flags |= RATE_STUCK
    loop.rates[ch, 0] = rate
    came = loop.since[ch, BELIEVED]
    if came != NEVER and abs(rate - loop.rates[ch, 1]) > slope * abs(t_ns - came) * 1e-9:
        return flags | RATE_IMPLAUSIBLE
    loop.rates[ch, 1] = rate
    loop.since[ch, BELIEVED] = t_ns
    return flags


@hot_kernel
def doubt_flags(loop, ch, role, stuck_ns):
    """Implausible while the latest temperature was not believed, stuck when those that came were all the same."""
    flags = TEMP_IMPLAUSIBLE if loop.doubts[ch, role] else 0
    since = loop.since[ch, role]
    if stuck_ns > 0 and since != NEVER and loop.times[ch, role] - since > stuck_ns:
        flags |= TEMP_STUCK
    return flags
