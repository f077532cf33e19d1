"""extended.json: the found physics as a model file, for the live compensator.

Only effects that are causal in rate, temperature and time since power-on get a term; the others are named in the
provenance.  Where the simulation was a model file its surface, rules and terms come along.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.model import Term, new_model, save_model
from rtcomp.terms import TERMS
from training.diagnose.document import Diagnosis
from training.diagnose.generic import VALUES, basis_of, grain_of
from training.diagnose.library import ROOM_DEGC, Parameters
from training.diagnose.measured import in_measured_rate, left_by_model, sized
from training.diagnose.naming import Part
from training.diagnose.pipeline import Analysis
from training.diagnose.prepare import smoothing_s
from training.diagnose.rate_columns import HUNDRED_DPS
from training.diagnose.unknown import empirical
from training.diagnose.work import Work

HIGH_CORNERS = 257
CORNERS = 65  # knots of an empirical term that is not piecewise linear in its driver
LEAST_SMOOTHING_S = 8.0
SHARP_WIDTHS = 4.0  # half-widths of a transition that get knots of their own
LN_TAU_S = {2.0: 600.0, 3.0: 3600.0}  # of the logarithms among the shapes of ageing
STATIC = {"b1_dps_per_K": "bias_temperature", "s1_ppm_per_K": "scale_temperature"}
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


def terms_of(analysis: Analysis, diagnosis: Diagnosis) -> tuple[list[Term], list[str]]:
    """(terms, effects without one) of all that was found."""
    terms = coefficient_terms(diagnosis)
    told = {term.effect for term in terms}
    left = [f.effect for f in diagnosis.findings if f.effect not in (*told, *_modelled(analysis), "unknown")]
    model = analysis.model
    works = [d.work for d in analysis.domains]
    ranges = {
        driver: (min(float(v.min()) for v in values), max(float(v.max()) for v in values))
        for driver, values in (
            ("temperature", [w.temp for w in works]),
            ("rate", [w.full["w"] for w in works]),
        )
        if values
    }
    for part, where in zip(model.parts, model.slices(), strict=True) if model is not None else ():
        found = (
            _part_terms(part, model.fit.beta[where], ranges)
            if model is not None and part.effect in TERMS
            else []
        )
        if part.effect == "thermal_lag" and found:
            found = [_on_surface(t, p, analysis) for t, p in zip(found, part.points, strict=True)]
        if part.effect == "shupe":
            found = [Term(t.effect, dict(_smoothed(_numbers(t), _smoothing(analysis)))) for t in found]
        terms += found
        left += [] if found else [part.effect]
    if analysis.unknown is not None and analysis.unknown.named:
        term = _unknown_term(analysis)
        terms += [term] if term is not None else []
        left += [] if term is not None else ["unknown"]
    return terms, list(dict.fromkeys(left))


def _modelled(analysis: Analysis) -> list[str]:
    return [part.effect for part in analysis.model.parts] if analysis.model is not None else []


def coefficient_terms(diagnosis: Diagnosis) -> list[Term]:
    """Offset and scale factor that were findings of their own, the mean over the recordings they were found in."""
    terms = []
    for name, key in (("bias_error", "dps"), ("scale_error", "ppm")):
        values = [f.parameters[key].value for f in diagnosis.findings if f.effect == name]
        terms += [Term(name, {key: float(np.mean(values))})] if values else []
    return terms


def _part_terms(part: Part, beta: np.ndarray, ranges: dict[str, tuple[float, float]]) -> list[Term]:
    """One term per point of the part's shape; a static slope that belongs to a hysteresis becomes a term of its own.

    Orders of a polynomial beyond the term's become a piecewise linear function over the driver's range (low, high).
    None at all where a coefficient has no place in the term.
    """
    terms, at = [], 0
    kind = TERMS[part.effect]
    for point in part.points:
        linear = part.group.linear(point)
        values = {name: float(v) for (name, _), v in zip(linear, beta[at : at + len(linear)], strict=True)}
        at += len(linear)
        higher, values = _higher_orders(values, kind.names, ranges) if "high" in point else ([], values)
        terms += higher
        shape = {"tau_s": point["coil_tau_s"]} if "coil_tau_s" in point else {}
        shape |= {"ln_tau_s": LN_TAU_S[point["shape"]]} if point.get("shape") in LN_TAU_S else {}
        own = {k: float(v) for k, v in {**point, **shape, **values}.items() if k in kind.names}
        static = {k: v for k, v in values.items() if k in STATIC and k not in kind.names}
        if not set(kind.required) <= set(own) or not set(values) <= {*own, *static}:
            return []
        terms.append(Term(part.effect, dict(own)))
        terms += [Term(STATIC[key], {key: value}) for key, value in static.items()]
    return terms


def _on_surface(lag: Term, point: Parameters, analysis: Analysis) -> Term:
    """A lag that was fitted on the simulation's surface, with the coefficients that this surface has there."""
    if analysis.surface is None or not point.get("on_surface"):
        return lag
    given = _numbers(lag)
    share = given["scale_ppm_per_K"] / analysis.surface.slope_ppm_per_K
    rates = np.concatenate([d.work.full["w"] for d in analysis.domains])
    return Term(lag.effect, {**given, **analysis.surface.term(share, rates)})


def _higher_orders(
    values: dict[str, float], known: Sequence[str], ranges: dict[str, tuple[float, float]]
) -> tuple[list[Term], dict[str, float]]:
    """(a piecewise linear term of the orders that the polynomial's own term has no names for, the other values).

    b4…, s4… go with the temperature above room, c7… with the rate.
    """
    powers = {name: int(re.findall(r"\d+", name)[0]) for name in values}  # of b4_…, s4_…, c7_…
    beyond = {name: v for name, v in values.items() if name not in known}
    driver = "rate" if any(name.startswith("c") for name in beyond) else "temperature"
    knots = np.linspace(*ranges[driver], HIGH_CORNERS)
    base = knots / HUNDRED_DPS if driver == "rate" else knots - ROOM_DEGC
    total = sum((v * base ** powers[name] for name, v in beyond.items()), np.zeros(len(base)))
    parameters: dict[str, Any] = {
        "driver": driver,
        "times_rate": float(any("ppm" in name for name in beyond)),
        "knots": knots.tolist(),
        "values": total.tolist(),
    }
    return [Term("unknown", parameters)], {name: v for name, v in values.items() if name not in beyond}


def _smoothing(analysis: Analysis) -> float:
    """Time constant [s] that takes the temperature's steps out of its slope, as the diagnosis smoothed it."""
    temps = [i.checked.columns["temp_degC"] for i in analysis.intakes if "temp_degC" in i.checked.columns]
    return max((smoothing_s(temp)[1] for temp in temps), default=LEAST_SMOOTHING_S)


def _smoothed(shupe: dict[str, float], width_s: float) -> dict[str, float]:
    """A Shupe term whose slope is not of the raw temperature's steps; both lags together stay what they were."""
    if not shupe.get("c2_dps_s2_per_K") or shupe["tau_s"] <= 2.0 * width_s:
        return shupe
    return {**shupe, "tau_s": shupe["tau_s"] - width_s, "smooth_s": width_s}


def _unknown_term(analysis: Analysis) -> Term | None:
    """The empirical model as a piecewise linear function of its driver; None for a driver the bus does not know."""
    unknown, model = analysis.unknown, analysis.model
    if unknown is None or model is None or unknown.driver not in UNKNOWN_DRIVERS:
        return None
    driver, times_rate = UNKNOWN_DRIVERS[unknown.driver]
    joint = empirical(unknown, analysis.domains, model)
    beta = joint.fit.beta[joint.slices()[-1]]
    works: list[Work] = [d.work for d in analysis.domains]
    pooled = np.concatenate([VALUES[unknown.driver][0](w) for w in works])
    point = unknown.part.points[0]
    sets = unknown.part.group.knots
    knots = _corners(pooled, point, sets, curved=unknown.driver == "time_since_power_on")
    values = np.stack(basis_of(knots, sets, point), axis=1) @ beta
    if unknown.driver == "time_since_power_on":
        knots = np.exp(knots) - 60.0
    parameters: dict[str, Any] = {
        "driver": driver,
        "times_rate": times_rate,
        "knots": knots.tolist(),
        "values": values.tolist(),  # °/s, or ppm of the rate
    }
    if driver == "temperature_rate":
        parameters["tau_s"] = _smoothing(analysis)
    return Term("unknown", parameters)


def _corners(
    pooled: np.ndarray, point: Parameters, sets: dict[float, np.ndarray], curved: bool
) -> np.ndarray:
    """Knots on which a piecewise linear term follows the basis of `point`, rising, within the driver's range."""
    low, high = float(pooled.min()), float(pooled.max())
    grain = grain_of(point)
    if grain is None and not curved:
        return sets[point["hats"]]
    if grain is None:
        return np.union1d(np.linspace(low, high, CORNERS), sets[point["hats"]])
    if "cycle" in point:
        return np.linspace(low, high, max(CORNERS, int(np.ceil((high - low) / grain)) + 1))
    middle, reach = point.get("centre", point.get("bump", low)), SHARP_WIDTHS * grain
    around = np.linspace(middle - reach, middle + reach, CORNERS)
    return np.union1d(np.linspace(low, high, CORNERS), around[(around > low) & (around < high)])


def save_extended(analysis: Analysis, diagnosis: Diagnosis, path: Path) -> None:
    """Write the model file; without anything found it is an empty, valid model."""
    terms, left = terms_of(analysis, diagnosis)
    base = analysis.simulation.model
    if base is not None:
        share = left_by_model(base, analysis.intakes, analysis.settings.power_on_known)
        terms = [sized(term, share) for term in terms]
    terms = in_measured_rate(terms, analysis.intakes, base)
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


def _numbers(term: Term) -> dict[str, float]:
    return {k: float(v) for k, v in term.parameters.items() if isinstance(v, int | float)}


def _plain(term: Term) -> dict[str, Any]:
    return {"effect": term.effect, "parameters": dict(term.parameters)}
