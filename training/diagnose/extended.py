"""extended.json: the found physics as a model file, for the live compensator.

Only effects that are causal in rate, temperature and time since power-on get a term; the others are named in the
provenance.  Where the simulation was a model file its surface, rules and terms come along.
"""

from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.model import Term, new_model, save_model
from rtcomp.terms import TERMS
from training.diagnose.document import Diagnosis
from training.diagnose.generic import HATS, VALUES, basis_of, knots_of
from training.diagnose.naming import Part
from training.diagnose.pipeline import Analysis
from training.diagnose.unknown import empirical
from training.diagnose.work import Work

RATE_TAU_S = 40.0
SIGMOID_KNOTS = 65
UNKNOWN_DRIVERS = {
    "temperature": ("temperature", False),
    "rate_times_temperature": ("temperature", True),
    "temperature_rate": ("temperature_rate", False),
    "rate_times_temperature_rate": ("temperature_rate", True),
    "rate": ("rate", False),
    "time": ("time_since_power_on", False),
    "rate_times_time": ("time_since_power_on", True),
    "time_since_power_on": ("time_since_power_on", False),
}


def terms_of(analysis: Analysis) -> tuple[list[Term], list[str]]:
    """(terms, effects without one) of the analysis' model."""
    terms: list[Term] = []
    left: list[str] = []
    model = analysis.model
    for part, where in zip(model.parts, model.slices(), strict=True) if model is not None else ():
        found = _part_terms(part, model.fit.beta[where]) if model is not None and part.effect in TERMS else []
        terms += found
        left += [] if found else [part.effect]
    if analysis.unknown is not None and analysis.unknown.named:
        term = _unknown_term(analysis)
        terms += [term] if term is not None else []
        left += [] if term is not None else ["unknown"]
    return terms, left


def _part_terms(part: Part, beta: np.ndarray) -> list[Term]:
    """One term per point of the part's shape; a static slope that belongs to a hysteresis becomes a term of its own."""
    terms, at = [], 0
    for point in part.points:
        linear = part.group.linear(point)
        values = {name: float(v) for (name, _), v in zip(linear, beta[at : at + len(linear)], strict=True)}
        at += len(linear)
        kind = TERMS[part.effect]
        parameters = {k: float(v) for k, v in point.items() if k in kind.names} | {
            k: v for k, v in values.items() if k in kind.names
        }
        if not set(kind.required) <= set(parameters):
            return []
        terms.append(Term(part.effect, dict(parameters)))
        for static, key in (("bias_temperature", "b1_dps_per_K"), ("scale_temperature", "s1_ppm_per_K")):
            if key in values and key not in kind.names:
                terms.append(Term(static, {key: values[key]}))
    return terms


def _unknown_term(analysis: Analysis) -> Term | None:
    unknown, model = analysis.unknown, analysis.model
    if unknown is None or model is None or unknown.driver not in UNKNOWN_DRIVERS:
        return None
    driver, times_rate = UNKNOWN_DRIVERS[unknown.driver]
    joint = empirical(unknown, analysis.domains, model)
    beta = joint.fit.beta[joint.slices()[-1]]
    works: list[Work] = [d.work for d in analysis.domains]
    pooled = np.concatenate([VALUES[unknown.driver][0](w) for w in works])
    point = unknown.part.points[0]
    sets = {float(n): knots_of(pooled, n) for n in {*HATS, int(point["hats"])} if n > 1}
    knots = (
        np.linspace(pooled.min(), pooled.max(), SIGMOID_KNOTS) if "centre" in point else sets[point["hats"]]
    )
    values = np.stack(basis_of(knots, sets, point), axis=1) @ beta
    if unknown.driver == "time_since_power_on":
        knots = np.exp(knots) - 60.0
    parameters: dict[str, Any] = {
        "driver": driver,
        "times_rate": times_rate,
        "knots": knots.tolist(),
        "values_dps": values.tolist(),
    }
    if driver == "temperature_rate":
        parameters["tau_s"] = RATE_TAU_S
    return Term("unknown", parameters)


def save_extended(analysis: Analysis, diagnosis: Diagnosis, path: Path) -> None:
    """Write the model file; without anything found it is an empty, valid model."""
    terms, left = terms_of(analysis)
    base = analysis.simulation.model
    works = [d.work for d in analysis.domains]
    fields: dict[str, Any] = {"terms": [_plain(t) for t in terms]}
    if works:
        temps = np.concatenate([w.temp for w in works])
        top = max(float(np.max(np.abs(w.w))) for w in works)
        fields["validity"] = {
            "temp_degC": [float(temps.min()), float(temps.max())],
            "rate_dps": [-top * 1.05 - 1.0, top * 1.05 + 1.0],
        }
    if base is not None:
        import msgspec

        document = msgspec.to_builtins(base)
        fields = {k: document[k] for k in ("inputs", "rules", "base", "filters", "sensor")} | fields
        fields["terms"] = [*document["terms"], *fields["terms"]]
    fields["provenance"] = {
        "made_by": "rtcomp diagnose",
        "verdict": diagnosis.verdict,
        "not_causal": left,
        "seed": diagnosis.seed,
        "recordings": [note.sha256 or note.file for note in diagnosis.recordings if not note.heldout],
        "improvement": diagnosis.fit.improvement,
        "adds_to_simulation": analysis.simulation.kind,
    }
    save_model(new_model(**fields), path)


def _plain(term: Term) -> dict[str, Any]:
    return {"effect": term.effect, "parameters": dict(term.parameters)}
