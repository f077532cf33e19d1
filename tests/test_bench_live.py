"""The arithmetic of tools.bench_live, and its traffic: what it says has to be what happened."""

import json

import numpy as np
import pytest

from rtcomp.fog_format import TEMPERATURE_ID
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from tools.bench_live import c_model, figures, measure, medians, ratios, shifted
from tools.bench_live_programs import RATES
from tools.bench_live_traffic import LOADS, Load, Sent, make_frames, numbers, rates


@pytest.mark.parametrize("load", LOADS, ids=lambda load: load.name)
def test_traffic_is_evenly_spaced_and_carries_the_gyro_at_its_rate(load):
    frames = make_frames(load, 2.0)
    assert len(frames) == 2 * load.frames_per_s
    gaps = np.diff(frames["t_ns"])
    assert gaps.max() - gaps.min() <= 1
    gyro = np.isin(frames["can_id"], [load.rate_id, TEMPERATURE_ID])
    assert gyro.sum() == 2 * min(load.frames_per_s, 1000)
    pipeline = Pipeline(compile_map(load_map(load.map)))
    samples = pipeline.process_all(frames).corrected
    assert pipeline.rejected == {}
    count = int((frames["can_id"] == load.rate_id).sum())
    assert numbers(samples["rate_raw_dps"], count).tolist() == list(range(count))


def test_every_program_s_payload_tells_which_rate_it_is_of():
    for load in (Load(1000), Load(20_000, fd=True)):
        frames = make_frames(load, 1.0)
        mine = frames[frames["can_id"] == load.rate_id]
        bare = [RATES["bare"](row["data"][: row["length"]].tobytes()) for row in mine]
        assert numbers(np.array(bare), len(mine)).tolist() == list(range(len(mine)))
        samples = Pipeline(compile_map(load_map(load.map))).process_all(frames).corrected
        assert [RATES["ours"](row.tobytes()) for row in samples] == samples["rate_raw_dps"].tolist()
    assert RATES["peer"](json.dumps({"raw": 1.5}).encode()) == 1.5


def test_figures_of_a_run_that_lost_two():
    sent = Sent(np.arange(10) * 1_000_000, 12, 0.01)
    seen = np.delete(np.arange(10), [3, 7])
    told = {"cpu_s": 24e-6, "process_cpu_s": 120e-6, "frames": 12}
    result = figures(told, sent, sent.rate_at_ns[seen] + 250_000, rates(10)[seen])
    assert result["lost"] == 2
    assert result["latency_us"] == {"p50": 250.0, "p99": 250.0}
    assert result["cpu_us_per_frame"] == pytest.approx(2.0)
    assert result["behind_s"] == pytest.approx(250e-6)


def test_a_sample_that_came_twice_is_no_result():
    sent = Sent(np.arange(3) * 1000, 3, 0.01)
    told = {"cpu_s": 1.0, "process_cpu_s": 1.0, "frames": 3}
    with pytest.raises(SystemExit, match="twice or out of order"):
        figures(told, sent, np.array([1, 2]), rates(3)[[1, 1]])


def run(cpu, p50, p99, lost=0):
    return {"cpu_us_per_frame": cpu, "latency_us": {"p50": p50, "p99": p99}, "lost": lost}


def test_ratios_are_medians_of_each_round_s_and_skip_where_the_forwarder_lost():
    runs = {
        "ours": [run(2.0, 110, 300), run(4.0, 330, 500), run(3.0, 1, 1)],
        "floor": [run(1.0, 1, 1), run(4.0, 1, 1), run(1.0, 1, 1)],
        "peer": [run(20.0, 9, 9, 5)] * 3,
        "bare": [run(1.0, 100, 200), run(1.0, 300, 400), run(1.0, 1000, 1000, lost=1)],
    }
    found = ratios(runs)
    assert found == pytest.approx(
        {"cpu_to_floor": 2.0, "cpu_to_peer": 0.15, "p50_to_bare": 1.1, "p99_to_bare": 1.375, "lost": 0}
    )
    assert ratios({})["cpu_to_floor"] is None


def test_medians_sum_what_is_lost():
    merged = medians([run(1.0, 10, 20, 1), run(3.0, 30, 20, 4), run(2.0, 20, 20)])
    assert merged == {"cpu_us_per_frame": 2.0, "latency_us": {"p50": 20.0, "p99": 20.0}, "lost": 5}


def test_each_round_begins_with_another_program():
    assert list(shifted(["a", "b", "c"], 4)) == ["b", "c", "a"]


def test_the_floor_has_the_same_model():
    from tools.bench_live_traffic import model

    filled, ours = c_model(), model()
    assert list(filled.centers) == np.ravel(ours.rules.centers).tolist()
    assert list(filled.rest)[-1] == ours.residual_std_dps


@pytest.mark.slow
def test_both_programs_run_over_a_datagram_socket_and_lose_nothing():
    results = measure([Load(100)], ["bare", "ours"], seconds=1.0, rounds=1, datagrams=True)
    for result in results["rates"]["100"].values():
        assert result["sent"] == 100
        assert result["lost"] == 0
        assert 0.0 < result["latency_us"]["p50"] <= result["latency_us"]["p99"]
