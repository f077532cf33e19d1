"""A thermal lag on the simulation's own surface: where it comes from, what it names, and what it becomes live."""

import msgspec
import numpy as np
import pytest
from diagnose_cases import lag_effect, recording

from rtcomp.compensator import predict
from rtcomp.model import Term, new_model
from training.diagnose.intervals import Estimates
from training.diagnose.measured import left_by_model, sized
from training.diagnose.pipeline import analyse
from training.diagnose.refit import as_one_lag
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation
from training.diagnose.surface import RATE_ORDER, fit_surface
from training.diagnose.verdict import conclude
from training.effects.catalogue import catalogue
from training.effects.truth import Truth
from training.simulator.run import simulate
from training.simulator.scenario import load_scenario


def bent(temp, rate):
    """An error whose slope over temperature changes with temperature and rate [dps]."""
    h = temp - 25.0
    return rate * (-1.2e-3 * h + 4e-6 * h**2) + 2e-9 * h * rate**3 + 3e-4 * h


def rows(seed=1, noise=0.0):
    rng = np.random.default_rng(seed)
    temp, rate = rng.uniform(-20.0, 50.0, 4000), rng.uniform(-60.0, 60.0, 4000)
    return np.stack([temp, rate, bent(temp, rate) + rng.normal(0.0, noise, 4000)])


def test_a_surface_is_found_again_and_gives_its_slope():
    surface = fit_surface([rows(1), rows(2)])
    assert surface is not None
    temp, rate = np.linspace(-15.0, 45.0, 50), np.linspace(-55.0, 55.0, 50)
    again = np.sum(surface.over_temperature(temp) * surface.powers(rate), axis=0)
    assert np.allclose(again, bent(temp, rate), atol=1e-6)
    assert surface.powers(rate).shape == (RATE_ORDER + 1, 50)
    assert surface.slope_ppm_per_K == pytest.approx(-1200.0 + 2.0 * 4.0 * -10.0, rel=0.02)


def test_what_is_no_surface_over_temperature_is_none():
    static = rows()
    static[2] = 0.01 * static[1]
    assert fit_surface([static]) is None
    assert fit_surface([rows(noise=1.0)]) is None
    assert fit_surface([np.empty((3, 0))]) is None


def test_the_live_term_is_the_surface_at_another_temperature():
    surface = fit_surface([rows()])
    assert surface is not None
    rate = np.random.default_rng(3).uniform(-20.0, 20.0, 500)
    p = surface.term(1.0, rate)
    h, coil = 10.0 - 25.0, 4.0 - 25.0
    bend = p["scale2_ppm_per_K2"] * (coil + h) + p["scale3_ppm_per_K3"] * (coil**2 + coil * h + h**2)
    term = (1e-6 * (p["scale_ppm_per_K"] + bend) * rate + p["bias_dps_per_K"]) * (coil - h)
    assert np.max(np.abs(term - (bent(4.0, rate) - bent(10.0, rate)))) < 2e-3  # of 0.16 °/s


def test_a_bent_lag_is_the_same_in_the_catalogue_and_in_the_compensator():
    t = np.arange(0.0, 3000.0)
    temp, rate = -20.0 + 0.02 * np.minimum(t, 2000.0), 30.0 * np.sin(t / 50.0)
    given = {"tau_s": 280.0, "scale_ppm_per_K": -1200.0, "scale2_ppm_per_K2": 4.0, "scale3_ppm_per_K3": -0.05}
    truth = Truth(t_s=t, rate_dps=rate, temp_degC=temp)
    wanted = catalogue()["thermal_lag"].error(truth, given)
    model = new_model(terms=[{"effect": "thermal_lag", "parameters": given}])
    got = predict(model, rate, temp, t).error_dps
    assert np.std(wanted) > 0.1
    assert np.allclose(got, wanted, atol=1e-9)


@pytest.fixture(scope="module")
def omission():
    """The paper's omission, simulated: two cold-start drives against the soaked gyro, at a fifth of the rate."""
    scenario = msgspec.structs.replace(load_scenario("paper_omission"), rate_hz=4.0)
    seen, unseen = (simulate(msgspec.structs.replace(scenario, seed=seed)) for seed in (1, 2))
    return conclude(analyse([seen], [unseen], Simulation("column"), Settings(surrogates=24)))


def test_the_papers_omission_is_lag_and_shupe(omission):
    lag, shupe = omission.findings
    assert (lag.effect, lag.status) == ("thermal_lag", "named")
    assert lag.alternatives == ["thermal_lag"]  # the bend of the surface tells it from its twin
    low, high = lag.parameters["tau_s"].ci95
    assert low < 280.0 < high
    assert high - low < 20.0
    assert shupe.effect == "shupe"
    assert shupe.parameters["c1_dps_s_per_K"].value == pytest.approx(4.0 / 60.0, rel=0.2)
    assert "Shupe" in omission.sentence


def test_the_omission_is_proved_on_the_other_drive(omission):
    assert omission.fit.heldout
    slow = omission.fit.slow
    assert slow["rms_after_dps"] < 0.05 * slow["rms_before_dps"]


def test_the_simulated_rate_of_a_model_is_that_of_the_true_rate():
    model = new_model(terms=[{"effect": "scale_error", "parameters": {"ppm": 50_000.0}}])
    true = np.linspace(-100.0, 100.0, 11)
    columns = {
        "ref_rate_dps": true,
        "rate_dps": true + 7.0,
        "temp_degC": np.full(11, 20.0),
        "t_s": np.arange(11.0),
    }
    got = Simulation("model", model=model).rate("x", columns, False, True)
    assert np.allclose(
        got - predict(model, got, columns["temp_degC"], columns["t_s"]).error_dps, true, atol=1e-3
    )


def test_on_a_straight_surface_a_lag_keeps_its_twin():
    case = recording(12, lag_effect)
    temp, rate = case.columns["temp_degC"], case.columns["ref_rate_dps"]
    straight = 40e-6 * rate * (temp - 25.0)
    case.columns["sim_rate_dps"] = rate + straight
    case.columns["rate_dps"] = case.columns["rate_dps"] + straight
    found = conclude(analyse([case], [], Simulation("column"), Settings(surrogates=16)))
    assert found.findings[0].alternatives == ["thermal_lag", "scale_temperature_rate"]


def test_a_terms_amplitudes_are_sized_and_its_shape_is_not():
    lag = sized(
        Term("thermal_lag", {"tau_s": 280.0, "scale_ppm_per_K": -1000.0, "scale2_ppm_per_K2": 4.0}), 0.5
    )
    assert lag.parameters == {"tau_s": 280.0, "scale_ppm_per_K": -500.0, "scale2_ppm_per_K2": 2.0}
    free = {"driver": "rate", "knots": [0.0, 1.0], "values": [2.0, 4.0]}
    assert sized(Term("unknown", free), 0.5).parameters == free | {"values": [1.0, 2.0]}


def test_a_model_takes_its_slope_of_every_error_it_does_not_know():
    case = recording(12, lambda t, rate, temp: 0.05 * np.sign(rate))
    model = new_model(terms=[{"effect": "scale_error", "parameters": {"ppm": 100_000.0}}])
    case.columns["rate_dps"] = case.columns["rate_dps"] + case.columns["ref_rate_dps"] / 9.0
    intake = analyse([case], [], Simulation("model", model=model), Settings(surrogates=16)).intakes[0]
    assert left_by_model(model, [intake], True) == pytest.approx(0.9, abs=0.01)


def test_two_poles_are_told_as_the_lag_they_are_on_a_slow_ramp():
    names = [(0, 0, "scale_ppm_per_K"), (0, 1, "scale_ppm_per_K"), (0, 0, "tau_s"), (0, 1, "tau_s")]
    values = np.array([-900.0, -100.0, 300.0, 100.0])
    covariance = np.diag([400.0, 400.0, 25.0, 25.0])
    covariance[0, 1] = covariance[1, 0] = -390.0  # known together, hardly apart
    told = as_one_lag(
        0, Estimates(names, values, covariance, np.full(4, 1000.0)), {"scale_ppm_per_K": "ppm/K"}
    )
    assert told["scale_ppm_per_K"].value == -1000.0
    assert told["tau_s"].value == pytest.approx(280.0)
    low, high = told["scale_ppm_per_K"].ci95
    assert high - low < 50.0  # the shape to a percent makes 39; of one pole alone the noise makes 90
