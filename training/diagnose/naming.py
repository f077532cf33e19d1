"""Groups compete for the name: forward steps, a swap step, richer shapes of what was chosen, equivalence classes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize

from training.diagnose.design import Domain, Fit, Frame, Library
from training.diagnose.library import Group, Parameters
from training.diagnose.likelihood import inverse
from training.diagnose.search import Candidate, Null, price, scan
from training.diagnose.work import FloatArray

ALPHA = 3e-4  # the Gumbel tail of four dozen surrogates is no better known than by a factor of a few
SHAPE_ALPHA = 1e-2
MAX_EFFECTS = 4
MAX_SHAPES = 2
CLASS_COST = 10.0
CLASS_SHARE = 0.012  # a group's shape is that much unlike the true one, so a rival may cost that share more
MOST_SHARE = 40.0
STRONGER = 10.0
GIANT = 2000.0
ONE_SHAPE = frozenset({"dead_band"})
BOUNDS = {"dead_band": (0.5, 1.5), "saturation": (0.0, 2.5)}
LONGER = 1.35
STRICTER = {  # noise that is not what it is taken for (a random walk, telegraph noise) draws these by itself
    "bias_drift": 1e-6,
    "dead_band": 1e-9,  # a few samples of a noisy reference near zero look like one
    "bias_step": 1e-5,
    "magnetic": 1e-5,
    "bias_warmup": 1e-4,
    "bias_temperature": 1e-4,
    "bias_hysteresis": 1e-4,
    "shupe": 1e-4,
}
FURTHER_ALPHA = (
    1e-3  # beside a name that is sure, where nothing was sought in mere noise; the strictest stay so
)
STRICT = 1e-4
ADDITIVE = {"chirp_per_K": 0.01, "phase_K": 5.0}  # moved by steps of this size instead of by ratio


@dataclass
class Part:
    """One chosen effect: its group and the points of its grid that make up its shape."""

    group: Group
    points: list[Parameters]
    p_value: float = 1.0
    alternatives: dict[str, float] = field(default_factory=dict)
    chi2: float = 0.0

    @property
    def effect(self) -> str:
        """The effect's id."""
        return self.group.effect


@dataclass
class Model:
    """The chosen parts with their joint fit; `slices[i]` are the columns of part i."""

    parts: list[Part]
    frame: Frame
    fit: Fit

    def slices(self) -> list[slice]:
        """Columns of every part within the chosen ones."""
        widths = [sum(len(p.group.linear(point)) for point in p.points) for p in self.parts]
        ends = np.cumsum(widths)
        return [slice(int(e - w), int(e)) for e, w in zip(ends, widths, strict=True)]


def part_columns(part: Part, d: Domain) -> FloatArray:
    """Columns of a part in the whitening domain, shape `(n, width)`."""
    columns = [c for point in part.points for c in part.group.columns(d.work, point)]
    return d.work.transform(np.stack(columns, axis=1))


def build(parts: Sequence[Part], domains: Sequence[Domain], weights: FloatArray | None = None) -> Model:
    """Fit the parts jointly with all nuisances and the noise."""
    chosen = []
    for d in domains:
        blocks = [part_columns(part, d) for part in parts]
        chosen.append(np.concatenate(blocks, axis=1) if blocks else np.empty((len(d.target), 0)))
    frame = Frame(domains, chosen)
    grams = frame.grams()
    fit = frame.fit(grams) if weights is None else frame.best_fit(grams, weights)
    return Model(list(parts), frame, fit)


def score(model: Model) -> float:
    """2 log-likelihood less the price of its columns; comparable between models of the same data."""
    return 2.0 * model.fit.loglik - sum(
        price(point, len(part.group.linear(point))) for part in model.parts for point in part.points
    )


def residual_scan(library: Library, model: Model, null: Null) -> dict[str, Candidate]:
    """Scan the library against what the model leaves."""
    targets = []
    for r, d in enumerate(model.frame.domains):
        left = d.target - d.nuisance @ model.fit.nuisance[r][: d.nuisance.shape[1]]
        targets.append((left - model.frame.chosen[r] @ model.fit.beta)[:, None])
    frame = Frame(model.frame.domains, model.frame.chosen, targets)
    fit = frame.fit(frame.grams(), model.fit.weights, rounds=4, inner=6)
    return scan(library, frame, fit, null)


def movable(group: Group, point: Parameters) -> list[str]:
    """The non-linear parameters of a point that can be moved: by a step, or by a ratio where they are not zero."""
    return [n for n in group.continuous if n in point and (point[n] != 0.0 or n in ADDITIVE)]


def refine(parts: list[Part], index: int, domains: Sequence[Domain], weights: FloatArray) -> list[Part]:
    """Improve the non-linear parameters of the last point of one part by a bounded simplex search."""
    part = parts[index]
    names = movable(part.group, part.points[-1])
    if not names:
        return parts
    others = [p for i, p in enumerate(parts) if i != index]
    fixed = [
        np.concatenate([part_columns(p, d) for p in others], axis=1) if others else None for d in domains
    ]
    head = Part(part.group, part.points[:-1])
    if head.points:
        fixed = [
            c if f is None else np.concatenate([f, c], axis=1)
            for f, c in zip(fixed, [part_columns(head, d) for d in domains], strict=True)
        ]
    frame = Frame(domains, [f for f in fixed if f is not None])
    start = part.points[-1]

    def point(x: FloatArray) -> Parameters:
        moved = {
            n: start[n] * float(np.exp(v)) if n not in ADDITIVE else start[n] + ADDITIVE[n] * float(v)
            for n, v in zip(names, x, strict=True)
        }
        return {**start, **moved}

    reach = 0.25 if {"lock_dps", "limit_dps"} & set(names) else 0.7

    def cost(x: FloatArray) -> float:
        if (
            np.max(np.abs(x)) > reach
            or point(x).get("tau_s", 0.0) > LONGER * start.get("tau_s", 0.0)
            or point(x).get("limit_dps", 0.0) > 1.02 * max(start.get("limit_dps", 0.0), 0.0)
        ):
            return 1e12
        extra = [d.work.transform(np.stack(part.group.columns(d.work, point(x)), axis=1)) for d in domains]
        return -frame.fit(frame.grams(extra=extra), weights, rounds=3, inner=6).loglik

    steps = [0.01 if n == "period_K" else 0.1 if n == "phase_K" else 0.12 for n in names]
    simplex = np.vstack([np.zeros(len(names)), np.diag(steps)])
    found = optimize.minimize(
        cost,
        np.zeros(len(names)),
        method="Nelder-Mead",
        options={"maxfev": 24 * len(names), "xatol": 0.003, "fatol": 0.1, "initial_simplex": simplex},
    )
    better = Part(part.group, [*part.points[:-1], point(found.x)], part.p_value)
    return [*parts[:index], better, *parts[index + 1 :]]


def _added(parts: list[Part], candidate: Candidate, p_value: float) -> tuple[list[Part], int]:
    """The parts with a candidate added: a new effect, or a further shape of one that is there already."""
    effect = candidate.variant.group.effect
    for i, part in enumerate(parts):
        if part.effect == effect:
            new = candidate.variant.parameters
            points = [new] if "order" in new and not part.group.continuous else [*part.points, new]
            grown = Part(part.group, points, part.p_value)
            return [*parts[:i], grown, *parts[i + 1 :]], i
    return [*parts, Part(candidate.variant.group, [candidate.variant.parameters], p_value)], len(parts)


def enough(effect: str, beside: bool) -> float:
    """The family-wise p-value that a name needs, alone or beside another."""
    alpha = STRICTER.get(effect, ALPHA)
    return max(alpha, ALPHA) if beside and alpha >= STRICT else alpha


def _next(found: dict[str, Candidate], parts: list[Part], null: Null) -> Candidate | None:
    """The step to take: a new effect where it is significant, unless a richer shape of a chosen one does as well."""
    room = {p.effect: len(p.points) <= (0 if p.effect in ONE_SHAPE else MAX_SHAPES) for p in parts}
    points = {p.effect: p.points for p in parts}
    shapes = [c for e, c in found.items() if room.get(e, False) and _differs(c.variant.parameters, points[e])]
    fresh = (
        [c for e, c in found.items() if e not in room and null.p_value(c.excess) <= enough(e, bool(parts))]
        if len(parts) < MAX_EFFECTS
        else []
    )
    shape = max(shapes, key=lambda c: c.excess, default=None)
    new = max(fresh, key=lambda c: c.excess, default=None)
    if shape is not None and (null.p_value(shape.excess) > SHAPE_ALPHA):
        shape = None
    if shape is not None and new is not None:
        return new if new.excess > STRONGER + 1.5 * shape.excess else shape
    return new or shape


def _differs(new: Parameters, points: list[Parameters]) -> bool:
    """Whether a further point of a group's grid is a different shape and not the one that is there already.

    One lag does not act both on the simulation's surface and beside it.
    """

    def close(old: Parameters) -> bool:
        if new.get("on_surface") != old.get("on_surface"):
            return True
        if new.get("chunk") != old.get("chunk"):
            return False
        return all(abs(new[k] - old[k]) <= 0.2 * abs(old[k]) + 1e-9 for k in new if k in old)

    return not any(close(old) for old in points)


def forward(library: Library, domains: Sequence[Domain], null: Null) -> Model:
    """Choose effects step by step; names whose coefficient physics forbids are barred and the choice made again."""
    barred: set[str] = set()
    model = _chosen(library, domains, null, barred)
    for _ in range(len(BOUNDS)):
        forbidden = {
            p.effect
            for p, where in zip(model.parts, model.slices(), strict=True)
            if _forbidden(p, model, where)
        }
        if not forbidden:
            break
        barred |= forbidden
        model = _chosen(library, domains, null, barred)
    return model


def leading(library: Library, domains: Sequence[Domain], null: Null) -> Model | None:
    """The model of what is so large that it must be taken out before the noise is judged; None if nothing is."""
    model, found = build([], domains), None
    for _ in range(MAX_EFFECTS):
        scanned = residual_scan(library, model, null)
        top = max(scanned.values(), key=lambda c: c.excess)
        parts, index = _added(model.parts, top, 0.0)
        larger = build(refine(parts, index, domains, model.fit.weights), domains)
        if 2.0 * (larger.fit.loglik - model.fit.loglik) < GIANT:
            break
        model = found = larger
    return found


def _forbidden(part: Part, model: Model, where: slice) -> bool:
    """Whether a coefficient lies outside its physical range with its error against it twice.

    A dead band takes the whole rate (depth one), a saturation cannot add gain beyond its knee.
    """
    if part.effect not in BOUNDS:
        return False
    low, high = BOUNDS[part.effect]
    value = float(model.fit.beta[where][0])
    error = 2.0 / float(np.sqrt(max(model.fit.information[where, where][0, 0], 1e-300)))
    return value + error < low or value - error > high


def _chosen(library: Library, domains: Sequence[Domain], null: Null, barred: set[str]) -> Model:
    """Forward steps; after each the chosen effects may be swapped for others."""
    model = build([], domains)
    for _ in range(MAX_EFFECTS * (1 + MAX_SHAPES)):
        found = {e: c for e, c in residual_scan(library, model, null).items() if e not in barred}
        step = _next(found, model.parts, null)
        if step is None:
            break
        parts, index = _added(model.parts, step, null.p_value(step.excess))
        parts = refine(parts, index, domains, model.fit.weights)
        model = build(parts, domains, model.fit.weights)
        if len(model.parts) > 1:
            model = swapped(library, domains, null, model, barred)
    return model


def swapped(library: Library, domains: Sequence[Domain], null: Null, model: Model, barred: set[str]) -> Model:
    """Replace a part by another group, or leave it out, where that scores better."""
    for i in range(len(model.parts)):
        if i >= len(model.parts):
            break
        rest = [p for j, p in enumerate(model.parts) if j != i]
        without = build(rest, domains, model.fit.weights)
        if 2.0 * (model.fit.loglik - without.fit.loglik) - null.mean[model.parts[i].effect] < null.excess_at(
            enough(model.parts[i].effect, bool(rest))
        ):
            model = without
            continue
        rival = best_rival(library, domains, null, without, barred | {p.effect for p in model.parts})
        if rival is not None and score(rival) > score(model) + 2.0:
            model = rival
    return model


def best_rival(
    library: Library, domains: Sequence[Domain], null: Null, without: Model, barred: set[str]
) -> Model | None:
    """The best model with one group not in `barred` added to `without`."""
    found = {e: c for e, c in residual_scan(library, without, null).items() if e not in barred}
    if not found:
        return None
    top = max(found.values(), key=lambda c: c.excess)
    parts, index = _added(without.parts, top, null.p_value(top.excess))
    return build(refine(parts, index, domains, without.fit.weights), domains, without.fit.weights)


def partial_chi2(model: Model) -> list[float]:
    """d'² of every part as fitted, the other parts and all nuisances projected out."""
    information, beta = model.fit.information, model.fit.beta
    values = []
    for part in model.slices():
        inside = np.arange(part.start, part.stop)
        outside = np.setdiff1d(np.arange(len(beta)), inside)
        block = information[np.ix_(inside, inside)]
        if len(outside):
            bridge = information[np.ix_(inside, outside)]
            block = block - bridge @ inverse(information[np.ix_(outside, outside)]) @ bridge.T
        values.append(float(beta[inside] @ block @ beta[inside]))
    return values
