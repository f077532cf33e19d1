"""Model files turned into the arrays that the compiled step reads."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rtcomp.model import INPUTS, MAX_INPUTS, Model, OpenLoopSine, Polynomial, ResidualTable
from rtcomp.terms import DRIVERS, EMPIRICAL, PPM, TERMS, parameter_row

N_INPUTS = len(INPUTS)
TEMP, RATE, COIL, TEMP_RATE, LAG_TEMP, TIME = range(N_INPUTS)
FILTER_TAU_S = {"temp_rate_degC_per_s": 60.0, "lag_temp_degC": 300.0}
RATE_NAME = INPUTS[RATE]
NO_BASE, SINE, POLYNOMIAL = range(3)
PARAMETERS, TERM_STATES = 8, 4
COLUMNS = 1 + MAX_INPUTS  # of the rules: the rate, whether they take it or not, and the other inputs
DYNAMIC = {"thermal_lag", "shupe", "scale_temperature_rate"}
TIMED = {"bias_warmup", "scale_warmup", "bias_drift", "source_ageing"}
SETTLE_TAUS = 5.0  # e⁻⁵ < 1 % of an unknown start is left


class Compiled(NamedTuple):
    """Models of all channels; group g is one model file, the groups of a channel add up. All arrays contiguous.

    Starts are unsigned, as all indices of the compiled step are: a signed one is tested for its sign at every use.
    """

    group_start: np.ndarray  # uint64 (channels + 1)
    term_start: np.ndarray  # uint64 (channels + 1)
    group_inputs: np.ndarray  # int64 (groups, COLUMNS): index into INPUTS, the rate first
    group_size: np.ndarray  # int64 (groups): how many columns are in use
    rule_start: np.ndarray  # uint64 (groups + 1)
    centers: np.ndarray  # float64 (rules, COLUMNS)
    inverse_widths: np.ndarray  # float64 (rules, COLUMNS); 0 where an input does not matter
    consequents: np.ndarray  # float64 (rules, COLUMNS + 1), the constant first
    base_kind: np.ndarray  # int64 (groups)
    base: np.ndarray  # float64 (groups, PARAMETERS)
    validity: np.ndarray  # float64 (groups, N_INPUTS, 2)
    filter_tau_s: np.ndarray  # float64 (groups, 2): of TEMP_RATE and LAG_TEMP
    term_kind: np.ndarray  # int64 (terms)
    term_group: np.ndarray  # uint64 (terms)
    term: np.ndarray  # float64 (terms, PARAMETERS)
    table: np.ndarray  # float64 flat: polynomials, knots and values, residual regions
    sigma: np.ndarray  # int64 (channels, 3): offset into table, temperature regions, rate regions
    needs: np.ndarray  # int64 (channels, 3): temperature, coil temperature, time since power-on
    settle_s: np.ndarray  # float64 (channels): how long an unknown thermal state matters


def compile_models(stacks: Sequence[Sequence[Model]]) -> Compiled:
    """Compile a stack of models per channel, the predictions of a stack adding up (an empty one predicts 0).

    The last model that states a residual standard deviation tells the stack's.
    """
    models = [model for stack in stacks for model in stack]
    table: list[float] = []
    inputs = np.full((len(models), COLUMNS), -1, np.int64)
    for g, model in enumerate(models):
        inputs[g, : len(_columns(model))] = [INPUTS.index(name) for name in _columns(model)]
    bases = [_base(model, table) for model in models]
    terms = [(TERMS[t.effect].code, g, _term_row(t, table)) for g, m in enumerate(models) for t in m.terms]
    sigma = np.array([_sigma(stack, table) for stack in stacks], np.int64).reshape(-1, 3)
    return Compiled(
        _starts([len(stack) for stack in stacks]),
        _starts([sum(len(m.terms) for m in stack) for stack in stacks]),
        inputs,
        np.array([len(_columns(m)) for m in models], np.int64),
        _starts([len(m.rules.centers) for m in models]),
        _rows([_ordered(m, row, 0.0) for m in models for row in m.rules.centers], COLUMNS, 0.0),
        1.0 / _rows([_ordered(m, row, np.inf) for m in models for row in m.rules.widths], COLUMNS, np.inf),
        _rows(
            [[a0, *_ordered(m, row, 0.0)] for m in models for a0, *row in m.rules.consequents],
            COLUMNS + 1,
            0.0,
        ),
        np.array([kind for kind, _ in bases], np.int64),
        _rows([row for _, row in bases], PARAMETERS, 0.0),
        _validity(models),
        _filters(models),
        np.array([kind for kind, _, _ in terms], np.int64),
        np.array([g for _, g, _ in terms], np.uint64),
        _rows([row for _, _, row in terms], PARAMETERS, 0.0),
        np.array(table, np.float64),
        sigma,
        np.array([_needs(stack) for stack in stacks], np.int64).reshape(-1, 3),
        np.array([SETTLE_TAUS * max((_slowest(m) for m in stack), default=0.0) for stack in stacks]),
    )


def _starts(counts: list[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.uint64)


def _rows(rows: list[list[float]], width: int, fill: float) -> np.ndarray:
    array = np.full((len(rows), width), fill, np.float64)
    for target, row in zip(array, rows, strict=True):
        target[: len(row)] = row
    return array


def _columns(model: Model) -> list[str]:
    """The inputs of the compiled rules: the rate always, and first."""
    return [RATE_NAME, *(name for name in model.inputs if name != RATE_NAME)]


def _ordered(model: Model, row: Sequence[float], absent: float) -> list[float]:
    """One value per input, in the order of `_columns`; `absent` for a rate that the rules do not take."""
    by_name = dict(zip(model.inputs, row, strict=True))
    return [by_name.get(name, absent) for name in _columns(model)]


def _base(model: Model, table: list[float]) -> tuple[int, list[float]]:
    base = model.base
    if isinstance(base, OpenLoopSine):
        return SINE, [base.K0_s, base.alpha_per_K, base.g0, base.g1_per_K, base.g2_per_K2, base.ref_degC]
    if isinstance(base, Polynomial):
        rows, columns = len(base.coefficients), max(len(row) for row in base.coefficients)
        offset = len(table)
        table.extend(_rows(base.coefficients, columns, 0.0).ravel())
        return POLYNOMIAL, [base.ref_degC, offset, rows, columns]
    return NO_BASE, []


def _term_row(term: Any, table: list[float]) -> list[float]:
    if TERMS[term.effect].code != EMPIRICAL:
        return parameter_row(term.effect, term.parameters)
    parameters = term.parameters
    times_rate = bool(parameters.get("times_rate", 0.0))
    offset, count = len(table), len(parameters["knots"])
    table.extend(float(x) for x in parameters["knots"])
    table.extend(float(x) * (PPM if times_rate else 1.0) for x in parameters["values"])
    driver = DRIVERS.index(parameters["driver"])
    return [driver, offset, count, float(times_rate), parameters.get("tau_s", 60.0)]


def _sigma(stack: Sequence[Model], table: list[float]) -> list[int]:
    stated = [m.residual_std_dps for m in stack if m.residual_std_dps is not None]
    offset = len(table)
    if not stated:
        table.append(np.nan)
        return [offset, 0, 0]
    residual = stated[-1]
    if not isinstance(residual, ResidualTable):
        table.append(residual)
        return [offset, 0, 0]
    for part in (residual.temp_degC, residual.rate_dps, *residual.std_dps):
        table.extend(part)
    return [offset, len(residual.temp_degC) - 1, len(residual.rate_dps) - 1]


def _validity(models: Sequence[Model]) -> np.ndarray:
    limits = np.tile(np.array([-np.inf, np.inf]), (len(models), N_INPUTS, 1))
    for g, model in enumerate(models):
        for name, pair in model.validity.items():
            limits[g, INPUTS.index(name)] = pair
    return limits


def _filters(models: Sequence[Model]) -> np.ndarray:
    taus = [[m.filters.get(name, default) for name, default in FILTER_TAU_S.items()] for m in models]
    return np.array(taus, np.float64).reshape(len(models), 2)


def _uses(model: Model) -> set[str]:
    """Inputs the model's rules, base and terms depend on."""
    used = set(model.inputs) if model.rules.centers else set()
    if model.base is not None:
        used |= {"temp_degC", "rate_dps"}
    for term in model.terms:
        used |= _term_uses(term)
    return used


def _term_uses(term: Any) -> set[str]:
    if term.effect in TIMED or term.parameters.get("driver") == "time_since_power_on":
        return {"time_since_power_on_s"}
    if term.effect in {"scale_asymmetry", "scale_error", "bias_error", "unit_error"}:
        return {"rate_dps"}
    if term.effect == "scale_nonlinearity" and not term.parameters.get("c3h_per_dps2_per_K"):
        return {"rate_dps"}
    return {"rate_dps"} if term.parameters.get("driver") == "rate" else {"temp_degC"}


def _needs(stack: Sequence[Model]) -> list[bool]:
    used: set[str] = set().union(*(_uses(model) for model in stack))
    temperature = used & {"temp_degC", "temp_rate_degC_per_s", "lag_temp_degC"}
    return [bool(temperature), "coil_temp_degC" in used, "time_since_power_on_s" in used]


def number(value: Any) -> float:
    """A parameter that is known to be a number."""
    return float(value)


def _slowest(model: Model) -> float:
    """The longest memory [s] of a temperature long past."""
    taus = [0.0]
    for term in model.terms:
        if term.effect in DYNAMIC or term.parameters.get("driver") == "temperature_rate":
            taus += [number(term.parameters.get(name, 0.0)) for name in ("tau_s", "tau2_s", "smooth_s")]
    if model.rules.centers:
        taus += [model.filters.get(name, FILTER_TAU_S[name]) for name in model.inputs if name in FILTER_TAU_S]
    return max(taus)
