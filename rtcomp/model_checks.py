"""What the types of a model file cannot say: finite numbers, shapes that fit, known names, sane sizes."""

import math
from itertools import pairwise
from typing import Any

import msgspec

from rtcomp.errors import RequestError
from rtcomp.model import (
    INPUTS,
    MAX_INPUTS,
    MAX_RULES,
    MAX_TABLE,
    MAX_TERMS,
    Model,
    Polynomial,
    ResidualTable,
    Term,
)
from rtcomp.terms import check_term

LONGEST_S = 1e8
TIMES = ("tau_s", "tau2_s", "smooth_s")


def check_model(model: Model, name: str) -> None:
    """Raise RequestError, with `name` and the reason, for a model that cannot be evaluated."""
    _check_finite(msgspec.to_builtins(model), name)
    _check_inputs(model, name)
    _check_rules(model, name)
    _check_validity(model, name)
    _check_residual(model, name)
    _check_base(model, name)
    if len(model.terms) > MAX_TERMS:
        raise RequestError(
            f"{name}: {len(model.terms)} terms; at most {MAX_TERMS}, each costs time in every sample"
        )
    for term in model.terms:
        check_term(term.effect, term.parameters, name)
        _check_size(term, name)
    _check_times(model, name)


def _check_finite(value: Any, where: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise RequestError(f"{where}: {value} is not a finite number; every number of a model is finite")
    if isinstance(value, dict):
        for key, item in value.items():
            _check_finite(item, f"{where}: {key}")
    elif isinstance(value, list | tuple):
        for item in value:
            _check_finite(item, where)


def _check_inputs(model: Model, name: str) -> None:
    unknown = [item for item in (*model.inputs, *model.validity, *model.filters) if item not in INPUTS]
    if unknown:
        raise RequestError(f"{name}: unknown input {unknown[0]!r}; known are {', '.join(INPUTS)}")
    if len(set(model.inputs)) != len(model.inputs):
        raise RequestError(f"{name}: an input is named twice in {model.inputs}")
    if model.rules.centers and not 1 <= len(model.inputs) <= MAX_INPUTS:
        raise RequestError(f"{name}: {len(model.inputs)} inputs; rules take 1 to {MAX_INPUTS}")
    if any(tau <= 0 for tau in model.filters.values()):
        raise RequestError(f"{name}: a filter's time constant must be above 0 s, got {model.filters}")


def _check_rules(model: Model, name: str) -> None:
    rules, n = model.rules, len(model.inputs)
    count = len(rules.centers)
    if count > MAX_RULES:
        raise RequestError(f"{name}: {count} rules; at most {MAX_RULES}")
    for key, columns in (("centers", n), ("widths", n), ("consequents", n + 1)):
        rows = getattr(rules, key)
        shape = (len(rows), sorted({len(row) for row in rows}))
        if len(rows) != count or any(len(row) != columns for row in rows):
            raise RequestError(
                f"{name}: rules.{key} has {shape[0]} rows of {shape[1]}, wanted {count} of {columns}"
            )
    if any(width <= 0 for row in rules.widths for width in row):
        raise RequestError(f"{name}: rules.widths must all be above 0")


def _check_validity(model: Model, name: str) -> None:
    for key, (low, high) in model.validity.items():
        if low > high:
            raise RequestError(f"{name}: validity.{key} is [{low}, {high}]; low must not exceed high")


def _check_residual(model: Model, name: str) -> None:
    residual = model.residual_std_dps
    if isinstance(residual, float) and residual < 0:
        raise RequestError(f"{name}: residual_std_dps is {residual}; a standard deviation is not negative")
    if not isinstance(residual, ResidualTable):
        return
    rows, columns = len(residual.temp_degC) - 1, len(residual.rate_dps) - 1
    if (
        rows < 1
        or columns < 1
        or len(residual.std_dps) != rows
        or any(len(r) != columns for r in residual.std_dps)
    ):
        raise RequestError(
            f"{name}: residual_std_dps.std_dps must have {rows} rows of {columns}: one per region"
        )
    for edges in (residual.temp_degC, residual.rate_dps):
        if any(b <= a for a, b in pairwise(edges)):
            raise RequestError(f"{name}: residual_std_dps: edges must rise, got {edges}")


def _check_base(model: Model, name: str) -> None:
    base = model.base
    if isinstance(base, Polynomial):
        longest = max((len(row) for row in base.coefficients), default=0)
        if not 0 < len(base.coefficients) * longest <= MAX_TABLE:
            raise RequestError(
                f"{name}: base.coefficients has {len(base.coefficients)} rows of up to {longest}; "
                f"wanted at least one number and at most {MAX_TABLE}"
            )


def _check_size(term: Term, name: str) -> None:
    longest = max((len(value) for value in term.parameters.values() if isinstance(value, list)), default=0)
    if longest > MAX_TABLE:
        raise RequestError(f"{name}: term {term.effect} has {longest} knots; at most {MAX_TABLE}")


def _check_times(model: Model, name: str) -> None:
    """Times are counted in 64-bit nanoseconds; beyond, a state would never be known to be unsettled."""
    times = [(key, value) for term in model.terms for key, value in term.parameters.items() if key in TIMES]
    for key, value in (*times, *model.filters.items()):
        if isinstance(value, int | float) and not 0.0 <= value <= LONGEST_S:
            raise RequestError(f"{name}: {key} is {value}; wanted 0 to {LONGEST_S:g} s")
