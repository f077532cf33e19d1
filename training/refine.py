"""Joint refinement of a TS model by variable projection (Golub-Pereyra, Kaufman's Jacobian).

Only centres and log widths are searched; for each of them the consequents are the linear least-squares solution,
so the search has half the dimensions and the consequents are never out of date.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from training.regressors import output_slopes, regressors

NARROWEST = 0.35  # of a starting width: narrower rules fit the gaps between soaks, not the surface
WIDEST = 8.0
RIDGE = 1e-6  # keeps consequents of overlapping rules finite, as P(0) = a·I does in RLS
PULL = 0.01  # per standardised unit away from the start, in units of the output's standard deviation


@dataclass(frozen=True)
class Antecedents:
    """Centres and widths (σ), shape `(rules, inputs)` each, in standardised inputs."""

    centers: np.ndarray
    widths: np.ndarray

    def vector(self) -> np.ndarray:
        """Centres and log widths as one vector."""
        return np.concatenate([self.centers.ravel(), np.log(self.widths).ravel()])

    def like(self, vector: np.ndarray) -> "Antecedents":
        """Antecedents of the same shape from such a vector."""
        n = self.centers.size
        shape = self.centers.shape
        return Antecedents(vector[:n].reshape(shape), np.exp(vector[n:]).reshape(shape))


def refine(
    z: np.ndarray,
    y: np.ndarray,
    start: Antecedents,
    extra: np.ndarray | None = None,
    evaluations: int = 200,
) -> Antecedents:
    """Refine antecedents on standardised inputs `z`, shape `(n_samples, n_inputs)`, and output `y`.

    `extra`, shape `(n_samples, n_columns)`, are columns of other linear effects that are fitted along.
    """
    scale = float(np.std(y)) or 1.0
    problem = _Projection(np.ascontiguousarray(z), y / scale, start, extra)
    first = start.vector()
    n = start.centers.size
    low = np.concatenate([np.full(n, -np.inf), first[n:] + np.log(NARROWEST)])
    high = np.concatenate([np.full(n, np.inf), first[n:] + np.log(WIDEST)])
    found = least_squares(
        problem.residual,
        first,
        jac=problem.jacobian,  # type: ignore[arg-type]  # scipy's stubs do not know callables of arrays
        bounds=(low, high),
        ftol=1e-7,
        xtol=1e-7,
        gtol=1e-9,
        max_nfev=evaluations,
    )
    return start.like(found.x)


class _Projection:
    """Residual and Jacobian of the projected problem at one vector, kept until the vector changes."""

    def __init__(self, z: np.ndarray, y: np.ndarray, start: Antecedents, extra: np.ndarray | None) -> None:
        self.z, self.start, self.first = z, start, start.vector()
        self.extra = np.empty((len(z), 0)) if extra is None else extra / np.std(extra, axis=0)
        self.columns = start.centers.shape[0] * (z.shape[1] + 1)
        self.size = self.columns + self.extra.shape[1]
        self.y = np.concatenate([y, np.zeros(self.size)])
        self.pull = PULL * np.sqrt(len(z) / 448)
        self.at: np.ndarray | None = None

    def residual(self, vector: np.ndarray) -> np.ndarray:
        self._solve(vector)
        return self.left

    def jacobian(self, vector: np.ndarray) -> np.ndarray:
        """Kaufman: −P⊥ ∂ŷ/∂p, the second term of the exact Jacobian left out."""
        self._solve(vector)
        now = self.start.like(vector)
        theta = self.theta[: self.columns].reshape(len(now.centers), -1)
        slopes = output_slopes(self.z, now.centers, now.widths, theta)
        slopes = np.vstack([slopes, np.zeros((self.size, slopes.shape[1]))])
        slopes -= self.q @ (self.q.T @ slopes)
        return np.vstack([slopes, self.pull * np.eye(len(vector))])

    def _solve(self, vector: np.ndarray) -> None:
        if self.at is not None and np.array_equal(self.at, vector):
            return
        now = self.start.like(vector)
        phi = np.hstack([regressors(self.z, now.centers, now.widths, True), self.extra])
        stacked = np.vstack([phi, np.sqrt(RIDGE) * np.eye(self.size)])
        self.q, r = np.linalg.qr(stacked)
        self.theta = solve_triangular(r, self.q.T @ self.y, check_finite=False)
        # positive slope of the model output is what jacobian() returns, so the residual is model − data
        self.left = np.concatenate([stacked @ self.theta - self.y, self.pull * (vector - self.first)])
        self.at = vector.copy()
