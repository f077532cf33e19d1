"""What a good frame may still carry: jumps and standstills are told from what a sensor can do."""

import msgspec
import numpy as np
import pytest

from rtcomp import fog_format
from rtcomp.frames import Flag
from rtcomp.model import Term, new_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from tests.conftest import START_NS

HZ, SECOND = 10, 1_000_000_000


@pytest.fixture(scope="module")
def strict_map():
    """The FOG's map with every limit set."""
    fog = load_map("fog")
    limits = {"max_rate_degC_per_s": 2.0, "stuck_after_s": 5.0}
    channel = fog.channels[0]
    channel = msgspec.structs.replace(
        channel,
        temperature=msgspec.structs.replace(channel.temperature, **limits),
        coil_temperature=msgspec.structs.replace(channel.coil_temperature, **limits),
        max_slope_dps_per_s=1000.0,
        stuck_after_s=0.5,
    )
    return compile_map(msgspec.structs.replace(fog, channels=[channel]))


def run(compiled, temperatures, rates=None, model=None):
    """Ten temperatures and a hundred rates a second; returns pipeline and samples."""
    slow = START_NS + np.arange(len(temperatures)) * (SECOND // HZ)
    fast = START_NS + np.arange(len(temperatures) * 10) * (SECOND // 100)
    if rates is None:
        rates = np.random.default_rng(1).normal(0.0, 0.1, len(fast))
    frames = fog_format.merge(
        fog_format.encode_temperature(slow, temperatures, temperatures), fog_format.encode_rate(fast, rates)
    )
    pipeline = Pipeline(compiled, {"yaw": [model]} if model else None)
    return pipeline, pipeline.process_all(frames).corrected


def has(samples, flag):
    return (samples["flags"] & flag) != 0


def ramp(n):
    return 20.0 + 0.02 * np.arange(n)


def test_a_healthy_stream_has_none_of_these_flags(strict_map):
    _, samples = run(strict_map, ramp(300))
    assert (samples["flags"] == Flag.NO_MODEL).all()


def test_a_single_wild_temperature_changes_nothing(strict_map):
    lag = new_model(terms=[Term("thermal_lag", {"tau_s": 30.0, "bias_dps_per_K": 0.1})])
    wild = ramp(300)
    wild[100] += 40.0
    clean_pipeline, clean = run(strict_map, ramp(300), model=lag)
    pipeline, samples = run(strict_map, wild, model=lag)
    assert pipeline.rejected == {"implausible": 2}  # housing and coil
    flagged = np.flatnonzero(has(samples, Flag.TEMPERATURE_IMPLAUSIBLE))
    assert flagged.tolist() == list(range(1000, 1010))
    assert np.abs(samples["correction_dps"] - clean["correction_dps"])[1010:].max() < 1e-5
    assert not has(samples, Flag.TEMPERATURE_STALE).any()
    settled = clean_pipeline.state.times[0, 2]
    assert pipeline.state.times[0, 2] == settled  # one bad frame does not unsettle what was known


def test_a_lasting_jump_is_held_off_then_stale_then_taken_as_a_new_start(strict_map):
    lag = new_model(terms=[Term("thermal_lag", {"tau_s": 1.0, "bias_dps_per_K": 0.1})])
    temperatures = ramp(300)
    temperatures[100:] += 20.0
    _, samples = run(strict_map, temperatures, model=lag)
    t = (samples["t_ns"] - START_NS) / SECOND
    believed = np.flatnonzero(~has(samples, Flag.TEMPERATURE_IMPLAUSIBLE) & (t >= 10.0))[0]
    assert t[believed] == pytest.approx(9.9 + 20.0 / (2.0 - 0.2), abs=0.3)  # at 2 K/s, while it rises itself
    held = samples[1000:believed]
    assert (held["temp_degC"] < 22.0).all()
    assert has(held, Flag.TEMPERATURE_STALE)[-1]
    assert has(samples[believed:], Flag.UNSETTLED)[:400].all()  # five time constants
    assert not has(samples[believed:], Flag.UNSETTLED)[-200:].any()


def test_standing_still_is_flagged_after_the_time_given(strict_map):
    temperatures = ramp(300)
    temperatures[100:200] = temperatures[100]
    rates = np.random.default_rng(2).normal(0.0, 0.1, 3000)
    rates[2500:2600] = rates[2500]
    _, samples = run(strict_map, temperatures, rates)
    stuck = np.flatnonzero(has(samples, Flag.TEMPERATURE_STUCK))
    assert stuck[0] == pytest.approx(1500, abs=15)
    assert stuck[-1] == 1999
    assert np.flatnonzero(has(samples, Flag.RATE_STUCK)).tolist() == list(range(2551, 2600))


def test_only_the_spike_of_a_rate_is_flagged(strict_map):
    rates = np.random.default_rng(3).normal(0.0, 0.1, 1000)
    rates[[100, 500]] = [-250.0, 80.0]
    _, samples = run(strict_map, ramp(100), rates)
    assert np.flatnonzero(has(samples, Flag.RATE_IMPLAUSIBLE)).tolist() == [100, 500]
    assert np.allclose(samples["rate_raw_dps"], rates, atol=1e-6)  # said, not swallowed


def test_without_limits_in_the_map_nothing_of_this_is_flagged(fog_map):
    temperatures = np.full(100, 20.0)
    temperatures[50] = 90.0
    pipeline, samples = run(fog_map, temperatures, np.zeros(1000))
    assert pipeline.rejected == {}
    new = Flag.TEMPERATURE_IMPLAUSIBLE | Flag.TEMPERATURE_STUCK | Flag.RATE_IMPLAUSIBLE | Flag.RATE_STUCK
    assert not has(samples, new).any()


def test_a_clock_that_was_set_back_starts_the_thermal_states_anew(fog_map):
    lag = new_model(terms=[Term("thermal_lag", {"tau_s": 2.0, "bias_dps_per_K": 0.1})])
    both = []
    for start, temperatures in ((START_NS, ramp(200)), (START_NS - 3600 * SECOND, ramp(200) + 15.0)):
        t_ns = start + np.arange(200) * (SECOND // HZ)
        both.append(fog_format.merge(
            fog_format.encode_temperature(t_ns, temperatures, counter=0 if start == START_NS else 200),
            fog_format.encode_rate(t_ns + 1, np.zeros(200), counter=0 if start == START_NS else 200),
        ))  # fmt: skip
    samples = Pipeline(fog_map, {"yaw": [lag]}).process_all(np.concatenate(both)).corrected
    alone = Pipeline(fog_map, {"yaw": [lag]}).process_all(both[1]).corrected
    assert has(samples, Flag.CLOCK_STEP).sum() == 1
    assert np.array_equal(samples["correction_dps"][200:], alone["correction_dps"])
    assert has(samples, Flag.UNSETTLED)[200:295].all()


def test_a_time_before_power_on_does_not_blow_up_a_warm_up(fog_map):
    warm_up = new_model(terms=[Term("bias_warmup", {"amplitude_dps": 1.0, "tau_s": 1.0})])
    rates = fog_format.encode_rate(START_NS + np.arange(20) * SECOND, np.zeros(20))
    samples = Pipeline(fog_map, {"yaw": [warm_up]}, START_NS + 10 * SECOND).process_all(rates).corrected
    assert np.abs(samples["correction_dps"]).max() <= 1.0
    assert has(samples, Flag.UNSETTLED).tolist() == [True] * 10 + [False] * 10


def test_until_time_set_back_a_little_has_caught_up_temperatures_are_stale(fog_map, ts_model):
    start, back = START_NS, 10 * SECOND
    parts = []
    for k, first in enumerate((start, start + 20 * SECOND - back)):
        t_ns = first + np.arange(200) * (SECOND // HZ)
        parts.append(fog_format.merge(
            fog_format.encode_temperature(t_ns, ramp(200) + k, counter=200 * k),
            fog_format.encode_rate(t_ns + 1, np.zeros(200), counter=200 * k),
        ))  # fmt: skip
    samples = Pipeline(fog_map, {"yaw": [ts_model]}).process_all(np.concatenate(parts)).corrected
    stale = np.flatnonzero(has(samples, Flag.TEMPERATURE_STALE))
    assert stale.tolist() == list(range(200, 279))  # ten seconds back, two of them allowed
