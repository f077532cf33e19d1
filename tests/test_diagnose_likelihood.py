from itertools import pairwise

import numpy as np

from training.diagnose.likelihood import profile
from training.diagnose.spectrum import band_edges, shapes


def white_problem(seed, columns):
    rng = np.random.default_rng(seed)
    n = 600
    stack = rng.standard_normal((n, columns + 1))
    edges = band_edges(n)
    grams = np.asarray([stack[a:b].T @ stack[a:b] for a, b in pairwise(edges)])
    phi = shapes(np.linspace(0.1, 1.0, len(edges) - 1), n)
    weights = np.zeros((1, len(phi)))
    weights[0, 0] = 1.0
    return stack, grams, np.diff(edges).astype(float), phi, weights


def fit(grams, counts, phi, weights, q):
    return profile(grams, counts, np.asarray([0, len(counts)]), phi, weights, q, 10, 10)


def test_under_white_noise_it_is_ordinary_least_squares():
    stack, grams, counts, phi, weights = white_problem(3, 4)
    _, beta, _, nuisance, _, spectrum = fit(grams, counts, phi, weights, 2)
    expected, residual, *_ = np.linalg.lstsq(stack[:, :4], stack[:, 4], rcond=None)
    np.testing.assert_allclose(np.concatenate([nuisance[0], beta]), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(spectrum, residual[0] / len(stack), rtol=1e-9)


def test_one_more_column_never_lowers_the_likelihood():
    _, grams, counts, phi, weights = white_problem(4, 5)
    fewer = np.delete(np.delete(grams, 4, axis=1), 4, axis=2)
    assert fit(grams, counts, phi, weights, 2)[0] >= fit(fewer, counts, phi, weights.copy(), 2)[0] - 1e-9


def test_a_copy_of_a_column_changes_nothing():
    stack, _, counts, phi, weights = white_problem(5, 3)
    edges = np.concatenate([[0], np.cumsum(counts)]).astype(int)

    def grams_of(columns):
        return np.asarray([columns[a:b].T @ columns[a:b] for a, b in pairwise(edges)])

    once = fit(grams_of(stack), counts, phi, weights.copy(), 1)
    twice = fit(grams_of(np.insert(stack, 3, 2.0 * stack[:, 2], axis=1)), counts, phi, weights.copy(), 1)
    assert abs(once[0] - twice[0]) < 1e-6
    assert np.all(np.abs(twice[1]) < 10.0)
