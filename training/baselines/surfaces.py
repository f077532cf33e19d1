"""Error surfaces over (temperature, measured rate) that the project is compared with, each from its library."""

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from sklearn.compose import ColumnTransformer
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, PolynomialFeatures, SplineTransformer, StandardScaler
from threadpoolctl import threadpool_limits

from training.baselines.lssvm import LeastSquaresSVM
from training.baselines.network import BackPropagationNetwork

log = logging.getLogger(__name__)
KERNEL_ROWS = 1500  # kernel methods cost rows³
SEARCH_ROWS = 150  # rows on which the Gaussian process looks for its length scales


@dataclass(frozen=True)
class Surface:
    """A method: `make(seed)` gives an untrained scikit-learn regressor over columns [temp_degC, rate_dps]."""

    what: str
    make: Callable[[int], Any]
    largest: int | None = None  # rows beyond which a random sample is taken, with a warning

    def fit(
        self, inputs: np.ndarray, error_dps: np.ndarray, seed: int = 0
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Train on `inputs`, shape `(n_samples, 2)`; returns the function that predicts the error [°/s]."""
        if self.largest and len(inputs) > self.largest:
            log.warning("%s: trained on %d of %d rows drawn at random", self.what, self.largest, len(inputs))
            rows = np.random.default_rng(seed).choice(len(inputs), self.largest, replace=False)
            inputs, error_dps = inputs[rows], error_dps[rows]
        with _quietly():
            trained = self.make(seed).fit(inputs, error_dps)

        def predict(inputs: np.ndarray) -> np.ndarray:
            with _quietly():
                return trained.predict(inputs)

        return predict


@contextmanager
def _quietly() -> Iterator[None]:
    """One thread (many cost more than they bring on a busy machine), and a search that ends at a bound is no news."""
    with threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        yield


def _plane(seed: int) -> Any:
    return LinearRegression()


def _bilinear(seed: int) -> Any:
    return make_pipeline(PolynomialFeatures(2, interaction_only=True, include_bias=False), LinearRegression())


def _cubic_temperature(seed: int) -> Any:
    columns = ColumnTransformer(
        [("temperature", make_pipeline(StandardScaler(), PolynomialFeatures(3)), [0])]
    )
    return make_pipeline(columns, LinearRegression())


def _lssvm(seed: int) -> Any:
    return make_pipeline(StandardScaler(), LeastSquaresSVM(gamma=80.0, sigma2=6.0))


def _network(seed: int) -> Any:
    return make_pipeline(StandardScaler(), BackPropagationNetwork(hidden=4, seed=seed))


def _lookup_table(seed: int) -> Any:
    """Hat functions on a grid (bilinear between its nodes, held outside), node values by least squares."""
    hats = SplineTransformer(n_knots=9, degree=1, extrapolation="constant")
    return make_pipeline(
        StandardScaler(), hats, FunctionTransformer(_products), Ridge(1e-3, fit_intercept=False)
    )


def _products(hats: np.ndarray) -> np.ndarray:
    half = hats.shape[1] // 2
    return (hats[:, :half, None] * hats[:, None, half:]).reshape(len(hats), -1)


def _boosted_trees(seed: int) -> Any:
    return HistGradientBoostingRegressor(max_iter=300, min_samples_leaf=5, random_state=seed)


class SearchedGaussianProcess(GaussianProcessRegressor):
    """A Gaussian process whose length scales are searched on at most SEARCH_ROWS rows."""

    def fit(self, X: np.ndarray, y: np.ndarray) -> "SearchedGaussianProcess":
        """Fit to standardised inputs `X`, shape `(n_samples, n_inputs)`."""
        rows = np.random.default_rng(self.random_state).permutation(len(X))[:SEARCH_ROWS]
        search = GaussianProcessRegressor(self.kernel, normalize_y=True).set_params(optimizer=_search)
        self.set_params(kernel=search.fit(X[rows], y[rows]).kernel_, optimizer=None)
        super().fit(X, y)
        return self


def _search(objective: Callable, theta: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, float]:
    """L-BFGS on the objective per row: on the raw one the first step overshoots the bounds and the search ends."""

    def scaled(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = objective(x)
        return value / SEARCH_ROWS, slope / SEARCH_ROWS

    found = minimize(scaled, theta, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 40})
    return found.x, found.fun


def _gaussian_process(seed: int) -> Any:
    kernel = ConstantKernel(1e2, (1e-4, 1e8)) * RBF(1.0, (1e-2, 1e3)).set_params(
        length_scale=[2.0, 2.0]
    ) + WhiteKernel(1e-4, (1e-9, 1e1))
    process = SearchedGaussianProcess(kernel, normalize_y=True, random_state=seed)
    return make_pipeline(StandardScaler(), process)


SURFACES: dict[str, Surface] = {
    "linear_plane": Surface("a + bT + cm (scikit-learn)", _plane),
    "linear_bilinear": Surface("a + bT + cm + dTm (scikit-learn)", _bilinear),
    "lssvm": Surface("LS-SVM, γ = 80, σ² = 6", _lssvm, KERNEL_ROWS),
    "bp_neural": Surface("BP network 2-4-1, Levenberg-Marquardt (scipy)", _network, 20_000),
    "cubic_temperature": Surface(
        "cubic in T alone, as PX4 and ArduPilot do (scikit-learn)", _cubic_temperature
    ),
    "lookup_table": Surface("bilinear look-up table, 9 × 9 nodes (scikit-learn)", _lookup_table, 200_000),
    "boosted_trees": Surface("gradient-boosted trees (scikit-learn)", _boosted_trees),
    "gaussian_process": Surface("Gaussian process, RBF (scikit-learn)", _gaussian_process, KERNEL_ROWS),
}
"""Method name → how to train it."""
