"""`rtcomp evaluate`: any models on any recordings, beside every baseline, with intervals clustered by group.

Baselines are trained without the group they are scored on (soak, recording or block), or on recordings of their
own. Models are scored as they are; one that was trained on a recording it is scored on is called in-sample.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from rtcomp.compensator import Prediction, predict
from rtcomp.model import Model
from training.baselines import FILTERS, SURFACES
from training.groups import groups_of
from training.inputs import Checked, rotating
from training.rest import allan
from training.scores import ratio_interval, score
from training.ts import fold_of_groups
from training.validity import coverage

FOLDS = 5
SCHEMA = "rtcomp.evaluation/1"


def evaluate(
    models: Mapping[str, Model],
    recordings: Sequence[Checked],
    baselines: bool = True,
    baselines_from: Sequence[Checked] = (),
    power_on_known: bool = True,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Score models, and unless `baselines` is False every baseline, on the recordings: a JSON document.

    RMS and intervals are of the error against the truth [°/s].
    """
    tell = progress or (lambda name: None)
    error = np.concatenate([item.error_dps for item in recordings])
    groups, what = groups_of([item.recording for item in recordings])
    left: dict[str, np.ndarray] = {"uncompensated": error}
    predictions: dict[str, Prediction] = {}
    for name, model in models.items():
        tell(name)
        predictions[name] = predict_all(model, recordings, power_on_known)
        left[name] = error - predictions[name].error_dps
    if baselines:
        left |= _surfaces(recordings, error, groups, baselines_from, tell) | _filters(recordings, tell)
    rows = [
        _row(name, values, error, groups) | _model_facts(name, models, recordings)
        for name, values in left.items()
    ]
    own = ["uncompensated", *models]
    return {
        "schema": SCHEMA,
        "recordings": [_about(item) for item in recordings],
        "groups": {"what": what, "count": len(np.unique(groups))},
        "baselines": _protocol(baselines, baselines_from, what, len(np.unique(groups))),
        "rows": rows,
        "per_temperature": _tables(recordings, {name: left[name] for name in own}, "temp_degC", 5.0),
        "per_rate": _tables(recordings, {name: left[name] for name in own}, "rate_dps", 20.0),
        "coverage": {name: _coverage(left[name], given.sigma_dps) for name, given in predictions.items()},
        "allan": allan(recordings, {name: left[name] for name in own}),
    }


def predict_all(model: Model, recordings: Sequence[Checked], power_on_known: bool = True) -> Prediction:
    """Predictions of a model for recordings put end to end, through the vehicle's compiled step."""
    parts = []
    for item in recordings:
        table = item.recording
        coil = table.get("coil_temp_degC")
        parts.append(
            predict(model, table["rate_dps"], table["temp_degC"], table.get("t_s"), coil, power_on_known)
        )
    return Prediction(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _stack(recordings: Sequence[Checked]) -> np.ndarray:
    """Inputs of the baselines; a gyro that never turned shows its error as rate, which no method may read."""
    temp = np.concatenate([item.recording["temp_degC"] for item in recordings])
    rate = np.concatenate([item.recording["rate_dps"] for item in recordings])
    return np.column_stack([temp, rate if rotating(recordings) else np.zeros(len(rate))])


def _surfaces(
    recordings: Sequence[Checked],
    error: np.ndarray,
    groups: np.ndarray,
    baselines_from: Sequence[Checked],
    tell: Callable[[str], None],
) -> dict[str, np.ndarray]:
    inputs = _stack(recordings)
    left = {}
    if not baselines_from and len(np.unique(groups)) < 2:
        return left
    fold = None if baselines_from else fold_of_groups(groups, FOLDS, 0)
    for name, surface in SURFACES.items():
        tell(name)
        if fold is None:
            trained = np.concatenate([item.error_dps for item in baselines_from])
            left[name] = error - surface.fit(_stack(baselines_from), trained)(inputs)
            continue
        left[name] = np.empty(len(error))
        for k in np.unique(fold):
            out = fold == k
            left[name][out] = error[out] - surface.fit(inputs[~out], error[~out])(inputs[out])
    return left


def _filters(recordings: Sequence[Checked], tell: Callable[[str], None]) -> dict[str, np.ndarray]:
    """Filters act over time: a recording without `t_s` (averages of soaked points) is no series, and has no row."""
    if any("t_s" not in item.recording for item in recordings):
        return {}
    left = {}
    for name, smooth in FILTERS.items():
        tell(name)
        left[name] = np.concatenate(
            [smooth(item.recording["rate_dps"]) - item.true_dps for item in recordings]
        )
    return left


def _row(name: str, left: np.ndarray, raw: np.ndarray, groups: np.ndarray) -> dict[str, Any]:
    told = asdict(score(left, groups))
    gain = float(np.sqrt(np.mean(raw**2) / max(float(np.mean(left**2)), 1e-300)))
    return {
        "method": name,
        **told,
        "improvement": gain,
        "improvement_ci95": ratio_interval(left, raw, groups),
    }


def _model_facts(name: str, models: Mapping[str, Model], recordings: Sequence[Checked]) -> dict[str, Any]:
    """Whether a model was trained on what it is scored on, as far as its provenance tells; null for the others."""
    if name not in models:
        return {"in_sample": None}
    trained = {str(item.get("sha256")) for item in models[name].provenance.get("recordings", [])}
    return (
        {"in_sample": any(item.recording.sha256 in trained for item in recordings)}
        if trained
        else {"in_sample": None}
    )


def _about(item: Checked) -> dict[str, Any]:
    table = item.recording
    return {"name": table.name, "sha256": table.sha256, "samples": len(table), "timed": "t_s" in table}


def _protocol(baselines: bool, baselines_from: Sequence[Checked], what: str, count: int) -> str:
    if not baselines:
        return "none"
    if baselines_from:
        return "trained on " + ", ".join(item.recording.name for item in baselines_from)
    if count < 2:
        return f"none but the filters: with one {what} nothing can be held out"
    return f"trained without the {what} they are scored on, {min(FOLDS, count)} folds"


def _tables(
    recordings: Sequence[Checked], left: Mapping[str, np.ndarray], column: str, step: float
) -> list[dict[str, Any]]:
    """RMS and largest error per bin of a column, bins centred on multiples of `step`."""
    values = np.concatenate(
        [r.recording[column] if column == "temp_degC" else r.true_dps for r in recordings]
    )
    bins = np.floor(values / step + 0.5).astype(int)
    table = []
    for k in np.unique(bins):
        inside = bins == k
        scores = {
            name: {
                "rms_dps": float(np.sqrt(np.mean(e[inside] ** 2))),
                "max_dps": float(np.abs(e[inside]).max()),
            }
            for name, e in left.items()
        }
        table.append({column: float(k * step), "samples": int(inside.sum()), "methods": scores})
    return table


def _coverage(left: np.ndarray, sigma: np.ndarray) -> float | None:
    """Share of errors within the model's own 95 % interval; None where it states none."""
    return coverage(left, sigma) if np.isfinite(sigma).all() else None
