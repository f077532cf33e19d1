"""What these recordings could have shown, and what they could not test at all."""

from collections.abc import Sequence

import numpy as np

from training.diagnose.design import Domain, Library
from training.diagnose.document import NotExcited
from training.diagnose.library import GROUPS, Survey
from training.diagnose.naming import ALPHA, Model
from training.diagnose.search import Null
from training.effects.catalogue import catalogue, effect

REACH = 2.0
NO_POWER_ON = "a recording that starts at power-on (t_s = 0 there)"


def visible_from(library: Library, domains: Sequence[Domain], model: Model, null: Null) -> dict[str, float]:
    """Smallest RMS [dps] of every tested effect that would have been found here.

    An effect of d' has a statistic of about d'² less what the refitted noise takes, so the threshold is met at
    √(threshold + mean) plus `REACH` standard deviations of the statistic's own scatter.
    """
    found: dict[str, list[float]] = {}
    for variant in library.variants:
        wave, white = _norms(library, domains, model, variant.first)
        if white <= 0.0:
            continue
        effect_id = variant.group.effect
        needed = float(np.sqrt(max(null.excess_at(ALPHA) + null.mean[effect_id], 1.0))) + REACH
        found.setdefault(effect_id, []).append(needed * wave / white)
    return {name: float(np.median(values)) for name, values in found.items()}


def _norms(library: Library, domains: Sequence[Domain], model: Model, row: int) -> tuple[float, float]:
    """(RMS of a column without offset and scale, its whitened norm) pooled over recordings."""
    power, white, count = 0.0, 0.0, 0
    cuts = np.cumsum([len(d.edges) - 1 for d in domains])[:-1]
    for i, (d, spectrum) in enumerate(zip(domains, np.split(model.fit.spectrum, cuts), strict=True)):
        column = library.rows[i][row].astype(np.float64)
        column = column - d.nuisance @ np.linalg.lstsq(d.nuisance, column, rcond=None)[0]
        power += float(column @ column)
        weight = np.repeat(spectrum, np.diff(d.edges))
        shrunk = d.nuisance / np.sqrt(weight)[:, None]
        scaled = column / np.sqrt(weight)
        scaled = scaled - shrunk @ np.linalg.lstsq(shrunk, scaled, rcond=None)[0]
        white += float(scaled @ scaled)
        count += len(column)
    return float(np.sqrt(power / max(count, 1))), float(np.sqrt(white))


def not_excited(found: Survey | None, library: Library | None) -> list[NotExcited]:
    """Effects without the excitation they need, with what to record instead (texts of the catalogue)."""
    tested = {v.group.effect for v in library.variants} if library is not None else set()
    have = found.has if found is not None else frozenset()
    rows = []
    for group in GROUPS:
        if group.effect in tested:
            continue
        missing = group.needs - have
        text = effect(group.effect).excitation
        if missing == {"power_on"}:
            text = NO_POWER_ON
        rows.append(NotExcited(group.effect, text))
    extra = ("bandwidth", "timestamp_skew", "clock_drift", "timing_jitter", "multiplicative_noise")
    if not {"rate", "clock"} <= have:
        rows += [NotExcited(name, effect(name).excitation) for name in extra if name in catalogue()]
    return rows
