"""Sending with a log's timing: deadlines, speeds, reports, stops, and the command."""

import json
import os
import signal
import socket
import threading
import time

import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.commands.replay import command, run_replay
from rtcomp.errors import RequestError
from rtcomp.frames import FRAME, FrameFlag
from rtcomp.sources.batch_send import send_paced, send_words
from rtcomp.sources.bus import open_bus, open_can
from rtcomp.sources.candump import write_candump
from rtcomp.sources.socketcan import SocketReceiver
from rtcomp.sources.transmit import _Errors, _Tally, repeated, replay


def even_frames(count, gap_ns):
    frames = np.zeros(count, FRAME)
    frames["t_ns"] = 1_600_000_000_000_000_000 + gap_ns * np.arange(count)
    frames["can_id"] = np.arange(count) % 0x7FF
    frames["length"] = 8
    frames["data"][:, 0] = np.arange(count) % 256
    return frames


@pytest.fixture
def channel(request):
    return f"virtual:{request.node.name}{time.monotonic_ns()}"


@pytest.fixture
def pair():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there:
        receiver = SocketReceiver(here)
        yield receiver, there
        receiver.close()


def receive_all(source, count):
    got, deadline = [], time.monotonic() + 60  # the first call compiles
    while sum(map(len, got)) < count and time.monotonic() < deadline:
        got.append(source.receive(0.1).copy())
    return np.concatenate(got)


@pytest.mark.parametrize("kind", ["socket", "virtual"])
@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_timing_is_kept_without_drift(pair, channel, kind, speed):
    receiver, sender = pair
    frames = even_frames(200, round(1_000_000 * speed))
    if kind == "socket":
        thread = threading.Thread(target=lambda: reports.append(replay([frames], sender, speed)))
        source = receiver
    else:
        source, bus = open_bus(channel), open_can(channel)
        thread = threading.Thread(target=lambda: reports.append(replay([frames], bus, speed)))
    reports = []
    thread.start()
    got = receive_all(source, len(frames))
    thread.join()
    if kind == "virtual":
        source.close()
        bus.shutdown()
    [report] = reports
    assert (report.sent, report.failed, report.skipped) == (200, 0, 0)
    assert got["can_id"].tolist() == frames["can_id"].tolist()
    assert report.seconds >= 0.199  # never early; how late is the machine's business
    assert report.gap_error_us["p50"] <= report.gap_error_us["p99"] <= report.gap_error_us["max"] + 1


def test_full_speed_has_no_timing_to_report(pair):
    receiver, sender = pair
    frames = even_frames(500, 10**9)
    thread = threading.Thread(target=receive_all, args=(receiver, len(frames)))
    thread.start()
    report = replay([frames[:300], frames[300:]], sender, 0)
    thread.join()
    assert report.sent == 500
    assert report.seconds < 299 * 10  # the recorded gaps alone would take this long
    assert report.gap_error_us == {"p50": None, "p99": None, "max": None}


def test_error_frames_are_left_out_unless_asked_for(channel):
    frames = even_frames(4, 1000)
    frames["flags"][1] = FrameFlag.ERROR
    with open_bus(channel) as source, open_can(channel) as bus:
        report = replay([frames], bus, 0)
        assert (report.sent, report.skipped) == (3, 1)
        assert receive_all(source, 3)["can_id"].tolist() == [0, 2, 3]
        assert replay([frames], bus, 0, error_frames=True).sent == 4
        assert receive_all(source, 4)["flags"].tolist() == [0, FrameFlag.ERROR, 0, 0]


def test_deadlines_are_absolute_scaled_and_never_go_back():
    tally = _Tally(2.0)
    first = tally.deadlines(np.array([5_000, 9_000, 7_000, 8_000]))
    second = tally.deadlines(np.array([10_000]))
    assert (np.append(first, second) - first[0]).tolist() == [0, 2000, 2000, 2500, 3500]


def test_a_failing_bus_is_counted_not_fatal(channel):
    bus = open_can(channel)
    bus.shutdown()
    report = replay([even_frames(5, 1000)], bus, 1.0)
    assert (report.sent, report.failed) == (0, 5)


def test_an_interface_that_is_down_fails_each_frame_once():
    words, frames = send_words(4), even_frames(6, 0).view(np.int64).reshape(6, -1)
    sent_at = np.zeros(6, np.int64)
    end = time.monotonic_ns() + 10**9
    done = send_paced(words, words.ctypes.data, 10**6, frames, np.zeros(6, np.int64), sent_at, 0, end)
    assert done == 6
    assert sent_at.tolist() == [-1] * 6


def test_a_full_queue_is_waited_for(pair):
    receiver, sender = pair
    frames = even_frames(2000, 0)
    reports = []
    thread = threading.Thread(target=lambda: reports.append(replay([frames], sender, 0)))
    thread.start()
    time.sleep(0.2)  # the socket pair holds far fewer: the sender is stuck now
    got = receive_all(receiver, len(frames))
    thread.join()
    assert len(got) == reports[0].sent == 2000


@pytest.mark.parametrize("kind", ["socket", "virtual"])
def test_stop_ends_it_soon(pair, channel, kind):
    frames = even_frames(3, 60_000_000_000)
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    start = time.monotonic()
    if kind == "socket":
        report = replay([frames], pair[1], 1.0, stop)
    else:
        with open_can(channel) as bus:
            report = replay([frames], bus, 1.0, stop)
    assert report.sent == 1
    assert time.monotonic() - start < 5


@pytest.mark.parametrize("speed", [-1.0, float("nan"), float("inf")])
def test_wrong_speed_is_refused(pair, speed):
    with pytest.raises(RequestError, match="wanted a number above 0"):
        replay([even_frames(1, 0)], pair[1], speed)


def test_a_log_that_breaks_says_so_after_its_good_part(channel):
    def arrays():
        yield even_frames(3, 0)
        raise RequestError("cut")

    with open_bus(channel) as source, open_can(channel) as bus:
        with pytest.raises(RequestError, match="cut"):
            replay(arrays(), bus, 0)
        assert len(receive_all(source, 3)) == 3


def test_percentiles_equal_numpys():
    rng = np.random.default_rng(2)
    errors_ns = (rng.exponential(200_000, 5000)).astype(np.int64) * rng.choice([-1, 1], 5000)
    errors = _Errors()
    errors.add(errors_ns[:3000])
    errors.add(errors_ns[3000:])
    summary = errors.summary()
    for name, share in (("p50", 50), ("p99", 99)):
        assert summary[name] == pytest.approx(np.percentile(np.abs(errors_ns), share) / 1000, abs=3)
    assert summary["max"] == pytest.approx(np.abs(errors_ns).max() / 1000, abs=0.1)


def test_repeats_go_on_one_mean_gap_later():
    frames = even_frames(5, 1000)
    all_times = np.concatenate([a["t_ns"] for a in repeated(lambda: [frames[:2], frames[2:]], 3)])
    assert np.diff(all_times).tolist() == [1000] * 14
    assert frames["t_ns"].tolist() == even_frames(5, 1000)["t_ns"].tolist()


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "some.log"
    write_candump(path, even_frames(20, 1_000_000))
    return path


def test_command_prints_one_json_document(log, channel):
    with open_bus(channel) as source:
        result = CliRunner().invoke(command, [str(log), "--bus", channel, "--repeat", "2", "--json"])
        assert result.exit_code == 0, result.output
        report = json.loads(result.output)
        assert (report["sent"], report["failed"], report["speed"]) == (40, 0, 1.0)
        assert set(report["gap_error_us"]) == {"p50", "p99", "max"}
        assert len(receive_all(source, 40)) == 40


def test_command_speaks_to_people_too(log, channel):
    result = CliRunner().invoke(command, [str(log), "--bus", channel, "--speed", "max"])
    assert result.exit_code == 0
    assert result.output.startswith("20 frames sent in ")


@pytest.mark.parametrize("speed", ["fast", "-1", "nan", "inf"])
def test_command_refuses_a_wrong_speed(log, channel, speed):
    result = CliRunner().invoke(command, [str(log), "--bus", channel, "--speed", speed])
    assert result.exit_code == 2
    assert "wanted a number above 0" in result.output


def test_missing_log_and_missing_bus_are_refused(tmp_path, log):
    with pytest.raises(RequestError, match="no such log file"):
        run_replay(tmp_path / "absent.log", "virtual:x")
    with pytest.raises(RequestError, match="rtcomp doctor"):
        run_replay(log, "socketcan:rtcomp_absent0")


def test_ctrl_c_ends_with_the_report(tmp_path, channel):
    before = signal.getsignal(signal.SIGINT)
    path = tmp_path / "long.log"
    write_candump(path, even_frames(3, 100_000_000_000))
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    result = CliRunner().invoke(command, [str(path), "--bus", channel, "--json"])
    assert result.exit_code == 0
    assert json.loads(result.output)["sent"] == 1
    assert signal.getsignal(signal.SIGINT) is before
