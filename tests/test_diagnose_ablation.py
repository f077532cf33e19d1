"""Where a name would say too much: entries left out, faint companions of a giant, intervals, the Earth."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.diagnose_cases import recording
from training.diagnose.document import Finding, Where
from training.diagnose.findings import _is_wake, _like_earth
from training.diagnose.intervals import Estimates
from training.diagnose.pipeline import analyse
from training.diagnose.settings import Settings
from training.diagnose.simulation import choose_simulation
from training.diagnose.verdict import conclude
from training.table import Recording


def diagnosed(case, *left_out, static=False):
    """The document of one recording, with entries taken out of the catalogue."""
    settings = Settings(static=static, surrogates=16, left_out=frozenset(left_out))
    return conclude(analyse([case], [], choose_simulation(None, [dict(case.columns)]), settings))


def ripple_of_the_supply():
    """A line at 0.31 Hz on a unit at rest, simulated."""
    return recording(31, lambda t, rate, temp: 0.003 * np.sin(2 * np.pi * 0.31 * t), static=True)


def test_a_line_is_found_beside_a_reference_three_times_as_noisy_as_it():
    """What is estimated of such a reference has a share of the line, which is not the motion's."""
    base = late(35)
    t, rng = base["t_s"], np.random.default_rng(35)
    line = 0.02 * np.sin(2 * np.pi * 0.61 * t)
    measured = {
        "rate_dps": base["rate_dps"] + line,
        "ref_rate_dps": base["ref_rate_dps"] + 0.06 * rng.standard_normal(len(t)),
    }
    told = diagnosed(Recording(base.name, dict(base.columns) | measured))
    assert "supply_ripple" in [f.effect for f in told.findings]


def sawtooth_in_temperature():
    """A compensation table's sawtooth of 6 K in a chamber cycle at rest, simulated."""
    return recording(32, lambda t, rate, temp: 0.02 * ((temp / 6.0) % 1.0 - 0.5), static=True)


def noise_with_the_rate():
    """White noise of 3·10⁻⁴ of the rate, simulated."""
    wild = np.random.default_rng(33)
    return recording(33, lambda t, rate, temp: 3e-4 * rate * wild.standard_normal(len(t)))


def late(seed):
    """A smooth motion measured 60 ms late, simulated."""
    base = recording(seed)
    t = base["t_s"]

    def motion(at):
        return 40.0 * np.sin(2 * np.pi * at / 31.0) + 12.0 * np.sin(2 * np.pi * at / 9.7)

    error = base["rate_dps"] - base["ref_rate_dps"]
    return Recording(
        base.name, dict(base.columns) | {"ref_rate_dps": motion(t), "rate_dps": motion(t - 0.06) + error}
    )


@pytest.mark.parametrize(
    ("case", "entry", "driver", "static"),
    [
        (ripple_of_the_supply(), "supply_ripple", "time", True),
        (sawtooth_in_temperature(), "compensation_table", "temperature", True),
        (noise_with_the_rate(), "multiplicative_noise", "rate", False),
    ],
)
def test_without_its_entry_it_is_unknown_with_the_right_driver(case, entry, driver, static):
    whole = diagnosed(case, static=static)
    assert entry in whole.findings[0].alternatives
    told = diagnosed(case, entry, static=static)
    assert told.verdict == "unknown"
    assert [f.driver for f in told.findings if f.status == "unknown"] == [driver]
    assert not any(entry in f.alternatives for f in told.findings)


def test_a_delay_is_not_fitted_without_the_entries_of_timing():
    case = late(34)
    named = {"timestamp_skew", "bandwidth", "clock_drift"}
    assert named & set(diagnosed(case).findings[0].alternatives)
    told = diagnosed(case, *named)
    assert told.verdict == "unknown"
    assert told.findings[0].driver == "angular_acceleration"
    assert told.alignment[0].delay_s.value == 0.0


def finding(effect, rms_dps, strength):
    return Finding(
        effect=effect,
        status="named",
        alternatives=[effect],
        separate_by=None,
        driver="rate",
        where=Where([], []),
        parameters={},
        rms_dps=rms_dps,
        p_value=1e-9,
        text="",
        strength=strength,
    )


def test_a_faint_delay_beside_a_giant_on_the_rate_is_its_wake_and_a_clear_or_large_one_is_none():
    giant, small = finding("saturation", 1.0, 1e7), finding("saturation", 0.01, 1e4)
    faint = finding("clock_drift", 0.005, 60.0)
    assert _is_wake(faint, [giant, faint])
    assert not _is_wake(faint, [small, faint])
    assert not _is_wake(finding("clock_drift", 0.005, 600.0), [giant])
    assert not _is_wake(finding("bias_step", 0.005, 60.0), [giant])
    assert not _is_wake(faint, [finding("multiplicative_noise", 1.0, 1e7), faint])


def test_an_interval_is_no_narrower_than_the_catalogues_shapes_are_true_save_for_a_period():
    values, names = np.array([2.0, 7.0]), [(0, 0, "c3_per_dps2"), (1, 0, "period_K")]
    sharp = Estimates(names, values, np.zeros((2, 2)), np.full(2, 1000.0))
    low, high = sharp.interval(0)
    assert high - low == pytest.approx(2 * 1.96 * 0.02, rel=1e-3)
    assert sharp.interval(1) == (7.0, 7.0)


@pytest.mark.parametrize(
    ("second_dps", "first_dps", "is_like"),
    [(0.3e-3, 2e-3, True), (0.9e-3, 2e-3, False), (0.3e-3, 8e-3, False)],
)
def test_a_second_harmonic_within_the_noise_does_not_rule_the_earth_out(second_dps, first_dps, is_like):
    """Errors of 0.14e-3 °/s each; the Earth turns by 4.18e-3."""
    fit = SimpleNamespace(
        beta=np.array([first_dps, 0.0, second_dps, 0.0]), information=np.eye(4) / 0.14e-3**2
    )
    assert _like_earth({"order": 2.0}, SimpleNamespace(fit=fit), slice(0, 4)) is is_like
