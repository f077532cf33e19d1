"""Whole runs: real buses, real zenoh sessions, real processes; what is recorded gives the same bits again."""

import json
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from rtcomp import fog_format
from rtcomp.config import RunConfig, load_config, override
from rtcomp.errors import RequestError
from rtcomp.frames import CORRECTED, Flag
from rtcomp.model import model_document, parse_model, save_model
from rtcomp.pipeline import Pipeline
from rtcomp.run import Runner, load_stacks
from rtcomp.sources.bus import open_can
from rtcomp.sources.candump import CandumpWriter
from rtcomp.sources.logs import read_log
from rtcomp.sources.transmit import replay
from rtcomp.zenoh_session import open_session


class Listener:
    """Collects what is published under a key."""

    def __init__(self, session, key):
        self.payloads = []
        self._subscriber = session.declare_subscriber(
            key, lambda m: self.payloads.append(m.payload.to_bytes())
        )

    def samples(self):
        return np.frombuffer(b"".join(self.payloads), CORRECTED)


def live(config, frames, during=lambda runner: None, speed=0):
    """Run `config` on a virtual bus while `frames` are sent; returns the runner and what a subscriber got."""
    runner = Runner(config)
    session = open_session(None)
    listener = Listener(session, f"{config.prefix}/*/rate")
    runner.start(session)
    loop = threading.Thread(target=runner.loop)
    loop.start()
    with open_can(config.bus) as bus:
        half = len(frames) // 2
        for part, sent in ((frames[:half], half), (frames[half:], len(frames))):
            replay([part], bus, speed=speed, stop=threading.Event())
            wait_for(lambda sent=sent: runner.pipeline.counts["frames"] >= sent)
            during(runner)
    runner.stop()
    loop.join()
    runner.close()
    session.close()
    return runner, listener


def wait_for(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.01)


@pytest.fixture
def model_file(tmp_path, lag_model):
    save_model(lag_model, tmp_path / "model.json")
    return str(tmp_path / "model.json")


def test_a_live_run_publishes_every_rate_frame_and_its_record_gives_the_same_bits(
    tmp_path, fog_frames, model_file
):
    frames = fog_frames(8.0)
    record = tmp_path / "kept.log"
    config = RunConfig(bus="virtual:test-run", model=[model_file], record=str(record))
    runner, listener = live(config, frames)
    online = listener.samples()
    assert len(online) == np.count_nonzero(frames["can_id"] == fog_format.RATE_ID)
    assert np.array_equal(online["seq"], np.arange(len(online)))
    assert (online["t_pub_ns"] >= online["t_ns"]).all()
    kept = np.concatenate(list(read_log(record)))
    pipeline = Pipeline(runner.map, load_stacks([model_file], ("yaw",), None), int(kept["t_ns"][0]))
    offline = pipeline.process_all(kept).corrected
    for name in CORRECTED.names:
        if name != "t_pub_ns":
            assert offline[name].tobytes() == online[name].tobytes(), name
    summary = runner.summary()
    assert summary["lost"] == 0
    assert summary["latency_us"]["p50"] > 0


SUBSCRIBER = """
import json, sys, time, numpy as np, zenoh
config = zenoh.Config.from_file(sys.argv[1])
with zenoh.open(config) as session:
    print("ready", flush=True)
    layout = None
    while layout is None:
        for reply in session.get("fleet/yaw/schema", timeout=1.0):
            layout = json.loads(reply.ok.payload.to_string())
        time.sleep(0.05)
    payloads = []
    subscriber = session.declare_subscriber("fleet/yaw/rate", lambda m: payloads.append(m.payload.to_bytes()))
    seen, quiet = -1, 0
    while quiet < 15:
        quiet = quiet + 1 if len(payloads) == seen and seen > 0 else 0
        seen = len(payloads)
        time.sleep(0.1)
names, kinds, offsets = zip(*layout["fields"])
dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": layout["size"]})
samples = np.frombuffer(b"".join(payloads), dtype)
np.save(sys.argv[2], samples)
"""


def endpoint_configs(tmp_path, port):
    common = {"mode": "peer", "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}}}
    ours = common | {"connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}, "listen": {"endpoints": []}}
    theirs = common | {"listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}
    paths = []
    for name, document in (("ours", ours), ("theirs", theirs)):
        path = tmp_path / f"{name}.json5"
        path.write_text(json.dumps(document))
        paths.append(str(path))
    return paths


def free_port():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def rtcomp(*arguments, **options):
    command = [sys.executable, "-m", "rtcomp", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)


def test_a_foreign_subscriber_reads_the_stream_from_its_schema_alone(tmp_path, fog_frames, ts_model):
    ours, theirs = endpoint_configs(tmp_path, free_port())
    log, model = tmp_path / "drive.log", tmp_path / "model.json"
    frames = fog_frames(60.0)
    with CandumpWriter(log) as writer:
        writer.append(frames)
    save_model(ts_model, model)
    got = tmp_path / "got.npy"
    with subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER, theirs, str(got)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline().strip() == "ready"
        result = rtcomp("run", "--log", str(log), "--model", str(model), "--zenoh", ours, "--prefix", "fleet",
                        "--wait-subscriber", "60", "--json")  # fmt: skip
        assert result.returncode == 0, result.stderr
        assert process.wait(timeout=60) == 0
    samples = np.load(got)
    assert len(samples) == np.count_nonzero(frames["can_id"] == fog_format.RATE_ID)
    assert np.array_equal(samples["seq"], np.arange(len(samples)))
    assert np.array_equal(samples["rate_dps"], samples["rate_raw_dps"] - samples["correction_dps"])
    v, sigma, a = (
        np.array(x) for x in (ts_model.rules.centers, ts_model.rules.widths, ts_model.rules.consequents)
    )
    x = np.column_stack([samples["temp_degC"], samples["rate_raw_dps"]])
    w = np.exp(-0.5 * ((x[:, None] - v) / sigma) ** 2).prod(axis=2)
    expected = (w * (a[:, 0] + x @ a[:, 1:].T)).sum(axis=1) / w.sum(axis=1)
    assert np.abs(expected - samples["correction_dps"]).max() < 1e-9
    summary = json.loads(result.stdout.splitlines()[-1])
    assert summary["published"] == len(samples)


def test_model_schema_health_and_alive_are_served(fog_frames, lag_model, model_file):
    config = RunConfig(bus="virtual:test-served", model=[model_file], prefix="p")
    served = {}

    def ask(runner):
        session = runner.publisher.session
        served["model"] = [r.ok.payload.to_string() for r in session.get("p/yaw/model")]
        served["schema"] = [json.loads(r.ok.payload.to_string()) for r in session.get("p/*/schema")]
        served["alive"] = [str(r.ok.key_expr) for r in session.liveliness().get("p/*/alive")]
        served["health"] = Listener(session, "p/yaw/health")
        wait_for(lambda: served["health"].payloads)

    live(config, fog_frames(2.0), ask)
    assert json.loads(served["model"][0]) == json.loads(json.dumps(model_document(lag_model)))
    assert served["schema"][0]["size"] == CORRECTED.itemsize
    assert served["alive"] == ["p/yaw/alive"]
    health = json.loads(served["health"].payloads[0])
    assert health["channel"] == "yaw"
    assert set(health["stages_us"]) == {"receive", "correct", "publish", "total"}


def test_a_model_put_to_the_opt_in_key_is_swapped_in_and_a_broken_one_is_not(
    fog_frames, ts_model, model_file
):
    config = RunConfig(bus="virtual:test-swap", model=[model_file], allow_swap=True)

    document = json.dumps(model_document(ts_model))
    swapped_in = parse_model(document, "the model put")

    def put(runner):
        before = sum(runner.swapper.counts.values())
        session = runner.publisher.session
        session.put("rtcomp/yaw/model/swap", b"{broken")
        session.put("rtcomp/yaw/model/swap", document)
        wait_for(lambda: sum(runner.swapper.counts.values()) >= before + 2)

    runner, listener = live(config, fog_frames(4.0), put)
    samples = listener.samples()
    assert runner.swapper.counts == {"accepted": 2, "refused": 2}  # put twice, once per half
    assert np.array_equal(samples["seq"], np.arange(len(samples)))
    swapped = samples["flags"] & Flag.MODEL_SWAPPED
    assert np.count_nonzero(swapped) == 1  # the second came after the last frame
    assert runner.pipeline.stacks[0][0] == swapped_in


def test_swaps_are_off_by_default(fog_frames, ts_model, model_file):
    def put(runner):
        runner.publisher.session.put("rtcomp/yaw/model/swap", json.dumps(model_document(ts_model)))

    runner, _ = live(RunConfig(bus="virtual:test-no-swap", model=[model_file]), fog_frames(1.0), put)
    assert runner.swapper.counts == {"accepted": 0, "refused": 0}


@pytest.mark.parametrize("encoding", ["json", "cdr"])
def test_other_encodings_carry_the_same_rates(fog_frames, encoding):
    frames = fog_frames(1.0)
    runner, listener = live(RunConfig(bus=f"virtual:test-{encoding}", encoding=encoding), frames)
    rates = Pipeline(runner.map).process_all(frames).corrected["rate_dps"]
    if encoding == "json":
        got = [json.loads(payload)["rate_dps"] for payload in listener.payloads]
        assert np.array_equal(got, rates)
    else:
        at = (
            4 + 16 + 8 * (4 + 9 + 2)
        )  # encapsulation, header with "yaw", quaternion and its covariance, x and y
        got = [np.frombuffer(payload, "<f8", 1, at)[0] for payload in listener.payloads]
        assert np.allclose(got, np.radians(rates), rtol=1e-12)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_silent_bus_does_not_hold_up_a_stop(number):
    command = [sys.executable, "-m", "rtcomp", "run", "--bus", "virtual:silent", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while "publishing" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(number)
        started = time.monotonic()
        out, err = process.communicate(timeout=20)
        assert process.returncode == 0, err
        assert time.monotonic() - started < 5
    assert json.loads(out.splitlines()[-1])["frames"] == 0


def test_rates_of_both_real_logs_are_cantools_own(recordings):
    import cantools

    from rtcomp.plan import compile_map
    from rtcomp.signal_map import load_map

    cases = [
        (
            "css_vw_drive.log.gz",
            "css_canmod_gps",
            "css_gnss.dbc",
            9,
            ["AngularRateX", "AngularRateY", "AngularRateZ"],
        ),
        ("comma2k19_rav4_bus0.log.gz", "toyota_kinematics", "toyota_2017_subset.dbc", 0x24, ["YAW_RATE"]),
    ]
    expected_counts = [526_432, 4_974]
    for (log, name, dbc, can_id, signals), count in zip(cases, expected_counts, strict=True):
        compiled = compile_map(load_map(name))
        frames = np.concatenate(list(read_log(recordings / log)))
        mine = frames[(frames["can_id"] == can_id) & (frames["flags"] == 0)]
        samples = Pipeline(compiled).process_all(frames)
        assert len(mine) == count
        message = cantools.database.load_file(recordings / dbc, strict=False).get_message_by_frame_id(can_id)
        payloads, first = np.unique(mine["data"][:, :8], axis=0, return_inverse=True)
        some = np.random.default_rng(0).choice(len(payloads), min(len(payloads), 20_000), replace=False)
        for ch, signal_name in enumerate(signals):
            sign = compiled.signal_map.channels[ch].rate.sign
            ours = samples.corrected[samples.channel == ch]
            assert np.array_equal(ours["t_ns"], mine["t_ns"])
            assert np.array_equal(ours["seq"], np.arange(count))
            theirs = np.full(len(payloads), np.nan)
            for k in some:
                theirs[k] = message.decode(payloads[k].tobytes(), decode_choices=False)[signal_name]
            known = np.isfinite(theirs[first.ravel()])
            assert np.array_equal(sign * theirs[first.ravel()][known], ours["rate_raw_dps"][known])


def test_configuration_file_and_command_line_go_together(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text('bus = "virtual:x"\nprefix = "car"\nmodel = ["yaw=m.json"]\n')
    config = override(load_config(path), prefix="truck", model=[], dbc=None)
    assert (config.bus, config.prefix, config.model) == ("virtual:x", "truck", ["yaw=m.json"])
    path.write_text('buss = "virtual:x"\n')
    with pytest.raises(RequestError, match="buss"):
        load_config(path)


def test_a_model_of_another_sensor_is_refused(tmp_path, ts_model):
    import msgspec

    save_model(msgspec.structs.replace(ts_model, sensor="A1"), tmp_path / "m.json")
    with pytest.raises(RequestError, match="sensor A1, but this is B2"):
        load_stacks([str(tmp_path / "m.json")], ("yaw",), "B2")
