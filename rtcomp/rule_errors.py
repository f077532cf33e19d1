"""The Takagi-Sugeno rules, PAPER eqs. 2, 9-11: for one rate, and for a block of rates with the same bits.

Of the inputs only the rate changes within a block. What the others give a rule is worked out once, and the loop over
rates then holds arithmetic alone, which the compiler turns into vector instructions.
"""

import numpy as np

from rtcomp.compiled import COIL, LAG_TEMP, TEMP, TEMP_RATE, TIME
from rtcomp.exponential import exp_falling
from rtcomp.frames import Flag
from rtcomp.jit import hot_kernel
from rtcomp.thermal import LAST_COIL, ONE, clip

UNDERFLOW = 1e-250  # below, quotients of firing strengths lose digits
EXTRAPOLATING = int(Flag.EXTRAPOLATING)


@hot_kernel
def rules_error(c, s, ch, g, warm, rate, t_s):
    """TS output of group g, which has rules, at a temperature and a rate inside their validity."""
    weights, weighted = sums(c, s, ch, g, warm, rate, t_s, 0.0)
    if weights < UNDERFLOW:
        weights, weighted = nearest_sums(c, s, ch, g, warm, rate, t_s)
    return weighted / weights


@hot_kernel
def sums(c, s, ch, g, warm, rate, t_s, shift):
    """Σw and Σw·g, every w times exp(−shift)."""
    weights, weighted = 0.0, 0.0
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        rule = cut_along_rate(c, s, ch, g, j, warm, t_s)
        firing = exp_falling(exponent(rule, rate) - shift)
        weights += firing
        weighted += firing * (rule[3] + rule[4] * rate)
    return weights, weighted


@hot_kernel
def nearest_sums(c, s, ch, g, warm, rate, t_s):
    """The sums far from every rule: with the largest exponent taken out the nearest one answers."""
    largest = -np.inf
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        largest = max(largest, exponent(cut_along_rate(c, s, ch, g, j, warm, t_s), rate))
    return sums(c, s, ch, g, warm, rate, t_s, largest)


@hot_kernel
def cut_along_rate(c, s, ch, g, j, warm, t_s):
    """Rule j as a function of the rate: ½Σz² of the other inputs; centre and 1/σ; output at rate 0, and its slope."""
    square, output = 0.0, c.consequents[j, 0]
    for i in range(1, c.group_size[g]):
        x = warm
        if c.group_inputs[g, i] != TEMP:
            x = clipped_input(c, s, ch, g, i, t_s)
        z = (x - c.centers[j, i]) * c.inverse_widths[j, i]
        square += z * z
        output += c.consequents[j, i + 1] * x
    return 0.5 * square, c.centers[j, 0], c.inverse_widths[j, 0], output, c.consequents[j, 1]


@hot_kernel
def exponent(rule, rate):
    """−½ Σ z² over all inputs."""
    z = (rate - rule[1]) * rule[2]
    return -0.5 * (z * z) - rule[0]


@hot_kernel
def other_input(c, s, ch, g, i, t_s):
    """Input i of group g as it is, neither temperature nor rate."""
    which = c.group_inputs[g, i]
    if which == COIL:
        return s.values[ch, LAST_COIL]
    if which == TEMP_RATE:
        return s.filters[g, 0, 1]
    if which == LAG_TEMP:
        return s.filters[g, 1, 1]
    return t_s


@hot_kernel
def clipped_input(c, s, ch, g, i, t_s):
    """The same inside its validity."""
    which = np.uint64(c.group_inputs[g, i])
    return clip(other_input(c, s, ch, g, i, t_s), c.validity[g, which, 0], c.validity[g, which, 1])


@hot_kernel
def input_flags(c, s, ch, g, t_s):
    """Whether one of the other inputs has to be clipped."""
    for i in range(1, c.group_size[g]):
        if c.group_inputs[g, i] != TEMP:
            value = other_input(c, s, ch, g, i, t_s)
            if clipped_input(c, s, ch, g, i, t_s) != value:
                return EXTRAPOLATING
    return 0


@hot_kernel
def takes_time(c, g):
    """Whether an input besides the rate changes from row to row."""
    found = False
    for i in range(1, c.group_size[g]):
        found = found or c.group_inputs[g, i] == TIME
    return found


@hot_kernel
def add_rules(c, s, rows, ch, g, warm, count):
    """Add the output of group g to the first `count` rows, and its flags."""
    if c.rule_start[g] == c.rule_start[g + ONE]:
        return
    if takes_time(c, g):
        for k in range(count):
            t_s = max(rows.t_s[k], 0.0)
            rows.error[k] += rules_error(c, s, ch, g, warm, rows.inside[k], t_s)
            rows.flags[k] |= input_flags(c, s, ch, g, t_s)
    else:
        flags = input_flags(c, s, ch, g, 0.0)
        for k in range(count):
            rows.flags[k] |= flags
        add_block(c, s, rows, ch, g, warm, count)


@hot_kernel
def add_block(c, s, rows, ch, g, warm, count):
    """The same where nothing but the rate changes from row to row."""
    rate, weights, weighted = rows.inside[:count], rows.weights[:count], rows.weighted[:count]
    weights[:] = 0.0
    weighted[:] = 0.0
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        add_rule(cut_along_rate(c, s, ch, g, j, warm, 0.0), rate, weights, weighted)
    far = 0
    for k in range(count):
        far |= 1 if weights[k] < UNDERFLOW else 0
    if far:
        for k in range(count):
            if weights[k] < UNDERFLOW:
                weights[k], weighted[k] = nearest_sums(c, s, ch, g, warm, rate[k], 0.0)
    for k in range(count):
        rows.error[k] += weighted[k] / weights[k]


@hot_kernel
def add_rule(rule, rate, weights, weighted):
    """Add w and w·g of one rule to each row's sums."""
    for k in range(len(rate)):
        firing = exp_falling(exponent(rule, rate[k]))
        weights[k] += firing
        weighted[k] += firing * (rule[3] + rule[4] * rate[k])
