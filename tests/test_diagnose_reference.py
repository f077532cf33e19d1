"""The reference's own noise: measured where the motion is smooth, and out of the regressors."""

import numpy as np
import pytest
from diagnose_cases import profile, recording

from training.diagnose.orders import without_orders
from training.diagnose.reference import cleared, reference, settled, standstills, unbiased
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation


def noisy(seed: int, reference_dps: float, gyro_dps: float):
    """(t, true rate, reference with noise, residual) of a table that steps every 50 s."""
    rng = np.random.default_rng(seed)
    t, rate, _ = profile()
    nu = reference_dps * rng.standard_normal(len(t))
    return t, rate, rate + nu, gyro_dps * rng.standard_normal(len(t)) - nu


@pytest.mark.parametrize(
    ("reference_dps", "gyro_dps", "within"), [(0.02, 0.004, 0.06), (0.004, 0.004, 0.06), (0.003, 0.02, 0.25)]
)
def test_the_references_noise_is_measured_though_the_rate_steps(reference_dps, gyro_dps, within):
    t, _, ref, residual = noisy(1, reference_dps, gyro_dps)
    assert reference(t, ref, residual).noise_dps == pytest.approx(reference_dps, rel=within)


def test_a_rate_is_averaged_where_it_stands_and_kept_where_it_moves():
    t, rate, ref, _ = noisy(6, 0.02, 0.004)
    found = settled(ref)
    step = np.abs(np.diff(rate, prepend=rate[0])) > 0.0
    away = np.convolve(step, np.ones(41), mode="same") < 0.5
    assert np.std((found - rate)[away]) < 0.25 * 0.02
    assert np.max(np.abs(found - rate)) < 0.1
    swing = 30.0 * np.sin(2.0 * np.pi * t / 20.0) + (ref - rate)
    assert np.std(settled(swing) - (swing - (ref - rate))) < 1.05 * 0.02


def test_only_a_standstill_at_zero_is_zero():
    rng = np.random.default_rng(7)
    rate = np.repeat([0.0, 5.0, 0.0, 0.3, 0.0], [400, 300, 60, 400, 30])
    rate[-30:] = np.linspace(0.0, 40.0, 30)
    known = standstills(rate + 0.02 * rng.standard_normal(len(rate)), 0.02)
    assert known[10:390].all()
    assert known[710:750].all()
    assert not known[410:690].any()
    assert not known[770:].any()
    t = np.arange(0.0, 600.0, 0.1)
    creep = 0.3 * np.sin(2.0 * np.pi * t / 200.0)
    assert standstills(creep + 0.02 * rng.standard_normal(len(t)), 0.02).mean() < 0.02


def test_the_slope_is_weighed_against_the_noise_of_the_reference():
    t = np.arange(0.0, 600.0, 0.1)
    nu = 0.02 * np.random.default_rng(8).standard_normal(len(t))
    slow, fast = (
        reference(t, a * np.sin(2.0 * np.pi * t / p) + nu, -nu) for a, p in ((0.4, 240.0), (40.0, 24.0))
    )
    assert slow.slope_to_noise() < 3.0
    assert fast.slope_to_noise() > 30.0
    assert reference(t, np.sin(t), np.random.default_rng(9).standard_normal(len(t))).slope_to_noise() > 30.0


def test_a_reference_whose_noise_the_residual_does_not_show_has_none():
    t, rate, ref, _ = noisy(2, 0.02, 0.004)
    other = 0.004 * np.random.default_rng(3).standard_normal(len(t))
    assert reference(t, ref, other).noise_dps < 2e-3
    assert reference(t, rate, other).noise_dps < 1e-3


def test_the_corrected_reference_errs_independently_of_the_residual():
    t, rate, ref, residual = noisy(4, 0.02, 0.008)
    corrected = unbiased(reference(t, ref, residual), residual, np.zeros(len(t)))
    quiet = np.abs(np.diff(rate, prepend=rate[0])) == 0.0
    raw = np.corrcoef((ref - rate)[quiet], residual[quiet])[0, 1]
    left = np.corrcoef((corrected.rate - rate)[quiet], residual[quiet])[0, 1]
    assert raw < -0.9
    assert abs(left) < 0.1  # as well as the noise itself is known


def test_clearing_takes_static_errors_and_leaves_a_delay():
    t, rate, temp = profile()
    smooth = np.convolve(rate, np.hanning(41) / np.hanning(41).sum(), mode="same")
    late = -0.02 * np.gradient(smooth, t)
    static = 0.05 * smooth + 1e-7 * smooth**3 + 4e-5 * smooth * (temp - 25.0)
    every = np.ones(len(t), dtype=bool)
    left, gain = cleared(late + static, t, smooth, temp, every)
    assert np.std(left - late) < 0.02 * np.std(late)
    assert np.median(gain) == pytest.approx(0.05, abs=0.01)


def test_harmonics_of_the_heading_are_taken_out_and_noise_is_not():
    t, rate, _ = profile()
    psi = np.deg2rad(np.concatenate([[0.0], np.cumsum(0.25 * (rate[1:] + rate[:-1]))]))
    noise = 0.004 * np.random.default_rng(5).standard_normal(len(t))
    columns, every = {"t_s": t}, np.ones(len(t), dtype=bool)
    wave = 2e-4 * rate * np.sin(7.0 * psi)
    assert np.std(without_orders(noise + wave, rate, columns, every) - noise) < 0.1 * np.std(wave)
    np.testing.assert_array_equal(without_orders(noise, rate, columns, every), noise)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_a_noisy_reference_alone_is_no_finding(seed):
    from training.diagnose.pipeline import analyse
    from training.diagnose.verdict import conclude

    case = recording(30 + seed)
    rng = np.random.default_rng(60 + seed)
    case.columns["ref_rate_dps"] = case.columns["ref_rate_dps"] + 0.02 * rng.standard_normal(
        len(case.columns["t_s"])
    )
    found = conclude(analyse([case], [], Simulation("ideal"), Settings(surrogates=24)))
    assert (found.verdict, found.findings) == ("nothing_missing", [])
