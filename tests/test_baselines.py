"""Baselines: each does what its name says, on data where the answer is known."""

import numpy as np
import pytest

from training.baselines import FILTERS, SURFACES
from training.baselines.lssvm import LeastSquaresSVM
from training.baselines.network import BackPropagationNetwork

RNG = np.random.default_rng(0)
INPUTS = np.column_stack([RNG.uniform(-30, 60, 250), RNG.uniform(-180, 180, 250)])
T, M = INPUTS.T
TARGETS = {
    "linear_plane": 1 + 0.1 * T - 0.02 * M,
    "linear_bilinear": 1 + 0.1 * T - 0.02 * M + 1e-3 * T * M,
    "cubic_temperature": 1 + 0.1 * T - 0.01 * T**2 + 1e-4 * T**3,
}


@pytest.mark.parametrize("name", TARGETS)
def test_polynomials_are_recovered_exactly(name):
    predict = SURFACES[name].fit(INPUTS, TARGETS[name])
    np.testing.assert_allclose(predict(INPUTS), TARGETS[name], atol=1e-8)


@pytest.mark.parametrize("name", SURFACES)
def test_every_surface_learns_a_bilinear_error_better_than_nothing(name):
    error = TARGETS["linear_bilinear"]
    left = error - SURFACES[name].fit(INPUTS, error)(INPUTS)
    assert left.std() < (0.98 if name == "cubic_temperature" else 0.75) * error.std()


def test_lssvm_solves_its_equations():
    X, y = RNG.standard_normal((30, 2)), RNG.standard_normal(30) + 3
    found = LeastSquaresSVM(gamma=80.0, sigma2=6.0).fit(X, y)
    K = np.exp(-((X[:, None] - X[None]) ** 2).sum(axis=2) / 6.0)
    system = np.block([[np.zeros((1, 1)), np.ones((1, 30))], [np.ones((30, 1)), K + np.eye(30) / 80.0]])
    solved = np.linalg.solve(system, np.concatenate([[0.0], y]))
    np.testing.assert_allclose(found.bias_, solved[0], rtol=1e-9)
    np.testing.assert_allclose(found.alpha_, solved[1:], rtol=1e-7, atol=1e-9)


def test_network_slopes_are_derivatives():
    X = RNG.standard_normal((10, 2))
    network = BackPropagationNetwork(hidden=3).fit(X, X[:, 0])
    p = RNG.standard_normal(13)
    slopes = network._backward(p, X)
    for k, step in enumerate(np.eye(13) * 1e-6):
        numeric = (network._forward(p + step, X)[0] - network._forward(p - step, X)[0]) / 2e-6
        np.testing.assert_allclose(slopes[:, k], numeric, atol=1e-7)


def test_network_learns_a_sine():
    X = np.linspace(-2, 2, 200)[:, None]
    left = np.sin(2 * X[:, 0]) - BackPropagationNetwork(hidden=4).fit(X, np.sin(2 * X[:, 0])).predict(X)
    assert left.std() < 0.01


def test_large_recordings_are_thinned_aloud(caplog):
    many = np.tile(INPUTS, (8, 1)) + RNG.standard_normal((2000, 2))
    SURFACES["lssvm"].fit(many, many[:, 0])
    assert "trained on 1500 of 2000 rows" in caplog.text


@pytest.mark.parametrize("name", FILTERS)
def test_filters_keep_a_constant_and_lower_white_noise(name):
    smooth = FILTERS[name]
    np.testing.assert_allclose(smooth(np.full(200, 3.0)), 3.0, atol=1e-9)
    noise = RNG.standard_normal(1000)
    assert smooth(noise).std() < 0.9 * noise.std()
    assert smooth(np.ones((2, 300))).shape == (2, 300)


def test_five_point_cubic_keeps_a_cubic():
    t = np.linspace(-1, 1, 50)
    np.testing.assert_allclose(FILTERS["five_point_cubic"](t**3 - t), t**3 - t, atol=1e-12)


@pytest.mark.parametrize("name", FILTERS)
def test_filters_take_series_shorter_than_themselves(name):
    assert FILTERS[name](np.array([1.0, 2.0, 3.0])).shape == (3,)
