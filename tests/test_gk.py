"""Gustafson-Kessel: identities of eqs. 3-8, planted clusters, independence of units, named degenerate outcomes."""

import numpy as np
import pytest

from rtcomp.errors import RequestError
from training.gk import Outcome, Settings, cluster, random_partition, standardise
from training.gk_kernels import (
    distances,
    norm_matrix,
    update_partition,
    weighted_moments,
)

NAMES = ["temp_degC", "rate_dps", "error_dps"]


def blobs(per=40, seed=0):
    """Three elongated clusters in three columns."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, center in enumerate([(-20.0, -100.0, 1.0), (10.0, 90.0, -2.0), (45.0, 0.0, 3.0)]):
        shape = np.eye(3) * [2.0, 8.0, 0.2]
        shape[1, 0] = 3.0 * (k - 1)
        parts.append(np.array(center) + rng.standard_normal((per, 3)) @ shape)
    return np.concatenate(parts)


def naive_round(z, mu, m):
    """One round of eqs. 7, 5, 4, 6 in plain numpy; z (samples, columns), mu (samples, clusters)."""
    w = mu**m
    v = (w.T @ z) / w.sum(axis=0)[:, None]
    new, d2 = np.empty_like(mu), np.empty_like(mu)
    for j in range(mu.shape[1]):
        apart = z - v[j]
        f = (w[:, j, None] * apart).T @ apart / w[:, j].sum()
        a = np.linalg.det(f) ** (1 / z.shape[1]) * np.linalg.inv(f)
        d2[:, j] = np.einsum("ik,kh,ih->i", apart, a, apart)
    for j in range(mu.shape[1]):
        new[:, j] = 1 / ((d2[:, j, None] / d2) ** (1 / (m - 1))).sum(axis=1)
    return v, d2, new


@pytest.mark.parametrize("m", [2.0, 1.6])
def test_one_round_is_the_printed_equations(m):
    z, _, _ = standardise(blobs())
    mu = random_partition(z.shape[1], 3, 1)
    v, d2, new = naive_round(z.T, mu.T, m)
    centers, covariances, norms = (
        z[:, :3].T.copy(),
        np.empty((3, 3, 3)),
        np.empty((3, 3, 3)),
    )  # any point to sum about
    weighted_moments(z, mu, m, centers, covariances)
    repaired = [norm_matrix(covariances[j], 1e12, 0.0, 1.0, norms[j]) for j in range(3)]
    assert not any(repaired)
    square = np.empty(mu.shape)
    distances(z, 0, z.shape[1], centers, norms, square, np.empty(z.shape))
    before = mu.copy()
    change, objective = update_partition(z, mu, centers, norms, m)
    np.testing.assert_allclose(centers, v, rtol=1e-10)
    np.testing.assert_allclose(square, d2.T, rtol=1e-9)
    np.testing.assert_allclose(mu, new.T, rtol=1e-9)
    assert change == pytest.approx(np.abs(new.T - before).max())
    assert objective == pytest.approx(np.sum(new**m * d2), rel=1e-9)


def test_norm_matrices_have_determinant_one():
    covariance = np.cov(blobs(), rowvar=False)
    norm = np.empty((3, 3))
    norm_matrix(covariance, 1e12, 0.0, 1.0, norm)
    assert np.linalg.det(norm) == pytest.approx(1.0)


def test_repair_caps_the_ratio_of_eigenvalues():
    flat = np.diag([1.0, 1.0, 0.0])
    norm = np.empty((3, 3))
    assert norm_matrix(flat, 1e6, 0.0, 1.0, norm)
    values = np.linalg.eigvalsh(norm)
    assert values[-1] / values[0] == pytest.approx(1e6, rel=1e-6)


def test_shrinkage_pulls_towards_the_sphere():
    norm = np.empty((2, 2))
    assert norm_matrix(np.diag([4.0, 1.0]), 1e12, 1.0, 2.0, norm)
    np.testing.assert_allclose(norm, np.eye(2), atol=1e-12)


def test_memberships_sum_to_one_and_the_objective_never_rises():
    found = cluster(blobs(), 3, names=NAMES)
    assert found.outcome is Outcome.CONVERGED
    assert not found.repaired
    np.testing.assert_allclose(found.memberships.sum(axis=0), 1.0, rtol=1e-12)
    assert (found.memberships >= 0).all()
    assert (np.diff(found.objective) <= 1e-9 * found.objective[:-1]).all()


def test_planted_clusters_are_found():
    found = cluster(blobs(), 3, names=NAMES)
    for center in [(-20.0, -100.0), (10.0, 90.0), (45.0, 0.0)]:
        nearest = np.abs(found.centers[:, :2] - center).min(axis=0)
        assert nearest[0] < 2.0
        assert nearest[1] < 6.0


def test_widths_are_equation_8():
    points = blobs()
    found = cluster(points, 3, names=NAMES)
    for j in range(3):
        square = np.average((points - found.centers[j]) ** 2, axis=0, weights=found.memberships[j])
        np.testing.assert_allclose(found.widths[j], np.sqrt(square), rtol=1e-9)


def test_units_do_not_matter():
    points = blobs()
    scale, shift = np.array([1.8, 1e-9, 1e6]), np.array([32.0, 0.0, -5.0])
    one, other = cluster(points, 3, names=NAMES), cluster(points * scale + shift, 3, names=NAMES)
    np.testing.assert_allclose(other.memberships, one.memberships, atol=1e-5)
    np.testing.assert_allclose(other.centers, one.centers * scale + shift, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(other.widths, one.widths * scale, rtol=1e-4)


def test_same_seed_same_bits_and_the_best_start_is_kept():
    points = blobs(20)
    found, again = (cluster(points, 4, Settings(starts=4), NAMES) for _ in range(2))
    np.testing.assert_array_equal(found.centers, again.centers)
    alone = [cluster(points, 4, Settings(starts=1, seed=seed), NAMES) for seed in range(4)]
    proper = [one.objective[-1] for one in alone if one.outcome is not Outcome.DEGENERATE]
    assert found.objective[-1] == min(proper)


@pytest.mark.parametrize("value", [25.0, 1e-7, 0.0])
def test_constant_temperature_is_named(value):
    points = blobs()
    points[:, 0] = value
    found = cluster(points, 3, names=NAMES)
    assert found.outcome is Outcome.DEGENERATE
    assert "temp_degC is constant" in found.sentence


def test_collinear_inputs_are_named():
    points = blobs()
    points[:, 1] = 3.0 - 2.0 * points[:, 0]
    found = cluster(points, 3, names=NAMES)
    assert found.outcome is Outcome.DEGENERATE
    assert "temp_degC and rate_dps are collinear" in found.sentence


def test_three_points_are_too_few():
    found = cluster(blobs()[:3], 3, names=NAMES)
    assert found.outcome is Outcome.DEGENERATE
    assert "3 points for 3 clusters" in found.sentence


def test_duplicated_points_change_nothing_but_the_weight():
    points = blobs(15)
    one = cluster(points, 3, Settings(tolerance=1e-9), NAMES)
    twice = cluster(np.repeat(points, 2, axis=0), 3, Settings(tolerance=1e-9), NAMES)
    order, other = np.argsort(one.centers[:, 0]), np.argsort(twice.centers[:, 0])
    np.testing.assert_allclose(twice.centers[other], one.centers[order], rtol=1e-4, atol=1e-3)


def test_few_distinct_points_engage_the_repair_or_are_called_degenerate():
    points = np.repeat(blobs(2), 10, axis=0)
    found = cluster(points, 3, names=NAMES)
    assert found.repaired or found.outcome is Outcome.DEGENERATE
    assert found.outcome is Outcome.DEGENERATE or np.isfinite(found.centers).all()


def test_more_clusters_than_there_are_fall_together():
    rng = np.random.default_rng(0)
    found = cluster(rng.standard_normal((300, 3)), 4, Settings(fuzziness=6.0, starts=1), NAMES)
    assert found.outcome is Outcome.DEGENERATE
    assert "fewer rules" in found.sentence


def test_rows_that_are_not_finite_are_refused_by_name():
    points = blobs()
    points[7, 1] = np.nan
    with pytest.raises(RequestError, match=r"rate_dps: 1 of 120 rows .* row 7"):
        cluster(points, 3, names=NAMES)
    with pytest.raises(RequestError, match="at least 1"):
        cluster(blobs(), 0, names=NAMES)


@pytest.mark.parametrize("m", [2.0, 1.3, 3.0])
def test_a_point_on_a_centre_belongs_to_it_alone(m):
    z = np.array([[0.0, 1.0, 4.0], [0.0, 2.0, 5.0]])
    mu = random_partition(3, 2, 0)
    centers = np.array([[0.0, 0.0], [4.0, 5.0]])
    norms = np.stack([np.eye(2), np.eye(2)])
    _, objective = update_partition(z, mu, centers, norms, m)
    np.testing.assert_allclose(mu[:, [0, 2]], np.eye(2), atol=1e-12)
    expected = np.sum(mu[:, 1] ** m * [5.0, 18.0])
    assert objective == pytest.approx(expected, rel=1e-9)
    update_partition(z, mu, np.zeros((2, 2)), norms, m)
    np.testing.assert_allclose(mu[:, 0], 0.5)
