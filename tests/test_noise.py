import allantools
import numpy as np
import pytest
from scipy.signal import welch

from training.effects.catalogue import effect
from training.effects.noise import flicker, gyro_noise, psd, random_walk, white
from training.effects.truth import Truth

N, B, R = 0.05, 0.5, 1.0  # °/√h, °/h, °/h/√h


def allan(rate_dps, dt_s, taus_s):
    """Return the overlapping Allan deviation [°/s] by an independent package."""
    found, deviation, _, _ = allantools.oadev(rate_dps, rate=1 / dt_s, data_type="freq", taus=taus_s)
    assert np.allclose(found, taus_s)
    return deviation


def test_angle_random_walk_falls_as_one_over_root_tau():
    n, dt = 200_000, 0.01
    deviation = allan(white(n, dt, N, np.random.default_rng(1)), dt, [0.1, 1.0, 10.0])
    np.testing.assert_allclose(deviation, N / 60 / np.sqrt([0.1, 1.0, 10.0]), rtol=0.12)


def test_bias_instability_is_flat_at_its_level():
    deviation = allan(flicker(2**17, B, np.random.default_rng(2)), 1.0, [30.0, 100.0, 300.0, 1000.0])
    np.testing.assert_allclose(deviation, np.sqrt(2 * np.log(2) / np.pi) * B / 3600, rtol=0.25)


def test_rate_random_walk_rises_as_root_tau():
    n, dt = 2**17, 1.0
    taus = np.array([10.0, 100.0, 1000.0])
    deviation = allan(random_walk(n, dt, R, np.random.default_rng(3)), dt, taus)
    np.testing.assert_allclose(deviation, R / 216000 * np.sqrt(taus / 3), rtol=0.25)


@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_spectrum_of_the_sum_is_the_stated_one(dt):
    n = 2**17
    rate = gyro_noise(n, dt, (N, 20 * B, 300 * R), np.random.default_rng(4))
    f, seen = welch(rate, 1 / dt, nperseg=2**11, detrend="linear")
    for low, high in ((0.01, 0.02), (0.03, 0.06), (0.1, 0.2)):
        band = (f > low / dt) & (f < high / dt)
        assert np.mean(seen[band] / psd(f[band], (N, 20 * B, 300 * R))) == pytest.approx(1.0, abs=0.15)


def test_flicker_does_not_depend_on_the_sampling_interval():
    coarse, fine = (
        allan(flicker(n, B, np.random.default_rng(5)), dt, [64.0]) for n, dt in ((2**16, 1.0), (2**18, 0.25))
    )
    assert coarse[0] == pytest.approx(fine[0], rel=0.2)


def test_an_effect_adds_in_power_and_repeats_with_its_seed():
    t = np.arange(50_000) * 0.1
    truth = Truth(t, np.zeros_like(t), t)
    entry = effect("noise_level")
    first = entry.error(truth, {"arw_deg_rt_h": N}, seed=6)
    assert np.array_equal(first, entry.error(truth, {"arw_deg_rt_h": N}, seed=6))
    both = first + entry.error(truth, {"arw_deg_rt_h": N}, seed=7)
    assert np.var(both) == pytest.approx(2 * (N / 60) ** 2 / 0.1, rel=0.05)


def test_multiplicative_noise_grows_with_the_rate_and_vanishes_at_rest():
    t = np.arange(60_000) * 0.1
    rate = np.repeat([0.0, 30.0, -90.0], 20_000)
    error = effect("multiplicative_noise").error(Truth(t, rate, t), {"sigma_ppm": 500.0}, seed=8)
    spread = error.reshape(3, -1).std(axis=1)
    assert spread[0] == 0.0
    np.testing.assert_allclose(spread[1:], 500e-6 * np.array([30.0, 90.0]), rtol=0.03)
