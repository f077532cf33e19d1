import numpy as np

from training.diagnose.spectrum import band_edges, band_frequencies, shapes, start, update


def whittle(counts, powers, spectrum):
    return -0.5 * np.sum(counts * (np.log(spectrum) + powers / spectrum))


def test_bands_cover_every_coefficient_once():
    for n in (3, 13, 200, 36_000):
        edges = band_edges(n)
        assert edges[0] == 0
        assert edges[-1] == n
        assert np.all(np.diff(edges) > 0)


def test_every_update_raises_the_likelihood():
    rng = np.random.default_rng(1)
    edges = band_edges(4000)
    counts, phi = np.diff(edges).astype(float), shapes(band_frequencies(edges, 4000), 4000)
    powers = rng.gamma(counts / 2, 2 / counts) * (1.0 + 20.0 * phi[2])
    a = start(phi, counts, powers)
    scores = [whittle(counts, powers, update(a, phi, counts, powers, 1)) for _ in range(30)]
    assert np.all(np.diff(scores) > -1e-9 * np.abs(scores[0]))


def test_white_noise_comes_out_white():
    edges = band_edges(4000)
    counts, phi = np.diff(edges).astype(float), shapes(band_frequencies(edges, 4000), 4000)
    powers = np.full(len(counts), 3.0)
    a = start(phi, counts, powers)
    np.testing.assert_allclose(update(a, phi, counts, powers, 300), powers, rtol=0.05)
