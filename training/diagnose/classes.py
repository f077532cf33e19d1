"""What cannot be told apart, and what is too much like the shape error of a stronger effect to be named."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from training.diagnose.design import Domain, Library
from training.diagnose.families import family, too_weak
from training.diagnose.library import Group
from training.diagnose.naming import (
    CLASS_COST,
    CLASS_SHARE,
    MOST_SHARE,
    SHAPE_ALPHA,
    Model,
    Part,
    build,
    part_columns,
    partial_chi2,
    refine,
    residual_scan,
    score,
)
from training.diagnose.search import STATIC_PRICE, Candidate, Null
from training.diagnose.work import FloatArray

PREFER = 2.0
SWAPS = 3
TABLE = "compensation_table"
PHASES = 12
STATIC_OF = {"bias_hysteresis": "bias_temperature", "scale_hysteresis": "scale_temperature"}
SLOPE_CHI2, SLOPE_SHARE = 50.0, 0.05
LAGGING = frozenset({"thermal_lag", "scale_temperature_rate"})


def apart(library: Library, domains: Sequence[Domain], null: Null, model: Model) -> Model:
    """The model with a strong static slope of a hysteresis as the effect of its own that it is.

    A loop of real material has a little of a line in common with the temperature; more than that is a static error.
    """
    for i, part in enumerate(model.parts):
        static = STATIC_OF.get(part.effect)
        group = next((g for g in library.groups if g.effect == static), None)
        sloped = [bool(point.get("with_static")) for point in part.points]
        if group is None or not any(sloped) or any(p.effect == static for p in model.parts):
            continue
        loop = replace(part, points=[{**point, "with_static": 0.0} for point in part.points])
        rest = [loop if j == i else p for j, p in enumerate(model.parts)]
        without = build(rest, domains, model.fit.weights)
        tried = [
            build([*rest, Part(group, [point])], domains, model.fit.weights)
            for point in (v.parameters for v in library.variants if v.group is group)
        ]
        best = max(tried, key=score)
        strengths = partial_chi2(best)
        if strengths[-1] > max(SLOPE_CHI2, SLOPE_SHARE * strengths[i]):
            found = residual_scan(library, without, null)[group.effect]
            best.parts[-1].p_value = null.p_value(found.excess)
            model = best
    return model


def demoted(model: Model, domains: Sequence[Domain], trained: bool = False) -> tuple[Model, list[str]]:
    """The model without parts too weak beside a stronger one; and the names of those left out.

    A `trained` simulation is itself only good to a share of its surface, so a weak part that acts as the strong one
    does is what the training left, however clearly it shows.
    """
    dropped: list[str] = []
    while len(model.parts) > 1:
        strengths = partial_chi2(model)
        strongest = max(range(len(strengths)), key=strengths.__getitem__)
        effects = [p.effect for p in model.parts]
        weak = [
            i for i in range(len(strengths)) if i != strongest and too_weak(effects, strengths, i, trained)
        ]
        if not weak:
            break
        worst = min(weak, key=strengths.__getitem__)
        dropped.append(model.parts[worst].effect)
        model = build([p for i, p in enumerate(model.parts) if i != worst], domains, model.fit.weights)
    return model, dropped


def with_classes(
    library: Library, domains: Sequence[Domain], null: Null, model: Model
) -> tuple[Model, list[tuple[int, Model]]]:
    """Give every part its alternatives: effects that explain the data nearly as well in its place.

    Returns the model and, per alternative, (index of the part, the model with the alternative in its place).
    """
    strengths = partial_chi2(model)
    reference = score(model)
    parts: list[Part] = []
    rivals: list[tuple[int, Model]] = []
    for i, part in enumerate(model.parts):
        rest = [p for j, p in enumerate(model.parts) if j != i]
        without = build(rest, domains, model.fit.weights)
        allowed = CLASS_COST + min(CLASS_SHARE * strengths[i], MOST_SHARE)
        found = residual_scan(library, without, null)
        if part.effect == TABLE:
            found = {e: c for e, c in found.items() if e == "polarization_ripple"}
        taken = {p.effect for p in model.parts}
        close: dict[str, float] = {}
        models: dict[str, Model] = {}
        mine = found[part.effect].excess if part.effect in found else 0.0
        for effect, candidate in found.items():
            if (
                effect in taken
                or _contains(part, candidate)
                or candidate.excess < mine - 3.0 * allowed - 0.5 * mine
            ):
                continue
            rival = _rival(library, domains, null, without, candidate, len(part.points))
            most = allowed if family(effect)[0] == family(part.effect)[0] else CLASS_COST
            cost = reference - score(rival)
            if cost < (STATIC_PRICE if _contains(part, candidate) else most) and _instead(
                part, rival, reference - score(without), domains
            ):
                close[effect], models[effect] = reference - score(rival), rival
        table = _table(domains, without, part, library)
        if table is not None and reference - score(table) < allowed:
            close[TABLE], models[TABLE] = reference - score(table), table
        if not _bent(part, rest, domains, reference - allowed, model):
            close |= dict.fromkeys(_twins(part, library, domains) - taken - set(close), CLASS_COST)
        parts.append(replace(part, chi2=strengths[i], alternatives=close))
        rivals += [(i, rival) for rival in models.values()]
    return Model(parts, model.frame, model.fit), rivals


def _instead(part: Part, rival: Model, worth: float, domains: Sequence[Domain]) -> bool:
    """Whether the rival stands in the part's place: beside it the part is worth less than half of what it was."""
    beside = build([*rival.parts, part], domains, rival.fit.weights)
    return score(beside) - score(rival) < 0.5 * worth


def _bent(part: Part, rest: Sequence[Part], domains: Sequence[Domain], least: float, model: Model) -> bool:
    """Whether a lag shows the bend of the surface, as only a lag can: a straight one then scores below `least`."""
    if not any(point.get("on_surface") for point in part.points):
        return False
    straight = replace(part, points=[{**point, "on_surface": 0.0} for point in part.points])
    weights = model.fit.weights
    parts = refine([*rest, straight], len(rest), domains, weights)
    return score(build(parts, domains, weights)) < least


def _twins(part: Part, library: Library, domains: Sequence[Domain]) -> set[str]:
    """Effects that no recording of this kind tells from the part, whatever the fit says.

    A coil that lags and a scale factor that follows its gradient relax alike; only a sensor at the coil parts them
    (PHYSICS.md B4).  A loop of which one side alone was walked is a bent function of temperature like any other.
    """
    if part.effect in STATIC_OF and not walked_back(
        [d.work.slow_temp for d in domains], min(point["play_K"] for point in part.points)
    ):
        return {group.effect for group in library.groups if group.effect == STATIC_OF[part.effect]}
    if part.effect not in LAGGING or "coil_tau_s" in part.points[0]:
        return set()
    return {group.effect for group in library.groups if group.effect in LAGGING} - {part.effect}


def walked_back(temps: Sequence[FloatArray], play_K: float) -> bool:
    """Whether one of these courses of temperature [degC], each `(n,)`, turns by more than a play [K]."""
    ups = [np.max(np.maximum.accumulate(temp) - temp) for temp in temps]
    downs = [np.max(temp - np.minimum.accumulate(temp)) for temp in temps]
    return any(min(up, down) > play_K for up, down in zip(ups, downs, strict=True))


def _table(domains: Sequence[Domain], without: Model, part: Part, library: Library) -> Model | None:
    """A sawtooth in temperature in the place of a ripple (None where it is no rival)."""
    group = next((g for g in library.groups if g.effect == TABLE), None)
    if group is None or part.effect != "polarization_ripple":
        return None
    return sawtooth_model(domains, without, group, part)


def sawtooth_model(domains: Sequence[Domain], without: Model, group: Group, ripple: Part) -> Model:
    """The best sawtooth near the ripple's period: coarse over period and phase, then refined."""
    weights = without.fit.weights
    period = ripple.points[0]["period_K"]
    tried = []
    for ratio in (0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06):
        for phase in range(PHASES):
            point = {"period_K": period * ratio, "phase_K": period * ratio * phase / PHASES}
            extra = [part_columns(Part(group, [point]), d) for d in domains]
            fit = without.frame.fit(without.frame.grams(extra=extra), weights, rounds=3, inner=6)
            tried.append((fit.loglik, point))
    best = max(tried, key=lambda item: item[0])[1]
    parts = refine([*without.parts, Part(group, [best])], len(without.parts), domains, weights)
    return build(parts, domains, weights)


def _contains(part: Part, rival: Candidate) -> bool:
    """Whether the rival carries the part's own column along (a hysteresis with its static slope).

    It always explains as much, so it is an alternative only where its loop earns the price of its column.
    """
    return (
        part.effect in ("bias_temperature", "scale_temperature")
        and rival.variant.parameters.get("with_static", 0.0) > 0.0
    )


def preferred(library: Library, domains: Sequence[Domain], null: Null, model: Model) -> Model:
    """The model with classes, a part replaced by a member of its class where that scores clearly better."""
    for _ in range(SWAPS):
        model, rivals = with_classes(library, domains, null, model)
        best = max(rivals, key=lambda item: score(item[1]), default=None)
        if best is None or score(best[1]) < score(model) + PREFER:
            return model
        index, better = best
        better.parts[-1].p_value = model.parts[index].p_value
        model = better
    return with_classes(library, domains, null, model)[0]


def _rival(
    library: Library, domains: Sequence[Domain], null: Null, without: Model, candidate: Candidate, points: int
) -> Model:
    """The model with the rival in the part's place, given as many shape points as the part has."""
    group = candidate.variant.group
    parts = [*without.parts, Part(group, [candidate.variant.parameters])]
    weights = without.fit.weights
    model = build(refine(parts, len(parts) - 1, domains, weights), domains, weights)
    for _ in range(points - 1):
        again = residual_scan(library, model, null)[group.effect]
        if null.p_value(again.excess) > SHAPE_ALPHA:
            break
        grown = Part(group, [*model.parts[-1].points, again.variant.parameters])
        model = build(refine([*model.parts[:-1], grown], len(parts) - 1, domains, weights), domains, weights)
    return model
