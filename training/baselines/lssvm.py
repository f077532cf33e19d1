"""Least-squares support vector machine: kernel ridge regression with a bias (Suykens), the bias not penalised."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.metrics.pairwise import rbf_kernel


class LeastSquaresSVM(RegressorMixin, BaseEstimator):
    """f(x) = Σ α_i K(x, x_i) + b with [0 1ᵀ; 1 K + I/γ][b; α] = [0; y], K = exp(−|x − x'|²/σ²)."""

    def __init__(self, gamma: float = 80.0, sigma2: float = 6.0) -> None:
        self.gamma = gamma
        self.sigma2 = sigma2

    def fit(self, X: np.ndarray, y: np.ndarray) -> "LeastSquaresSVM":
        """Fit to standardised inputs `X`, shape `(n_samples, n_inputs)`."""
        self.X_ = X
        factor = cho_factor(rbf_kernel(X, gamma=1 / self.sigma2) + np.eye(len(X)) / self.gamma)
        ones, solved = cho_solve(factor, np.ones(len(X))), cho_solve(factor, y)
        self.bias_ = solved.sum() / ones.sum()
        self.alpha_ = solved - ones * self.bias_
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Output at `X`."""
        return rbf_kernel(X, self.X_, gamma=1 / self.sigma2) @ self.alpha_ + self.bias_
