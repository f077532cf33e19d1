"""`rtcomp train`: recordings in, a model out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import Model
from training.build import provenance, ts_model
from training.dynamic import fit_dynamic
from training.groups import groups_of
from training.inputs import Checked, input_columns, rotating
from training.physics_informed import fit_physics
from training.ts import TsOptions, choose_rules, fit, rules_output
from training.validity import held_out_residuals, residual_table

METHODS = ("gk-rls-refined", "gk-rls", "physics-informed", "dynamic")
MOST_FOR_VALIDITY = 50_000  # rows above which the held-out residual is made on a thinned recording


@dataclass(frozen=True)
class Request:
    """What `rtcomp train` was asked for; `rules` None: chosen by held-out score."""

    method: str = "gk-rls-refined"
    rules: int | None = None
    inputs: tuple[str, ...] | None = None  # None: temperature, and rate where the gyro turned
    filters: dict[str, float] | None = None
    options: TsOptions = field(default_factory=TsOptions)
    sensor: str | None = None


@dataclass(frozen=True)
class Trained:
    """The model and what a person should know about it."""

    model: Model
    sentences: list[str]
    facts: dict[str, Any]


def train(
    recordings: Sequence[Checked], request: Request, progress: Callable[[int, float], None] | None = None
) -> Trained:
    """Train one model on recordings put end to end.

    Raises RequestError on a method that does not exist or data that cannot carry the model.
    """
    if request.method not in METHODS:
        raise RequestError(f"method {request.method!r}: give one of {', '.join(METHODS)}")
    groups, what = groups_of([item.recording for item in recordings])
    request = replace(request, inputs=settle_inputs(recordings, request))
    recipe = {"physics-informed": _physics, "dynamic": _dynamic}.get(request.method, _rules)
    trained = recipe(recordings, groups, request, progress)
    model = msgspec.structs.replace(
        trained.model,
        sensor=request.sensor,
        provenance=provenance(
            method=request.method,
            groups=f"{len(np.unique(groups))} {what}s",
            recordings=[{"name": r.recording.name, "sha256": r.recording.sha256} for r in recordings],
            **trained.facts,
        ),
    )
    return replace(trained, model=model)


def settle_inputs(recordings: Sequence[Checked], request: Request) -> tuple[str, ...]:
    """The inputs of the rules.

    Raises RequestError where the rate is asked for and the gyro never turned: its output is then the error itself,
    and a model that reads it would only return it.
    """
    turned = rotating(recordings)
    if request.inputs is None:
        return ("temp_degC", "rate_dps") if turned else ("temp_degC",)
    if "rate_dps" in request.inputs and not turned:
        raise RequestError(
            "input rate_dps: the gyro never turned in these recordings, so its output is the error itself; "
            "leave the rate out (--inputs temp_degC) or record it turning"
        )
    return request.inputs


def _stack(recordings: Sequence[Checked], request: Request) -> tuple[np.ndarray, np.ndarray]:
    names = _names(request)
    inputs = np.concatenate([input_columns(r.recording, names, request.filters) for r in recordings])
    return inputs, np.concatenate([item.error_dps for item in recordings])


def _rules(
    recordings: Sequence[Checked],
    groups: np.ndarray,
    request: Request,
    progress: Callable[[int, float], None] | None,
) -> Trained:
    inputs, error = _stack(recordings, request)
    names = _names(request)
    options, sentences, facts = _counted(inputs, error, groups, request)
    found = fit(inputs, error, names, options, progress)
    fields: dict[str, Any] = {"filters": dict(request.filters)} if request.filters else {}
    model = ts_model(found, names, inputs, **fields)
    sentences += found.notes

    def again(train: np.ndarray, test: np.ndarray) -> np.ndarray:
        return rules_output(fit(inputs[train], error[train], names, options).rules, inputs[test])

    stated = _residual(recordings, groups, error, again)
    return Trained(
        msgspec.structs.replace(model, residual_std_dps=stated or found.residual_std_dps), sentences, facts
    )


def _names(request: Request) -> tuple[str, ...]:
    return request.inputs or ("temp_degC", "rate_dps")


def _counted(
    inputs: np.ndarray, error: np.ndarray, groups: np.ndarray, request: Request
) -> tuple[TsOptions, list[str], dict[str, Any]]:
    """The options with their number of rules settled."""
    if request.rules is not None:
        return (
            replace(request.options, method=request.method, rules=request.rules),
            [],
            {"rules": request.rules},
        )
    options = replace(request.options, method=request.method)
    count, scores = choose_rules(inputs, error, groups, _names(request), options)
    told = ", ".join(f"{rules}: {score:.3g}" for rules, score in scores.items())
    facts = {"rules": count, "held_out_rms_dps": {str(rules): score for rules, score in scores.items()}}
    return replace(options, rules=count), [f"{count} rules by held-out RMS [°/s] ({told})"], facts


def _physics(
    recordings: Sequence[Checked],
    groups: np.ndarray,
    request: Request,
    progress: Callable[[int, float], None] | None,
) -> Trained:
    temp = np.concatenate([item.recording["temp_degC"] for item in recordings])
    rate = np.concatenate([item.recording["rate_dps"] for item in recordings])
    error = np.concatenate([item.error_dps for item in recordings])
    options = replace(request.options, method="gk-rls", rules=request.rules or 4)
    found = fit_physics(temp, rate, error, groups, options)

    def again(train: np.ndarray, test: np.ndarray) -> np.ndarray:
        model = fit_physics(temp[train], rate[train], error[train], groups[train], None).model
        return predict(model, rate[test], temp[test]).error_dps

    stated = _residual(recordings, groups, error, again)
    has = "with" if found.model.rules.centers else "without"
    sentence = (
        f"open-loop sine {has} rules on the remainder: held-out RMS {found.score_base_dps:.3g} °/s without, "
        f"{found.score_with_rules_dps:.3g} with them"
    )
    facts = {"held_out_rms_dps": {"base": found.score_base_dps, "with_rules": found.score_with_rules_dps}}
    return Trained(msgspec.structs.replace(found.model, residual_std_dps=stated), [sentence], facts)


def _dynamic(
    recordings: Sequence[Checked],
    groups: np.ndarray,
    request: Request,
    progress: Callable[[int, float], None] | None,
) -> Trained:
    if any("t_s" not in item.recording for item in recordings):
        raise RequestError("--method dynamic needs recordings over time (t_s); soaked points have no history")
    options = replace(request.options, method="gk-rls-refined", rules=request.rules or 4)
    found = fit_dynamic(recordings, None, options)
    facts = {"claimed": found.claimed, "tau_s": found.tau_s, "rules": len(found.model.rules.centers)}
    return Trained(found.model, [found.sentence], facts)


def _residual(
    recordings: Sequence[Checked],
    groups: np.ndarray,
    error: np.ndarray,
    again: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Any:
    """Residual table from held-out groups; None where nothing can be held out or it would take long."""
    if len(np.unique(groups)) < 3 or len(error) > MOST_FOR_VALIDITY:
        return None
    try:
        left = held_out_residuals(groups, again, error)
    except RequestError:
        return (
            None  # a fold without the group lacks excitation: the model states its training residual instead
        )
    temp = np.concatenate([item.recording["temp_degC"] for item in recordings])
    rate = np.concatenate([item.recording["rate_dps"] for item in recordings])
    return residual_table(temp, rate, left, groups)
