"""The frame loop: what a frame must satisfy, what each sample says of itself, and that arrays do not matter."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from conftest import START_NS
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcomp import fog_format
from rtcomp.compensator import predict
from rtcomp.frames import CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW, CORRECTED, FRAME, Flag, FrameFlag
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map

RATE_ID, TEMP_ID = fog_format.RATE_ID, fog_format.TEMPERATURE_ID
MS = 1_000_000


def rates(n, counter=0, start_ns=START_NS, period_ns=10 * MS):
    return fog_format.encode_rate(
        start_ns + np.arange(n) * period_ns, np.arange(n, dtype=float) + 1, counter=counter
    )


def temperatures(*times_ns, value=20.0):
    return fog_format.encode_temperature(np.array(times_ns), np.full(len(times_ns), value))


def error_frame(t_ns, can_id, data):
    frame = np.zeros(1, FRAME)
    frame["t_ns"], frame["can_id"], frame["flags"], frame["length"] = t_ns, can_id, FrameFlag.ERROR, 8
    frame["data"][0, : len(data)] = list(data)
    return frame


def run(fog_map, frames, models=()):
    pipeline = Pipeline(fog_map, {"yaw": list(models)}, power_on_ns=START_NS)
    return pipeline, pipeline.process_all(frames).corrected


def has(samples, flag):
    return [bool(value & flag) for value in samples["flags"]]


def test_good_frames_give_one_sample_each_in_order(fog_map, fog_frames):
    frames = fog_frames(5.0)
    pipeline, samples = run(fog_map, frames)
    mine = frames[frames["can_id"] == RATE_ID]
    assert np.array_equal(samples["t_ns"], mine["t_ns"])
    assert np.array_equal(samples["seq"], np.arange(len(mine)))
    assert pipeline.rejected == {}
    assert pipeline.counts == {
        "frames": len(frames), "samples": len(mine), "lost_frames": 0, "clock_steps": 0, "ignored": 0,
    }  # fmt: skip


def test_correction_is_the_compensators_over_the_same_rows(fog_map, fog_frames, lag_model):
    frames = fog_frames(30.0)
    _, samples = run(fog_map, frames, [lag_model])
    temp = np.full(len(samples), np.nan)
    fresh = np.flatnonzero(samples["temp_age_s"] == 0.0)
    temp[fresh] = samples["temp_degC"][fresh]
    t_s = (samples["t_ns"] - START_NS) * 1e-9
    expected = predict(lag_model, samples["rate_raw_dps"], temp, t_s)
    assert np.allclose(samples["correction_dps"], expected.error_dps, atol=1e-9)
    assert np.array_equal(samples["rate_dps"], samples["rate_raw_dps"] - samples["correction_dps"])
    assert np.allclose(samples["sigma_dps"], 0.03)


@settings(max_examples=30)
@given(cuts=st.lists(st.integers(0, 600), max_size=8), seed=st.integers(0, 99))
def test_how_frames_are_cut_into_arrays_changes_no_bit(fog_map, fog_frames, lag_model, cuts, seed):
    frames = fog_frames(5.0, seed=seed).copy()
    damage = np.random.default_rng(seed).integers(0, len(frames), 5)
    frames["data"][damage, 3] ^= 0x55
    whole = Pipeline(fog_map, {"yaw": [lag_model]}, START_NS).process_all(frames).corrected
    pipeline = Pipeline(fog_map, {"yaw": [lag_model]}, START_NS)
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
    parts = [pipeline.process_all(frames[a:b]).corrected for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole.tobytes()


def damaged(frames, index, change):
    frames = frames.copy()
    change(frames[index : index + 1])
    return frames


def set_field(name, value):
    return lambda frame: frame.__setitem__(name, value)


def flip_bit(frame):
    frame["data"][0, 4] ^= 1


@pytest.mark.parametrize(
    ("cause", "change"),
    [
        ("crc", flip_bit),
        ("length", set_field("length", 7)),
        ("length", set_field("length", 0)),
        ("remote_frame", set_field("flags", FrameFlag.REMOTE)),
        ("id_kind", set_field("flags", FrameFlag.EXTENDED)),
    ],
)
def test_a_bad_frame_changes_nothing_is_counted_and_marks_the_next(fog_map, cause, change):
    frames = rates(6)
    pipeline, samples = run(fog_map, damaged(frames, 2, change))
    if cause != "crc":  # its counter was not seen, so the next one looks like a jump
        assert pipeline.rejected == {cause: 1, "counter_jump": 1}
        assert samples["rate_raw_dps"].tolist() == [1, 2, 5, 6]
    else:
        assert pipeline.rejected == {cause: 1}
        assert samples["rate_raw_dps"].tolist() == [1, 2, 4, 5, 6]
    assert has(samples, Flag.BAD_FRAME_BEFORE) == [value == 3 for value in range(1, len(samples) + 1)]
    assert np.array_equal(samples["seq"], np.arange(len(samples)))


def test_a_repeated_counter_is_rejected_and_the_stream_goes_on(fog_map):
    frames = rates(5)
    pipeline, samples = run(fog_map, frames[[0, 1, 1, 1, 2, 3, 4]])
    assert pipeline.rejected == {"counter_repeat": 2}
    assert samples["rate_raw_dps"].tolist() == [1, 2, 3, 4, 5]


def test_a_counter_jump_rejects_one_frame_and_takes_its_counter(fog_map):
    pipeline, samples = run(fog_map, rates(10)[[0, 1, 4, 5, 6]])
    assert pipeline.rejected == {"counter_jump": 1}
    assert samples["rate_raw_dps"].tolist() == [1, 2, 6, 7]


def test_a_frozen_counter_never_becomes_good(fog_map):
    pipeline, samples = run(fog_map, rates(3)[[0, 1, 2] + [2] * 40])
    assert pipeline.rejected == {"counter_repeat": 40}
    assert len(samples) == 3


def test_error_frames_mark_and_are_counted(fog_map):
    frames = np.concatenate(
        [rates(2), error_frame(START_NS + 12 * MS, 0x40, b""), rates(2, 2, START_NS + 20 * MS)]
    )
    pipeline, samples = run(fog_map, frames)
    assert pipeline.rejected == {"error_frame": 1}
    assert has(samples, Flag.BAD_FRAME_BEFORE) == [False, False, True, False]


def test_losses_of_the_receiver_travel_in_band(fog_map):
    lost = bytes([0, CAN_ERR_CRTL_RX_OVERFLOW]) + (300).to_bytes(4, "little")
    frames = np.concatenate(
        [rates(2), error_frame(START_NS + 12 * MS, CAN_ERR_CRTL, lost), rates(2, 2, START_NS + 20 * MS)]
    )
    pipeline, samples = run(fog_map, frames)
    assert pipeline.lost_frames == 300
    assert pipeline.counts["frames"] == 4
    assert has(samples, Flag.FRAMES_LOST) == [False, False, True, False]


def test_a_clock_step_is_flagged_and_moves_no_time(fog_map):
    frames = np.concatenate(
        [rates(2), error_frame(START_NS + 12 * MS, 0, b""), rates(2, 2, START_NS + 20 * MS)]
    )
    pipeline, samples = run(fog_map, frames)
    assert pipeline.counts["clock_steps"] == 1
    assert has(samples, Flag.CLOCK_STEP) == [False, False, True, False]


def test_time_backwards_and_gaps_are_flagged(fog_map):
    frames = rates(5)
    frames["t_ns"] = START_NS + np.array([0, 10, 500, 510, 505]) * MS
    _, samples = run(fog_map, frames)
    assert has(samples, Flag.GAP_BEFORE) == [False, False, True, False, False]
    assert has(samples, Flag.CLOCK_STEP) == [False, False, False, False, True]


def test_temperature_is_held_with_its_age_then_stale_and_never_silently_reused(fog_map, ts_model):
    frames = fog_format.merge(temperatures(START_NS + 20 * MS), rates(300))
    _, samples = run(fog_map, frames, [ts_model])
    assert has(samples, Flag.TEMPERATURE_MISSING)[:4] == [True, True, False, False]
    assert np.isnan(samples["temp_age_s"][:2]).all()
    age = (samples["t_ns"][2:] - START_NS - 20 * MS) * 1e-9
    assert np.allclose(samples["temp_age_s"][2:], age, atol=1e-6)
    assert has(samples, Flag.TEMPERATURE_STALE)[2:] == [value > 2.0 for value in age]
    assert samples["correction_dps"][1] == 0.0 != samples["correction_dps"][2]


def test_a_temperature_that_is_not_available_is_not_taken(fog_map):
    frames = fog_format.merge(temperatures(START_NS), rates(3))
    second = fog_format.encode_temperature(np.array([START_NS + 5 * MS]), np.array([np.nan]), counter=1)
    _, samples = run(fog_map, fog_format.merge(frames, second))
    assert (samples["temp_degC"] == 20.0).all()


def test_status_and_range_are_flagged(fog_map):
    faulty = fog_format.encode_rate(
        START_NS + np.arange(3) * 10 * MS, np.array([1.0, 399.0, 401.0]), status=2
    )
    _, samples = run(fog_map, faulty)
    assert has(samples, Flag.SENSOR_FAULT) == [True] * 3
    assert has(samples, Flag.SATURATED) == [False, False, True]


def test_without_a_model_rates_pass_through_flagged(fog_map):
    _, samples = run(fog_map, rates(3))
    assert has(samples, Flag.NO_MODEL) == [True] * 3
    assert np.array_equal(samples["rate_dps"], samples["rate_raw_dps"])
    assert np.isnan(samples["sigma_dps"]).all()


def test_other_frames_are_ignored_and_counted(fog_map):
    frames = rates(4)
    frames["can_id"][1:3] = 0x123
    pipeline, _ = run(fog_map, frames[[0, 1, 2]])
    assert pipeline.counts["ignored"] == 2


def test_one_fd_frame_brings_its_own_temperature(ts_model):
    fd_map = compile_map(load_map("fog_fd"))
    t_ns = START_NS + np.arange(400) * 10 * MS
    frames = fog_format.encode_fd(t_ns, np.linspace(-50, 50, 400), np.linspace(0, 30, 400))
    pipeline = Pipeline(fd_map, {"yaw": [ts_model]})
    samples = pipeline.process_all(frames).corrected
    assert pipeline.rejected == {}
    assert (samples["temp_age_s"] == 0.0).all()
    assert np.allclose(samples["temp_degC"], np.linspace(0, 30, 400), atol=0.0051)


def test_j1939_is_matched_by_pgn_whoever_sends_it():
    pipeline = Pipeline(compile_map(load_map("aceinna_openimu300")))
    frames = np.zeros(3, FRAME)
    frames["can_id"] = [0x0CF02A80, 0x08F02A17, 0x0CF02B80]  # other priority and source; another PGN
    frames["flags"], frames["length"] = FrameFlag.EXTENDED, 8
    frames["data"][:, :6] = np.frombuffer((32000).to_bytes(2, "little") * 3, np.uint8)
    frames["data"][1, :2] = (0, 0xFE)  # an error code in one axis
    samples = pipeline.process_all(frames)
    assert pipeline.counts["ignored"] == 1
    assert pipeline.rejected == {"not_available": 1}
    assert (samples.corrected["rate_raw_dps"] == 0.0).all()
    assert len(samples.corrected) == 5


def test_an_output_array_smaller_than_the_input_loses_nothing(fog_map, fog_frames):
    frames = np.concatenate([fog_frames(60.0), fog_frames(60.0)])
    pipeline = Pipeline(fog_map)
    assert sum(len(part.corrected) for part in pipeline.process(frames)) == pipeline.counts["samples"]


def test_scores_are_the_rms_against_the_reference(ts_model):
    simulated = compile_map(load_map("fog_simulated"))
    t_ns = START_NS + np.arange(500) * 10 * MS
    truth = 40.0 * np.sin(np.arange(500) / 50)
    reference = fog_format.encode_rate(t_ns, truth)
    reference["can_id"] = 0x0A3
    raw = fog_format.encode_rate(t_ns, truth + 0.5)
    pipeline = Pipeline(simulated, {"yaw": [ts_model]})
    samples = pipeline.process_all(fog_format.merge(temperatures(START_NS), reference, raw)).corrected
    assert np.allclose(samples["ref_rate_dps"], truth, atol=1e-6)
    errors = [samples[name] - samples["ref_rate_dps"] for name in ("rate_raw_dps", "rate_dps")]
    assert np.allclose(pipeline.rms_dps, [np.sqrt(np.mean(e**2)) for e in errors])


def test_swap_changes_the_model_without_a_gap_and_keeps_common_thermal_states(fog_map, fog_frames, lag_model):
    frames = fog_frames(20.0)
    other = msgspec.structs.replace(lag_model, residual_std_dps=0.5)
    pipeline = Pipeline(fog_map, {"yaw": [lag_model]}, START_NS)
    first = pipeline.process_all(frames[:1000]).corrected
    pipeline.swap({"yaw": [other]})
    second = pipeline.process_all(frames[1000:]).corrected
    whole = Pipeline(fog_map, {"yaw": [lag_model]}, START_NS).process_all(frames).corrected
    both = np.concatenate([first, second])
    assert np.array_equal(both["seq"], np.arange(len(both)))
    assert np.array_equal(both["correction_dps"], whole["correction_dps"])
    assert has(second, Flag.MODEL_SWAPPED) == [True] + [False] * (len(second) - 1)
    assert np.allclose(second["sigma_dps"], 0.5)


def test_the_sample_is_packed_as_its_schema_says():
    assert CORRECTED.itemsize == sum(CORRECTED[name].itemsize for name in CORRECTED.names)


def test_an_11_bit_id_that_has_more_bits_is_no_message_of_the_map(fog_map):
    frames = rates(3)
    frames["can_id"][1] |= 0x800
    pipeline, samples = run(fog_map, frames[:2])
    assert pipeline.counts["ignored"] == 1
    assert len(samples) == 1
