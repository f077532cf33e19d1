"""Gustafson-Kessel clustering, PAPER eqs. 3-8, with the covariance repair of Babuška, van der Veen and Kaymak (2002).

Points are standardised first, so that units do not matter: every column has mean 0 and standard deviation 1.
Memory beyond the input: one standardised copy and the partition matrix, 8·(columns + clusters) bytes a row.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from rtcomp.errors import RequestError
from training.excitation import check_finite, lacking
from training.gk_kernels import cluster_widths, iterate

LARGE = 100_000  # samples from which every iteration is worth a progress report
COINCIDE = 1e-3  # Mahalanobis distance of two centres, below which two clusters are one


class Outcome(Enum):
    """How a clustering ended."""

    CONVERGED = "the partition settled"
    STOPPED = "the iteration limit was reached before the partition settled"
    DEGENERATE = "the data do not carry that many clusters"


@dataclass(frozen=True)
class Clustering:
    """The best of several starts, in the units of the points."""

    outcome: Outcome
    sentence: str
    centers: np.ndarray  # (clusters, columns): v, eq. 7
    widths: np.ndarray  # (clusters, columns): σ, eq. 8
    memberships: np.ndarray  # (clusters, samples): μ, eq. 6
    objective: np.ndarray  # J after each iteration, eq. 3, on standardised points
    repaired: bool  # the covariance repair acted in the start that was kept
    seed: int  # of the start that was kept


@dataclass(frozen=True)
class Settings:
    """The paper's m and ε, and the repair: eigenvalue-ratio cap β and shrinkage γ (0: off)."""

    fuzziness: float = 2.0
    tolerance: float = 1e-4
    max_iterations: int = 1000
    max_ratio: float = 1e12
    shrinkage: float = 0.0
    starts: int = 3
    seed: int = 0


def cluster(
    points: np.ndarray,
    clusters: int,
    settings: Settings | None = None,
    names: Sequence[str] | None = None,
    outputs: int = 1,
    progress: Callable[[int, float], None] | None = None,
) -> Clustering:
    """Cluster `points`, shape `(n_samples, n_columns)`; the last `outputs` columns are outputs.

    Only inputs are tested for excitation: a degenerate outcome names the input that lacks it.
    `progress(iterations, change)` is called after every iteration of a large recording, after every start of a small
    one. Raises RequestError on rows that are not finite.
    """
    settings = settings or Settings()
    points = np.ascontiguousarray(points, np.float64)
    names = names or [f"column {k}" for k in range(points.shape[1])]
    check_finite(points, names)
    if clusters < 1:
        raise RequestError(f"{clusters} clusters asked for; give at least 1")
    reason = _refusal(points, clusters, names, points.shape[1] - outputs)
    if reason:
        return _degenerate(points, clusters, reason)
    z, mean, scale = standardise(points)
    ends = (_run(z, clusters, settings, settings.seed + k, progress) for k in range(settings.starts))
    best = min(ends, key=lambda end: (end.coincide, end.objective[-1]))
    return _finish(best, z, mean, scale)


def standardise(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standardised copy, shape `(n_columns, n_samples)`, mean and scale; a constant column keeps scale 1."""
    mean, scale = points.mean(axis=0), points.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    z = np.empty(points.shape[::-1])
    for k, row in enumerate(z):
        np.subtract(points[:, k], mean[k], out=row)
        np.divide(row, scale[k], out=row)
    return z, mean, scale


def _refusal(points: np.ndarray, clusters: int, names: Sequence[str], inputs: int) -> str | None:
    needed = clusters * (points.shape[1] + 1)
    if len(points) < needed:
        return f"{len(points)} points for {clusters} clusters; at least {needed} are needed"
    return lacking(points[:, :inputs], names[:inputs])


def _degenerate(points: np.ndarray, clusters: int, reason: str) -> Clustering:
    empty = np.full((clusters, points.shape[1]), np.nan)
    nothing = np.empty(0)
    return Clustering(Outcome.DEGENERATE, reason, empty, empty, np.empty((clusters, 0)), nothing, False, -1)


@dataclass
class _End:
    """Where one start ended (standardised units)."""

    centers: np.ndarray
    memberships: np.ndarray
    objective: np.ndarray
    repaired: bool
    settled: bool
    coincide: bool
    seed: int


def _run(
    z: np.ndarray, clusters: int, settings: Settings, seed: int, progress: Callable[[int, float], None] | None
) -> _End:
    """One start: Λ random, then eqs. 7, 5, 4, 6 in turn until ‖Λ_l − Λ_(l−1)‖ (largest entry) < ε."""
    mu = random_partition(z.shape[1], clusters, seed)
    spread = _spread(z) if settings.shrinkage else 0.0
    at_once = settings.max_iterations if z.shape[1] < LARGE else 1
    objective = np.empty(settings.max_iterations)
    done, change, repaired = 0, np.inf, False
    centers, covariances = np.empty((0, 0)), np.empty((0, 0, 0))
    while done < settings.max_iterations and change >= settings.tolerance:
        more, change, mended, centers, covariances = iterate(
            z, mu, settings.fuzziness, settings.tolerance, at_once,
            settings.max_ratio, settings.shrinkage, spread, objective[done:],
        )  # fmt: skip
        done, repaired = done + more, repaired or mended
        if progress:
            progress(done, change)
    coincide = _coincide(centers, covariances)
    return _End(centers, mu, objective[:done], repaired, change < settings.tolerance, coincide, seed)


def _spread(z: np.ndarray) -> float:
    """The scale of the identity that covariances are shrunk to: det(cov z)^(1/columns)."""
    return float(np.linalg.det(np.atleast_2d(np.cov(z, bias=True)))) ** (1 / len(z))


def random_partition(samples: int, clusters: int, seed: int) -> np.ndarray:
    """Λ at first: random memberships `(clusters, samples)` whose columns sum to 1."""
    mu = np.random.default_rng(seed).random((clusters, samples))
    mu += 1e-9
    mu /= mu.sum(axis=0)
    return mu


def _coincide(centers: np.ndarray, covariances: np.ndarray) -> bool:
    """Two centres closer than COINCIDE in the metric of either cluster."""
    first, second = np.triu_indices(len(centers), 1)
    apart = centers[first] - centers[second]
    metric = np.linalg.pinv(covariances[first] + covariances[second])
    return bool((np.einsum("pi,pij,pj->p", apart, metric, apart) < COINCIDE**2).any())


def _finish(end: _End, z: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> Clustering:
    outcome = Outcome.CONVERGED if end.settled else Outcome.STOPPED
    sentence = outcome.value
    if end.coincide:
        outcome = Outcome.DEGENERATE
        sentence = f"two of {len(end.centers)} clusters fell together; ask for fewer rules"
    widths = cluster_widths(z, end.memberships, end.centers)
    return Clustering(
        outcome,
        sentence,
        end.centers * scale + mean,
        widths * scale,
        end.memberships,
        end.objective,
        end.repaired,
        end.seed,
    )
