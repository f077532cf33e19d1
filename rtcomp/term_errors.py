"""The error of each dynamic or static term for one rate; its thermal column is kept by `rtcomp.thermal`."""

import math

import numpy as np

from rtcomp.compiled import TEMP
from rtcomp.exponential import exp_falling
from rtcomp.jit import hot_kernel, rare_kernel
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
from rtcomp.thermal import LAST_TEMP, clip


@hot_kernel
def term_error(c, s, ch, j, rate, w, t_s):
    """Error [°/s] of term j from the measured rate and the true rate w, about [°/s], and the time since power-on t_s.

    `s.terms[j, 0]` is the term's thermal column; a time below 0 is not known.
    """
    kind, p0, column = c.term_kind[j], c.term[j, 0], s.terms[j, 0]
    if kind == LAG:
        slope = c.term[j, 1]
        if c.term[j, 4] != 0.0 or c.term[j, 5] != 0.0:
            slope += bent_slope(c.term[j], term_temperature(c, s, ch, j) - REF_DEGC, column)
        return (w * slope + c.term[j, 2]) * column
    if kind == SHUPE:
        return column
    if kind == BIAS_PLAY:
        return c.term[j, 1] * column
    if kind in (SCALE_PLAY, SCALE_RATE):
        return w * c.term[j, 1] * column
    if kind in (BIAS_T, SCALE_T, RIPPLE, SAWTOOTH, CUBIC):
        return static_error(kind, c.term[j], term_temperature(c, s, ch, j), w)
    if kind == EMPIRICAL:
        return empirical_error(c.term[j], c.table, term_temperature(c, s, ch, j), column, rate, w, t_s)
    if kind == ASYMMETRY:
        return p0 * abs(w)
    if kind == SCALE:
        return w * p0
    if kind == BIAS:
        return p0
    if kind == UNIT:
        return rate * (1.0 - 1.0 / p0)
    return timed_error(kind, c.term[j], w, t_s) if t_s >= 0.0 else 0.0


@rare_kernel
def bent_slope(p, h, behind):
    """(S(T_c) − S(T))/(T_c − T) of the square and the cube in S, T_c = T + behind."""
    coil = h + behind
    return p[4] * (coil + h) + p[5] * (coil * coil + coil * h + h * h)


@rare_kernel
def timed_error(kind, p, w, t_s):
    """Terms in time since power-on; `p` are the parameters."""
    if kind == BIAS_WARMUP:
        return p[0] * exp_falling(-t_s / p[1])
    if kind == SCALE_WARMUP:
        return w * p[0] * exp_falling(-t_s / p[1])
    if kind == AGEING:
        return w * (p[0] * t_s + p[1] * math.sqrt(t_s) + p[2] * math.log1p(t_s / p[3]))
    return p[0] * t_s  # DRIFT


@hot_kernel
def term_temperature(c, s, ch, j):
    """The last temperature inside the validity of term j's model."""
    g = c.term_group[j]
    return clip(s.values[ch, LAST_TEMP], c.validity[g, TEMP, 0], c.validity[g, TEMP, 1])


@rare_kernel
def static_error(kind, p, temp, w):
    """Terms that depend on the present temperature and rate only."""
    if kind == CUBIC:
        warm = p[2] * (temp - REF_DEGC) if p[2] != 0.0 else 0.0
        return w * w * w * (p[0] + p[1] * w * w + warm)
    h = temp - REF_DEGC
    if kind == RIPPLE:
        phi = 2.0 * math.pi * (h + p[3] * h * h) / p[0]
        return p[1] * math.cos(phi) + p[2] * math.sin(phi)
    if kind == SAWTOOTH:
        phase = (h - p[2]) / p[0]
        return p[1] * (2.0 * (phase - math.floor(phase)) - 1.0)
    polynomial = h * (p[0] + h * (p[1] + h * p[2]))
    return w * polynomial if kind == SCALE_T else polynomial


@rare_kernel
def empirical_error(p, table, temp, column, rate, w, t_s):
    """Piecewise linear in one driver, held outside its knots."""
    driver, offset, count = int(p[0]), int(p[1]), int(p[2])
    if driver == 0:
        value = temp
    elif driver == 1:
        value = column
    elif driver == 2:
        value = rate
    elif t_s >= 0.0:
        value = t_s
    else:
        return 0.0
    knots, values = table[offset : offset + count], table[offset + count : offset + 2 * count]
    return interpolate(value, knots, values) * (w if p[3] != 0.0 else 1.0)


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
