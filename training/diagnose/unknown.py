"""Locate before naming, and catch after naming what no catalogue entry carries."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from training.diagnose.design import Domain, Library, domain
from training.diagnose.generic import CYCLIC
from training.diagnose.library import Group
from training.diagnose.naming import (
    ALPHA,
    Model,
    Part,
    build,
    partial_chi2,
    residual_scan,
    score,
)
from training.diagnose.search import EXTRA_COLUMN, Candidate, Null, surrogate_null
from training.effects.catalogue import effect

GENERIC_SURROGATES = 40
WITHDRAW_SHARE = 0.10
REMAINDER_ALPHA = (
    1e-4  # waves and resonances try many shapes: the surrogates' tail is known less well than for names
)
MUST_ADD = (
    0.3  # share of the remainder that the function must explain beyond what the name does, or the name stands
)
SEVERAL_STAND = 1.0  # one smooth function in the place of several names: simpler, if it explains as much
TURNING = frozenset({"magnetic", "table_eccentricity"})
FALSE_ALPHA = (
    1e-9  # a name that leaves a tenth of what it gains, so surely, is none, even if no function does as well
)
TIME_WEIGHT = (
    0.75  # any slow course is a function of time: a physical driver that explains nearly as much goes first
)
TIME_LIKE = frozenset({"time", "rate_times_time", "time_since_power_on"})
TIME_ALPHA = (
    1e-7  # slow noise that is not Gaussian (telegraph, drift) is a function of time like anything else
)
CYCLE_ALPHA = 1e-5  # but it keeps no beat
SHAPE_SHARE = 0.03  # a name that leaves less than this of its own waveform is right, if not to the last digit
STANDS_OUT = (
    0.1  # share of the strongest name's χ² from which something without a name is a finding beside it
)
BESIDE_ALPHA = 1e-6
ITS_SHAPE = 0.05  # share of its χ² below which a name beside it is what a smooth function leaves of its shape
RATE_DRIVERS = frozenset(
    {
        "rate",
        "rate_times_temperature",
        "rate_times_temperature_rate",
        "rate_times_time",
        "rate_times_heading",
    }
)


@dataclass
class Located:
    """One driver before naming: what its best function gains, and how often noise does as well."""

    driver: str
    gain: float
    excess: float
    p_value: float


@dataclass
class Unknown:
    """Something significant without a name: its driver, an empirical model of it, and the names it displaced."""

    driver: str
    part: Part
    p_value: float
    chi2: float
    withdrawn: list[str]
    named: bool


def locate(
    generic: Library, domains: Sequence[Domain], base: Model, noise: Model, seed: int
) -> tuple[list[Located], Null]:
    """Rank drivers by what any smooth function of them explains of the null residual; `noise` has the noise's fit."""
    null = surrogate_null(generic, domains, noise.fit, seed, count=GENERIC_SURROGATES)
    return ranked([_located(d, c, null) for d, c in residual_scan(generic, base, null).items()]), null


def located_by_shape(library: Library, base: Model, null: Null) -> list[Located]:
    """The same for shapes that no smooth function of one driver has: steps, loops, a play, what a stop resets."""
    found = residual_scan(library, base, null)
    return [_located(effect(name).drivers[0], c, null) for name, c in found.items() if effect(name).drivers]


def _located(driver: str, candidate: Candidate, null: Null) -> Located:
    return Located(
        driver,
        max(candidate.statistic, 0.0),
        candidate.excess,
        min(2.0 * null.p_value(candidate.excess), 1.0),
    )


def ranked(rows: Sequence[Located]) -> list[Located]:
    """Every driver once, by the best of its rows, strongest first."""
    best: dict[str, Located] = {}
    for row in rows:
        if row.driver not in best or row.excess > best[row.driver].excess:
            best[row.driver] = row
    return sorted(
        best.values(), key=lambda row: -row.excess * (TIME_WEIGHT if row.driver in TIME_LIKE else 1.0)
    )


def unexplained(
    generic: Library,
    domains: Sequence[Domain],
    model: Model,
    null: Null,
    names: list[str],
    name_again: Callable[[list[Domain]], Model],
) -> tuple[Model, Unknown | None]:
    """Check the remainder of the named model against every driver.

    Nothing named and something there: unknown.  Named, but a smooth function of a driver adds a good part of what
    the name explains: the name is withdrawn, be it that it leaves no more than one function can stand for or so much
    that it cannot be right.  Something on another driver, and strong: the names are looked for again
    beside it (`name_again` names on domains that have it as a nuisance).  Less: a remainder.
    """
    for scale_like in (False, True):
        several = [
            i
            for i, p in enumerate(model.parts)
            if _scale_like(p.group) == scale_like and p.group.effect not in TURNING
        ]
        if sum(len(model.parts[i].points) for i in several) > 1:
            withdrawn = _withdrawn(generic, domains, model, null, several, SEVERAL_STAND)
            if (
                withdrawn is not None
                and withdrawn[1] is not None
                and _related(model.parts[several[0]].group, withdrawn[1].driver)
                and not _nearly_whole(model, several, *withdrawn)
            ):
                return withdrawn
    found = residual_scan(generic, model, null)
    if not found:
        return model, None
    strict = {d: c for d, c in found.items() if null.p_value(c.excess) < _alpha(d, c)}
    if not strict:
        return model, None
    driver, top = max(strict.items(), key=lambda item: item[1].excess)
    p_value = null.p_value(top.excess)
    group = top.variant.group
    part = Part(group, [top.variant.parameters], p_value)
    joint = build([*model.parts, part], domains, model.fit.weights)
    strength = partial_chi2(joint)[-1]
    if not model.parts:
        return model, Unknown(driver, part, p_value, strength, names, named=p_value < ALPHA)
    related = [i for i, p in enumerate(model.parts) if _related(p.group, driver)]
    strongest = max((model.parts[i].chi2 for i in related), default=0.0)
    half_told = related and top.statistic > WITHDRAW_SHARE * _gain(model, related)
    its_shape = bool(related) and _left_over(model, joint) <= SHAPE_SHARE
    if related and not its_shape and (half_told or strength > WITHDRAW_SHARE * strongest):
        withdrawn = _withdrawn(generic, domains, model, null, related, more=MUST_ADD * top.statistic)
        if withdrawn is None and half_told and p_value < FALSE_ALPHA:
            withdrawn = _withdrawn(generic, domains, model, null, related, stands=0.0)
        if withdrawn is not None:
            return withdrawn
    stands_out = strength > STANDS_OUT * max(p.chi2 for p in model.parts)
    if p_value < BESIDE_ALPHA and stands_out and not its_shape:
        beside = [domain(d.work, group.columns(d.work, top.variant.parameters)) for d in domains]
        parts = name_again(beside).parts
        *strengths, strength = partial_chi2(build([*parts, part], domains, model.fit.weights))
        kept = [p for p, worth in zip(parts, strengths, strict=True) if worth > ITS_SHAPE * strength]
        dropped = [p.effect for p in parts if p not in kept]
        again = build(kept, domains, model.fit.weights)
        return again, Unknown(driver, part, p_value, strength, dropped, named=True)
    return model, Unknown(driver, part, p_value, strength, [], named=False)


def _gain(model: Model, chosen: list[int]) -> float:
    """2 Δ log-likelihood of the chosen parts, the others staying."""
    rest = [p for i, p in enumerate(model.parts) if i not in chosen]
    return 2.0 * (model.fit.loglik - build(rest, model.frame.domains, model.fit.weights).fit.loglik)


def _nearly_whole(model: Model, several: list[int], kept: Model, unknown: Unknown | None) -> bool:
    """Whether the strongest of several names alone is all of the function's waveform but a trifle: then it is right."""
    if unknown is None:
        return False
    domains = model.frame.domains
    strongest = max(several, key=lambda i: partial_chi2(model)[i])
    alone = build([*kept.parts, model.parts[strongest]], domains, model.fit.weights)
    joint = build([*kept.parts, unknown.part], domains, model.fit.weights)
    return _left_over(alone, joint) < SHAPE_SHARE


def _left_over(model: Model, joint: Model) -> float:
    """What a further part changes of the named waveform, as a share of it, both weighed by the smaller noise."""
    named = changed = 0.0
    cuts = np.cumsum([len(d.edges) - 1 for d in joint.frame.domains])[:-1]
    for r, (d, bands) in enumerate(zip(joint.frame.domains, np.split(joint.fit.spectrum, cuts), strict=True)):
        weight = 1.0 / np.repeat(bands, np.diff(d.edges))
        before, after = (
            m.frame.chosen[r] @ m.fit.beta + d.nuisance @ m.fit.nuisance[r][: d.nuisance.shape[1]]
            for m in (model, joint)
        )
        shape = model.frame.chosen[r] @ model.fit.beta
        named += float(weight @ shape**2)
        changed += float(weight @ (after - before) ** 2)
    return changed / max(named, 1e-300)


def _alpha(driver: str, candidate: Candidate) -> float:
    if driver not in TIME_LIKE:
        return REMAINDER_ALPHA
    return CYCLE_ALPHA if "cycle" in candidate.variant.parameters else TIME_ALPHA


def _withdrawn(
    generic: Library,
    domains: Sequence[Domain],
    model: Model,
    null: Null,
    related: list[int],
    stands: float = 1.0,
    more: float = 0.0,
) -> tuple[Model, Unknown | None] | None:
    """Take the related names back and let a smooth function of the best driver stand in their place.

    None where that function explains clearly less than the names did: then the names stand.
    """
    kept = build([p for i, p in enumerate(model.parts) if i not in related], domains, model.fit.weights)
    kept = Model([replace(p) for p in kept.parts], kept.frame, kept.fit)
    found = residual_scan(generic, kept, null)
    driver, top = max(found.items(), key=lambda item: item[1].excess)
    part = Part(top.variant.group, [top.variant.parameters], null.p_value(top.excess))
    joint = build([*kept.parts, part], domains, kept.fit.weights)
    searched = sum(len(model.parts[i].group.continuous) * len(model.parts[i].points) for i in related)
    named_gain = score(model) - score(kept) - EXTRA_COLUMN * searched
    if part.p_value > ALPHA or score(joint) - score(kept) < stands * named_gain + more:
        return None
    names = [model.parts[i].effect for i in related]
    return kept, Unknown(driver, part, part.p_value, partial_chi2(joint)[-1], names, named=True)


def _related(group: Group, driver: str) -> bool:
    """Whether a remainder on this driver can be what the name failed to explain: both scale-like or both bias-like."""
    if driver in CYCLIC or group.effect in TURNING:
        return (driver in CYCLIC) == (group.effect in TURNING)
    return _scale_like(group) == (driver in RATE_DRIVERS)


def _scale_like(group: Group) -> bool:
    """Whether the effect needs turning: then it is not one of the bias."""
    return "rate" in group.needs


def empirical(unknown: Unknown, domains: Sequence[Domain], model: Model) -> Model:
    """The named parts and the empirical part fitted together."""
    joint = build([*model.parts, unknown.part], domains, model.fit.weights)
    np.testing.assert_equal(len(joint.parts), len(model.parts) + 1)
    return joint
