"""Columns of the effects that bend the rate itself: nonlinearity, dead band, saturation (see `columns`)."""

from collections.abc import Callable

import numpy as np

from training.diagnose.columns import above_room
from training.diagnose.library import CLEAR_OF_NOISE, FloatArray, Parameters, Survey
from training.diagnose.work import Work

KNEES = (0.0, 0.006, 0.02, 0.06)  # roundness of a saturation's knee, of the highest rate
ODD_POWERS: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((3, 0),),
    2: ((3, 0), (5, 0)),
    3: ((3, 0), (3, 1)),
    4: ((3, 0), (5, 0), (3, 1)),
    5: ((3, 0), (5, 0), (7, 0)),
    6: ((3, 0), (5, 0), (7, 0), (9, 0)),
    7: ((3, 0), (5, 0), (7, 0), (9, 0), (11, 0)),
    8: ((3, 0), (5, 0), (7, 0), (9, 0), (3, 1)),
}
"""Which ω^n·h^k a nonlinearity may consist of; from the fifth on only where it is so large that its shape shows."""
BEYOND = frozenset({(7, 0), (9, 0), (11, 0)})
HUNDRED_DPS = 100.0  # high powers are of the rate in hundreds, or their size would leave every range


def nonlinearity_grid(survey: Survey) -> list[Parameters]:
    """Which odd powers of the rate, alone or times temperature; high ones are marked, for what they must pay."""
    return [{"order": float(k)} | ({"high": 1.0} if k > 4 else {}) for k in ODD_POWERS]


def nonlinearity(work: Work, p: Parameters) -> list[FloatArray]:
    """ω³, ω⁵, hω³ and powers of ω/(100 °/s) beyond, as the order says."""
    kinds = ODD_POWERS[int(p["order"])]
    powers_of = {
        n: work.per_block(lambda w, n=n: _odd_power(w / HUNDRED_DPS, n)) for n in {n for n, _ in kinds}
    }
    columns = []
    for n, k in kinds:
        column = powers_of[n] * (1.0 if (n, k) in BEYOND else HUNDRED_DPS**n)
        columns.append(above_room(work) * column if k else column)
    return columns


def _odd_power(x: FloatArray, n: int) -> FloatArray:
    """xⁿ by products: `**` with a float array is twenty times slower."""
    power, squared = x, x * x
    for _ in range(n // 2):
        power = power * squared
    return power


def nonlinearity_names(p: Parameters) -> list[tuple[str, str]]:
    """Coefficients of those columns."""
    known = {
        (3, 0): ("c3_per_dps2", "1/dps^2"),
        (5, 0): ("c5_per_dps4", "1/dps^4"),
        (3, 1): ("c3h_per_dps2_per_K", "1/(dps^2 K)"),
    }
    beyond = {(n, k): (f"c{n}_dps", "dps") for n, k in BEYOND}
    return [(known | beyond)[kind] for kind in ODD_POWERS[int(p["order"])]]


WASHED_OUT = 2.0  # a dead band narrower than this many times the noise left in the rate cannot be seen
NORMAL_NODES = [
    (float(x), float(share / np.sqrt(2.0 * np.pi)))
    for x, share in zip(*np.polynomial.hermite_e.hermegauss(9), strict=True)
]
DEAD_SHAPES: dict[int, Callable[[FloatArray, float], FloatArray]] = {
    0: lambda w, w0: -np.sign(w) * (np.abs(w) - np.sqrt(np.maximum(0.0, w * w - w0 * w0))),
    1: lambda w, w0: -w * (np.abs(w) < w0),
    2: lambda w, w0: -np.clip(w, -w0, w0),
}


def dead_grid(survey: Survey) -> list[Parameters]:
    """Widths that the reference noise does not wash out, times three shapes."""
    low, high = (
        max(1e-3, 2e-5 * survey.rate_max, WASHED_OUT * survey.rate_noise_dps),
        min(3.0, 0.1 * survey.rate_max),
    )
    widths = np.geomspace(low, high, 32) if low < 0.5 * high else []
    return [{"lock_dps": float(w0), "shape": float(s)} for s in DEAD_SHAPES for w0 in widths]


def dead_band(work: Work, p: Parameters) -> list[FloatArray]:
    """What a dead band of that width and shape takes away, on average over what the true rate can be.

    The smoothed rate is the mean of the true one given the reference, which lies about it with the noise that is left:
    a bend not much wider than that noise is found in the residual as round as the noise makes it (Berkson's error).
    """
    shape, width, noise = DEAD_SHAPES[int(p["shape"])], p["lock_dps"], work.rate_noise_dps
    if width > CLEAR_OF_NOISE * noise:
        return [work.per_block(lambda w: shape(w, width))]

    def washed(w: FloatArray) -> FloatArray:
        return sum((share * shape(w + noise * x, width) for x, share in NORMAL_NODES), np.zeros(len(w)))

    return [work.per_block(washed)]


def knee_grid(survey: Survey) -> list[Parameters]:
    """Knees clear of the highest rate, hard and soft."""
    top = survey.rate_max * (1.0 - 1e-4) - CLEAR_OF_NOISE * survey.rate_noise_dps
    return [
        {"limit_dps": knee, "soft_dps": share * survey.rate_max}
        for share in KNEES
        for knee in survey.rate_quantiles
        if knee < top
    ]


def beyond_knee(work: Work, p: Parameters) -> list[FloatArray]:
    """What lies beyond the knee, taken away: a hinge, or one with a round corner (softplus) of `soft_dps`."""
    knee, soft = p["limit_dps"], p.get("soft_dps", 0.0)

    def lost(w: FloatArray) -> FloatArray:
        over = np.abs(w) - knee
        return -np.sign(w) * (soft * np.logaddexp(0.0, over / soft) if soft > 0.0 else np.maximum(0.0, over))

    return [work.per_block(lost)]
