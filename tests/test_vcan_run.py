"""The whole chain on vcan0: recorded traces replayed, run, and taken by a subscriber in another process."""

import json
import subprocess
import sys

import numpy as np
import pytest
from vcan_parts import (
    BUS,
    PATIENCE_S,
    Collector,
    free_endpoint,
    running,
    same_but_publishing,
    send,
    taken,
    wait_for,
    zenoh_config,
)

from rtcomp.demo import MODEL, TRACE
from rtcomp.model import save_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.run import load_stacks
from rtcomp.signal_map import load_map
from rtcomp.sources.bus import open_bus
from rtcomp.sources.candump import write_candump
from rtcomp.sources.logs import read_log
from rtcomp.zenoh_session import open_session

pytestmark = pytest.mark.vcan


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A subscriber in another process, and the configuration of a session that reaches it."""
    folder, endpoint = tmp_path_factory.mktemp("zenoh"), free_endpoint()
    theirs = zenoh_config(folder / "theirs.json5", listen=[endpoint])
    ours = zenoh_config(folder / "ours.json5", connect=[endpoint])
    collector = Collector(theirs)
    yield collector, ours
    collector.kill()


def excerpt(path, frames, folder):
    """The first frames of a log as a log of their own, and how many of them a map's filters let through."""
    arrays, count = [], 0
    for array in read_log(path):
        arrays.append(array[: frames - count].copy())
        count += len(arrays[-1])
        if count == frames:
            break
    log = folder / "excerpt.log"
    write_candump(log, np.concatenate(arrays))
    return log, np.concatenate(arrays)


def let_through(frames, filters):
    fits = [
        (frames["can_id"] & mask == can_id & mask) & (frames["flags"] & 1 == extended)
        for can_id, mask, extended in filters
    ]
    return np.logical_or.reduce(fits)


TRACES = {
    "drive of a car, recorded": ("css_vw_drive.log.gz", "css_canmod_gps", None),
    "factory yaw rate of a car, recorded": ("comma2k19_rav4_bus0.log.gz", "toyota_kinematics", None),
    "cold start, simulated": (TRACE, "fog_simulated", MODEL),
}


@pytest.mark.parametrize("name", TRACES)
def test_vcan_trace_arrives_whole_in_order_and_bit_for_bit(name, network, request, tmp_path):
    collector, config = network
    source, map_name, model = TRACES[name]
    path = source if model else request.getfixturevalue("recordings") / source  # ours comes with the package
    _, frames = excerpt(path, 1500, tmp_path)
    compiled = compile_map(load_map(map_name))
    wanted = let_through(frames, compiled.filters)
    options = {
        "map": map_name,
        "model": [str(model)] if model else [],
        "prefix": f"t{list(TRACES).index(name)}",
    }
    assert collector.ask("clear") == "cleared"
    session = open_session(config)
    with running(session, record=str(tmp_path / "kept.log"), **options) as runner:
        wait_for(lambda: runner.publisher.wait_for_subscribers(0.0), "the subscriber")
        assert send(frames) == len(frames)
        taken(runner, int(wanted.sum()))
    session.close()
    summary = runner.summary()
    assert (summary["frames"], summary["lost"]) == (wanted.sum(), 0)
    kept = np.concatenate(list(read_log(tmp_path / "kept.log")))
    for field in ("can_id", "flags", "length", "data"):
        assert kept[field].tolist() == frames[wanted][field].tolist()  # nothing lost, order kept
    pipeline = Pipeline(compiled, load_stacks(options["model"], compiled.channel_names, None))
    pipeline.power_on(int(kept["t_ns"][0]))
    offline = pipeline.process_all(kept)
    collector.settle(len(offline.corrected))
    for index, channel in enumerate(compiled.channel_names):
        online = collector.samples(f"{options['prefix']}/{channel}/rate", tmp_path / "samples")
        assert np.array_equal(online["seq"], np.arange(len(online)))
        assert same_but_publishing(online, offline.corrected[offline.channel == index]) == []


def test_vcan_compiled_loop_gives_the_same_bits_as_offline(network, lag_model, fog_frames, tmp_path):
    """Without --record Python sees no frame; a second receiver with the run's own clock keeps them."""
    collector, config = network
    save_model(lag_model, tmp_path / "model.json")
    frames = fog_frames(8.0)
    assert collector.ask("clear") == "cleared"
    session = open_session(config)
    with running(session, model=[str(tmp_path / "model.json")], prefix="live") as runner:
        wait_for(lambda: runner.publisher.wait_for_subscribers(0.0), "the subscriber")
        with open_bus(BUS, runner.map.filters, runner.clock) as beside:
            assert send(frames, speed=20) == len(frames)
            taken(runner, len(frames))
            kept = [beside.receive(1.0).copy()]
            while len(part := beside.receive(0.2)):
                kept.append(part.copy())
    session.close()
    kept = np.concatenate(kept)
    pipeline = Pipeline(runner.map, {"yaw": [lag_model]}, int(kept["t_ns"][0]))
    offline = pipeline.process_all(kept).corrected
    collector.settle(len(offline))
    online = collector.samples("live/yaw/rate", tmp_path / "samples")
    assert same_but_publishing(online, offline) == []
    stages = runner.summary()["stages_us"]
    assert all(
        stages[name]["p50"] <= stages[name]["p99"] for name in ("receive", "correct", "publish", "total")
    )
    assert runner.summary()["receive_cpu_s"] > 0.0


def rtcomp(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "rtcomp", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_vcan_commands_go_together_and_training_from_the_bus_gives_the_files_model(network, tmp_path):
    """`rtcomp replay` → `rtcomp run --record` → `rtcomp train`, each a process; and the subscriber."""
    collector, config = network
    log, frames = excerpt(TRACE, 1500, tmp_path)
    assert collector.ask("clear") == "cleared"
    kept = tmp_path / "kept.log"
    run = rtcomp("run", "--bus", BUS, "--map", "fog_simulated", "--model", MODEL, "--zenoh", config,
                 "--prefix", "car", "--record", kept, "--wait-subscriber", "60", "--json")  # fmt: skip
    while "publishing" not in (line := run.stderr.readline()):
        assert line, "the run ended before it began"
    sender = rtcomp("replay", log, "--bus", BUS, "--speed", "10", "--json")
    out, err = sender.communicate(timeout=PATIENCE_S)
    assert sender.returncode == 0, err
    report = json.loads(out)
    assert (report["sent"], report["failed"]) == (len(frames), 0)
    rates = int((frames["can_id"] == 0xA0).sum())
    collector.settle(rates)
    run.terminate()
    out, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, err
    summary = json.loads(out.splitlines()[-1])
    assert (summary["frames"], summary["lost"], summary["published"]) == (len(frames), 0, rates)
    online = collector.samples("car/yaw/rate", tmp_path / "samples")
    assert np.array_equal(online["seq"], np.arange(rates))
    models = []
    for recording in (log, kept):
        path = tmp_path / f"{recording.stem}.json"
        command = rtcomp("train", recording, "--map", "fog_simulated", "--method", "gk-rls", "-o", path)
        _, err = command.communicate(timeout=2 * PATIENCE_S)
        assert command.returncode == 0, err
        models.append(json.loads(path.read_text()))
    assert models[0]["rules"] == models[1]["rules"]
    assert models[0]["validity"] == models[1]["validity"]
    assert models[0]["residual_std_dps"] == models[1]["residual_std_dps"]


def test_vcan_replay_fidelity_is_reported_at_every_speed(fog_frames):
    """What it is, is the machine's business; that it is, and that nothing is lost meanwhile, is ours."""
    from rtcomp.sources.bus import open_can
    from rtcomp.sources.transmit import replay

    frames = fog_frames(2.0)
    for speed in (1.0, 10.0, 0):
        with open_bus(BUS) as source, open_can(BUS) as bus:
            report = replay([frames], bus, speed)
            got = 0
            while len(part := source.receive(0.3)):
                got += len(part)
        assert (report.sent, got, source.lost) == (len(frames), len(frames), 0)
        assert (report.gap_error_us["p99"] is None) == (speed == 0)
        if speed:
            assert report.seconds >= 1.99 / speed
