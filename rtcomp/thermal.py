"""The thermal states: what the step remembers of the temperatures that came, and of when.

Call `thermal_update` at every valid temperature of channel `ch` (time in ns, °C), in the order of the times. The
states move only with temperatures, exactly for a temperature linear in time between two of them; gaps and uneven
sampling are in the times themselves.
"""

from typing import NamedTuple

import numpy as np

from rtcomp.compiled import TEMP, TERM_STATES, Compiled
from rtcomp.exponential import exp_falling
from rtcomp.jit import hot_kernel, rare_kernel
from rtcomp.terms import BIAS_PLAY, EMPIRICAL, LAG, SCALE_PLAY, SCALE_RATE, SHUPE

GAP_S = 60.0  # longer without a temperature, and what happened between is no longer known
ONE = np.uint64(1)  # a signed one would make a float of an unsigned index
NEVER = np.iinfo(np.int64).min
LAST_TEMP, LAST_COIL, LOWEST, HIGHEST = range(4)
T_THERMAL, T_POWER_ON, SETTLED_AT = range(3)


class State(NamedTuple):
    """Everything the step remembers; a checkpoint is these arrays."""

    values: (
        np.ndarray
    )  # float64 (channels, 4): last temperature, last coil temperature, lowest and highest temperature
    times: np.ndarray  # int64 (channels, 3) ns: last temperature, power-on (NEVER: unknown), when settled
    filters: np.ndarray  # float64 (groups, 2, 2): per input filter its state and output
    terms: np.ndarray  # float64 (terms, TERM_STATES): [0] is the thermal column the term multiplies


def new_state(compiled: Compiled) -> State:
    """A state that has seen nothing."""
    channels = len(compiled.needs)
    return State(
        np.full((channels, 4), np.nan),
        np.full((channels, 3), NEVER, np.int64),
        np.zeros((len(compiled.base_kind), 2, 2)),
        np.zeros((len(compiled.term_kind), TERM_STATES)),
    )


@hot_kernel
def forget(s, ch):
    """Forget every temperature of channel `ch` (not the time of power-on): the next one starts anew."""
    for k in range(s.values.shape[1]):
        s.values[ch, k] = np.nan
    s.times[ch, T_THERMAL] = NEVER
    s.times[ch, SETTLED_AT] = NEVER


@hot_kernel
def clip(value, low, high):
    """`value` kept between `low` and `high`."""
    return min(max(value, low), high)


@rare_kernel
def low_pass(y, x0, x1, dt, tau):
    """First-order low pass over `dt` for an input that goes linearly from x0 to x1 (exact)."""
    lag = (x1 - x0) / dt * tau
    return x1 - lag + (y - x0 + lag) * exp_falling(-dt / tau)


@hot_kernel
def thermal_update(c, s, ch, t_ns, temp, coil):
    """Take in a temperature [°C] (and the coil's, NaN when there is none) received at t_ns."""
    first = s.times[ch, T_THERMAL] == NEVER
    dt = 0.0 if first else (t_ns - s.times[ch, T_THERMAL]) * 1e-9
    if dt < -GAP_S:  # the frames' clock was set back: nothing from before can be placed in time
        first, dt = True, 0.0
    if first or dt > GAP_S:
        s.times[ch, SETTLED_AT] = t_ns + np.int64(c.settle_s[ch] * 1e9)
    if first:
        s.values[ch, LOWEST], s.values[ch, HIGHEST] = temp, temp
    elif dt <= 0.0:
        return  # time does not run backwards in a thermal state
    s.values[ch, LOWEST] = min(s.values[ch, LOWEST], temp)
    s.values[ch, HIGHEST] = max(s.values[ch, HIGHEST], temp)
    for g in range(c.group_start[ch], c.group_start[ch + ONE]):
        x1 = clip(temp, c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])
        x0 = x1 if first else clip(s.values[ch, LAST_TEMP], c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])
        for k in range(2):
            tau = c.filter_tau_s[g, k]
            s.filters[g, k, 0] = x1 if first else low_pass(s.filters[g, k, 0], x0, x1, dt, tau)
        s.filters[g, 0, 1] = (x1 - s.filters[g, 0, 0]) / c.filter_tau_s[g, 0]
        s.filters[g, 1, 1] = s.filters[g, 1, 0]
    for j in range(c.term_start[ch], c.term_start[ch + ONE]):
        g = c.term_group[j]
        x1 = clip(temp, c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])
        x0 = x1 if first else clip(s.values[ch, LAST_TEMP], c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])
        thermal_column(c.term_kind[j], c.term[j], s.terms[j], x0, x1, dt, first)
    s.values[ch, LAST_TEMP], s.values[ch, LAST_COIL] = temp, coil
    s.times[ch, T_THERMAL] = t_ns


@hot_kernel
def thermal_column(kind, p, x, t0, t1, dt, first):
    """Move one term's state `x` from temperature t0 to t1; `x[0]` is the column its coefficient multiplies."""
    if kind == LAG:
        x[1] = t1 if first else low_pass(x[1], t0, t1, dt, p[0])
        if p[3] > 0.0:  # a second pole, fed with the first one's output
            before = x[3]
            x[2] = t1 if first else low_pass(x[2], before, x[1], dt, p[3])
            x[3] = x[1]
            x[0] = x[2] - t1
        else:
            x[0] = x[1] - t1
    elif kind == SHUPE:
        shupe_column(p, x, t0, t1, dt, first)
    elif kind in (BIAS_PLAY, SCALE_PLAY):
        x[1] = t1 if first else min(max(x[1], t1 - p[0]), t1 + p[0])
        x[0] = x[1] - t1
    elif kind == SCALE_RATE:
        x[1] = t1 if first else low_pass(x[1], t0, t1, dt, p[0])
        x[0] = (t1 - x[1]) / p[0]
    elif kind == EMPIRICAL:
        x[1] = t1 if first else low_pass(x[1], t0, t1, dt, p[4])
        x[0] = (t1 - x[1]) / p[4]


@rare_kernel
def shupe_column(p, x, t0, t1, dt, first):
    """c1·LP_τ(u̇) + c2·d/dt LP_τ(u̇), u the temperature smoothed with p[3] (Mohr's integral with one time constant)."""
    if first:
        x[1], x[2], x[0] = t1, t1, 0.0
        return
    before, slope = t0, (t1 - t0) / dt
    after = t1
    if p[3] > 0.0:
        before = x[1]
        x[1] = low_pass(x[1], t0, t1, dt, p[3])
        after, slope = x[1], (t1 - x[1]) / p[3]
    x[2] = low_pass(x[2], before, after, dt, p[0])
    filtered = (after - x[2]) / p[0]
    x[0] = p[1] * filtered + p[2] * (slope - filtered) / p[0]
