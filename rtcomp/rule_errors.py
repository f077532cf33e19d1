"""The Takagi-Sugeno rules over a block of rates: PAPER eqs. 2, 9-11.

Of the inputs only the rate changes from row to row; what the others give a rule is worked out once for the block. The
loops over rows then hold arithmetic alone, which the compiler turns into vector instructions.
"""

import numpy as np

from rtcomp.compiled import COIL, LAG_TEMP, RATE, TEMP, TEMP_RATE, TIME
from rtcomp.exponential import exp_falling
from rtcomp.frames import Flag
from rtcomp.jit import hot_kernel
from rtcomp.thermal import LAST_COIL, ONE, clip

UNDERFLOW = 1e-250  # below, quotients of firing strengths lose digits
EXTRAPOLATING = int(Flag.EXTRAPOLATING)


@hot_kernel
def rules_error(c, s, rows, ch, g, warm, count):
    """Add the TS output of group g to the first `count` rows; `warm` is the temperature inside its validity."""
    start, stop = c.rule_start[g], c.rule_start[g + ONE]
    if start == stop:
        return
    for i in range(c.group_size[g]):
        if c.group_inputs[g, i] == TIME:  # a second input that changes: each row is a block of its own
            for k in range(count):
                block_error(c, s, rows, ch, g, warm, max(rows.t_s[k], 0.0), k, k + 1)
            return
    block_error(c, s, rows, ch, g, warm, 0.0, 0, count)


@hot_kernel
def block_error(c, s, rows, ch, g, warm, t_s, first, last):
    """The same for rows `first` to `last`, which have all inputs but the rate in common."""
    flags = take_inputs(c, s, rows, ch, g, warm, t_s)
    rate, weights, weighted = rows.inside[first:last], rows.weights[first:last], rows.weighted[first:last]
    weights[:] = 0.0
    weighted[:] = 0.0
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        add_rule(cut_along_rate(c, rows, g, j), rate, weights, weighted)
    far = 0
    for k in range(len(rate)):
        far |= 1 if weights[k] < UNDERFLOW else 0
    if far:
        for k in range(len(rate)):
            if weights[k] < UNDERFLOW:
                weights[k], weighted[k] = nearest_rules(c, rows, g, rate[k])
    error, bits = rows.error[first:last], rows.flags[first:last]
    for k in range(len(rate)):
        error[k] += weighted[k] / weights[k]
        bits[k] |= flags


@hot_kernel
def take_inputs(c, s, rows, ch, g, warm, t_s):
    """Set the inputs other than the rate, inside their validity; returns the flags of having clipped one."""
    flags = 0
    for i in range(c.group_size[g]):
        which = c.group_inputs[g, i]
        if which == RATE or which == TEMP:  # clipped and flagged with the group
            rows.inputs[i] = warm
            continue
        value = t_s
        if which == COIL:
            value = s.values[ch, LAST_COIL]
        elif which == TEMP_RATE:
            value = s.filters[g, 0, 1]
        elif which == LAG_TEMP:
            value = s.filters[g, 1, 1]
        rows.inputs[i] = clip(value, c.validity[g, which, 0], c.validity[g, which, 1])
        if rows.inputs[i] != value:
            flags = EXTRAPOLATING
    return flags


@hot_kernel
def cut_along_rate(c, rows, g, j):
    """Rule j as a function of the rate alone: ½Σz² of the other inputs; centre and 1/σ; output at rate 0, and slope."""
    square, output = 0.0, c.consequents[j, 0]
    center, inverse_width, slope = 0.0, 0.0, 0.0
    for i in range(c.group_size[g]):
        if c.group_inputs[g, i] == RATE:
            center, inverse_width, slope = c.centers[j, i], c.inverse_widths[j, i], c.consequents[j, i + 1]
        else:
            z = (rows.inputs[i] - c.centers[j, i]) * c.inverse_widths[j, i]
            square += z * z
            output += c.consequents[j, i + 1] * rows.inputs[i]
    return 0.5 * square, center, inverse_width, output, slope


@hot_kernel
def exponent(rule, rate):
    """−½ Σ z² over all inputs."""
    z = (rate - rule[1]) * rule[2]
    return -0.5 * (z * z) - rule[0]


@hot_kernel
def add_rule(rule, rate, weights, weighted):
    """Add w and w·g of one rule to each row's sums."""
    for k in range(len(rate)):
        firing = exp_falling(exponent(rule, rate[k]))
        weights[k] += firing
        weighted[k] += firing * (rule[3] + rule[4] * rate[k])


@hot_kernel
def nearest_rules(c, rows, g, rate):
    """Σw and Σw·g far from every rule: with the largest exponent taken out the nearest one answers."""
    largest = -np.inf
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        largest = max(largest, exponent(cut_along_rate(c, rows, g, j), rate))
    weights, weighted = 0.0, 0.0
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        rule = cut_along_rate(c, rows, g, j)
        firing = exp_falling(exponent(rule, rate) - largest)
        weights += firing
        weighted += firing * (rule[3] + rule[4] * rate)
    return weights, weighted
