"""The exponential of the compiled step: the same bits one by one, in vectors and on every machine.

A C library's `exp` keeps the compiler from putting several rows into one vector instruction, and its last bit differs
between libraries. This one is nothing but additions, multiplications and shifts, each rounded by itself.
"""

import numpy as np

from rtcomp.jit import hot_kernel

LOWEST = -708.0  # below, the result would not be a normal number any more
LOG2_E = 1.4426950408889634
LN2_HIGH = 0.6931471801362932  # ln 2 to 31 bits: a product with any exponent is exact
LN2_LOW = 4.236521365809284e-10  # the rest of ln 2
TO_INTEGER = 6755399441055744.0  # 1.5·2⁵²: added, it rounds to an integer that then stands in the lowest bits
MANTISSA_BITS = np.int64(52)
ONE = np.int64(1023 << 52)  # the bits of 1.0

# (eˣ − 1 − x)/x² for |x| ≤ ln 2 / 2, interpolated at the ten Chebyshev nodes: below 2e-17 of eˣ everywhere.
C0, C1, C2, C3, C4 = (
    0.5000000000000001,
    0.16666666666666669,
    0.041666666666624066,
    0.008333333333330056,
    0.0013888888917245787,
)
C5, C6, C7, C8, C9 = (
    0.0001984126986307828,
    2.4801521246131495e-05,
    2.7557268421682613e-06,
    2.7620112139572367e-07,
    2.510040371657669e-08,
)


@hot_kernel
def exp_falling(x):
    """eˣ for x ≤ 0, within one unit in the last place; 0 below `LOWEST`, NaN for NaN."""
    inside = LOWEST if x < LOWEST else x
    shifted = np.float64(inside * LOG2_E + TO_INTEGER)
    n = shifted - TO_INTEGER
    r = inside - n * LN2_HIGH - n * LN2_LOW
    r2 = r * r
    r4 = r2 * r2
    low = (C0 + C1 * r) + r2 * (C2 + C3 * r)
    high = (C4 + C5 * r) + r2 * (C6 + C7 * r) + r4 * (C8 + C9 * r)
    power = np.int64((shifted.view(np.int64) << MANTISSA_BITS) + ONE).view(np.float64)  # 2ⁿ
    result = (1.0 + (r + r2 * (low + r4 * high))) * power
    return 0.0 if x < LOWEST else result
