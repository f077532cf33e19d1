"""Checkpoints: fresh ones carry on bit for bit, everything else is refused, said and flagged."""

import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest

from rtcomp.checkpoint import (
    Checkpointer,
    check_fits,
    decode,
    encode,
    oldest_s,
    restore,
    take_snapshot,
)
from rtcomp.errors import RequestError
from rtcomp.frames import Flag
from rtcomp.model import Term, save_model
from rtcomp.pipeline import Pipeline
from rtcomp.sources.candump import CandumpWriter
from rtcomp.thermal import NEVER, T_POWER_ON
from tests.conftest import START_NS

SECOND = 1_000_000_000
CONTINUED = ("rate_dps", "correction_dps", "temp_degC", "sigma_dps", "temp_age_s")


@pytest.fixture
def ran(fog_map, fog_frames, lag_model):
    """A pipeline that has seen the first half of a stream, and the rest of the stream."""
    frames = fog_frames(30.0)
    pipeline = Pipeline(fog_map, {"yaw": [lag_model]}, START_NS)
    half = len(frames) // 2
    pipeline.process_all(frames[:half])
    return pipeline, frames[half:], int(frames["t_ns"][half - 1])


def fresh(fog_map, *models):
    return Pipeline(fog_map, {"yaw": list(models)})


def test_a_restored_state_carries_on_as_if_never_stopped(fog_map, lag_model, ran):
    pipeline, rest, t_ns = ran
    content = encode(take_snapshot(pipeline, t_ns, None))
    other = fresh(fog_map, lag_model)
    restore(decode(content), other, power_on=True)
    expected, got = pipeline.process_all(rest).corrected, other.process_all(rest).corrected
    for name in CONTINUED:
        assert got[name].tobytes() == expected[name].tobytes(), name
    assert np.array_equal(got["flags"], expected["flags"])
    assert not (got["flags"] & Flag.TEMPERATURE_MISSING).any()
    assert other.state.times[0, T_POWER_ON] == START_NS


def test_without_it_the_same_frames_give_other_corrections(fog_map, lag_model, ran):
    pipeline, rest, _ = ran
    expected, got = (p.process_all(rest).corrected for p in (pipeline, fresh(fog_map, lag_model)))
    assert not np.array_equal(got["correction_dps"], expected["correction_dps"])


@pytest.mark.parametrize("where", range(0, 1200, 37))
def test_any_flipped_bit_is_found(ran, where):
    pipeline, _, t_ns = ran
    content = bytearray(encode(take_snapshot(pipeline, t_ns, None)))
    content[where % (len(content) - 1)] ^= 1  # the last byte only ends the line
    with pytest.raises(RequestError, match="corrupt"):
        decode(bytes(content))


@pytest.mark.parametrize("cut", [0, 1, 50, 400])
def test_a_truncated_one_is_corrupt(ran, cut):
    pipeline, _, t_ns = ran
    with pytest.raises(RequestError, match="corrupt"):
        decode(encode(take_snapshot(pipeline, t_ns, None))[:cut])


def test_age_decides(fog_map, lag_model, ran):
    pipeline, _, t_ns = ran
    checkpoint = decode(encode(take_snapshot(pipeline, t_ns, None)))
    limit_ns = round(oldest_s(pipeline) * SECOND)
    for age in (0, limit_ns):
        check_fits(checkpoint, fresh(fog_map, lag_model), t_ns + age, None)
    for age in (-1, limit_ns + SECOND):
        with pytest.raises(RequestError, match="stale"):
            check_fits(checkpoint, fresh(fog_map, lag_model), t_ns + age, None)


def test_no_state_is_taken_up_beyond_its_own_memory(fog_map, lag_model, ts_model):
    def limit(tau_s):
        quick = msgspec.structs.replace(lag_model, terms=[Term("thermal_lag", {"tau_s": tau_s})])
        return oldest_s(fresh(fog_map, quick))

    assert limit(20.0) == pytest.approx(20.0)
    assert limit(5000.0) == oldest_s(fresh(fog_map, ts_model)) == 300.0


def test_other_models_channels_or_a_clock_that_was_set_are_foreign(fog_map, lag_model, ts_model, ran):
    pipeline, _, t_ns = ran
    checkpoint = decode(encode(take_snapshot(pipeline, t_ns, 7 * SECOND)))
    with pytest.raises(RequestError, match="other models"):
        check_fits(checkpoint, fresh(fog_map, ts_model), t_ns, None)
    renamed = msgspec.structs.replace(checkpoint, channels=["pitch"])
    with pytest.raises(RequestError, match="pitch"):
        check_fits(renamed, fresh(fog_map, lag_model), t_ns, None)
    check_fits(checkpoint, fresh(fog_map, lag_model), t_ns + 5 * SECOND, 12 * SECOND)
    with pytest.raises(RequestError, match=r"clock was set by -85\.0 s"):
        check_fits(checkpoint, fresh(fog_map, lag_model), t_ns + 5 * SECOND, 97 * SECOND)


@pytest.mark.parametrize(
    "change", [{"terms": []}, {"terms": [["x"]]}, {"times": [[2**70] * 3]}, {"filters": [[None] * 4]}]
)
def test_shapes_and_numbers_that_do_not_fit_change_nothing(fog_map, lag_model, ran, change):
    pipeline, _, t_ns = ran
    checkpoint = msgspec.structs.replace(decode(encode(take_snapshot(pipeline, t_ns, None))), **change)
    other = fresh(fog_map, lag_model)
    before = [array.tobytes() for array in (*other.state, *other.loop)]
    with pytest.raises(RequestError, match="corrupt"):
        restore(checkpoint, other, power_on=True)
    assert [array.tobytes() for array in (*other.state, *other.loop)] == before


def test_after_another_start_of_the_machine_power_on_is_unknown(fog_map, lag_model, ran):
    pipeline, _, t_ns = ran
    checkpoint = decode(encode(take_snapshot(pipeline, t_ns, None)))
    other = fresh(fog_map, lag_model)
    restore(msgspec.structs.replace(checkpoint, boot="an earlier one"), other, power_on=True)
    assert other.state.times[0, T_POWER_ON] == NEVER


@pytest.mark.parametrize("content", [None, b"", b"{}", b"\xff\xfe", b"[" * 5000])
def test_whatever_the_file_holds_the_run_starts_unsettled(
    tmp_path, fog_map, fog_frames, ts_model, content, caplog
):
    path = tmp_path / "state.json"
    if content is not None:
        path.write_bytes(content)
    pipeline, frames = fresh(fog_map, ts_model), fog_frames(1.0)
    checkpointer = Checkpointer(str(path), live=False)
    assert not checkpointer.start(pipeline, int(frames["t_ns"][0]), power_on=True)
    samples = pipeline.process_all(frames).corrected
    assert (samples["flags"] & Flag.UNSETTLED).astype(bool).tolist() == [True] + [False] * (len(samples) - 1)
    checkpointer.offer(pipeline, int(frames["t_ns"][-1]))
    checkpointer.close(pipeline)
    assert checkpointer.counts == {
        "restored": 0,
        "refused": int(content is not None),
        "written": 1,
        "failed": 0,
    }
    assert ("refused" in caplog.text) == (content is not None)
    assert decode(path.read_bytes()).channels == ["yaw"]


def test_a_disk_that_takes_nothing_is_counted_and_harms_nobody(tmp_path, fog_map, lag_model, ran, caplog):
    pipeline, _, t_ns = ran
    checkpointer = Checkpointer("/dev/full", live=False)
    checkpointer.start(pipeline, t_ns, power_on=True)
    checkpointer.offer(pipeline, t_ns)
    checkpointer.close(pipeline)
    assert checkpointer.counts["failed"] == 1
    assert "No space left" in caplog.text


def test_the_folder_must_be_there():
    with pytest.raises(RequestError, match="no such folder"):
        Checkpointer("/absent/state.json", live=True)


def test_two_runs_over_two_halves_are_one_run_over_the_whole(tmp_path, fog_frames, lag_model):
    frames, model, state = fog_frames(20.0), tmp_path / "model.json", tmp_path / "state.json"
    save_model(lag_model, model)
    flags = []
    for name, part in (("a", frames[:1100]), ("b", frames[1100:])):
        with CandumpWriter(tmp_path / f"{name}.log") as writer:
            writer.append(part)
        command = [sys.executable, "-m", "rtcomp", "run", "--log", str(writer.path), "--model", str(model),
                   "--state", str(state), "--json"]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        flags.append(json.loads(done.stdout.splitlines()[-1]))
    assert [run["state"]["restored"] for run in flags] == [0, 1]
    assert "temperature_missing" not in flags[1]["flags"]
    assert (
        flags[1]["flags"]["unsettled"] == flags[1]["samples"]
    )  # still inside five time constants, and says so
