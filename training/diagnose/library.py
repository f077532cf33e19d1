"""What a regressor group is, what the recordings excite, and the two operators with memory (lag and play)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from rtcomp.jit import kernel
from training.diagnose.work import Work

FloatArray = NDArray[np.float64]
Parameters = dict[str, float]
PPM = 1e-6
ROOM_DEGC = 25.0
CLEAR_OF_NOISE = 12.0  # a bend of the rate must be this much wider than the reference's own noise


@dataclass(frozen=True)
class Survey:
    """What all recordings together excite; grids are the same for every recording.

    `coil_tau_s` is the lag of a sensor at the coil behind the reported temperature (0 without one); `stops` are
    (recording, end of a standstill [s]).
    """

    duration_s: float
    step_s: float
    temp_low: float
    temp_high: float
    rate_max: float
    rate_quantiles: tuple[float, ...]
    start_s: float
    has: frozenset[str]
    points: bool
    recordings: int = 1
    rate_noise_dps: float = 0.0
    coil_tau_s: float = 0.0
    stops: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Group:
    """One effect as columns.

    `grid(survey)` lists the non-linear parameters to try; `columns(work, parameters)` gives the list of columns
    [dps per unit coefficient]; `linear(parameters)` names and units of the coefficients, one per column; `knots`
    [driver units] are the corners of a basis without a name, by how many were asked for.
    """

    effect: str
    grid: Callable[[Survey], list[Parameters]]
    columns: Callable[[Work, Parameters], list[FloatArray]]
    linear: Callable[[Parameters], Sequence[tuple[str, str]]]
    needs: frozenset[str] = frozenset()
    continuous: tuple[str, ...] = ()
    knots: dict[float, FloatArray] = field(default_factory=dict)


def low_pass(values: FloatArray, step_s: float, tau_s: float) -> FloatArray:
    """First-order lag, exact for piecewise linear input, starting settled at the first value."""
    if tau_s <= 0.0:
        return values
    x = step_s / tau_s
    decay = np.exp(-x)
    b0 = 1.0 - (1.0 - decay) / x
    b1 = (1.0 - decay) / x - decay
    state = signal.lfiltic([b0, b1], [1.0, -decay], [values[0]], [values[0]])
    return signal.lfilter([b0, b1], [1.0, -decay], values, zi=state)[0]


@kernel
def play(values, width):
    """The play operator: p follows `values` only when they leave p ± width; starts at the first value."""
    out = np.empty_like(values)
    p = values[0]
    for i in range(len(values)):
        p = min(max(p, values[i] - width), values[i] + width)
        out[i] = p
    return out
