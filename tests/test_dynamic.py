"""Dynamic terms: a planted lag is found and proved on another history; noise and drift claim nothing."""

import numpy as np
import pytest

from rtcomp.compensator import predict
from training.branches import compare
from training.dynamic import branches, fit_dynamic
from training.gk import Settings
from training.inputs import check, lagged
from training.table import Recording
from training.ts import TsOptions

OPTIONS = TsOptions(rules=2, clustering=Settings(starts=1))
T_S = np.arange(0.0, 4000.0, 5.0)
CYCLE = 20 + 35 * np.cos(T_S / 500)


def still(extra, temp=CYCLE, noise=0.01, seed=0):
    """A gyro at rest whose bias is quadratic in temperature, plus `extra` [°/s]."""
    rng = np.random.default_rng(seed)
    rate = 0.5 + 4e-3 * temp + 2e-4 * temp**2 + extra + noise * rng.standard_normal(len(T_S))
    return check(Recording("still", {"t_s": T_S, "rate_dps": rate, "temp_degC": temp}), static=True)


def test_low_pass_of_a_ramp_lags_by_tau():
    t = np.arange(0.0, 3000.0, 7.0)
    np.testing.assert_allclose(t - lagged(t, t, 200.0), 200.0 * (1 - np.exp(-t / 200.0)), rtol=1e-9)


def test_a_planted_lag_is_found_and_holds_on_another_history():
    lag = lagged(CYCLE, T_S, 300.0) - CYCLE
    found = fit_dynamic([still(0.02 * lag)], options=OPTIONS)
    assert found.claimed
    assert found.tau_s == pytest.approx(300, rel=0.25)
    other = 10 + 25 * np.sin(T_S / 300)
    test = still(0.02 * (lagged(other, T_S, 300.0) - other), other, seed=1)
    given = predict(found.model, test.recording["rate_dps"], other, T_S)
    inside = (other > CYCLE.min()) & (other < CYCLE.max())
    assert np.std((test.error_dps - given.error_dps)[inside]) < 0.03
    assert found.model.terms[0].effect == "thermal_lag"


def test_a_turning_gyro_gives_the_lag_of_its_scale_factor():
    rate = 60 * np.sin(T_S / 37)
    lag = lagged(CYCLE, T_S, 250.0) - CYCLE
    error = 1e-3 * rate * lag + 0.01 * np.random.default_rng(0).standard_normal(len(T_S))
    columns = {"t_s": T_S, "rate_dps": rate + error, "temp_degC": CYCLE, "ref_rate_dps": rate}
    found = fit_dynamic([check(Recording("turning", columns))], options=OPTIONS)
    assert found.claimed
    assert found.model.terms[0].parameters["scale_ppm_per_K"] == pytest.approx(1000, rel=0.1)


def test_noise_claims_nothing():
    found = fit_dynamic([still(0.0)], options=OPTIONS)
    assert not found.claimed
    assert not found.model.terms


def test_a_drift_in_time_claims_nothing():
    found = fit_dynamic([still(1e-4 * T_S)], options=OPTIONS)
    assert not found.claimed
    assert "drift in time" in found.sentence


def test_branches_of_a_cycle():
    temp = np.concatenate(
        [np.linspace(50, -20, 70), np.linspace(-20, 70, 90)[1:], np.linspace(70, 30, 40)[1:]]
    )
    parts = branches(temp)
    assert np.all(np.diff(parts) >= 0)
    assert temp[parts == 1].max() == 70
    assert set(parts) == {0, 1, 2}


@pytest.mark.slow
def test_real_chamber_across_branches(recordings):
    from training.branches import chamber

    told = chamber(recordings / "tofupilot_mems_chamber.csv.gz", lambda doing: None)
    assert told["x"]["dynamic_better_than_cubic"] >= 1.5
    assert told["y"]["dynamic_better_than_cubic"] >= 1.8
    assert told["x"]["claimed"]
    assert told["y"]["claimed"]
    assert not told["z"]["claimed"]


def test_comparison_tests_only_what_was_not_trained_on():
    lag = lagged(CYCLE, T_S, 300.0) - CYCLE
    told = compare([still(0.02 * lag)], [T_S < 2500])
    assert told["rms_dps"]["ts_dynamic"] < told["rms_dps"]["ts_static"]
    assert told["claimed"]


@pytest.mark.slow
def test_simulated_drives_prefer_the_lag():
    from training.branches import drives

    told = drives(lambda doing: None)
    assert told["rms_dps"]["ts_dynamic"] < 0.3 * told["rms_dps"]["ts_static"]
    assert told["filters_rms_dps"]["wavelet"] > 0.9 * told["rms_dps"]["uncompensated"]
