"""Recursive least squares: ridge identity, symmetry, forgetting that tracks and does not wind up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp.errors import RequestError
from training.rls import RecursiveLeastSquares


def rows(n=200, p=5, seed=0):
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((n, p))
    return phi, phi @ rng.standard_normal(p) + 0.1 * rng.standard_normal(n)


@given(st.integers(0, 10_000), st.sampled_from([1.0, 300.0, 1e4, 1e6]), st.integers(1, 8))
def test_equals_ridge_with_lambda_one_over_a(seed, a, p):
    phi, y = rows(60, p, seed)
    ridge = np.linalg.solve(phi.T @ phi + np.eye(p) / a, phi.T @ y)
    np.testing.assert_allclose(RecursiveLeastSquares(p, a).update(phi, y), ridge, rtol=1e-8, atol=1e-8)


def test_matches_the_printed_recursion():
    phi, y = rows(50)
    theta, P = np.zeros(5), 300.0 * np.eye(5)
    for x, value in zip(phi, y, strict=True):
        K = P @ x / (1 + x @ P @ x)
        theta = theta + K * (value - x @ theta)
        P = (np.eye(5) - np.outer(K, x)) @ P
    estimator = RecursiveLeastSquares(5, 300.0)
    np.testing.assert_allclose(estimator.update(phi, y), theta, rtol=1e-9)
    np.testing.assert_allclose(estimator.P, P, rtol=1e-7, atol=1e-12)


def test_pieces_give_the_same_bits_as_the_whole():
    phi, y = rows()
    whole, pieces = RecursiveLeastSquares(5), RecursiveLeastSquares(5)
    whole.update(phi, y)
    for part in np.array_split(np.arange(len(y)), 7):
        pieces.update(phi[part], y[part])
    np.testing.assert_array_equal(whole.theta, pieces.theta)


def test_stays_symmetric_and_positive_under_nearly_collinear_rows():
    phi, y = rows(3000)
    phi[:, 1] = phi[:, 0] * (1 + 1e-7)
    estimator = RecursiveLeastSquares(5, 1e6)
    estimator.update(phi, y)
    np.testing.assert_array_equal(estimator.P, estimator.P.T)
    assert np.linalg.eigvalsh(estimator.P)[0] > -1e-9


def test_forgetting_does_not_wind_up_where_nothing_is_excited():
    estimator = RecursiveLeastSquares(3, 300.0, forgetting=0.98)
    phi = np.tile([1.0, 0.0, 0.0], (20_000, 1))
    estimator.update(phi, np.ones(len(phi)))
    assert np.trace(estimator.P) <= 3 * 300.0 * (1 + 1e-9)
    assert estimator.P[1, 1] == pytest.approx(300.0)
    assert estimator.theta[0] == pytest.approx(1.0)


def test_forgetting_keeps_its_bound_for_weak_rows_in_all_directions():
    phi, y = rows(5000)
    estimator = RecursiveLeastSquares(5, 300.0, forgetting=0.95)
    estimator.update(1e-3 * phi, y)
    assert np.trace(estimator.P) <= 5 * 300.0 * (1 + 1e-9)


def test_forgetting_follows_a_change_that_plain_rls_averages():
    rng = np.random.default_rng(0)
    phi = rng.standard_normal((2000, 2))
    y = np.where(np.arange(2000) < 1000, phi[:, 0], -phi[:, 0])
    plain, forgetful = RecursiveLeastSquares(2), RecursiveLeastSquares(2, forgetting=0.97)
    assert abs(plain.update(phi, y)[0]) < 0.2
    assert forgetful.update(phi, y)[0] == pytest.approx(-1.0, abs=0.01)


@pytest.mark.parametrize(("start", "forgetting"), [(0.0, 1.0), (300.0, 0.0), (300.0, 1.5)])
def test_bad_settings_are_refused(start, forgetting):
    with pytest.raises(RequestError, match=r"give a number|above 0"):
        RecursiveLeastSquares(2, start, forgetting)
