"""The compiled step: a temperature in, a rate in, the predicted error out, with explicit state.

When to call what, both for one channel `ch` and in the order of the times: `thermal_update` at every valid
temperature (time in ns, °C), `predict_error` at every rate (°/s in, predicted error in °/s out). The thermal states
move only with temperatures, exactly for a temperature linear in time between two of them; gaps and uneven sampling
are in the times themselves.
"""

import math
from typing import NamedTuple

import numpy as np

from rtcomp.compiled import (
    COIL,
    LAG_TEMP,
    NO_BASE,
    RATE,
    SINE,
    TEMP,
    TEMP_RATE,
    TERM_STATES,
    Compiled,
)
from rtcomp.frames import Flag
from rtcomp.jit import hot_kernel
from rtcomp.terms import (
    AGEING,
    ASYMMETRY,
    BIAS,
    BIAS_PLAY,
    BIAS_T,
    BIAS_WARMUP,
    CUBIC,
    EMPIRICAL,
    LAG,
    REF_DEGC,
    RIPPLE,
    SAWTOOTH,
    SCALE,
    SCALE_PLAY,
    SCALE_RATE,
    SCALE_T,
    SCALE_WARMUP,
    SHUPE,
    UNIT,
)

GAP_S = 60.0  # longer without a temperature, and what happened between is no longer known
DEG = math.pi / 180.0
ONE = np.uint64(1)  # a signed one would make a float of an unsigned index
UNDERFLOW = 1e-250  # below, quotients of firing strengths lose digits
EXTRAPOLATING, UNSETTLED = int(Flag.EXTRAPOLATING), int(Flag.UNSETTLED)
MISSING = int(Flag.TEMPERATURE_MISSING)
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


@hot_kernel
def low_pass(y, x0, x1, dt, tau):
    """First-order low pass over `dt` for an input that goes linearly from x0 to x1 (exact)."""
    lag = (x1 - x0) / dt * tau
    return x1 - lag + (y - x0 + lag) * math.exp(-dt / tau)


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


@hot_kernel
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


@hot_kernel
def predict_error(c, s, ch, t_ns, rate):
    """Predicted error [°/s] of a measured rate [°/s], and the flag bits that the model adds."""
    if (c.needs[ch, 0] and math.isnan(s.values[ch, LAST_TEMP])) or (
        c.needs[ch, 1] and math.isnan(s.values[ch, LAST_COIL])
    ):
        return 0.0, MISSING
    flags = 0
    timed = s.times[ch, T_POWER_ON] != NEVER and t_ns >= s.times[ch, T_POWER_ON]
    t = (t_ns - s.times[ch, T_POWER_ON]) * 1e-9 if timed else 0.0
    if t_ns < s.times[ch, SETTLED_AT] or (c.needs[ch, 2] and not timed):
        flags |= UNSETTLED
    total = 0.0
    for g in range(c.group_start[ch], c.group_start[ch + ONE]):
        temp, inside = s.values[ch, LAST_TEMP], clip(rate, c.validity[g, RATE, 0], c.validity[g, RATE, 1])
        warm = clip(temp, c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])
        if inside != rate or (warm != temp and c.needs[ch, 0]):
            flags |= EXTRAPOLATING
        if c.base_kind[g] != NO_BASE:
            total += base_error(c, g, warm, inside)
        if c.rule_start[g] != c.rule_start[g + ONE]:
            error, rule_flags = rules_error(c, s, ch, g, warm, inside, t)
            total += error
            flags |= rule_flags
    w = rate - total  # the best estimate of the true rate
    for j in range(c.term_start[ch], c.term_start[ch + ONE]):
        total += term_error(c, s, ch, j, rate, w, t, timed)
        is_play = c.term_kind[j] in (BIAS_PLAY, SCALE_PLAY)
        if is_play and not s.values[ch, HIGHEST] - s.values[ch, LOWEST] >= 2.0 * c.term[j, 0]:
            flags |= UNSETTLED  # until then the play still shows where it started
    return total, flags


@hot_kernel
def base_error(c, g, temp, rate):
    """The physical surface under the rules of group g."""
    if c.base_kind[g] == SINE:
        h = temp - c.base[g, 5]
        gain = 1.0 + c.base[g, 2] + h * (c.base[g, 3] + h * c.base[g, 4])
        sine = clip(rate * DEG * c.base[g, 0] / gain, -1.0, 1.0)
        return rate - math.asin(sine) / (c.base[g, 0] * (1.0 + c.base[g, 1] * h)) / DEG
    h = temp - c.base[g, 0]
    offset, rows, columns = int(c.base[g, 1]), int(c.base[g, 2]), int(c.base[g, 3])
    total = 0.0
    for i in range(rows - 1, -1, -1):
        row = 0.0
        for j in range(columns - 1, -1, -1):
            row = row * rate + c.table[offset + i * columns + j]
        total = total * h + row
    return total


@hot_kernel
def input_value(c, s, ch, g, k, temp, rate, t):
    """Input k of the rules of group g, and whether it had to be clipped; 0 where they take fewer."""
    which = c.group_inputs[g, k]
    if which == TEMP:
        return temp, 0
    if which == RATE:
        return rate, 0
    if which < 0:
        return 0.0, 0
    value = t
    if which == COIL:
        value = s.values[ch, LAST_COIL]
    elif which == TEMP_RATE:
        value = s.filters[g, 0, 1]
    elif which == LAG_TEMP:
        value = s.filters[g, 1, 1]
    inside = clip(value, c.validity[g, which, 0], c.validity[g, which, 1])
    return inside, (EXTRAPOLATING if inside != value else 0)


@hot_kernel
def exponent(c, g, j, x0, x1, x2, x3):
    """−½ Σ z² of rule j of group g."""
    z0 = (x0 - c.centers[j, 0]) * c.inverse_widths[j, 0]
    z1 = (x1 - c.centers[j, 1]) * c.inverse_widths[j, 1]
    total = z0 * z0 + z1 * z1  # an input that is not there has an inverse width of 0
    if c.group_size[g] > 2:
        z2 = (x2 - c.centers[j, 2]) * c.inverse_widths[j, 2]
        z3 = (x3 - c.centers[j, 3]) * c.inverse_widths[j, 3]
        total += z2 * z2 + z3 * z3
    return -0.5 * total


@hot_kernel
def weighted_outputs(c, g, shift, x0, x1, x2, x3):
    """Σ w and Σ w·g of group g, firing strengths w scaled by exp(−shift)."""
    weights, weighted = 0.0, 0.0
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        firing = math.exp(exponent(c, g, j, x0, x1, x2, x3) - shift)
        output = c.consequents[j, 0] + c.consequents[j, 1] * x0 + c.consequents[j, 2] * x1
        if c.group_size[g] > 2:
            output += c.consequents[j, 3] * x2 + c.consequents[j, 4] * x3
        weights += firing
        weighted += firing * output
    return weights, weighted


@hot_kernel
def rules_error(c, s, ch, g, temp, rate, t):
    """TS output of group g (PAPER eqs. 2, 9-11) and its flags."""
    x0, f0 = input_value(c, s, ch, g, 0, temp, rate, t)
    x1, f1 = input_value(c, s, ch, g, 1, temp, rate, t)
    x2, f2, x3, f3 = 0.0, 0, 0.0, 0
    if c.group_size[g] > 2:
        x2, f2 = input_value(c, s, ch, g, 2, temp, rate, t)
        x3, f3 = input_value(c, s, ch, g, 3, temp, rate, t)
    weights, weighted = weighted_outputs(c, g, 0.0, x0, x1, x2, x3)
    if weights < UNDERFLOW:  # far from every rule: take the largest exponent out and the nearest one answers
        largest = -np.inf
        for j in range(c.rule_start[g], c.rule_start[g + ONE]):
            largest = max(largest, exponent(c, g, j, x0, x1, x2, x3))
        weights, weighted = weighted_outputs(c, g, largest, x0, x1, x2, x3)
    return weighted / weights, f0 | f1 | f2 | f3


@hot_kernel
def term_error(c, s, ch, j, rate, w, t, timed):
    """Error of term j; `s.terms[j, 0]` is its thermal column, kept by `thermal_update`."""
    kind, p0, column = c.term_kind[j], c.term[j, 0], s.terms[j, 0]
    if kind == LAG:
        return (w * c.term[j, 1] + c.term[j, 2]) * column
    if kind == SHUPE:
        return column
    if kind == BIAS_PLAY:
        return c.term[j, 1] * column
    if kind in (SCALE_PLAY, SCALE_RATE):
        return w * c.term[j, 1] * column
    if kind in (BIAS_T, SCALE_T, RIPPLE, SAWTOOTH, CUBIC):
        return static_error(c, s, ch, j, w)
    if kind == EMPIRICAL:
        return empirical_error(c, s, ch, j, rate, w, t, timed)
    if kind == ASYMMETRY:
        return p0 * abs(w)
    if kind == SCALE:
        return w * p0
    if kind == BIAS:
        return p0
    if kind == UNIT:
        return rate * (1.0 - 1.0 / p0)
    return timed_error(c, j, w, t) if timed else 0.0


@hot_kernel
def timed_error(c, j, w, t):
    """Terms in time since power-on."""
    kind, p0 = c.term_kind[j], c.term[j, 0]
    if kind == BIAS_WARMUP:
        return p0 * math.exp(-t / c.term[j, 1])
    if kind == SCALE_WARMUP:
        return w * p0 * math.exp(-t / c.term[j, 1])
    if kind == AGEING:
        shape = p0 * t + c.term[j, 1] * math.sqrt(t) + c.term[j, 2] * math.log1p(t / c.term[j, 3])
        return w * shape
    return p0 * t  # DRIFT


@hot_kernel
def term_temperature(c, s, ch, j):
    """The last temperature inside the validity of term j's model."""
    g = c.term_group[j]
    return clip(s.values[ch, LAST_TEMP], c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])


@hot_kernel
def static_error(c, s, ch, j, w):
    """Terms that depend on the present temperature and rate only."""
    kind, p0, p1, p2 = c.term_kind[j], c.term[j, 0], c.term[j, 1], c.term[j, 2]
    if kind == CUBIC:
        warm = p2 * (term_temperature(c, s, ch, j) - REF_DEGC) if p2 != 0.0 else 0.0
        return w * w * w * (p0 + p1 * w * w + warm)
    h = term_temperature(c, s, ch, j) - REF_DEGC
    if kind == RIPPLE:
        phi = 2.0 * math.pi * (h + c.term[j, 3] * h * h) / p0
        return p1 * math.cos(phi) + p2 * math.sin(phi)
    if kind == SAWTOOTH:
        phase = (h - p2) / p0
        return p1 * (2.0 * (phase - math.floor(phase)) - 1.0)
    polynomial = h * (p0 + h * (p1 + h * p2))
    return w * polynomial if kind == SCALE_T else polynomial


@hot_kernel
def empirical_error(c, s, ch, j, rate, w, t, timed):
    """Piecewise linear in one driver, held outside its knots."""
    driver, offset, count = int(c.term[j, 0]), int(c.term[j, 1]), int(c.term[j, 2])
    if driver == 0:
        value = term_temperature(c, s, ch, j)
    elif driver == 1:
        value = s.terms[j, 0]
    elif driver == 2:
        value = rate
    elif timed:
        value = t
    else:
        return 0.0
    knots, values = c.table[offset : offset + count], c.table[offset + count : offset + 2 * count]
    return interpolate(value, knots, values) * (w if c.term[j, 3] != 0.0 else 1.0)


@hot_kernel
def interpolate(value, knots, values):
    """Linear interpolation, the end values held outside."""
    last = knots.shape[0] - 1
    if value <= knots[0]:
        return values[0]
    if value >= knots[last]:
        return values[last]
    k = np.searchsorted(knots, value, side="right") - 1
    share = (value - knots[k]) / (knots[k + 1] - knots[k])
    return values[k] + share * (values[k + 1] - values[k])


@hot_kernel
def sigma(c, s, ch, rate):
    """Residual standard deviation [°/s] stated by the model for this region (NaN when it states none)."""
    offset, rows, columns = c.sigma[ch, 0], c.sigma[ch, 1], c.sigma[ch, 2]
    if rows == 0:
        return c.table[offset]
    i = region(s.values[ch, LAST_TEMP], c.table[offset:], rows)
    j = region(rate, c.table[offset + rows + 1 :], columns)
    return c.table[offset + rows + columns + 2 + i * columns + j]


@hot_kernel
def region(value, edges, count):
    """Index of the region that holds `value`, edges from `edges` on; the outer ones are open."""
    for k in range(count - 1):
        if not value >= edges[k + 1]:
            return k
    return count - 1
