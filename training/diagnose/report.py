"""The report for a person: one HTML file with its pictures inside, escaped by the template engine."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from training.diagnose import pictures
from training.diagnose.document import Diagnosis, probability
from training.diagnose.pipeline import Analysis
from training.effects.catalogue import catalogue

TEMPLATE = Path(__file__).parent / "report.html.j2"
VERDICT_WORDS: Mapping[str, str] = {
    "named": "Named",
    "ambiguous": "Ambiguous: a class of effects",
    "unknown": "Unknown physics",
    "nothing_missing": "Nothing is missing",
    "not_excited": "Not excited",
    "bad_recording": "Bad recording",
}


COMPARED_WITH: Mapping[str, str] = {
    "ideal": "an ideal gyro (rate = reference)",
    "column": "the column sim_rate_dps",
    "model": "a model file",
    "scenario": "a simulated gyro (scenario)",
}


def title_of(effect_id: str) -> str:
    """The name of an effect for people."""
    found = catalogue().get(effect_id)
    return found.title if found is not None else effect_id


def number(value: float | None, digits: int = 4) -> str:
    """A number for people: four significant digits."""
    return "–" if value is None else f"{value:.{digits}g}"


def report_html(analysis: Analysis, diagnosis: Diagnosis) -> str:
    """Render the report of one diagnosis."""
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "number": number,
        "probability": probability,
        "words": lambda name: name.replace("_", " ").replace("rate times", "rate ×"),
        "title_of": title_of,
        "unit": lambda unit: unit.replace("dps", "°/s") if unit != "1" else "",
    }
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(
        d=diagnosis,
        verdict=VERDICT_WORDS[diagnosis.verdict],
        regimes=pictures.regime_text(diagnosis.findings),
        catalogue=catalogue(),
        pictures=_pictures(analysis, diagnosis),
        simulation=COMPARED_WITH[analysis.simulation.kind],
        fitted=analysis.intakes,
        hours=sum(float(np.ptp(i.work.t)) for i in analysis.intakes if not i.work.points) / 3600.0,
        step_s=analysis.intakes[0].work.step_s
        if analysis.intakes and not analysis.intakes[0].work.points
        else None,
    )


def _pictures(analysis: Analysis, diagnosis: Diagnosis) -> dict[str, Any]:
    if not analysis.intakes or analysis.model is None:
        return {"time": None, "drivers": None, "allan": None, "heldout": None}
    return {
        "time": pictures.time_strips(analysis, diagnosis),
        "drivers": pictures.driver_plots(analysis, diagnosis),
        "allan": pictures.allan_plot(analysis),
        "heldout": pictures.heldout_plot(analysis),
    }
