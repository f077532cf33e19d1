import numpy as np
import pytest
from diagnose_cases import recording

from training.diagnose.integrity import check


def columns(seed=1):
    return {k: v.copy() for k, v in recording(seed).columns.items()}


def effects(checked):
    return {fault.effect for fault in checked.faults}


def test_a_sound_recording_has_no_faults():
    checked = check(columns(), static=False)
    assert not checked.faults
    assert not checked.remarks
    assert checked.valid.all()


def test_frozen_samples_are_found_and_masked():
    c = columns()
    c["ref_rate_dps"] = c["ref_rate_dps"] + 20 * np.sin(c["t_s"])
    c["rate_dps"] = c["rate_dps"] + 20 * np.sin(c["t_s"])
    c["rate_dps"][3000:3020] = c["rate_dps"][3000]
    checked = check(c, static=False)
    assert effects(checked) == {"frozen_frames"}
    assert not checked.valid[3001:3020].any()
    assert checked.valid[:3000].all()


def test_a_dead_band_is_not_a_frozen_frame():
    c = columns()
    c["rate_dps"] = np.where(np.abs(c["rate_dps"]) < 0.5, 0.0, c["rate_dps"])
    assert not check(c, static=False).faults


def test_dropped_frames_are_counted():
    c = columns()
    keep = np.random.default_rng(3).random(len(c["t_s"])) > 5e-3
    keep[[0, -1]] = True
    checked = check({k: v[keep] for k, v in c.items()}, static=False)
    assert effects(checked) == {"dropped_frames"}
    assert checked.faults[0].samples == int((~keep).sum())


def test_a_wrapped_time_stamp_is_unwrapped():
    c = columns()
    t = c["t_s"].copy()
    c["t_s"] = np.mod(t, 2.0**32 * 1e-6)
    checked = check(c, static=False)
    assert effects(checked) == {"counter_wrap"}
    np.testing.assert_allclose(checked.columns["t_s"], t, atol=1e-6)


@pytest.mark.parametrize("factor", [np.pi / 180, -1.0, 180 / np.pi, 0.5, 1000.0])
def test_a_wrong_unit_is_named_and_divided_out(factor):
    c = columns()
    right = c["rate_dps"].copy()
    c["rate_dps"] = right * factor
    checked = check(c, static=False)
    assert effects(checked) == {"unit_error"}
    np.testing.assert_allclose(checked.columns["rate_dps"], right, rtol=1e-9)


def test_sentinel_codes_and_missing_values_do_not_vote():
    c = columns()
    c["rate_dps"][[10, 20, 30]] = 327.67 * 10
    c["rate_dps"][50] = np.nan
    c["temp_degC"][60] = np.nan
    checked = check(c, static=False)
    assert not checked.valid[[10, 20, 30, 50]].any()
    assert np.all(np.isfinite(checked.columns["temp_degC"]))
    assert len(checked.remarks) == 3


def test_disorder_is_sorted_and_repeats_are_dropped():
    c = columns()
    order = np.arange(len(c["t_s"]))
    order[100:110] = order[100:110][::-1]
    order = np.sort(np.concatenate([order[:100], order[:50]])).tolist() + order[100:].tolist()
    checked = check({k: v[order] for k, v in c.items()}, static=False)
    assert np.all(np.diff(checked.columns["t_s"]) > 0)
    assert checked.unusable is None


@pytest.mark.parametrize("spoil", ["short", "still clock", "shuffled", "empty"])
def test_unusable_recordings_say_why(spoil):
    c = columns()
    if spoil == "short":
        c = {k: v[:10] for k, v in c.items()}
    elif spoil == "still clock":
        c["t_s"] = np.zeros_like(c["t_s"])
    elif spoil == "shuffled":
        c["t_s"] = np.random.default_rng(1).permutation(c["t_s"])
    else:
        c["rate_dps"] = np.full_like(c["rate_dps"], np.nan)
    assert check(c, static=False).unusable


def test_a_staircase_is_one_though_its_codes_are_stored_on_a_finer_grid():
    from training.diagnose.fast import quantization_finding

    rng = np.random.default_rng(3)
    rate = 30.0 * np.sin(np.arange(20_000) / 300.0) + 2e-3 * rng.standard_normal(20_000)
    every = np.ones(len(rate), bool)
    coarse = np.rint(np.rint(rate / 0.0713) * 0.0713 / 0.003) * 0.003
    found = quantization_finding(coarse, coarse - rate, every)
    assert found is not None
    assert abs(found.parameters["lsb_dps"][0] / 0.0713 - 1.0) < 1e-3
    fine = np.rint(rate / 1e-3) * 1e-3
    noisy = 0.026 * rng.standard_normal(len(rate))
    assert quantization_finding(fine, fine - rate + noisy, every, 0.0262) is None


def test_the_step_of_a_staircase_is_known_well_enough_to_count_it_across_wide_gaps():
    from training.diagnose.fast import quantization_finding

    rng = np.random.default_rng(4)
    level = np.repeat([0.0, 11.3, -8.2, 40.1, 3.7], 2000)  # codes far apart, with nothing between them
    rate = level + 0.4 * np.sin(np.arange(len(level)) / 90.0) + 2e-3 * rng.standard_normal(len(level))
    lsb, grid = 0.018857374, 1.0825e-3
    coarse = np.rint(np.rint(rate / lsb) * lsb / grid) * grid
    found = quantization_finding(coarse, coarse - rate, np.ones(len(rate), bool))
    assert found is not None
    assert abs(found.parameters["lsb_dps"][0] / lsb - 1.0) < 1e-4
