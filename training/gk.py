"""Gustafson-Kessel clustering, PAPER eqs. 3-8, with the covariance repair of Babuška, van der Veen and Kaymak (2002).

Points are standardised first, so that units do not matter: every column has mean 0 and standard deviation 1.
Memory beyond the input: one standardised copy and the partition matrix, 8·(columns + clusters) bytes a row.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from rtcomp.errors import RequestError
from training.excitation import check_finite, lacking
from training.gk_kernels import cluster_widths, update_partition, weighted_centers, weighted_covariances

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
    memberships: np.ndarray  # (samples, clusters): μ, eq. 6
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
    `progress(iteration, change)` is called after every iteration. Raises RequestError on rows that are not finite.
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
    """Standardised copy, mean and scale; a constant column keeps scale 1."""
    mean, scale = points.mean(axis=0), points.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    z = points - mean
    z /= scale
    return z, mean, scale


def _refusal(points: np.ndarray, clusters: int, names: Sequence[str], inputs: int) -> str | None:
    needed = clusters * (points.shape[1] + 1)
    if len(points) < needed:
        return f"{len(points)} points for {clusters} clusters; at least {needed} are needed"
    return lacking(points[:, :inputs], names[:inputs])


def _degenerate(points: np.ndarray, clusters: int, reason: str) -> Clustering:
    empty = np.full((clusters, points.shape[1]), np.nan)
    nothing = np.empty(0)
    return Clustering(Outcome.DEGENERATE, reason, empty, empty, np.empty((0, clusters)), nothing, False, -1)


@dataclass
class _End:
    """Where one start ended (standardised units)."""

    centers: np.ndarray
    memberships: np.ndarray
    objective: list[float]
    repaired: bool
    settled: bool
    coincide: bool
    seed: int


def _run(
    z: np.ndarray, clusters: int, settings: Settings, seed: int, progress: Callable[[int, float], None] | None
) -> _End:
    """One start: Λ random, then eqs. 7, 5, 4, 6 in turn until ‖Λ_l − Λ_(l−1)‖ (largest entry) < ε."""
    mu = random_partition(len(z), clusters, seed)
    objective: list[float] = []
    repaired, change = False, np.inf
    centers, covariances = np.empty((0, 0)), np.empty((0, 0, 0))
    for iteration, step in enumerate(_steps(z, mu, settings)):
        centers, covariances, mended, change, value = step
        objective.append(value)
        repaired |= mended
        if progress:
            progress(iteration, change)
        if change < settings.tolerance:
            break
    return _End(
        centers, mu, objective, repaired, change < settings.tolerance, _coincide(centers, covariances), seed
    )


def _steps(z: np.ndarray, mu: np.ndarray, settings: Settings) -> Iterator[tuple]:
    """The paper's steps 3-5, `mu` updated in place; yields (centres, covariances, repaired, change, J)."""
    m = settings.fuzziness
    spread = np.linalg.det(np.atleast_2d(np.cov(z, rowvar=False, bias=True))) ** (1 / z.shape[1])
    for _ in range(settings.max_iterations):
        centers = weighted_centers(z, mu, m)
        covariances = weighted_covariances(z, mu, centers, m)
        norms, mended = norm_matrices(covariances, spread, settings)
        change, value = update_partition(z, mu, centers, norms, m)
        yield centers, covariances, mended, change, value


def random_partition(samples: int, clusters: int, seed: int) -> np.ndarray:
    """Λ at first: random memberships `(samples, clusters)` whose rows sum to 1."""
    mu = np.random.default_rng(seed).random((samples, clusters))
    mu += 1e-9
    mu /= mu.sum(axis=1, keepdims=True)
    return mu


def norm_matrices(covariances: np.ndarray, spread: float, settings: Settings) -> tuple[np.ndarray, bool]:
    """A_j = (ρ_j det F_j)^(1/n) F_j⁻¹ with ρ_j = 1 (eq. 4), and whether the repair acted.

    The repair (Babuška 2002): F ← (1−γ)F + γ·spread·I, then eigenvalues below λ_max/β are raised to it.
    """
    n, gamma = covariances.shape[1], settings.shrinkage
    if gamma > 0:
        covariances = (1 - gamma) * covariances + gamma * spread * np.eye(n)
    values, vectors = np.linalg.eigh(covariances)
    floor = np.maximum(values[:, -1:] / settings.max_ratio, np.finfo(float).tiny)
    mended = gamma > 0 or bool((values < floor).any())
    values = np.maximum(values, floor)
    volume = np.exp(np.log(values).mean(axis=1))  # det F^(1/n) without underflow
    inverse = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.ascontiguousarray(volume[:, None, None] * inverse), mended


def _coincide(centers: np.ndarray, covariances: np.ndarray) -> bool:
    """Two centres closer than COINCIDE in the metric of either cluster."""
    for j in range(len(centers)):
        for k in range(j):
            apart = centers[j] - centers[k]
            if apart @ np.linalg.pinv(covariances[j] + covariances[k]) @ apart < COINCIDE**2:
                return True
    return False


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
        np.array(end.objective),
        end.repaired,
        end.seed,
    )
