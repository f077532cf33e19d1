"""Physics-informed model: the open-loop sine with K(T) and G(T) as base, TS rules on what it leaves.

m = G sin(K ω)/K0, K = K0 (1 + αh), G = 1 + g0 + g1 h + g2 h² (PHYSICS.md §4.2), and a zero-rate bias b0 + b1 h.
Five optical coefficients extrapolate, where free surfaces do not; so without rules the model's validity reaches
beyond the training data by REACH of their range.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import Model, OpenLoopSine, Rules, Term, new_model
from training.ts import TsOptions, fit, fold_of_groups

REACH = 0.5
REF_DEGC = 25.0
START = np.array([0.18, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # K0_s, α, g0, g1, g2, b0, b1
UNIT = np.array([0.1, 1e-3, 0.1, 1e-3, 1e-5, 0.01, 1e-4])
FEWEST = 30


@dataclass(frozen=True)
class PhysicsFit:
    """The model, and the held-out RMS [°/s] of the base alone and with rules that decided about the rules."""

    model: Model
    score_base_dps: float
    score_with_rules_dps: float | None


def fit_physics(
    temp_degC: np.ndarray,
    rate_dps: np.ndarray,
    error_dps: np.ndarray,
    groups: np.ndarray,
    options: TsOptions | None = None,
) -> PhysicsFit:
    """Fit base, bias and, where they help on held-out `groups` (soaks, recordings), rules on the remainder.

    All arrays have shape `(n_samples,)`. Raises RequestError where temperature or rate is not excited.
    """
    _check(temp_degC, rate_dps)
    base = fit_base(temp_degC, rate_dps, error_dps)
    score_base, score_rules = _held_out(temp_degC, rate_dps, error_dps, groups, options)
    if options is None or score_rules is None or score_rules >= 0.95 * score_base:
        return PhysicsFit(base, score_base, score_rules)
    return PhysicsFit(add_rules(base, temp_degC, rate_dps, error_dps, options), score_base, score_rules)


def fit_base(temp_degC: np.ndarray, rate_dps: np.ndarray, error_dps: np.ndarray) -> Model:
    """Base and bias by least squares on the corrected rate; two starts, since K0 and g0 share a valley.

    Weighting by soak (generalised least squares) was tried and gains nothing: the repeatability between soaks,
    not the readings, limits g2, and every soak already weighs the same.
    """
    true = rate_dps - error_dps
    h = temp_degC - REF_DEGC

    def residual(scaled: np.ndarray) -> np.ndarray:
        return corrected(scaled * UNIT, h, rate_dps) - true

    starts = [START, START * np.array([2.0, 1, 1, 1, 1, 1, 1])]
    ends = [least_squares(residual, start / UNIT, method="lm", max_nfev=2000) for start in starts]
    return base_model(min(ends, key=lambda end: end.cost).x * UNIT, temp_degC, rate_dps)


def corrected(p: np.ndarray, h: np.ndarray, rate_dps: np.ndarray) -> np.ndarray:
    """The rate [°/s] that base `p` recovers from the measured one."""
    K0, alpha, g0, g1, g2, b0, b1 = p
    gain = 1 + g0 + g1 * h + g2 * h**2
    sine = np.clip(np.radians(rate_dps) * K0 / gain, -1, 1)
    return np.degrees(np.arcsin(sine) / (K0 * (1 + alpha * h))) - b0 - b1 * h


def base_model(p: np.ndarray, temp_degC: np.ndarray, rate_dps: np.ndarray) -> Model:
    """A model file of base and bias, valid REACH beyond the data."""
    K0, alpha, g0, g1, g2, b0, b1 = (float(value) for value in p)
    return new_model(
        inputs=["temp_degC", "rate_dps"],
        base=OpenLoopSine(K0_s=K0, alpha_per_K=alpha, g0=g0, g1_per_K=g1, g2_per_K2=g2, ref_degC=REF_DEGC),
        terms=[Term("bias_error", {"dps": b0}), Term("bias_temperature", {"b1_dps_per_K": b1})],
        validity={"temp_degC": reach(temp_degC, REACH), "rate_dps": reach(rate_dps, REACH)},
    )


def reach(values: np.ndarray, beyond: float) -> tuple[float, float]:
    """Range of `values`, widened at both ends by `beyond` of its length."""
    low, high = float(values.min()), float(values.max())
    return low - beyond * (high - low), high + beyond * (high - low)


def add_rules(
    base: Model, temp_degC: np.ndarray, rate_dps: np.ndarray, error_dps: np.ndarray, options: TsOptions
) -> Model:
    """Rules on what `base` leaves; rules do not extrapolate, so the validity shrinks to the data."""
    left = error_dps - predict(base, rate_dps, temp_degC).error_dps
    found = fit(np.column_stack([temp_degC, rate_dps]), left, ["temp_degC", "rate_dps"], options)
    return with_rules(base, found.rules, ["temp_degC", "rate_dps"], temp_degC, rate_dps)


def with_rules(
    model: Model, rules: Rules, inputs: Sequence[str], temp: np.ndarray, rate: np.ndarray
) -> Model:
    """`model` with these rules, valid on the data."""
    return new_model(
        inputs=list(inputs),
        rules=rules,
        base=model.base,
        terms=model.terms,
        validity={"temp_degC": reach(temp, 0.0), "rate_dps": reach(rate, 0.0)},
    )


def _held_out(
    temp: np.ndarray, rate: np.ndarray, error: np.ndarray, groups: np.ndarray, options: TsOptions | None
) -> tuple[float, float | None]:
    fold = fold_of_groups(groups, 5, 0)
    squares: list[list[np.ndarray]] = [[], []]
    for left_out in np.unique(fold):
        train, test = fold != left_out, fold == left_out
        models = [fit_base(temp[train], rate[train], error[train])]
        if options is not None:
            models.append(add_rules(models[0], temp[train], rate[train], error[train], options))
        for kept, model in zip(squares, models, strict=False):
            kept.append((error[test] - predict(model, rate[test], temp[test]).error_dps) ** 2)
    scores = [float(np.sqrt(np.concatenate(kept).mean())) for kept in squares if kept]
    return scores[0], scores[1] if len(scores) > 1 else None


def _check(temp_degC: np.ndarray, rate_dps: np.ndarray) -> None:
    if len(temp_degC) < FEWEST:
        raise RequestError(f"{len(temp_degC)} points; the physical base needs at least {FEWEST}")
    for name, values, least in (("temp_degC", temp_degC, 5.0), ("rate_dps", rate_dps, 20.0)):
        span = float(np.ptp(values))
        if span < least:
            raise RequestError(
                f"{name} spans {span:g}; the physical base needs at least {least:g} to be identified"
            )
