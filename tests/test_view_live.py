"""The live viewer against a real publisher on a real zenoh session, and the sinks."""

import json
import os
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.commands.view import command
from rtcomp.demo import MODEL
from rtcomp.errors import RequestError, WorkError
from rtcomp.frames import CORRECTED, Flag
from rtcomp.model import load_model, model_document
from rtcomp.publisher import Publisher
from rtcomp.sources.clock import SteadyClock
from rtcomp.view.live import Viewer
from rtcomp.view.rerun_sdk import quiet_environment
from rtcomp.view.run import ViewConfig, run_view
from rtcomp.view.sinks import LIVE_ROWS, check_display, free_port, open_sink
from rtcomp.zenoh_session import open_session
from tests.view_rrd import Rrd

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
START_NS = 1_700_000_000_000_000_000


def samples(first: int, count: int, flags: int = 0) -> np.ndarray:
    rows = np.zeros(count, CORRECTED)
    k = np.arange(first, first + count)
    rows["t_ns"], rows["seq"] = START_NS + k * 1_000_000, k
    rows["ref_rate_dps"] = 30.0 * np.sin(k / 300.0)
    rows["rate_raw_dps"], rows["rate_dps"] = rows["ref_rate_dps"] + 1.0, rows["ref_rate_dps"] + 0.01
    rows["correction_dps"], rows["sigma_dps"], rows["temp_degC"] = 0.99, 0.02, 20.0 + k / 1000.0
    rows["flags"] = flags
    return rows


class Stream:
    """A publisher of three channels."""

    names = ("x", "y", "z")

    def __init__(self, session) -> None:
        self.publisher = Publisher(session, "t", self.names, SteadyClock(), lossless=True)
        self.publisher.models = {"x": model_document(load_model(MODEL)), "y": None, "z": None}
        self.publisher.health = lambda name: {"losses": {"receiver": 2, "queue": 1}, "rejected": {"crc": 4}}
        self.publisher.start()

    def send(self, rows: np.ndarray) -> None:
        for channel in range(len(self.names)):
            self.publisher.offer(rows, np.full(len(rows), channel, np.uint8), 0)


@pytest.fixture
def session():
    opened = open_session(None)
    yield opened
    opened.close()


def wait_for(condition, timeout_s=60.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def rows(viewer):
    return list(viewer.counts()["channels"].values())


def watch(session, path, sends):
    """Send arrays of samples one after the other, each when the last has been logged."""
    with open_sink(save=path) as sink:
        viewer = Viewer(session, "t", sink)
        viewer.start()
        stream = Stream(session)
        wait_for(lambda: len(viewer.channels) == 3 and not viewer._unsure)  # its questions are answered
        sent = 0
        for rows in sends:
            stream.send(rows)
            sent += len(rows)
            for name in Stream.names:
                wait_for(lambda: viewer.counts()["channels"][name]["logged"] == sent)  # noqa: B023 - called at once
        stream.publisher.close()
        viewer.stop()
    return viewer.counts(), Rrd(path)


def test_every_sample_of_every_channel_arrives_with_its_values(session, tmp_path):
    counts, rrd = watch(session, tmp_path / "l.rrd", [samples(0, 800), samples(800, 700)])
    rows = samples(0, 1500)
    for name in Stream.names:
        t_ns, rates = rrd.scalars(f"/{name}/rate")
        assert t_ns.tolist() == rows["t_ns"].tolist()
        assert (
            rates.tolist()
            == np.stack([rows[c] for c in ("rate_raw_dps", "rate_dps", "ref_rate_dps")], -1).tolist()
        )
        assert counts["channels"][name] == {"logged": 1500, "missed": 0, "thinned": 0}
    assert "/x/surface/before/model/mesh" in rrd.entities
    assert "/y/surface/before/model/mesh" not in rrd.entities
    assert "/y/surface/before/measured" in rrd.entities
    losses = rrd.scalars("/x/losses")[1]
    assert losses[-1].tolist() == [2, 1, 4, 0, 0]


def test_gaps_restarts_and_flags_are_told(session, tmp_path):
    grave = int(Flag.TEMPERATURE_STALE)
    sends = [samples(0, 100), samples(150, 50, grave), samples(200, 50), samples(0, 30)]
    counts, rrd = watch(session, tmp_path / "g.rrd", sends)
    assert counts["channels"]["x"]["missed"] == 50
    states = [state[0] for _, state in rrd.column("/x/status/temperature_stale", "StateChange:state")]
    assert states == ["yes", ""]
    when = [t for t, _ in rrd.column("/x/status/temperature_stale", "StateChange:state")]
    assert when == [START_NS + 150_000_000, START_NS + 200_000_000]


def test_a_flood_is_thinned_for_a_screen_and_counted(session, tmp_path):
    with open_sink(save=tmp_path / "f.rrd") as sink:
        sink.rows_per_batch = LIVE_ROWS
        viewer = Viewer(session, "t", sink)
        viewer.start()
        stream = Stream(session)
        stream.send(samples(0, 9_000))
        stream.publisher.close()
        wait_for(lambda: [c["logged"] + c["thinned"] + c["missed"] for c in rows(viewer)] == [9_000] * 3)
        viewer.stop()
    for row in viewer.counts()["channels"].values():
        assert row["logged"] + row["thinned"] + row["missed"] == 9_000
        assert row["thinned"] > 0
        assert row["logged"] < 7_000


def test_a_publisher_that_starts_anew_is_shown_again(tmp_path):
    quiet, at = "scouting: {multicast: {enabled: false}}", f"tcp/127.0.0.1:{free_port('127.0.0.1')}"
    client, peer = tmp_path / "client.json5", tmp_path / "peer.json5"
    client.write_text(f'{{mode: "client", {quiet}, connect: {{endpoints: ["{at}"]}}}}')
    peer.write_text(f'{{mode: "peer", {quiet}, listen: {{endpoints: ["{at}"]}}}}')
    vehicle = open_session(str(peer))
    watching = open_session(str(client))
    with open_sink(save=tmp_path / "r.rrd") as sink:
        viewer = Viewer(watching, "t", sink)
        viewer.start()
        for start in (0, 40_000):  # ms; the second run counts its samples from 0 again
            stream = Stream(vehicle)
            assert stream.publisher.wait_for_subscribers(30.0)
            rows = samples(0, 200)
            rows["t_ns"] += start * 1_000_000
            before = viewer.counts()["channels"].get("z", {}).get("logged", 0)
            stream.send(rows)
            stream.publisher.close()
            wait_for(lambda: viewer.counts()["channels"].get("z", {}).get("logged") == before + 200)  # noqa: B023
            vehicle.close()
            if not start:
                wait_for(lambda: not viewer.channels["z"].running)
                vehicle = open_session(str(peer))
        viewer.stop()
    watching.close()
    rrd = Rrd(tmp_path / "r.rrd")
    assert rrd.rows("/x/rate") == 400
    states = [state[0] for _, state in rrd.column("/x/status/stream", "StateChange:state")]
    assert states == ["running", "paused", "running"]
    assert viewer.counts()["channels"]["x"] == {"logged": 400, "missed": 0, "thinned": 0}


def test_a_window_that_the_person_closes_ends_the_viewing_without_a_word(session, tmp_path):
    with open_sink(web=True, web_port=0, save=tmp_path / "c.rrd") as sink:
        viewer = Viewer(session, "t", sink)
        viewer.start()
        stream = Stream(session)
        stream.send(samples(0, 100))
        wait_for(viewer.seen)
        sink.viewer.kill()
        wait_for(lambda: not viewer.running())
        viewer.stop()
        stream.publisher.close()
    assert Rrd(tmp_path / "c.rrd").rows("/x/rate") == 100


@pytest.mark.parametrize("encoding", ["json", "cdr"])
def test_whatever_the_rates_are_encoded_as_the_viewer_gets_every_value(session, tmp_path, encoding):
    with open_sink(save=tmp_path / "j.rrd") as sink:
        viewer = Viewer(session, "t", sink)
        viewer.start()
        aliases = {"x": "0/imu/sensor_msgs::msg::dds_::Imu_/hash"}
        publisher = Publisher(
            session, "t", ("x",), SteadyClock(), encoding=encoding, lossless=True, aliases=aliases
        )
        assert publisher.wait_for_subscribers(5.0)
        publisher.start()
        publisher.offer(samples(0, 50), np.zeros(50, np.uint8), 0)
        publisher.close()
        wait_for(lambda: viewer.counts()["channels"].get("x", {}).get("logged") == 50)
        viewer.stop()
    _, rates = Rrd(tmp_path / "j.rrd").scalars("/x/rate")
    assert rates[:, 1].tolist() == samples(0, 50)["rate_dps"].tolist()


def test_what_is_not_ours_is_said_in_one_sentence(session, tmp_path):
    session.declare_queryable("t/x/schema", lambda query: query.reply("t/x/schema", '{"size": 3}'))
    session.declare_queryable("t/y/schema", lambda query: query.reply("t/y/schema", "<html>"))
    for key, payload, told in (
        ("t/x/batch", b"abc", "t/x/schema is not a sample's layout"),
        ("t/y/batch", b"abc", "t/y/schema says what is not JSON"),
        ("t/z/batch", b"abc", "3 bytes are not samples"),
    ):
        with open_sink(save=tmp_path / "n.rrd") as sink:
            viewer = Viewer(session, "t", sink)
            viewer.start()
            session.put(key, payload)
            wait_for(lambda: not viewer.running())  # noqa: B023 - called at once
            with pytest.raises(WorkError, match=told):
                viewer.stop()


def test_no_display_and_no_stream_are_said_in_one_sentence(monkeypatch, tmp_path):
    nobody, somebody = tmp_path / "nobody.json5", tmp_path / "somebody.json5"
    quiet, at = "scouting: {multicast: {enabled: false}}", f"tcp/127.0.0.1:{free_port('127.0.0.1')}"
    nobody.write_text(f'{{mode: "client", {quiet}, connect: {{endpoints: ["{at}"]}}}}')
    somebody.write_text(f'{{mode: "peer", {quiet}, listen: {{endpoints: ["{at}"]}}}}')
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RequestError, match="--web"):
        check_display()
    with pytest.raises(WorkError, match="rtcomp run"):
        run_view(ViewConfig(save=str(tmp_path / "n.rrd"), zenoh=str(nobody), wait_s=0.0), print)
    with open_session(str(somebody)), pytest.raises(WorkError, match="rtcomp run"):
        run_view(ViewConfig(save=str(tmp_path / "n.rrd"), zenoh=str(nobody), wait_s=2.0), print)
    with pytest.raises(RequestError, match=r"\.rrd"):
        run_view(ViewConfig(files=[str(MODEL)], save=str(tmp_path / "n.txt")), print)
    assert sorted(tmp_path.iterdir()) == sorted([nobody, somebody])


@pytest.mark.parametrize("size", ["lots", "64M", "5KB", "-1GB", "1 GB", ""])
def test_a_memory_limit_that_rerun_cannot_read_is_refused_before_anything_is_waited_for(size):
    told = CliRunner().invoke(command, ["--memory-limit", size])
    assert told.exit_code == 2
    assert "256MiB" in told.stderr


def test_without_rerun_the_way_on_is_said(tmp_path):
    (tmp_path / "rerun.py").write_text("raise ImportError('not here')")
    code = "import sys; from rtcomp.cli import main; main(['view', '--save', 'x.rrd'])"
    told = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": f"{tmp_path}:{os.getcwd()}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert told.returncode == 1
    assert "pip install rerun-sdk" in told.stderr
    assert "Traceback" not in told.stderr


def test_nothing_of_rerun_is_loaded_by_the_command_line():
    code = "import sys, rtcomp.cli, rtcomp.commands.view, rtcomp.run; print('rerun' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "False"


def test_analytics_are_off_in_what_we_start():
    from rtcomp.view.rerun_sdk import rerun_program

    quiet = quiet_environment()
    told = subprocess.run(
        [rerun_program(), "analytics", "config"], env=quiet, capture_output=True, text=True, check=True
    )
    start = told.stdout.index("{")
    assert json.loads(told.stdout[start : told.stdout.rindex("}") + 1])["analytics_enabled"] is False


def test_the_page_is_on_loopback_and_may_reach_nobody_else(tmp_path):
    with open_sink(web=True, web_port=0, save=tmp_path / "w.rrd") as sink:
        assert sink.url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(sink.url, timeout=10) as page:  # noqa: S310 - our own page
            policy = page.headers["Content-Security-Policy"]
            assert b"<html" in page.read().lower()
        assert "connect-src 'self' data: blob: http://127.0.0.1:" in policy
        assert "rerun.io" not in policy
        listening = subprocess.run(["ss", "-ltnp"], capture_output=True, text=True, check=False).stdout
        ours = [line.split()[3] for line in listening.splitlines() if f"pid={sink.viewer.pid}," in line]
        assert ours
        assert all(address.startswith("127.0.0.1:") for address in ours)
        assert sink.alive()
    assert not sink.alive()
    assert (tmp_path / "w.rrd").is_file()
