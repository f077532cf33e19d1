"""Recursive least squares, PAPER eqs. 12-14, kept symmetric, with forgetting that cannot wind up.

θ(0) = 0 and P(0) = a·I make it ridge regression with λ = 1/a: θ(N) = (ΦᵀΦ + I/a)⁻¹ Φᵀy, not plain least squares.
"""

from dataclasses import dataclass, field

import numpy as np

from rtcomp.errors import RequestError
from rtcomp.jit import kernel


@dataclass
class RecursiveLeastSquares:
    """State of the estimator. `update` may be called with any number of rows at a time, in the order of arrival.

    `start` is the paper's a ("large enough, usually > 300"). `forgetting` is λ in (0, 1]; below 1 information is
    forgotten only along the direction of the new row (Kulhavý), so what is not excited stays as it was, and
    never while trace P would exceed that of P(0): P cannot wind up.
    """

    size: int
    start: float = 1e6
    forgetting: float = 1.0
    theta: np.ndarray = field(init=False)  # (size,)
    P: np.ndarray = field(init=False)  # (size, size), symmetric in every bit

    def __post_init__(self) -> None:
        """Set θ(0) and P(0). Raises RequestError on a start or forgetting factor out of range."""
        if self.start <= 0:
            raise RequestError(f"P(0) = {self.start}·I: a must be above 0, usually above 300")
        if not 0 < self.forgetting <= 1:
            raise RequestError(f"forgetting factor {self.forgetting}: give a number above 0 and at most 1")
        self.theta = np.zeros(self.size)
        self.P = self.start * np.eye(self.size)

    def update(self, phi: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Take rows `phi`, shape `(n_samples, size)`, with outputs `y`, shape `(n_samples,)`; returns θ."""
        phi, y = np.ascontiguousarray(phi, np.float64), np.ascontiguousarray(y, np.float64)
        recurse(self.theta, self.P, phi, y, self.forgetting, self.start * self.size)
        return self.theta


@kernel
def recurse(theta, P, phi, y, forgetting, largest_trace):
    """Eqs. 12-14 over rows, `theta` and `P` in place.

    With r = φᵀPφ, forgetting adds ε φφᵀ instead of φφᵀ to the information P⁻¹, ε = λ − (1 − λ)/r; λ = 1 is eq. 14.
    """
    p = len(theta)
    gain = np.empty(p)
    trace = 0.0
    for j in range(p):
        trace += P[j, j]
    for i in range(len(y)):
        r, residual, length = 0.0, y[i], 0.0
        gain[:] = 0.0
        for k in range(p):  # P is symmetric: its rows are its columns, and a row is a vector
            for j in range(p):
                gain[j] += P[k, j] * phi[i, k]
        for j in range(p):
            length += gain[j] * gain[j]
            r += gain[j] * phi[i, j]
            residual -= theta[j] * phi[i, j]
        if not r > 0.0:
            continue
        for j in range(p):
            theta[j] += gain[j] / (1.0 + r) * residual
        less = r / (1.0 + r)
        if forgetting < 1.0:
            epsilon = forgetting - (1.0 - forgetting) / r
            forgetful = epsilon * r / (1.0 + epsilon * r)
            if trace - forgetful / r * length <= largest_trace:
                less = forgetful
        less /= r
        trace = 0.0
        for j in range(p):
            for k in range(p):
                P[j, k] -= less * (gain[j] * gain[k])  # in this order the same bits for (k, j)
            trace += P[j, j]
