"""Back-propagation network 2-h-1, trained by Levenberg-Marquardt: scikit-learn's optimisers stop 5× above its floor."""

from typing import Any

import numpy as np
from scipy.optimize import least_squares
from sklearn.base import BaseEstimator, RegressorMixin


class BackPropagationNetwork(RegressorMixin, BaseEstimator):
    """f(x) = c + Σ_h v_h tanh(b_h + w_hᵀ x), the best of several random starts on the training rows."""

    def __init__(self, hidden: int = 4, starts: int = 5, seed: int = 0, evaluations: int = 400) -> None:
        self.hidden = hidden
        self.starts = starts
        self.seed = seed
        self.evaluations = evaluations

    def fit(self, X: np.ndarray, y: np.ndarray) -> "BackPropagationNetwork":
        """Fit to standardised inputs `X`, shape `(n_samples, n_inputs)`."""
        self.scale_ = float(np.std(y)) or 1.0
        self.inputs_ = X.shape[1]
        size = self.hidden * (self.inputs_ + 2) + 1
        rng = np.random.default_rng(self.seed)
        ends = [self._train(X, y / self.scale_, rng.normal(0, 0.7, size)) for _ in range(self.starts)]
        self.weights_ = min(ends, key=lambda end: end.cost).x
        return self

    def _train(self, X: np.ndarray, y: np.ndarray, start: np.ndarray) -> Any:
        return least_squares(
            lambda p: self._forward(p, X)[0] - y,
            start,
            jac=lambda p: self._backward(p, X),  # type: ignore[arg-type]  # scipy's stubs
            method="lm" if len(y) >= len(start) else "trf",
            max_nfev=self.evaluations,
            xtol=1e-6,
            ftol=1e-6,
        )

    def _parts(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        h, k = self.hidden, self.inputs_
        return p[: h * k].reshape(h, k), p[h * k : h * (k + 1)], p[h * (k + 1) :]

    def _forward(self, p: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weights, biases, outer = self._parts(p)
        hidden = np.tanh(X @ weights.T + biases)
        return hidden @ outer[:-1] + outer[-1], hidden

    def _backward(self, p: np.ndarray, X: np.ndarray) -> np.ndarray:
        outer = self._parts(p)[2]
        hidden = self._forward(p, X)[1]
        slope = (1 - hidden**2) * outer[:-1]
        inner = (slope[:, :, None] * X[:, None, :]).reshape(len(X), -1)
        return np.hstack([inner, slope, hidden, np.ones((len(X), 1))])

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Output at `X`."""
        return self._forward(self.weights_, X)[0] * self.scale_
