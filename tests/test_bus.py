"""Live buses through python-can: opening, batches, time, shutdown, and what is refused."""

import subprocess
import sys
import threading
import time

import can
import numpy as np
import pytest

from rtcomp.errors import RequestError, WorkError
from rtcomp.frames import CLOCK_STEP_ID, FRAME, FrameFlag
from rtcomp.sources import clock as clock_module
from rtcomp.sources.bus import MAX_ERRORS, PythonCanSource, open_bus, open_can, parse_spec
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.events import describe_error
from rtcomp.sources.messages import to_frames, to_message


@pytest.fixture
def pair():
    """A source and a python-can bus on one virtual channel."""
    name = f"virtual:pair{time.monotonic_ns()}"
    with open_bus(name) as source, open_can(name) as sender:
        yield source, sender


def test_importing_sources_does_not_load_python_can():
    code = "import sys, rtcomp.sources.bus, rtcomp.sources.candump; sys.exit('can' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_opening_a_bus_does_not_load_what_only_mf4_logs_need():
    code = (
        "import sys\nfrom rtcomp.sources.bus import open_bus\nopen_bus('virtual:x').close()\n"
        "sys.exit('pandas' in sys.modules or 'asammdf' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("text", "interface", "channel", "options"),
    [
        ("virtual:rtcomp", "virtual", "rtcomp", {}),
        ("udp_multicast:239.0.0.1", "udp_multicast", "239.0.0.1", {}),
        ("udp_multicast:ff15::1?port=4000", "udp_multicast", "ff15::1", {"port": 4000}),
        ("socketcan:can0?fd=true&bitrate=500000", "socketcan", "can0", {"fd": True, "bitrate": 500000}),
        ("virtual", "virtual", None, {}),
    ],
)
def test_spec(text, interface, channel, options):
    spec = parse_spec(text)
    assert (spec.interface, spec.channel, spec.options) == (interface, channel, options)


@pytest.mark.parametrize("text", ["", ":can0", "virtual:x?novalue", "?a=b"])
def test_malformed_spec_is_refused(text):
    with pytest.raises(RequestError, match="wanted interface:channel"):
        open_bus(text)


@pytest.mark.parametrize(
    "text",
    [
        "socketcan:rtcomp_absent0",
        "nosuchinterface:0",
        "udp_multicast:notanaddress",
        "udp_multicast:239.0.0.1?port=-1",
    ],
)
def test_bus_that_does_not_exist_is_refused(text):
    with pytest.raises(RequestError, match="rtcomp doctor"):
        open_bus(text)


MESSAGES = [
    can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02\x03"),
    can.Message(arbitration_id=0x1ABCDEFF, is_extended_id=True, data=bytes(8)),
    can.Message(arbitration_id=0x7FF, is_extended_id=False, is_remote_frame=True, dlc=5),
    can.Message(
        arbitration_id=0x10, is_extended_id=False, is_fd=True, data=bytes(range(64)), bitrate_switch=True
    ),
    can.Message(arbitration_id=0x10, is_extended_id=False, is_fd=True, error_state_indicator=True),
    can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)),
    can.Message(arbitration_id=0x7FF, is_extended_id=False),
]


@pytest.mark.parametrize("name", ["virtual:kinds", "udp_multicast:239.74.163.7"])
def test_every_kind_of_frame_arrives(name):
    with open_bus(name) as source, open_can(name) as sender:
        got = []
        for message in MESSAGES:
            sender.send(message)
        deadline = time.monotonic() + 5
        while sum(map(len, got)) < len(MESSAGES) and time.monotonic() < deadline:
            got.append(source.receive(0.2).copy())
    frames = np.concatenate(got)
    wanted = to_frames(MESSAGES)
    for field in ("can_id", "flags", "length", "data"):
        assert frames[field].tolist() == wanted[field].tolist()


def test_conversion_there_and_back():
    frames = to_frames(MESSAGES)
    assert to_frames([to_message(frame) for frame in frames]).tobytes() == frames.tobytes()
    assert frames["length"].tolist() == [3, 8, 5, 64, 0, 8, 0]
    assert frames["flags"][5] == FrameFlag.ERROR


def test_an_error_frame_without_class_is_a_bus_error_and_no_clock_step():
    [frame] = to_frames([can.Message(is_error_frame=True)])
    assert describe_error(frame) == ["bus error"]


def test_queued_messages_come_as_one_batch_in_order(pair):
    source, sender = pair
    before = time.time_ns()
    for i in range(100):
        sender.send(can.Message(arbitration_id=i, is_extended_id=False))
    frames = source.receive(1.0)
    assert frames["can_id"].tolist() == list(range(100))
    assert np.all(np.diff(frames["t_ns"]) >= 0)
    assert before <= frames["t_ns"][0] <= frames["t_ns"][-1] <= time.time_ns() + 1_000_000
    assert len(source.receive(0.0)) == 0
    assert source.lost == 0


def test_silent_bus_returns_after_the_timeout(pair):
    source, _ = pair
    start = time.monotonic()
    assert len(source.receive(0.25)) == 0
    assert 0.2 <= time.monotonic() - start < 2


def test_wake_ends_a_long_wait(pair):
    source, _ = pair
    threading.Timer(0.05, source.wake).start()
    start = time.monotonic()
    assert len(source.receive(30.0)) == 0
    assert time.monotonic() - start < 2


class SteppedTime:
    """The time module with a host clock that was set."""

    monotonic_ns = staticmethod(time.monotonic_ns)

    def __init__(self):
        self.step_ns = 0

    def time_ns(self):
        return time.time_ns() + self.step_ns


@pytest.mark.parametrize("step_s", [3600, -5])
def test_clock_step_is_told_in_band_and_never_reaches_the_time(pair, monkeypatch, step_s):
    host = SteppedTime()
    monkeypatch.setattr(clock_module, "time", host)
    _, sender = pair
    source = PythonCanSource(
        open_can(sender.channel_info.replace("Virtual bus channel ", "virtual:")), "stepped"
    )
    with source:
        sender.send(MESSAGES[0])
        before = source.receive(1.0).copy()
        host.step_ns = step_s * 10**9
        sender.send(MESSAGES[0])
        after = source.receive(1.0).copy()
        again = source.receive(0.0)
    assert len(before) == 1
    assert after["can_id"].tolist() == [CLOCK_STEP_ID, 0x123]
    assert after["flags"].tolist() == [FrameFlag.ERROR, 0]
    told = int.from_bytes(after["data"][0, :8].tobytes(), "little", signed=True)
    assert told == pytest.approx(step_s * 10**9, abs=10**6)
    assert f"{step_s:+.3f} s" in describe_error(after[0])[0]
    assert 0 <= after["t_ns"][1] - before["t_ns"][0] < 10**9
    assert len(again) == 0


def test_steady_clock_reads_as_unix_time_and_sees_no_step_of_its_own():
    steady = SteadyClock()
    assert abs(steady.now_ns() - time.time_ns()) < 50_000_000
    assert [steady.host_step() for _ in range(1000)] == [0] * 1000


def test_unreadable_datagrams_are_survived_and_counted():
    name = "udp_multicast:239.74.163.8?port=43120"
    with open_bus(name) as source, open_can(name) as sender:
        sender._multicast.send(b"no msgpack here")
        sender.send(MESSAGES[0])
        got = []
        deadline = time.monotonic() + 5
        while not got and time.monotonic() < deadline:
            got += source.receive(0.2)["can_id"].tolist()
        assert got == [0x123]
        assert source.errors == 1


def test_a_bus_that_only_fails_is_given_up():
    name = f"virtual:failing{time.monotonic_ns()}"
    source = open_bus(name)
    source.bus.shutdown()  # from now on every call on it raises
    with pytest.raises(WorkError, match=f"gone after {MAX_ERRORS} errors"):
        source.receive(60.0)
    source.close()


def test_receive_view_has_the_frame_layout(pair):
    source, _ = pair
    assert source.receive(0.0).dtype == FRAME
    assert "virtual:pair" in source.describe()
