"""The regressor groups: for every effect the columns its equation gives, on a grid of its non-linear parameters.

A group is compared with others by what all its columns together explain.  Equations and sources are in the effect
catalogue (`training.effects`); here is only how each becomes columns of a linear model.  Rate-multiplied effects
carry 1e-6 so that their coefficients are ppm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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
    """What all recordings together excite; grids are the same for every recording."""

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


@dataclass(frozen=True)
class Group:
    """One effect as columns.

    `grid(survey)` lists the non-linear parameters to try; `columns(work, parameters)` gives the list of columns
    [dps per unit coefficient]; `linear(parameters)` names and units of the coefficients, one per column.
    """

    effect: str
    grid: Callable[[Survey], list[Parameters]]
    columns: Callable[[Work, Parameters], list[FloatArray]]
    linear: Callable[[Parameters], Sequence[tuple[str, str]]]
    needs: frozenset[str] = frozenset()
    continuous: tuple[str, ...] = ()


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


def _slope(work: Work) -> FloatArray:
    return np.gradient(work.temp, work.step_s)


def _h(work: Work) -> FloatArray:
    return work.temp - ROOM_DEGC


def _taus(low: float, high: float, count: int) -> Callable[[Survey], list[Parameters]]:
    def grid(survey: Survey) -> list[Parameters]:
        top = min(high, survey.duration_s / 4.0)  # longer lags are copies of the temperature itself
        bottom = max(low, 3.0 * survey.step_s)
        return [{"tau_s": float(tau)} for tau in np.geomspace(low, high, count) if bottom <= tau <= top]

    return grid


def _orders(top: int) -> Callable[[Survey], list[Parameters]]:
    return lambda survey: [{"order": float(k)} for k in range(1, top + 1)]


def _single(survey: Survey) -> list[Parameters]:
    return [{}]


def _powers(base: FloatArray, order: float, unit: float) -> list[FloatArray]:
    return [unit * base**k for k in range(1, int(order) + 1)]


def _shupe(work: Work, p: Parameters) -> list[FloatArray]:
    lagged = low_pass(work.temp, work.step_s, p["tau_s"])
    first = (work.temp - lagged) / p["tau_s"]
    second = (_slope(work) - first) / p["tau_s"]
    return [first, second] if p.get("order", 2.0) > 1.5 else [first]


def _shupe_grid(survey: Survey) -> list[Parameters]:
    taus = _taus(10.0, 500.0, 11)(survey)
    return [{**tau, "order": order} for order in (1.0, 2.0) for tau in taus]


def _lag(work: Work, p: Parameters) -> FloatArray:
    lagged = low_pass(work.temp, work.step_s, p["tau_s"])
    if p.get("tau2_s", 0.0) > 0.0:
        lagged = low_pass(lagged, work.step_s, p["tau2_s"])
    return lagged - work.temp


def _thermal_lag(work: Work, p: Parameters) -> list[FloatArray]:
    difference = _lag(work, p)
    columns = [PPM * work.w * difference]
    return [*columns, difference] if p.get("with_bias", 0.0) else columns


def _lag_grid(survey: Survey) -> list[Parameters]:
    return [{**tau, "with_bias": b} for b in (0.0, 1.0) for tau in _taus(50.0, 900.0, 11)(survey)]


def _plays(survey: Survey) -> list[Parameters]:
    span = survey.temp_high - survey.temp_low
    return [{"play_K": r} for r in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 15.0) if r < 0.4 * span]


def _loop_grid(survey: Survey) -> list[Parameters]:
    return [{**width, "with_static": s} for s in (0.0, 1.0) for width in _plays(survey)]


def _played(work: Work, p: Parameters) -> list[FloatArray]:
    """The loop p − T and, on request, the part of it that every real hysteresis has in common with a line."""
    loop = play(work.temp, p["play_K"]) - work.temp
    return [loop, _h(work)] if p.get("with_static", 0.0) else [loop]


def _scale_rate(work: Work, p: Parameters) -> list[FloatArray]:
    lagged = low_pass(work.temp, work.step_s, p["tau_s"])
    return [PPM * work.w * (work.temp - lagged) / p["tau_s"]]


def _nonlinearity_grid(survey: Survey) -> list[Parameters]:
    return [{"order": k} for k in (1.0, 2.0, 3.0, 4.0)]


def _nonlinearity(work: Work, p: Parameters) -> list[FloatArray]:
    top = work.full["w_max"][0]
    cubic = work.per_block(lambda w: w * w * w)
    quintic = work.per_block(lambda w: (w / top) ** 5) * top**5
    kinds = {1: [cubic], 2: [cubic, quintic], 3: [cubic, _h(work) * cubic], 4: [cubic, quintic, _h(work) * cubic]}
    return kinds[int(p["order"])]


def _nonlinearity_names(p: Parameters) -> list[tuple[str, str]]:
    c3, c5, c3h = ("c3_per_dps2", "1/dps^2"), ("c5_per_dps4", "1/dps^4"), ("c3h_per_dps2_per_K", "1/(dps^2 K)")
    return {1: [c3], 2: [c3, c5], 3: [c3, c3h], 4: [c3, c5, c3h]}[int(p["order"])]


DEAD_SHAPES: dict[int, Callable[[FloatArray, float], FloatArray]] = {
    0: lambda w, w0: -np.sign(w) * (np.abs(w) - np.sqrt(np.maximum(0.0, w * w - w0 * w0))),
    1: lambda w, w0: -w * (np.abs(w) < w0),
    2: lambda w, w0: -np.clip(w, -w0, w0),
}


def _dead_grid(survey: Survey) -> list[Parameters]:
    low, high = max(1e-3, 2e-5 * survey.rate_max, CLEAR_OF_NOISE * survey.rate_noise_dps), min(3.0, 0.1 * survey.rate_max)
    widths = np.geomspace(low, high, 28) if low < 0.5 * high else []
    return [{"lock_dps": float(w0), "shape": float(s)} for s in DEAD_SHAPES for w0 in widths]


def _dead_band(work: Work, p: Parameters) -> list[FloatArray]:
    shape = DEAD_SHAPES[int(p["shape"])]
    return [work.per_block(lambda w: shape(w, p["lock_dps"]))]


def _knees(survey: Survey) -> list[Parameters]:
    top = survey.rate_max * (1.0 - 1e-4) - CLEAR_OF_NOISE * survey.rate_noise_dps
    return [{"limit_dps": knee} for knee in survey.rate_quantiles if knee < top]


def _clip(work: Work, p: Parameters) -> list[FloatArray]:
    knee = p["limit_dps"]
    return [work.per_block(lambda w: -np.sign(w) * np.maximum(0.0, np.abs(w) - knee))]


def _ripple_grid(survey: Survey) -> list[Parameters]:
    span = survey.temp_high - survey.temp_low
    if span < 4.0:
        return []
    inverse = np.arange(1.0 / min(30.0, 0.8 * span), 1.0 / 2.5, 0.22 / span)
    return [{"period_K": float(1.0 / f), "chirp_per_K": c} for c in (0.0, -0.004, 0.004) for f in inverse]


def ripple_phase(h: FloatArray, p: Parameters) -> FloatArray:
    """φ = 2π (h + χh²)/P [rad]."""
    return 2.0 * np.pi * (h + p.get("chirp_per_K", 0.0) * h * h) / p["period_K"]


def _ripple(work: Work, p: Parameters) -> list[FloatArray]:
    phase = ripple_phase(_h(work), p)
    return [np.cos(phase), np.sin(phase)]


def _sawtooth_grid(survey: Survey) -> list[Parameters]:
    """Tried in a ripple's place, around its period (`training.diagnose.classes`), not on a grid of its own."""
    return []


def _sawtooth(work: Work, p: Parameters) -> list[FloatArray]:
    return [2.0 * np.mod((_h(work) - p["phase_K"]) / p["period_K"], 1.0) - 1.0]


def _decay(work: Work, p: Parameters) -> FloatArray:
    return np.exp(-work.t / p["tau_s"])


def _changes(survey: Survey) -> list[Parameters]:
    """Instants are searched sample by sample (`training.diagnose.steps`), not on a grid."""
    return []


def _after(work: Work, p: Parameters) -> FloatArray:
    if work.index != int(p["recording"]):
        return np.zeros(len(work))
    return (np.arange(len(work)) >= p["at_share"] * len(work)).astype(float)


def _ageing(work: Work, p: Parameters) -> list[FloatArray]:
    late = np.maximum(work.t, 0.0)
    shape = {0: late, 1: np.sqrt(late), 2: np.log1p(late / 600.0), 3: np.log1p(late / 3600.0)}
    return [PPM * work.w * shape[int(p["shape"])]]


def _heading(work: Work, harmonic: int) -> list[FloatArray]:
    return [work.extra[f"cos{harmonic}"], work.extra[f"sin{harmonic}"]]


def _rate_heading(work: Work, p: Parameters) -> list[FloatArray]:
    names = ["wcos1", "wsin1"] + (["wcos2", "wsin2"] if p["order"] > 1.5 else [])
    return [PPM * work.extra[name] for name in names]


def _names(*pairs: tuple[str, str]) -> Callable[[Parameters], Sequence[tuple[str, str]]]:
    return lambda p: pairs


def _poly_names(letter: str, unit: str) -> Callable[[Parameters], Sequence[tuple[str, str]]]:
    stem = {"b": "dps", "s": "ppm"}[letter]
    return lambda p: [
        (f"{letter}{k}_{stem}_per_K{'' if k == 1 else k}", f"{unit}/K{'' if k == 1 else f'^{k}'}")
        for k in range(1, int(p["order"]) + 1)
    ]


TEMP, RATE = frozenset({"temperature"}), frozenset({"rate"})
TIME, BOTH = frozenset({"clock"}), frozenset({"temperature", "rate"})

GROUPS: tuple[Group, ...] = (
    Group("bias_temperature", _orders(3), lambda k, p: _powers(_h(k), p["order"], 1.0), _poly_names("b", "dps"), TEMP),
    Group(
        "scale_temperature", _orders(3),
        lambda k, p: [PPM * k.w * column for column in _powers(_h(k), p["order"], 1.0)],
        _poly_names("s", "ppm"), BOTH,
    ),
    Group(
        "shupe", _shupe_grid, _shupe,
        lambda p: [("c1_dps_s_per_K", "dps s/K"), ("c2_dps_s2_per_K", "dps s^2/K")][: int(p["order"])],
        TEMP | TIME, ("tau_s",),
    ),
    Group(
        "thermal_lag", _lag_grid, _thermal_lag,
        lambda p: [("scale_ppm_per_K", "ppm/K"), ("bias_dps_per_K", "dps/K")][: 1 + int(p.get("with_bias", 0.0))],
        BOTH | TIME, ("tau_s",),
    ),
    Group(
        "bias_hysteresis", _loop_grid, _played,
        lambda p: [("c_dps_per_K", "dps/K"), ("b1_dps_per_K", "dps/K")][: 1 + int(p.get("with_static", 0.0))],
        TEMP | TIME, ("play_K",),
    ),
    Group(
        "scale_hysteresis", _loop_grid, lambda k, p: [PPM * k.w * column for column in _played(k, p)],
        lambda p: [("c_ppm_per_K", "ppm/K"), ("s1_ppm_per_K", "ppm/K")][: 1 + int(p.get("with_static", 0.0))],
        BOTH | TIME, ("play_K",),
    ),
    Group(
        "scale_temperature_rate", lambda s: [{"tau_s": tau} for tau in (5.0, 20.0, 40.0)], _scale_rate,
        _names(("c_ppm_s_per_K", "ppm s/K")), BOTH | TIME, ("tau_s",),
    ),
    Group("scale_nonlinearity", _nonlinearity_grid, _nonlinearity, _nonlinearity_names, RATE),
    Group("scale_asymmetry", _single, lambda k, p: [PPM * k.per_block(np.abs)], _names(("c_ppm", "ppm")), RATE),
    Group("dead_band", _dead_grid, _dead_band, _names(("depth", "1")), RATE, ("lock_dps",)),
    Group("saturation", _knees, _clip, _names(("loss", "1")), RATE, ("limit_dps",)),
    Group(
        "polarization_ripple", _ripple_grid, _ripple,
        _names(("cos_dps", "dps"), ("sin_dps", "dps")), TEMP, ("period_K", "chirp_per_K"),
    ),
    Group("compensation_table", _sawtooth_grid, _sawtooth, _names(("amplitude_dps", "dps")), TEMP, ("period_K", "phase_K")),
    Group("bias_drift", _single, lambda k, p: [k.t], _names(("c_dps_per_s", "dps/s")), TIME),
    Group(
        "source_ageing", lambda s: [{"shape": k} for k in (0.0, 1.0, 2.0, 3.0)], _ageing,
        lambda p: [[("c_ppm_per_s", "ppm/s"), ("c_ppm_per_sqrt_s", "ppm/s^0.5"), ("c_ppm_per_ln", "ppm"), ("c_ppm_per_ln", "ppm")][int(p["shape"])]],
        RATE | TIME,
    ),
    Group("bias_warmup", _taus(60.0, 2500.0, 10), lambda k, p: [_decay(k, p)], _names(("amplitude_dps", "dps")), TIME | {"power_on"}, ("tau_s",)),
    Group(
        "scale_warmup", _taus(60.0, 2500.0, 10), lambda k, p: [PPM * k.w * _decay(k, p)],
        _names(("amplitude_ppm", "ppm")), RATE | TIME | {"power_on"}, ("tau_s",),
    ),
    Group("bias_step", _changes, lambda k, p: [_after(k, p)], _names(("step_dps", "dps")), TIME, ("at_share",)),
    Group("scale_step", _changes, lambda k, p: [PPM * k.w * _after(k, p)], _names(("step_ppm", "ppm")), RATE | TIME, ("at_share",)),
    Group("magnetic", lambda s: [{"order": k} for k in (1.0, 2.0)],
          lambda k, p: _heading(k, 1) + (_heading(k, 2) if p["order"] > 1.5 else []),
          lambda p: [("cos_dps", "dps"), ("sin_dps", "dps"), ("cos2_dps", "dps"), ("sin2_dps", "dps")][: 2 * int(p["order"])],
          frozenset({"heading"})),
    Group("table_eccentricity", lambda s: [{"order": k} for k in (1.0, 2.0)], _rate_heading,
          lambda p: [("cos_ppm", "ppm"), ("sin_ppm", "ppm"), ("cos2_ppm", "ppm"), ("sin2_ppm", "ppm")][: 2 * int(p["order"])],
          frozenset({"heading", "rate"})),
    Group("acceleration", lambda s: [{"order": k} for k in (1.0, 2.0)],
          lambda k, p: [k.extra["accel"], k.extra["accel2"]][: int(p["order"])],
          lambda p: [("c1_dps_per_g", "dps/g"), ("c2_dps_per_g2", "dps/g^2")][: int(p["order"])],
          frozenset({"acceleration"})),
    Group("vibration_rectification", _single, lambda k, p: [k.extra["vib2"]],
          _names(("c_dps_per_m2s4", "dps/(m/s^2)^2")), frozenset({"vibration"})),
    Group("misalignment", _single, lambda k, p: [k.extra["roll_rate"]],
          _names(("roll_coupling", "dps/(m/s^3)")), frozenset({"acceleration"})),
)
