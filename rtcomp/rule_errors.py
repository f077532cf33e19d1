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

FIRST, FEW = np.int64(1), np.int64(2)  # columns: the rate comes before; more than two are seldom
UNDERFLOW = 1e-250  # below, quotients of firing strengths lose digits
EXTRAPOLATING = int(Flag.EXTRAPOLATING)


@hot_kernel
def rules_error(c, s, ch, g, warm, rate, t_s):
    """TS output of group g, which has rules, at a temperature and a rate inside their validity.

    Far from every rule all firing strengths are nearly 0: with the largest exponent taken out the nearest one answers.
    """
    x, shift = other_input(c, s, ch, g, FIRST, warm, t_s), 0.0
    while True:
        weights, weighted = 0.0, 0.0
        for j in range(c.rule_start[g], c.rule_start[g + ONE]):
            rule = cut_along_rate(c, s, ch, g, j, x, warm, t_s)
            firing = exp_falling(exponent(rule, rate) - shift)
            weights += firing
            weighted += firing * (rule[3] + rule[4] * rate)
        if not weights < UNDERFLOW:
            return weighted / weights
        shift = -np.inf
        for j in range(c.rule_start[g], c.rule_start[g + ONE]):
            shift = max(shift, exponent(cut_along_rate(c, s, ch, g, j, x, warm, t_s), rate))


@hot_kernel
def cut_along_rate(c, s, ch, g, j, x, warm, t_s):
    """Rule j as a function of the rate: ½Σz² of the other inputs; centre and 1/σ; output at rate 0, and its slope.

    `x` is the first of the other inputs; an absent one has neither weight nor consequent.
    """
    z = (x - c.centers[j, 1]) * c.inverse_widths[j, 1]
    square, output = z * z, c.consequents[j, 0] + c.consequents[j, 2] * x
    if c.group_size[g] > FEW:
        more, further = further_inputs(c, s, ch, g, j, warm, t_s)
        square += more
        output += further
    return 0.5 * square, c.centers[j, 0], c.inverse_widths[j, 0], output, c.consequents[j, 1]


@hot_kernel
def further_inputs(c, s, ch, g, j, warm, t_s):
    """Σz² and Σ a_k x_k of rule j over the inputs behind the first two."""
    square, output = 0.0, 0.0
    for i in range(FEW, c.group_size[g]):
        x = other_input(c, s, ch, g, i, warm, t_s)
        z = (x - c.centers[j, i]) * c.inverse_widths[j, i]
        square += z * z
        output += c.consequents[j, i + 1] * x
    return square, output


@hot_kernel
def exponent(rule, rate):
    """−½ Σ z² over all inputs."""
    z = (rate - rule[1]) * rule[2]
    return -0.5 * (z * z) - rule[0]


@hot_kernel
def other_input(c, s, ch, g, i, warm, t_s):
    """Input i of group g, not the rate, inside its validity; 0 for an absent one."""
    which = c.group_inputs[g, i]
    if which == TEMP:
        return warm
    if which < 0:
        return 0.0
    limits = c.validity[g, np.uint64(which)]
    return clip(unclipped_input(s, ch, g, which, t_s), limits[0], limits[1])


@hot_kernel
def unclipped_input(s, ch, g, which, t_s):
    """The same as it is; neither temperature nor rate."""
    if which == COIL:
        return s.values[ch, LAST_COIL]
    if which == TEMP_RATE:
        return s.filters[g, 0, 1]
    if which == LAG_TEMP:
        return s.filters[g, 1, 1]
    return t_s


@hot_kernel
def input_flags(c, s, ch, g, t_s):
    """Whether one of the other inputs has to be clipped; of the temperature the group tells that."""
    if c.group_size[g] == FEW and c.group_inputs[g, 1] == TEMP:
        return 0
    return further_flags(c, s, ch, g, t_s)


@hot_kernel
def further_flags(c, s, ch, g, t_s):
    """The same for any inputs."""
    for i in range(1, c.group_size[g]):
        which = c.group_inputs[g, i]
        if which != TEMP and other_input(c, s, ch, g, i, 0.0, t_s) != unclipped_input(s, ch, g, which, t_s):
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
    if count == 1 or takes_time(c, g) or not add_block(c, s, rows, ch, g, warm, count):
        for k in range(count):
            t_s = max(rows.t_s[k], 0.0)
            rows.error[k] += rules_error(c, s, ch, g, warm, rows.inside[k], t_s)
            rows.flags[k] |= input_flags(c, s, ch, g, t_s)


@hot_kernel
def add_block(c, s, rows, ch, g, warm, count):
    """The same where nothing but the rate changes from row to row; False, and nothing done, far from every rule."""
    rate, weights, weighted = rows.inside[:count], rows.weights[:count], rows.weighted[:count]
    weights[:] = 0.0
    weighted[:] = 0.0
    x = other_input(c, s, ch, g, FIRST, warm, 0.0)
    for j in range(c.rule_start[g], c.rule_start[g + ONE]):
        add_rule(cut_along_rate(c, s, ch, g, j, x, warm, 0.0), rate, weights, weighted)
    far = 0
    for k in range(count):
        far |= 1 if weights[k] < UNDERFLOW else 0
    if far:
        return False
    flags = input_flags(c, s, ch, g, 0.0)
    for k in range(count):
        rows.error[k] += weighted[k] / weights[k]
        rows.flags[k] |= flags
    return True


@hot_kernel
def add_rule(rule, rate, weights, weighted):
    """Add w and w·g of one rule to each row's sums."""
    for k in range(len(rate)):
        firing = exp_falling(exponent(rule, rate[k]))
        weights[k] += firing
        weighted[k] += firing * (rule[3] + rule[4] * rate[k])
