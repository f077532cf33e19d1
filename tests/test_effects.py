import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import Term, new_model
from rtcomp.terms import TERMS
from training.effects.alias import ALIAS_CLASSES
from training.effects.base import DRIVERS, ErrorEffect, FrameEffect, OutputEffect, TimingEffect
from training.effects.catalogue import alias_class, catalogue, effect
from training.effects.truth import Truth
from training.effects.units import DEG_PER_H, EARTH_RATE_DPS

PHYSICS_IDS = """
bias_temperature shupe thermal_lag bias_hysteresis polarization_ripple scale_temperature
scale_nonlinearity scale_hysteresis scale_temperature_rate scale_asymmetry source_ageing
multiplicative_noise dead_band saturation bandwidth quantization supply_ripple timestamp_skew
clock_drift timing_jitter frozen_frames dropped_frames counter_wrap unit_error
compensation_table auto_zero bias_warmup scale_warmup noise_level bias_step scale_step
bias_drift acceleration vibration_rectification misalignment earth_rate magnetic
table_eccentricity scale_error bias_error
"""

ALL = list(catalogue().values())
ADDING = [entry for entry in ALL if isinstance(entry, ErrorEffect)]
RUNTIME = [entry for entry in ALL if entry.id in TERMS]


def by_id(entry):
    return entry.id


def course(n=3000, dt=1.0):
    """Return an hour of turning and of rising, falling and wandering temperature, every driver excited."""
    t = np.arange(n) * dt
    rate = 60.0 * np.sin(t / 37.0) + 15.0 * np.sin(t / 5.3)
    temp = 20.0 + 25.0 * np.sin(t / 700.0) + 3.0 * np.sin(t / 90.0)
    heading = np.cumsum(rate) * dt
    speed = 8.0 + 6.0 * np.sin(t / 200.0)
    vibration = 0.2 + 0.05 * speed
    return Truth(t, rate, temp, temp - 1.0, heading, speed, speed * np.radians(rate), vibration)


def ramp(slope, n=2000, dt=1.0):
    t = np.arange(n) * dt
    return Truth(t, np.full(n, 50.0), 10.0 + slope * t)


def loop(period_s, dt=1.0):
    """Return three closed temperature loops of ±20 K at zero rate, the first of which settles the play."""
    t = np.arange(round(3 * period_s / dt)) * dt
    return Truth(t, np.zeros_like(t), 20.0 * np.sin(2 * np.pi * t / period_s))


def loop_area(error, truth, period_s):
    last = truth.t_s >= 2 * period_s
    return np.trapezoid(error[last], truth.temp_degC[last])


def test_every_id_of_the_physics_table_is_there_and_no_other():
    assert sorted(catalogue()) == sorted(PHYSICS_IDS.split())


@pytest.mark.parametrize("entry", ALL, ids=by_id)
def test_metadata_is_complete(entry):
    assert catalogue()[entry.id] is entry
    for text in (entry.title, entry.section, entry.equation, entry.excitation, entry.source, entry.mechanism):
        assert text.strip()
    assert set(entry.drivers) <= set(DRIVERS)
    assert all(parameter.unit for parameter in entry.parameters.values())
    for case in (entry.nominal(), entry.hard()):
        assert vars(entry.complete(case)) == case


def test_alias_classes_name_known_effects_and_an_experiment():
    assert [alias.id for alias in ALIAS_CLASSES[:10]] == [f"H{k}" for k in range(1, 11)]
    for alias in ALIAS_CLASSES:
        assert set(alias.members) <= set(catalogue())
        assert alias.separate_by
    assert {alias.id for alias in alias_class("thermal_lag")} == {"H1", "H2"}


def test_parameters_unknown_missing_or_not_finite_are_refused():
    lag = effect("thermal_lag")
    for wrong in ({"tau_s": 1.0, "tau": 2.0}, {"scale_ppm_per_K": 1.0}, {"tau_s": float("nan")}):
        with pytest.raises(RequestError, match="thermal_lag"):
            lag.complete(wrong)
    with pytest.raises(RequestError, match="no effect 'lag'"):
        effect("lag")


@pytest.mark.parametrize("entry", ADDING, ids=by_id)
def test_error_is_proportional_to_its_linear_parameters(entry):
    truth = course()
    linear = {name for name, parameter in entry.parameters.items() if parameter.linear}
    once = entry.error(truth, entry.hard())
    twice = entry.error(
        truth, {name: value * (2 if name in linear else 1) for name, value in entry.hard().items()}
    )
    assert np.any(once)
    if linear:
        np.testing.assert_allclose(twice, 2 * once, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("entry", ADDING, ids=by_id)
def test_an_effect_leaves_the_truth_alone(entry):
    truth, untouched = course(), course()
    entry.error(truth, entry.hard())
    for name in ("t_s", "rate_dps", "temp_degC", "heading_deg", "speed_mps"):
        assert np.array_equal(getattr(truth, name), getattr(untouched, name))


@pytest.mark.parametrize("entry", RUNTIME, ids=by_id)
def test_runtime_correction_equals_the_effect(entry):
    """The compiled step, given the true rate, predicts what the catalogue adds: two codes, one equation."""
    truth = course()
    shown = truth.rate_dps
    if isinstance(entry, OutputEffect):  # the runtime sees the measured rate
        shown = entry.apply(truth.rate_dps, truth, entry.hard())
    model = new_model(terms=[Term(entry.id, dict(entry.hard()))])
    predicted = predict(model, shown, truth.temp_degC, truth.t_s).error_dps
    expected = entry.error(truth, entry.hard())
    np.testing.assert_allclose(predicted, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_lag_on_a_ramp_is_the_analytic_exponential():
    truth, tau = ramp(1 / 60), 280.0
    error = effect("thermal_lag").error(truth, {"tau_s": tau, "scale_ppm_per_K": -1263.0})
    behind = -tau / 60 * (1 - np.exp(-truth.t_s / tau))
    np.testing.assert_allclose(error, 50.0 * -1263e-6 * behind, rtol=1e-9)
    # PHYSICS A3: 1.06 °/s at 180 °/s for 1 K/min and 280 s
    assert np.abs(error[-1]) * 180 / 50 == pytest.approx(1.06, abs=0.01)


def test_lag_does_not_depend_on_the_sampling_of_a_ramp():
    fine, tau = ramp(1 / 60), 300.0
    rows = np.sort(np.random.default_rng(1).choice(fine.t_s.size, 200, replace=False))
    rows[0] = 0
    coarse = Truth(fine.t_s[rows], fine.rate_dps[rows], fine.temp_degC[rows])
    np.testing.assert_allclose(coarse.lagged_temp(tau), fine.lagged_temp(tau)[rows], rtol=1e-12)


def test_two_pole_lag_settles_at_the_sum_of_both():
    truth = ramp(1 / 60, n=20000)
    error = effect("thermal_lag").error(truth, {"tau_s": 280.0, "tau2_s": 120.0, "bias_dps_per_K": 1.0})
    assert error[-1] == pytest.approx(-(280.0 + 120.0) / 60, rel=1e-6)


def test_shupe_on_a_ramp_has_a_plateau_and_a_decaying_spike():
    truth, tau, slope = ramp(1 / 60), 150.0, 1 / 60
    steady = effect("shupe").error(truth, {"tau_s": tau, "c1_dps_s_per_K": 2.0})
    change = effect("shupe").error(truth, {"tau_s": tau, "c2_dps_s2_per_K": 2.0})
    decay = np.exp(-truth.t_s / tau)
    np.testing.assert_allclose(steady, 2.0 * slope * (1 - decay), atol=1e-9)
    np.testing.assert_allclose(change[1:], 2.0 * slope / tau * decay[1:], atol=1e-9)


def test_hysteresis_loop_area_does_not_depend_on_ramp_speed_and_lag_does():
    areas = {}
    for period in (600.0, 2400.0, 19200.0):
        truth = loop(period)
        play = effect("bias_hysteresis").error(truth, {"play_K": 4.0, "c_dps_per_K": 1.0})
        lag = effect("thermal_lag").error(truth, {"tau_s": 60.0, "bias_dps_per_K": 1.0})
        areas[period] = loop_area(play, truth, period), loop_area(lag, truth, period)
    plays, lags = zip(*areas.values(), strict=True)
    # a play of half width r over an amplitude A encloses 4r(A − r); 0.3 % is the area between samples
    np.testing.assert_allclose(np.abs(plays), 4 * 4.0 * (20.0 - 4.0), rtol=5e-3)
    assert abs(lags[0]) > 2 * abs(lags[1]) > 10 * abs(lags[2])


def test_hysteresis_remembers_the_path_and_not_the_time():
    truth = course()
    slow = Truth(truth.t_s * 7.0, truth.rate_dps, truth.temp_degC)
    for name in ("bias_hysteresis", "scale_hysteresis"):
        entry = effect(name)
        assert np.array_equal(entry.error(truth, entry.hard()), entry.error(slow, entry.hard()))


@pytest.mark.parametrize("name", ["shupe", "thermal_lag", "scale_temperature_rate"])
def test_dynamics_vanish_on_soaked_points(name):
    truth = course()
    soaked = Truth(truth.t_s, truth.rate_dps, truth.temp_degC, soaked=True)
    entry = effect(name)
    assert not np.any(entry.error(soaked, entry.hard()))


def test_cubic_and_quintic_are_the_series_of_the_sine():
    rate = np.linspace(-180, 180, 361)
    truth = Truth(np.arange(rate.size), rate, np.full(rate.size, 25.0))
    K = 0.178
    sine = np.degrees(np.sin(K * np.radians(rate))) / K - rate
    k = K * np.pi / 180
    series = effect("scale_nonlinearity").error(
        truth, {"c3_per_dps2": -(k**2) / 6, "c5_per_dps4": k**4 / 120}
    )
    assert np.abs(series - sine).max() < 180 * (k * 180) ** 6 / 5040  # the first term left out
    assert sine[-1] == pytest.approx(-9.2, abs=0.1)  # PHYSICS B2


def test_asymmetry_is_even_and_everything_else_of_the_scale_factor_is_odd():
    truth = course()
    mirrored = Truth(truth.t_s, -truth.rate_dps, truth.temp_degC)
    for entry in ADDING:
        if entry.section in ("B1", "B2", "B3", "B4", "B5", "B6", "E2"):
            sign = 1.0 if entry.id == "scale_asymmetry" else -1.0
            expected = sign * entry.error(truth, entry.hard())
            np.testing.assert_allclose(entry.error(mirrored, entry.hard()), expected, rtol=1e-12)


def test_ripple_repeats_with_its_period_and_so_does_the_table():
    temp = np.linspace(-20.0, 40.0, 601)
    truth = Truth(np.arange(601.0), np.zeros(601), temp)
    for name in ("polarization_ripple", "compensation_table"):
        parameters = {**effect(name).nominal(), "period_K": 6.0, "phase_K": 0.03, "chirp_per_K": 0.0}
        parameters = {key: value for key, value in parameters.items() if key in effect(name).parameters}
        error = effect(name).error(truth, parameters)
        np.testing.assert_allclose(error[60:], error[:-60], atol=1e-12)
        assert abs(error.mean()) < 0.02 * np.abs(error).max()


def test_earth_rate_is_known():
    n = 3600
    truth = Truth(np.arange(n), np.ones(n), np.zeros(n), heading_deg=np.arange(n) * 0.1)
    upright = effect("earth_rate").error(truth, {"latitude_deg": 48.0})
    assert upright[0] / DEG_PER_H == pytest.approx(11.18, abs=0.01)  # PHYSICS G5
    tilted = effect("earth_rate").error(truth, {"latitude_deg": 48.0, "tilt_deg": 1.0})
    assert np.ptp(tilted) / 2 / DEG_PER_H == pytest.approx(0.176, abs=0.001)
    pole = effect("earth_rate").error(truth, {"latitude_deg": 90.0})
    assert pole[0] == pytest.approx(EARTH_RATE_DPS)


def test_heading_effects_average_out_over_whole_turns_and_only_eccentricity_scales_with_rate():
    n = 3600
    turning = Truth(np.arange(n), np.full(n, 10.0), np.zeros(n), heading_deg=np.arange(n) * 0.2)
    faster = Truth(np.arange(n), np.full(n, 20.0), np.zeros(n), heading_deg=np.arange(n) * 0.2)
    for name, ratio in (("magnetic", 1.0), ("table_eccentricity", 2.0)):
        error = effect(name).error(turning, effect(name).hard())
        assert abs(error.mean()) < 1e-9 * np.abs(error).max()
        np.testing.assert_allclose(effect(name).error(faster, effect(name).hard()), ratio * error)


def test_a_missing_driver_is_named():
    truth = Truth(np.arange(5.0), np.ones(5), np.zeros(5))
    for name, driver in (("magnetic", "heading_deg"), ("acceleration", "accel_lat_mps2")):
        with pytest.raises(RequestError, match=driver):
            effect(name).error(truth, effect(name).nominal())


@given(rate=st.floats(-50, 50), lock=st.floats(1e-4, 1.0))
def test_dead_band_is_adlers(rate, lock):
    truth = Truth(np.zeros(1), np.array([rate]), np.zeros(1))
    (measured,) = effect("dead_band").apply(truth.rate_dps, truth, {"lock_dps": lock})
    assert measured**2 == pytest.approx(max(rate**2 - lock**2, 0.0), abs=1e-12)
    assert measured * rate >= 0.0


@given(rate=st.floats(-500, 500), limit=st.floats(50, 300), knee=st.floats(0, 40))
def test_saturation_passes_small_rates_and_never_exceeds_its_limit(rate, limit, knee):
    truth = Truth(np.zeros(2), np.array([rate, rate + 1.0]), np.zeros(2))
    low, high = effect("saturation").apply(truth.rate_dps, truth, {"limit_dps": limit, "knee_dps": knee})
    assert abs(low) <= limit * (1 + 1e-12)
    assert high >= low
    if abs(rate) <= limit - knee:
        assert low == rate


@given(rate=st.floats(-300, 300), lsb=st.floats(1e-4, 1.0))
def test_quantization_is_within_half_a_step(rate, lsb):
    truth = Truth(np.zeros(1), np.array([rate]), np.zeros(1))
    (measured,) = effect("quantization").apply(truth.rate_dps, truth, {"lsb_dps": lsb})
    assert abs(measured - rate) <= lsb / 2 * (1 + 1e-9)
    assert measured / lsb == pytest.approx(round(measured / lsb), abs=1e-6)


def test_bandwidth_is_a_butterworth_even_with_a_cut_off_at_half_the_sampling_rate():
    t = np.arange(20000) / 100.0
    for cutoff in (2.0, 50.0):
        wave = np.sin(2 * np.pi * 2.0 * t)
        truth = Truth(t, wave, np.zeros_like(t))
        out = effect("bandwidth").apply(wave, truth, {"cutoff_hz": cutoff})[10000:]
        seen = 2 * np.mean(out * np.exp(-2j * np.pi * 2.0 * t[10000:])) * 1j
        s = 2j * np.pi * 2.0 / (2 * np.pi * cutoff)
        # first-order hold of a sine at 50 samples a period loses 1 − sinc²(1/50) ≈ 1.3e-3 of it
        assert abs(seen - 1 / (1 + np.sqrt(2) * s + s**2)) < 3e-3
    level = np.full(100, 7.0)
    np.testing.assert_allclose(
        effect("bandwidth").error(Truth(t[:100], level, level), {"cutoff_hz": 5.0}), 0, atol=1e-9
    )


def test_skew_and_clock_drift_shift_a_wave_exactly():
    t = np.arange(0, 1000, 0.01)
    wave = Truth(t, 30 * np.sin(2 * np.pi * 0.5 * t), np.zeros_like(t))
    inside = slice(100, -100)
    skew = effect("timestamp_skew").error(wave, {"delay_s": 0.010})
    expected = 30 * np.sin(2 * np.pi * 0.5 * (t - 0.010)) - wave.rate_dps
    np.testing.assert_allclose(skew[inside], expected[inside], atol=1e-6)
    drift = effect("clock_drift").error(wave, {"ppm": 50.0})
    expected = 30 * np.sin(2 * np.pi * 0.5 * t * (1 - 50e-6)) - wave.rate_dps
    np.testing.assert_allclose(drift[inside], expected[inside], atol=1e-6)


def test_a_delay_refuses_time_stamps_that_do_not_rise():
    t = np.array([0.0, 1.0, 1.0, 2.0])
    with pytest.raises(RequestError, match="rise"):
        effect("timestamp_skew").error(Truth(t, t, t), {"delay_s": 0.1})


def test_jitter_scatters_with_the_angular_acceleration():
    t = np.arange(0, 500, 0.01)
    rate = 40 * np.sin(2 * np.pi * 0.3 * t)
    error = effect("timing_jitter").error(Truth(t, rate, t), {"sigma_s": 4e-3}, seed=3)
    # 50 000 samples: the rms is known to 1/√(2n) = 0.3 %
    assert np.std(error) == pytest.approx(4e-3 * np.std(np.gradient(rate, t)), rel=0.02)


def test_auto_zero_learns_its_zero_at_a_stop_and_takes_a_creep_for_one():
    t = np.arange(0, 90, 0.1)
    rate = np.select([t < 10, t < 20, t < 50, t < 60, t < 80], [20.0, 0.0, 20.0, 0.05, 20.0], 0.0)
    error = effect("auto_zero").error(
        Truth(t, rate, t), {"zero_dps": 0.2, "threshold_dps": 0.1, "hold_s": 2.0}
    )
    assert error[t < 19] == pytest.approx(0.2)
    assert error[(t > 21) & (t < 49)] == pytest.approx(0.0, abs=1e-12)
    assert error[(t > 61) & (t < 79)] == pytest.approx(-0.05)


def test_frozen_frames_repeat_value_and_counter_while_time_goes_on():
    t = np.arange(0, 3600, 0.1)
    columns = {"t_s": t, "rate_dps": np.sin(t), "temp_degC": t / 100, "counter": np.arange(t.size) % 256.0}
    out = effect("frozen_frames").alter(
        columns, {"events_per_h": 60.0, "duration_s": 5.0}, np.random.default_rng(1)
    )
    stuck = np.diff(out["counter"]) == 0
    assert np.array_equal(out["t_s"], t)
    assert np.all(np.diff(out["rate_dps"])[stuck] == 0)
    assert np.all(np.diff(out["temp_degC"])[stuck] == 0)
    assert (
        0.3 * 60 * 50 < stuck.sum() < 1.7 * 60 * 50
    )  # Poisson of 60 freezes of 50 samples, some overlapping


def test_dropped_frames_are_a_subset_of_the_right_size():
    t = np.arange(200_000) / 100.0
    columns = {"t_s": t, "rate_dps": np.sin(t)}
    out = effect("dropped_frames").alter(columns, {"fraction": 0.01, "burst": 5.0}, np.random.default_rng(2))
    lost = 1 - out["t_s"].size / t.size
    assert lost == pytest.approx(0.01, rel=0.25)  # 400 bursts: 1/√400·√2 = 7 % at one σ
    assert np.all(np.diff(out["t_s"]) > 0)
    assert np.array_equal(out["rate_dps"], np.sin(out["t_s"]))


def test_a_wrapped_time_stamp_jumps_back_by_exactly_the_wrap():
    t = np.arange(0, 200, 0.25)
    out = effect("counter_wrap").alter({"t_s": t}, {"wrap_s": 65.536}, np.random.default_rng(0))["t_s"]
    assert np.unique(np.round(out - t, 9)).tolist() == [-196.608, -131.072, -65.536, 0.0]


def test_each_kind_of_effect_has_its_own_stage():
    kinds = {entry.id: type(entry).__mro__[1] for entry in ALL}
    assert {name for name, kind in kinds.items() if kind is TimingEffect} == {
        "timestamp_skew",
        "clock_drift",
        "timing_jitter",
    }
    assert {name for name, kind in kinds.items() if kind is FrameEffect} == {
        "frozen_frames",
        "dropped_frames",
        "counter_wrap",
    }
