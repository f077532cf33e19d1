"""Which groups compete, how strongly, and how often noise alone would do as well."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from training.diagnose.design import Domain, Fit, Frame, Library, Variant
from training.diagnose.library import Parameters
from training.diagnose.steps import Stepper, steppers
from training.diagnose.work import FloatArray

SURROGATES = 48
EXTRA_COLUMN = 3.0
STATIC_PRICE = 8.0
HIGH_PRICE = 60.0
EULER = 0.5772156649


@dataclass
class Null:
    """What noise alone does: per group the mean of its best statistic, and the largest excess over all groups."""

    mean: dict[str, float]
    location: float
    width: float
    seed: int
    count: int

    def p_value(self, excess: float) -> float:
        """Family-wise p-value of an excess, from the Gumbel law fitted to the surrogate maxima."""
        return float(-np.expm1(-np.exp(min(-(excess - self.location) / self.width, 100.0))))

    def excess_at(self, p: float) -> float:
        """The excess with family-wise p-value `p`."""
        return float(self.location - self.width * np.log(-np.log1p(-p)))


@dataclass
class Candidate:
    """The best variant of one group in one scan."""

    variant: Variant
    index: int
    statistic: float
    excess: float = field(default=0.0)


def price(parameters: Parameters, width: int) -> float:
    """What a variant must pay for its columns.

    A loop with its static slope also pays for the search over the loop's width: where only the slope is there, some
    width always fits a little of the noise.  High orders of a polynomial are no physics but the shape of something
    large, and only worth while there.
    """
    return (
        EXTRA_COLUMN * width
        + STATIC_PRICE * parameters.get("with_static", 0.0)
        + HIGH_PRICE * parameters.get("high", 0.0)
    )


def statistics(library: Library, gains: FloatArray) -> dict[str, Candidate]:
    """Best variant per group by 2 Δ log-likelihood less the price of its further columns."""
    best: dict[str, Candidate] = {}
    for index, (variant, gain) in enumerate(zip(library.variants, gains, strict=True)):
        value = float(gain) - price(variant.parameters, variant.width) + EXTRA_COLUMN
        effect = variant.group.effect
        if effect not in best or value > best[effect].statistic:
            best[effect] = Candidate(variant, index, value)
    return best


def change_points(searches: Sequence[Stepper], frame: Frame, fit: Fit, column: int) -> dict[str, Candidate]:
    """The best step in bias and in scale factor."""
    found = {}
    for search in searches:
        best = search.best(frame, fit, column)
        if best is not None:
            found[search.group.effect] = Candidate(Variant(search.group, best[0], -1, 1), -1, best[1])
    return found


def scan(library: Library, frame: Frame, fit: Fit, null: Null | None) -> dict[str, Candidate]:
    """All groups against the current frame; `excess` is the statistic beyond what noise gives that group."""
    cross = library.cross(frame.base)
    target = library.cross(frame.targets)[:, :, 0]
    best = statistics(library, 2.0 * (library.scan(frame, fit, 0, cross, target) - fit.loglik))
    best |= change_points(steppers(library.groups, library.domains), frame, fit, 0)
    if null is not None:
        for effect, candidate in best.items():
            candidate.excess = candidate.statistic - null.mean[effect]
    return best


def surrogate_null(
    library: Library,
    domains: Sequence[Domain],
    fit: Fit,
    seed: int,
    inflate: float = 1.0,
    count: int = SURROGATES,
) -> Null:
    """Scan `count` recordings of pure noise drawn from the fitted spectra, end to end."""
    rng = np.random.default_rng(seed)
    frame = Frame(domains)
    targets = [
        _noise(rng, d, s, count)
        for d, s in zip(domains, _split(fit.spectrum * inflate, domains), strict=True)
    ]
    frame.targets = targets
    cross = library.cross(frame.base)
    projected = library.cross(targets)
    searches = steppers(library.groups, domains)
    table = []
    for column in range(count):
        null_fit = frame.fit(frame.grams(column), fit.weights)
        gains = 2.0 * (
            library.scan(frame, null_fit, column, cross, projected[:, :, column]) - null_fit.loglik
        )
        best = statistics(library, gains) | change_points(searches, frame, null_fit, column)
        table.append({effect: c.statistic for effect, c in best.items()})
    mean = {effect: float(np.mean([row[effect] for row in table])) for effect in table[0]}
    maxima = np.asarray([max(row[e] - mean[e] for e in row) for row in table])
    width = max(float(np.std(maxima, ddof=1)) * np.sqrt(6.0) / np.pi, 1.0)
    return Null(mean, float(np.mean(maxima)) - EULER * width, width, seed, count)


def _split(values: FloatArray, domains: Sequence[Domain]) -> list[FloatArray]:
    cuts = np.cumsum([len(d.edges) - 1 for d in domains])[:-1]
    return np.split(values, cuts)


def _noise(rng: np.random.Generator, d: Domain, spectrum: FloatArray, count: int) -> NDArray[np.float64]:
    deviation = np.repeat(np.sqrt(spectrum), np.diff(d.edges))
    return rng.standard_normal((len(deviation), count)) * deviation[:, None]
