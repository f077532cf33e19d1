"""How each effect becomes columns of a linear model [dps per unit coefficient], and the grids of what is not linear.

Equations and sources are in the effect catalogue (`training.effects`).  Rate-multiplied effects carry 1e-6 so that
their coefficients are ppm.
"""

from collections.abc import Callable, Sequence

import numpy as np

from training.diagnose.library import (
    PPM,
    ROOM_DEGC,
    FloatArray,
    Parameters,
    Survey,
    low_pass,
    play,
)
from training.diagnose.work import Work

MOST_STOPS = 12


def temperature_slope(work: Work) -> FloatArray:
    """dT/dt [K/s] of the smoothed temperature."""
    return np.gradient(work.slow_temp, work.step_s)


def above_room(work: Work) -> FloatArray:
    """h = T − 25 °C [K]."""
    return work.temp - ROOM_DEGC


def tau_grid(low: float, high: float, count: int) -> Callable[[Survey], list[Parameters]]:
    """A grid of time constants, clipped to what the recordings can tell."""

    def grid(survey: Survey) -> list[Parameters]:
        top = min(high, survey.duration_s / 4.0)  # longer lags are copies of the temperature itself
        bottom = max(low, 3.0 * survey.step_s)
        return [{"tau_s": float(tau)} for tau in np.geomspace(low, high, count) if bottom <= tau <= top]

    return grid


ORDERS = (
    1,
    2,
    3,
    4,
    6,
)  # a cubic serves all but the strongest: their next orders must not pass for another effect


def order_grid(survey: Survey) -> list[Parameters]:
    """Polynomial orders; those beyond a cubic are marked, for what they must pay."""
    return [{"order": float(k)} | ({"high": 1.0} if k > 3 else {}) for k in ORDERS]


def no_grid(survey: Survey) -> list[Parameters]:
    """The grid of an effect without non-linear parameters."""
    return [{}]


def powers(base: FloatArray, order: float, unit: float) -> list[FloatArray]:
    """unit·base, unit·base², …"""
    return [unit * base**k for k in range(1, int(order) + 1)]


def shupe_columns(work: Work, p: Parameters) -> list[FloatArray]:
    """LP_τ(dT/dt) and its rate of change."""
    lagged = low_pass(work.slow_temp, work.step_s, p["tau_s"])
    first = (work.slow_temp - lagged) / p["tau_s"]
    second = (temperature_slope(work) - first) / p["tau_s"]
    return [first, second] if p.get("order", 2.0) > 1.5 else [first]


def shupe_grid(survey: Survey) -> list[Parameters]:
    """Time constants with one or both columns."""
    taus = tau_grid(10.0, 500.0, 11)(survey)
    return [{**tau, "order": order} for order in (1.0, 2.0) for tau in taus]


def coil_temperature(work: Work, p: Parameters) -> FloatArray:
    """LP_τ(T) [degC], two poles with tau2_s; as measured where a sensor sits at the coil."""
    if "coil_tau_s" in p:
        return work.extra["coil"]
    lagged = low_pass(work.temp, work.step_s, p["tau_s"])
    return low_pass(lagged, work.step_s, p["tau2_s"]) if p.get("tau2_s", 0.0) > 0.0 else lagged


def thermal_lag(work: Work, p: Parameters) -> list[FloatArray]:
    """What the simulation says at the coil's temperature, or rate times the difference and, on request, that itself."""
    coil = coil_temperature(work, p)
    if p.get("on_surface", 0.0) and work.elsewhere is not None:
        return [work.elsewhere(coil)]
    columns = [PPM * work.w * (coil - work.temp)]
    return [*columns, coil - work.temp] if p.get("with_bias", 0.0) else columns


def lag_grid(survey: Survey) -> list[Parameters]:
    """Time constants, with or without a part in the bias; where the simulation is a surface that says which part."""
    if survey.coil_tau_s > 0.0:
        lags: list[Parameters] = [{"coil_tau_s": survey.coil_tau_s}]
    else:
        lags = tau_grid(50.0, 900.0, 11)(survey)
    known = "on_surface" if "surface" in survey.has else "with_bias"
    return [lag | {known: share} for share in (0.0, 1.0) for lag in lags]


def play_grid(survey: Survey) -> list[Parameters]:
    """Half-widths of the play [K] that the temperature range can show."""
    span = survey.temp_high - survey.temp_low
    return [
        {"play_K": r}
        for r in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 15.0)
        if r < 0.4 * span
    ]


def loop_grid(survey: Survey) -> list[Parameters]:
    """Half-widths with and without a static slope."""
    return [{**width, "with_static": s} for s in (0.0, 1.0) for width in play_grid(survey)]


def loop_columns(work: Work, p: Parameters) -> list[FloatArray]:
    """The loop p − T and, on request, the part of it that every real hysteresis has in common with a line."""
    loop = play(work.temp, p["play_K"]) - work.temp
    return [loop, above_room(work)] if p.get("with_static", 0.0) else [loop]


def scale_rate(work: Work, p: Parameters) -> list[FloatArray]:
    """Rate times LP_τ(dT/dt)."""
    lagged = low_pass(work.slow_temp, work.step_s, p["tau_s"])
    return [PPM * work.w * (work.slow_temp - lagged) / p["tau_s"]]


def ripple_grid(survey: Survey) -> list[Parameters]:
    """Periods fine enough for the temperature span, straight and chirped."""
    span = survey.temp_high - survey.temp_low
    if span < 4.0:
        return []
    inverse = np.arange(1.0 / min(30.0, 0.8 * span), 1.0 / 2.5, 0.22 / span)
    return [{"period_K": float(1.0 / f), "chirp_per_K": c} for c in (0.0, -0.004, 0.004) for f in inverse]


def ripple_phase(h: FloatArray, p: Parameters) -> FloatArray:
    """φ = 2π (h + χh²)/P [rad]."""
    return 2.0 * np.pi * (h + p.get("chirp_per_K", 0.0) * h * h) / p["period_K"]


def ripple_columns(work: Work, p: Parameters) -> list[FloatArray]:
    """cos φ and sin φ."""
    phase = ripple_phase(above_room(work), p)
    return [np.cos(phase), np.sin(phase)]


def sawtooth_grid(survey: Survey) -> list[Parameters]:
    """Tried in a ripple's place, around its period (`training.diagnose.classes`), not on a grid of its own."""
    return []


def sawtooth(work: Work, p: Parameters) -> list[FloatArray]:
    """A sawtooth of unit amplitude in temperature."""
    return [2.0 * np.mod((above_room(work) - p["phase_K"]) / p["period_K"], 1.0) - 1.0]


def decay(work: Work, p: Parameters) -> FloatArray:
    """exp(−t/τ)."""
    return np.exp(-work.t / p["tau_s"])


def change_grid(survey: Survey) -> list[Parameters]:
    """Instants are searched sample by sample (`training.diagnose.steps`), not on a grid."""
    return []


def after_step(work: Work, p: Parameters) -> FloatArray:
    """0 before the instant, 1 from it on, in its recording."""
    if work.index != int(p["recording"]):
        return np.zeros(len(work))
    return (np.arange(len(work)) >= p["at_share"] * len(work)).astype(float)


def stop_grid(survey: Survey) -> list[Parameters]:
    """The ends of the stops, at each of which firmware may have taken a new zero; one stop alone is a bias step.

    Many stops are dealt out to several points, which the search may all take.
    """
    chunks = max(1, -(-len(survey.stops) // MOST_STOPS))
    found: list[Parameters] = []
    for i in range(chunks):
        part = survey.stops[i::chunks]
        of = {f"of_{j}": recording for j, (recording, _) in enumerate(part)}
        at = {f"at_s_{j}": end for j, (_, end) in enumerate(part)}
        found += [{"chunk": float(i), **of, **at}] if len(part) > 1 else []
    return found


def after_stops(work: Work, p: Parameters) -> list[FloatArray]:
    """1 from the end of each stop on, in its recording."""
    return [
        (work.t >= p[f"at_s_{j}"]).astype(float) * (work.index == int(p[f"of_{j}"]))
        for j in range(len(p) // 2)
    ]


def stop_names(p: Parameters) -> list[tuple[str, str]]:
    """One coefficient per stop."""
    return [(f"step_{j + 1}_dps", "dps") for j in range(len(p) // 2)]


def ageing_columns(work: Work, p: Parameters) -> list[FloatArray]:
    """Rate times t, √t or a logarithm of it."""
    late = np.maximum(work.t, 0.0)
    shape = {0: late, 1: np.sqrt(late), 2: np.log1p(late / 600.0), 3: np.log1p(late / 3600.0)}
    return [PPM * work.w * shape[int(p["shape"])]]


def heading_columns(work: Work, harmonic: int) -> list[FloatArray]:
    """cos kψ and sin kψ."""
    return [work.extra[f"cos{harmonic}"], work.extra[f"sin{harmonic}"]]


def rate_heading(work: Work, p: Parameters) -> list[FloatArray]:
    """ω cos kψ and ω sin kψ."""
    names = ["wcos1", "wsin1"] + (["wcos2", "wsin2"] if p["order"] > 1.5 else [])
    return [PPM * work.extra[name] for name in names]


def fixed_names(*pairs: tuple[str, str]) -> Callable[[Parameters], Sequence[tuple[str, str]]]:
    """The same coefficient names at every grid point."""
    return lambda p: pairs


def poly_names(letter: str, unit: str) -> Callable[[Parameters], Sequence[tuple[str, str]]]:
    """Names and units of polynomial coefficients."""
    stem = {"b": "dps", "s": "ppm"}[letter]
    return lambda p: [
        (f"{letter}{k}_{stem}_per_K{'' if k == 1 else k}", f"{unit}/K{'' if k == 1 else f'^{k}'}")
        for k in range(1, int(p["order"]) + 1)
    ]
