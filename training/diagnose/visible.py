"""What these recordings could have shown, and what they could not test at all."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from training.diagnose.design import Domain, Library
from training.diagnose.document import NotExcited
from training.diagnose.groups import GROUPS
from training.diagnose.library import Survey
from training.diagnose.naming import ALPHA, Model
from training.diagnose.search import Null
from training.diagnose.work import FloatArray
from training.effects.catalogue import catalogue, effect

REACH = 2.0
NO_POWER_ON = "a recording that starts at power-on (t_s = 0 there)"


def visible_from(library: Library, domains: Sequence[Domain], model: Model, null: Null) -> dict[str, float]:
    """Smallest RMS [dps] of every tested effect that would have been found here.

    An effect of d' has a statistic of about d'² less what the refitted noise takes, so the threshold is met at
    √(threshold + mean) plus `REACH` standard deviations of the statistic's own scatter.
    """
    firsts = [v.first for v in library.variants]
    wave, white = _norms(library, domains, model, firsts)
    found: dict[str, list[float]] = {}
    for variant, size, seen in zip(library.variants, wave, white, strict=True):
        if seen <= 0.0:
            continue
        effect_id = variant.group.effect
        needed = float(np.sqrt(max(null.excess_at(ALPHA) + null.mean[effect_id], 1.0))) + REACH
        found.setdefault(effect_id, []).append(needed * size / seen)
    return {name: float(np.median(values)) for name, values in found.items()}


def _norms(
    library: Library, domains: Sequence[Domain], model: Model, rows: list[int]
) -> tuple[FloatArray, FloatArray]:
    """(RMS of columns without offset and scale, their whitened norms) pooled over recordings."""
    power, white, count = np.zeros(len(rows)), np.zeros(len(rows)), 0
    cuts = np.cumsum([len(d.edges) - 1 for d in domains])[:-1]
    for i, (d, bands) in enumerate(zip(domains, np.split(model.fit.spectrum, cuts), strict=True)):
        columns = library.rows[i][rows]
        power += _left(columns, d.nuisance, np.ones(len(d.target)))
        white += _left(columns, d.nuisance, np.repeat(bands, np.diff(d.edges)))
        count += len(d.target)
    return np.sqrt(np.maximum(power, 0.0) / max(count, 1)), np.sqrt(np.maximum(white, 0.0))


def _left(columns: NDArray[np.float32], nuisance: FloatArray, variance: FloatArray) -> FloatArray:
    """Squared norms of rows of `columns` under a variance per coefficient, nuisances projected out."""
    weighted = (nuisance / variance[:, None]).astype(np.float32)
    cross = (columns @ weighted).astype(np.float64)
    own = np.einsum("ij,ij,j->i", columns, columns, (1.0 / variance).astype(np.float32)).astype(np.float64)
    gram = np.linalg.pinv((nuisance / variance[:, None]).T @ nuisance)
    return own - np.sum((cross @ gram) * cross, axis=1)


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
