"""A subscriber that tells the run when the samples got there."""

import threading

import pytest

from rtcomp.config import RunConfig
from rtcomp.latency import PERCENTILES
from rtcomp.probe import Probe, read_told
from rtcomp.run import Runner
from rtcomp.sources.bus import open_can
from rtcomp.sources.transmit import replay
from rtcomp.zenoh_session import open_session
from tests.test_run import wait_for


def test_a_run_shows_what_a_probe_tells(fog_frames):
    frames = fog_frames(1.0)
    with open_session(None) as session:
        runner = Runner(RunConfig(bus="virtual:test-probe"))
        runner.start(session)
        probe = Probe(session, "rtcomp")
        loop = threading.Thread(target=runner.loop)
        loop.start()
        with open_can("virtual:test-probe") as bus:
            replay([frames], bus, 0)
        wait_for(lambda: probe.streams and probe.streams["rtcomp/yaw"].received == 100)
        told = probe.tell()["rtcomp/yaw"]
        wait_for(lambda: "received" in runner.publisher.latency_us())
        runner.stop()
        loop.join()
        runner.close()
        probe.close()
    assert (told["received"], told["missed"]) == (100, 0)
    stages = runner.summary()["stages_us"]
    assert stages["received"] == told["latency_us"]
    assert set(stages["received"]) == set(PERCENTILES)


@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b'{"received": 1, "missed": 0, "latency_us": {"p50": "x"}}', b"\xff" * 9000,
     b'{"received": 1, "missed": 0, "latency_us": {"other": 1.0}}'],
)  # fmt: skip
def test_what_is_no_report_changes_nothing(payload):
    assert read_told(payload) is None
