"""Planted truths that hide: beside a giant, at stops, in harmonics, in a beat, in a twin, in a drifting clock."""

import numpy as np
import pytest
from diagnose_cases import STEP_S, profile, recording
from scipy.interpolate import CubicSpline

from training.diagnose.library import play
from training.diagnose.pipeline import analyse
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation
from training.diagnose.verdict import conclude
from training.table import Recording

QUICK = Settings(surrogates=24)


def diagnose(*recordings, heldout=(), settings=QUICK):
    return conclude(analyse(list(recordings), list(heldout), Simulation("ideal"), settings))


def names(found):
    return {effect for finding in found.findings for effect in finding.alternatives}


def heading(t, rate):
    return np.concatenate([[0.0], np.cumsum(0.5 * STEP_S * (rate[1:] + rate[:-1]))])


def test_a_dwarf_is_found_beside_a_giant_a_thousand_times_its_size():
    def both(t, w, temp):
        return 5e-4 * w * (temp - 25.0) * (1 + 0.004 * (temp - 25.0)) + 8e-3 * (t > 2500.0)

    found = diagnose(recording(40, both))
    assert {"scale_temperature", "bias_step"} <= names(found)
    assert found.findings[0].effect == "scale_temperature"


def test_a_strong_static_slope_of_a_hysteresis_is_an_effect_of_its_own():
    def both(t, w, temp):
        return 2e-3 * (play(temp, 4.0) - temp) + 6e-4 * (temp - 25.0)

    assert {"bias_temperature", "bias_hysteresis"} <= names(diagnose(recording(41, both, static=True)))


@pytest.mark.slow
def test_zeros_taken_at_stops_are_auto_zero():
    t, _, _ = profile()
    speed = np.where((t % 900.0) < 60.0, 0.0, 12.0)
    ends = t[1:][(speed[1:] > 0.0) & (speed[:-1] == 0.0)]
    zeros = np.random.default_rng(2).normal(0.0, 0.01, len(ends))
    steps = sum(z * (t >= end) for z, end in zip(zeros, ends, strict=True))
    case = recording(42, lambda t, w, temp: steps, speed_mps=speed)
    first = diagnose(case).findings[0]
    assert first.effect == "auto_zero"


@pytest.mark.slow
def test_many_periods_a_turn_are_unknown_and_driven_by_the_heading():
    def poles(t, w, temp):
        return 2e-3 * np.sin(np.deg2rad(7.0 * heading(t, w)))

    first = diagnose(recording(43, poles)).findings[0]
    assert (first.effect, first.driver) == ("unknown", "heading")


def test_a_tooth_error_of_the_axis_is_neither_noise_nor_a_line():
    def teeth(t, w, temp):
        return 4e-5 * w * np.sin(np.deg2rad(9.0 * heading(t, w)))

    found = diagnose(recording(44, teeth))
    assert [(f.effect, f.driver) for f in found.findings] == [("unknown", "rate_times_heading")]


@pytest.mark.slow
def test_a_beat_in_time_is_unknown_and_driven_by_time():
    first = diagnose(
        recording(45, lambda t, w, temp: 3e-3 * np.sign(np.sin(2 * np.pi * t / 470.0)))
    ).findings[0]
    assert (first.effect, first.driver) == ("unknown", "time")


@pytest.mark.slow
def test_a_resonance_in_temperature_is_unknown_and_driven_by_temperature():
    def line(t, w, temp):
        x = (temp - 20.0) / 1.5
        return 3e-3 * (1.0 + 2.0 * x) / (1.0 + x * x)

    first = diagnose(recording(46, line)).findings[0]
    assert (first.effect, first.driver) == ("unknown", "temperature")


@pytest.mark.slow
def test_once_a_turn_may_be_the_field_or_the_earth():
    def field(t, w, temp):
        return 2e-3 * np.cos(np.deg2rad(heading(t, w)))

    first = diagnose(recording(47, field)).findings[0]
    assert (first.effect, first.alternatives, first.status) == (
        "magnetic",
        ["magnetic", "earth_rate"],
        "ambiguous",
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["timestamp_skew", "clock_drift"])
def test_timing_learnt_on_one_recording_is_applied_to_another_and_not_fitted_there(kind):
    t, rate, _ = profile()
    smooth = np.convolve(rate, np.hanning(9) / np.hanning(9).sum(), mode="same")
    delay = 0.02 if kind == "timestamp_skew" else 60e-6 * t

    def case(seed, late):
        found = recording(seed)
        quiet = found.columns["rate_dps"] - rate
        shown = CubicSpline(t, smooth)(t - late) if late is not None else smooth
        found.columns.update(ref_rate_dps=smooth, rate_dps=shown + quiet)
        return found

    found = diagnose(case(48, delay), heldout=[case(49, delay)])
    assert found.findings[0].effect == kind
    assert found.fit.improvement > 0.3
    punctual = diagnose(case(48, delay), heldout=[case(50, None)])
    assert punctual.fit.rms_after_dps > 1.2 * punctual.fit.rms_before_dps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size_dps", "alternatives"),
    [(4.3e-3, ["magnetic", "earth_rate"]), (8e-3, ["magnetic"])],
)
def test_the_earth_is_no_rival_only_of_what_is_surely_more_than_it_turns(size_dps, alternatives):
    """The Earth turns by 4.18e-3 °/s; 4.3e-3 is more, but within the error."""
    found = diagnose(recording(51, lambda t, w, temp: size_dps * np.cos(np.deg2rad(heading(t, w)))))
    assert found.findings[0].alternatives == alternatives


def test_drivers_tell_of_timing_and_of_shapes_no_smooth_function_has():
    t, rate, _ = profile()
    smooth = np.convolve(rate, np.hanning(9) / np.hanning(9).sum(), mode="same")
    late = recording(52)
    quiet = late.columns["rate_dps"] - rate
    late.columns.update(ref_rate_dps=smooth, rate_dps=CubicSpline(t, smooth)(t - 0.02) + quiet)
    assert diagnose(late).drivers[0].driver == "angular_acceleration"
    loop = recording(53, lambda t, w, temp: 2e-3 * (play(temp, 4.0) - temp), static=True)
    assert "temperature" in [d.driver for d in diagnose(loop).drivers[:2]]


def creep(seed, lock_dps, reference_dps):
    """Slow rates through zero past a reference that is noisier than the dead band is wide."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 3000.0, 0.1)
    true = 0.7 * np.sin(2 * np.pi * t / 240.0) * np.sin(2 * np.pi * t / 1700.0)
    shown = np.where(np.abs(true) < lock_dps, 0.0, true) + 2e-3 * rng.standard_normal(len(t))
    reference = true + reference_dps * rng.standard_normal(len(t))
    return Recording(f"creep{seed}", {"t_s": t, "rate_dps": shown, "ref_rate_dps": reference})


@pytest.mark.slow
def test_a_dead_band_no_wider_than_the_noise_of_the_reference_is_named():
    found = diagnose(creep(54, 0.015, 0.02))
    assert [f.effect for f in found.findings] == ["dead_band"]
    lock = found.findings[0].parameters["lock_dps"]
    assert 0.7 * 0.015 < lock.value < 1.4 * 0.015
    assert not diagnose(creep(55, 0.0, 0.02)).findings
