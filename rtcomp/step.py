"""The compiled step: rates in, the predicted errors out, from the models and the thermal states of one channel.

Rates wait until a temperature comes or their block is full, and are then predicted together (`predict_rows`): between
two temperatures only the rate and the time change. `predict_error` is the same for one rate; neither that nor how
rates are cut into blocks makes a difference to a single bit.
"""

import math
from typing import NamedTuple

import numpy as np

from rtcomp.compiled import NO_BASE, RATE, SINE, TEMP
from rtcomp.frames import Flag
from rtcomp.jit import hot_kernel, rare_kernel
from rtcomp.rule_errors import EXTRAPOLATING, add_rules, input_flags, rules_error
from rtcomp.term_errors import term_error
from rtcomp.terms import BIAS_PLAY, SCALE_PLAY
from rtcomp.thermal import HIGHEST, LAST_COIL, LAST_TEMP, LOWEST, NEVER, ONE, SETTLED_AT, T_POWER_ON, clip

BLOCK = 256  # rows that stay in the first cache
DEG = math.pi / 180.0
UNSETTLED, MISSING = int(Flag.UNSETTLED), int(Flag.TEMPERATURE_MISSING)


class Rows(NamedTuple):
    """A block of rates: the first two are given, `error` and `flags` are the answer, the rest is room to work in."""

    t_ns: np.ndarray  # int64 (BLOCK)
    rate: np.ndarray  # float64 (BLOCK) °/s
    error: np.ndarray  # float64 (BLOCK) °/s
    flags: np.ndarray  # int64 (BLOCK)
    t_s: np.ndarray  # float64 (BLOCK): since power-on, −1 where that is not known
    inside: np.ndarray  # float64 (BLOCK): the rate inside the validity of a group; then the true rate, about
    weights: np.ndarray  # float64 (BLOCK): Σw of the rules
    weighted: np.ndarray  # float64 (BLOCK): Σw·g
    row: np.ndarray  # uint64 (BLOCK): where a sample waits for the answer


def new_rows() -> Rows:
    """Room for one block."""
    columns = [np.zeros(BLOCK) for _ in range(6)]
    rate, error, t_s, inside, weights, weighted = columns
    times, flags, row = np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.uint64)
    return Rows(times, rate, error, flags, t_s, inside, weights, weighted, row)


@hot_kernel
def predict_error(c, s, ch, t_ns, rate):
    """Predicted error [°/s] of a measured rate [°/s], and the flag bits that the model adds."""
    if is_blind(c, s, ch):
        return 0.0, MISSING
    t_s = since_power_on(s, ch, t_ns)
    flags, total = play_flags(c, s, ch) | unsettled(c, s, ch, t_ns, t_s), 0.0
    for g in range(c.group_start[ch], c.group_start[ch + ONE]):
        warm, outside = clipped_temperature(c, s, ch, g)
        inside = clip(rate, c.validity[g, RATE, 0], c.validity[g, RATE, 1])
        flags |= outside | (EXTRAPOLATING if inside != rate else 0)
        if c.base_kind[g] != NO_BASE:
            total += base_error(c.base_kind[g], c.base[g], c.table, warm, inside)
        if c.rule_start[g] != c.rule_start[g + ONE]:
            total += rules_error(c, s, ch, g, warm, inside, max(t_s, 0.0))
            flags |= input_flags(c, s, ch, g, max(t_s, 0.0))
    w = rate - total  # the best estimate of the true rate
    for j in range(c.term_start[ch], c.term_start[ch + ONE]):
        total += term_error(c, s, ch, j, rate, w, t_s)
    return total, flags


@hot_kernel
def predict_rows(c, s, rows, ch, count):
    """The same for the first `count` rows, all of channel `ch`: each step for all rows before the next."""
    if is_blind(c, s, ch):
        rows.error[:count] = 0.0
        rows.flags[:count] = MISSING
        return
    always = play_flags(c, s, ch)
    for k in range(count):
        rows.t_s[k] = since_power_on(s, ch, rows.t_ns[k])
        rows.error[k] = 0.0
        rows.flags[k] = always | unsettled(c, s, ch, rows.t_ns[k], rows.t_s[k])
    for g in range(c.group_start[ch], c.group_start[ch + ONE]):
        warm = enter_validity(c, s, rows, ch, g, count)
        if c.base_kind[g] != NO_BASE:
            for k in range(count):
                rows.error[k] += base_error(c.base_kind[g], c.base[g], c.table, warm, rows.inside[k])
        add_rules(c, s, rows, ch, g, warm, count)
    for k in range(count):
        rows.inside[k] = rows.rate[k] - rows.error[k]
    for j in range(c.term_start[ch], c.term_start[ch + ONE]):
        for k in range(count):
            rows.error[k] += term_error(c, s, ch, j, rows.rate[k], rows.inside[k], rows.t_s[k])


@hot_kernel
def enter_validity(c, s, rows, ch, g, count):
    """Clip the rates into the validity of group g, flagged; returns the temperature, clipped likewise."""
    warm, outside = clipped_temperature(c, s, ch, g)
    low, high = c.validity[g, RATE, 0], c.validity[g, RATE, 1]
    for k in range(count):
        rows.inside[k] = clip(rows.rate[k], low, high)
        rows.flags[k] |= outside | (EXTRAPOLATING if rows.inside[k] != rows.rate[k] else 0)
    return warm


@hot_kernel
def is_blind(c, s, ch):
    """Whether a temperature that the models need has never come."""
    return (c.needs[ch, 0] and math.isnan(s.values[ch, LAST_TEMP])) or (
        c.needs[ch, 1] and math.isnan(s.values[ch, LAST_COIL])
    )


@hot_kernel
def since_power_on(s, ch, t_ns):
    """Time since power-on [s], −1 where that is not known."""
    power_on = s.times[ch, T_POWER_ON]
    return (t_ns - power_on) * 1e-9 if power_on != NEVER and t_ns >= power_on else -1.0


@hot_kernel
def unsettled(c, s, ch, t_ns, t_s):
    """Whether an unknown past still matters."""
    return UNSETTLED if t_ns < s.times[ch, SETTLED_AT] or (c.needs[ch, 2] and t_s < 0.0) else 0


@hot_kernel
def play_flags(c, s, ch):
    """Unsettled while a play still shows where it started."""
    for j in range(c.term_start[ch], c.term_start[ch + ONE]):
        is_play = c.term_kind[j] == BIAS_PLAY or c.term_kind[j] == SCALE_PLAY
        if is_play and not s.values[ch, HIGHEST] - s.values[ch, LOWEST] >= 2.0 * c.term[j, 0]:
            return UNSETTLED
    return 0


@hot_kernel
def clipped_temperature(c, s, ch, g):
    """The last temperature inside the validity of group g, and whether it had to be clipped."""
    temp = s.values[ch, LAST_TEMP]
    warm = clip(temp, c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])
    return warm, (EXTRAPOLATING if warm != temp and c.needs[ch, 0] else 0)


@rare_kernel
def base_error(kind, p, table, temp, rate):
    """The physical surface under the rules of a group; `p` are its parameters."""
    if kind == SINE:
        h = temp - p[5]
        gain = 1.0 + p[2] + h * (p[3] + h * p[4])
        sine = clip(rate * DEG * p[0] / gain, -1.0, 1.0)
        return rate - math.asin(sine) / (p[0] * (1.0 + p[1] * h)) / DEG
    h = temp - p[0]
    offset, rows, columns = int(p[1]), int(p[2]), int(p[3])
    total = 0.0
    for i in range(rows - 1, -1, -1):
        row = 0.0
        for j in range(columns - 1, -1, -1):
            row = row * rate + table[offset + i * columns + j]
        total = total * h + row
    return total


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
