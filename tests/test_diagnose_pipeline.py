import numpy as np
import pytest
from diagnose_cases import lag_effect, lagged, profile, recording
from scipy.interpolate import CubicSpline

from rtcomp.errors import RequestError
from training.diagnose.classes import walked_back
from training.diagnose.pipeline import analyse
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation
from training.diagnose.verdict import conclude
from training.table import Recording

QUICK = Settings(surrogates=16)


def diagnose(*recordings, heldout=(), settings=QUICK):
    return conclude(analyse(list(recordings), list(heldout), Simulation("ideal"), settings))


def test_noise_alone_says_nothing_and_tells_what_it_could_have_seen():
    found = diagnose(recording(11))
    assert found.verdict == "nothing_missing"
    assert not found.findings
    assert found.visible_from["thermal_lag"] > 0.0


def test_a_planted_lag_is_found_in_its_class_and_its_parameters_are_covered():
    found = diagnose(recording(12, lag_effect), heldout=[recording(13, lag_effect)])
    first = found.findings[0]
    assert (found.verdict, first.effect) == ("ambiguous", "thermal_lag")
    assert first.alternatives == ["thermal_lag", "scale_temperature_rate"]
    assert "coil" in (first.separate_by or "")
    assert first.parameters["tau_s"].ci95[0] < 200.0 < first.parameters["tau_s"].ci95[1]
    assert abs(first.parameters["scale_ppm_per_K"].value / 40.0 - 1.0) < 0.15
    assert found.fit.heldout
    assert found.fit.rms_after_dps < found.fit.rms_before_dps
    assert (
        found.fit.improvement > 10 * abs(found.fit.placebo_improvement or 0.0) or found.fit.improvement > 0.2
    )


def test_a_sensor_at_the_coil_tells_a_lag_from_its_twin():
    case = recording(12, lag_effect)
    coil = lagged(case.columns["temp_degC"], 200.0)
    case.columns["coil_temp_degC"] = coil + np.random.default_rng(1).normal(0.0, 0.01, len(coil))
    first = diagnose(case).findings[0]
    assert (first.effect, first.status) == ("thermal_lag", "named")
    assert first.parameters["coil_tau_s"].value == pytest.approx(200.0, rel=0.15)


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        (lambda t, w, temp: 3e-4 * np.abs(w), "scale_asymmetry"),
        (lambda t, w, temp: 2e-3 * np.sin(2 * np.pi * temp / 11.0), "polarization_ripple"),
        (lambda t, w, temp: 20e-6 * w * (temp - 25), "scale_temperature"),
        (lambda t, w, temp: 0.01 * (t > 3000.0), "bias_step"),
    ],
)
def test_planted_effects_are_named(effect, name):
    assert diagnose(recording(14, effect)).findings[0].effect == name


def test_a_step_is_placed_where_it_is():
    first = diagnose(recording(15, lambda t, w, temp: 0.02 * (t > 2000.0))).findings[0]
    assert abs(first.parameters["t0_s"].value - 2000.0) < 5.0
    low, high = first.parameters["step_dps"].ci95
    assert low < 0.02 < high


def test_a_delay_is_measured_and_not_taken_for_physics():
    t, rate, _ = profile()
    smooth_rate = np.convolve(rate, np.hanning(41) / np.hanning(41).sum(), mode="same")
    late = CubicSpline(t, smooth_rate)(t - 0.12)
    case = recording(16)
    quiet = case.columns["rate_dps"] - rate
    case.columns.update(ref_rate_dps=smooth_rate, rate_dps=late + quiet)
    found = diagnose(case)
    assert found.findings[0].effect in ("timestamp_skew", "bandwidth")
    assert "timestamp_skew" in found.findings[0].alternatives


def test_what_no_entry_carries_is_unknown_with_its_driver():
    found = diagnose(recording(17, lambda t, w, temp: 1.5e-3 * w / 60 * np.tanh((temp - 18.0) / 0.8)))
    assert found.verdict == "unknown"
    assert found.findings[0].driver == "rate_times_temperature"


def test_constant_temperature_is_not_excited():
    case = recording(18)
    case.columns["temp_degC"] = np.full_like(case.columns["t_s"], 25.0)
    found = diagnose(case)
    assert found.verdict == "not_excited"
    assert "thermal_lag" in {row.effect for row in found.not_excited}


def test_soaked_points_without_time_are_diagnosed():
    rng = np.random.default_rng(19)
    temp = np.repeat(np.arange(-20.0, 50.0, 10.0), 24)
    rate = np.tile(np.linspace(-150.0, 150.0, 24), 7)
    soak = np.repeat(200e-6 * rng.standard_normal(7), 24)
    noisy = rate * (1 + soak) + 0.005 * rng.standard_normal(len(rate))

    def case(measured):
        return Recording("points", {"rate_dps": measured, "ref_rate_dps": rate, "temp_degC": temp})

    assert diagnose(case(noisy)).verdict == "nothing_missing"
    first = diagnose(case(noisy + 4e-4 * np.abs(rate))).findings[0]
    assert first.effect == "scale_asymmetry"
    assert first.parameters["c_ppm"].ci95[0] < 400.0 < first.parameters["c_ppm"].ci95[1]


def test_leaving_the_true_entry_out_never_names_it():
    found = diagnose(
        recording(12, lag_effect), settings=Settings(surrogates=16, left_out=frozenset({"thermal_lag"}))
    )
    assert all("thermal_lag" not in f.alternatives for f in found.findings)
    assert found.findings


def test_without_a_truth_it_is_refused():
    case = recording(20)
    del case.columns["ref_rate_dps"]
    with pytest.raises(RequestError, match="ref_rate_dps"):
        diagnose(case)


def test_static_recordings_need_no_reference():
    case = recording(21, lambda t, w, temp: 8e-4 * (temp - 25), static=True)
    del case.columns["ref_rate_dps"]
    found = diagnose(case, settings=Settings(static=True, surrogates=16))
    assert "bias_temperature" in found.findings[0].alternatives


def test_the_same_input_gives_the_same_document():
    assert diagnose(recording(22, lag_effect)) == diagnose(recording(22, lag_effect))


def played(temp, half_width_K):
    """The play operator, slow and obvious."""
    out = np.empty_like(temp)
    state = temp[0]
    for i, now in enumerate(temp):
        state = min(max(state, now - half_width_K), now + half_width_K)
        out[i] = state
    return out


def test_a_loop_walked_on_one_side_only_is_not_told_from_a_bent_line():
    def loop(t, rate, temp):
        return 0.01 * (played(temp, 4.0) - temp)

    [both] = diagnose(recording(61, loop, static=True)).findings
    assert both.alternatives == ["bias_hysteresis"]
    t, rate, temp = profile(static=True)
    rising = 20.0 + 35.0 * t / t[-1]
    error = recording(62, static=True)["rate_dps"]
    columns = {"t_s": t, "temp_degC": rising, "ref_rate_dps": rate}
    once = Recording("rising", {**columns, "rate_dps": rate + error + loop(t, rate, rising)})
    found = [set(f.alternatives) for f in diagnose(once).findings]
    assert found
    assert all("bias_temperature" in names for names in found if "bias_hysteresis" in names)
    assert walked_back([rising, temp], 4.0)
    assert not walked_back([rising], 4.0)
