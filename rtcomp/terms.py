"""The effects that can be corrected in the vehicle: causal in rate, temperature and time since power-on.

Symbols: e error [°/s] = measured − true; w best estimate of the true rate [°/s]; m measured rate; T temperature
[°C]; h = T − 25; t time since power-on [s]; y = LP_τ(T) first-order low pass, exact for T linear between samples
(so LP_τ(dT/dt) = (T − y)/τ); p play operator of half-width r. Physics and sources: the catalogue in `training.effects`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from rtcomp.errors import RequestError

PPM = 1e-6
REF_DEGC = 25.0
DRIVERS = ("temperature", "temperature_rate", "rate", "time_since_power_on")


@dataclass(frozen=True)
class TermKind:
    """How one effect is corrected: `code` in the compiled step, parameters in the order of its parameter row."""

    code: int
    equation: str
    required: tuple[str, ...]
    optional: Mapping[str, float] = field(default_factory=dict)
    positive: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All parameter names, in the order of the compiled parameter row."""
        return self.required + tuple(self.optional)


LAG, SHUPE, BIAS_PLAY, SCALE_PLAY, SCALE_RATE, BIAS_T, SCALE_T, CUBIC, ASYMMETRY = range(9)
BIAS_WARMUP, SCALE_WARMUP, RIPPLE, SAWTOOTH, DRIFT, AGEING, SCALE, BIAS, UNIT, EMPIRICAL = range(9, 19)

TERMS: dict[str, TermKind] = {
    "thermal_lag": TermKind(
        LAG,
        "e = w·(S(T_c) − S(T)) + bias·(T_c − T), T_c = LP_τ(T), a second pole with tau2_s, "
        "S(T) = scale·h + scale2·h² + scale3·h³",
        ("tau_s",),
        {
            "scale_ppm_per_K": 0.0,
            "bias_dps_per_K": 0.0,
            "tau2_s": 0.0,
            "scale2_ppm_per_K2": 0.0,
            "scale3_ppm_per_K3": 0.0,
        },
        ("tau_s",),
    ),
    "shupe": TermKind(
        SHUPE,
        "e = c1·LP_τ(dT/dt) + c2·d/dt LP_τ(dT/dt), T first smoothed with smooth_s",
        ("tau_s",),
        {"c1_dps_s_per_K": 0.0, "c2_dps_s2_per_K": 0.0, "smooth_s": 0.0},
        ("tau_s",),
    ),
    "bias_hysteresis": TermKind(BIAS_PLAY, "e = c·(p − T)", ("play_K", "c_dps_per_K"), positive=("play_K",)),
    "scale_hysteresis": TermKind(
        SCALE_PLAY, "e = w·c·(p − T)", ("play_K", "c_ppm_per_K"), positive=("play_K",)
    ),
    "scale_temperature_rate": TermKind(
        SCALE_RATE, "e = w·c·LP_τ(dT/dt)", ("tau_s", "c_ppm_s_per_K"), positive=("tau_s",)
    ),
    "bias_temperature": TermKind(
        BIAS_T, "e = b1·h + b2·h² + b3·h³", ("b1_dps_per_K",), {"b2_dps_per_K2": 0.0, "b3_dps_per_K3": 0.0}
    ),
    "scale_temperature": TermKind(
        SCALE_T,
        "e = w·(s1·h + s2·h² + s3·h³)",
        ("s1_ppm_per_K",),
        {"s2_ppm_per_K2": 0.0, "s3_ppm_per_K3": 0.0},
    ),
    "scale_nonlinearity": TermKind(
        CUBIC,
        "e = c3·w³ + c5·w⁵ + c3h·h·w³",
        ("c3_per_dps2",),
        {"c5_per_dps4": 0.0, "c3h_per_dps2_per_K": 0.0},
    ),
    "scale_asymmetry": TermKind(ASYMMETRY, "e = c·|w|", ("c_ppm",)),
    "bias_warmup": TermKind(BIAS_WARMUP, "e = A·exp(−t/τ)", ("amplitude_dps", "tau_s"), positive=("tau_s",)),
    "scale_warmup": TermKind(
        SCALE_WARMUP, "e = w·A·exp(−t/τ)", ("amplitude_ppm", "tau_s"), positive=("tau_s",)
    ),
    "polarization_ripple": TermKind(
        RIPPLE,
        "e = cos_dps·cos φ + sin_dps·sin φ, φ = 2π(h + χh²)/P",
        ("period_K",),
        {"cos_dps": 0.0, "sin_dps": 0.0, "chirp_per_K": 0.0},
        ("period_K",),
    ),
    "compensation_table": TermKind(
        SAWTOOTH,
        "e = A·(2·frac((h − phase)/P) − 1)",
        ("period_K", "amplitude_dps"),
        {"phase_K": 0.0},
        ("period_K",),
    ),
    "bias_drift": TermKind(DRIFT, "e = c·t", ("c_dps_per_s",)),
    "source_ageing": TermKind(
        AGEING,
        "e = w·(c·t + r·√t + l·ln(1 + t/ln_tau_s))",
        (),
        {"c_ppm_per_s": 0.0, "c_ppm_per_sqrt_s": 0.0, "c_ppm_per_ln": 0.0, "ln_tau_s": 600.0},
        ("ln_tau_s",),
    ),
    "scale_error": TermKind(SCALE, "e = w·c", ("ppm",)),
    "bias_error": TermKind(BIAS, "e = b", ("dps",)),
    "unit_error": TermKind(UNIT, "e = m·(1 − 1/factor)", ("factor",)),
    "unknown": TermKind(
        EMPIRICAL,
        "e = f(driver), or w·f(driver): piecewise linear between knots, held outside",
        ("driver", "knots", "values"),
        {"times_rate": 0.0, "tau_s": 60.0},
    ),
}
"""Every effect a model file may carry; scale coefficients are in ppm (1e-6), all others in the units of their names."""


def check_term(effect: str, parameters: Mapping[str, Any], where: str) -> None:
    """Refuse a term the compiled step could not evaluate.

    Raises RequestError naming what is unknown, missing or out of range.
    """
    kind = TERMS.get(effect)
    if kind is None:
        raise RequestError(f"{where}: no runtime term for effect {effect!r}; there are {', '.join(TERMS)}")
    extra = sorted(set(parameters) - set(kind.names))
    missing = sorted(set(kind.required) - set(parameters))
    if extra or missing:
        raise RequestError(
            f"{where}: term {effect}: missing {missing}, unknown {extra}; it takes {list(kind.names)}"
        )
    if kind.code == EMPIRICAL:
        _check_empirical(parameters, where)
        return
    for name in parameters:
        if not isinstance(parameters[name], int | float):
            raise RequestError(f"{where}: term {effect}: {name} is {parameters[name]!r}, wanted a number")
    if any(parameters.get(name, kind.optional.get(name)) <= 0 for name in kind.positive):
        raise RequestError(f"{where}: term {effect}: {', '.join(kind.positive)} must be above 0")
    if kind.code == UNIT and parameters["factor"] == 0:
        raise RequestError(f"{where}: term {effect}: factor must not be 0")


def _check_empirical(parameters: Mapping[str, Any], where: str) -> None:
    knots, values = parameters["knots"], parameters["values"]
    if parameters["driver"] not in DRIVERS:
        raise RequestError(
            f"{where}: term unknown: driver {parameters['driver']!r}; known are {', '.join(DRIVERS)}"
        )
    if (
        not isinstance(knots, Sequence)
        or not isinstance(values, Sequence)
        or not len(knots) == len(values) >= 2
    ):
        raise RequestError(
            f"{where}: term unknown: knots and values must be two lists of one length, at least 2"
        )
    if any(b <= a for a, b in pairwise(knots)):
        raise RequestError(f"{where}: term unknown: knots must rise")
    for name in ("times_rate", "tau_s"):
        if not isinstance(parameters.get(name, 1.0), int | float):
            raise RequestError(f"{where}: term unknown: {name} is {parameters[name]!r}, wanted a number")
    if parameters.get("tau_s", 1.0) <= 0:
        raise RequestError(f"{where}: term unknown: tau_s must be above 0")


def parameter_row(effect: str, parameters: Mapping[str, Any]) -> list[float]:
    """The numbers of a term in the order of the compiled parameter row, ppm turned into ratios."""
    kind = TERMS[effect]
    values = {**kind.optional, **parameters}
    return [values[name] * (PPM if "ppm" in name else 1.0) for name in kind.names]
