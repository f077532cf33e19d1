"""Batch receive: on datagram sockets that carry struct can_frame everywhere, on vcan0 where there is one."""

import os
import socket
import struct
import subprocess
import threading
import time

import numpy as np
import pytest

from rtcomp.errors import RequestError
from rtcomp.frames import CAN_ERR_CRTL, CLOCK_STEP_ID, FRAME, FrameFlag
from rtcomp.sources import batch_receive as kernels
from rtcomp.sources.bus import open_bus, open_can
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.events import describe_error
from rtcomp.sources.socketcan import SocketCanSource, SocketReceiver, configure_socket, stamps_in_hardware
from rtcomp.sources.transmit import replay

EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000


def classic(can_id, data=b"", length=None):
    return struct.pack("=IB3x8s", can_id, len(data) if length is None else length, data)


def flexible(can_id, data, bits=0):
    return struct.pack("=IBBxx64s", can_id, len(data), bits, data)


def random_frames(count, seed=5):
    """FRAME arrays of every kind that a bus carries."""
    rng = np.random.default_rng(seed)
    frames = np.zeros(count, FRAME)
    kinds = rng.integers(0, 4, count)
    for i, kind in enumerate(kinds):
        extended = rng.random() < 0.5
        flags = FrameFlag.EXTENDED if extended else FrameFlag(0)
        length = int(rng.integers(0, 9))
        if kind == 1:
            flags |= FrameFlag.FD | (
                FrameFlag.BITRATE_SWITCH if rng.random() < 0.5 else FrameFlag.ERROR_STATE
            )
            length = int(rng.choice([0, 1, 8, 12, 20, 64]))
        if kind == 2:
            flags |= FrameFlag.REMOTE
        frames[i]["can_id"] = rng.integers(0x20000000 if extended else 0x800)
        frames[i]["flags"] = flags
        frames[i]["length"] = length
        if kind != 2:
            frames[i]["data"][:length] = rng.integers(0, 256, length)
    frames["t_ns"] = np.arange(count) * 100_000
    return frames


def same_but_time(got, wanted):
    return all(
        got[field].tolist() == wanted[field].tolist() for field in ("can_id", "flags", "length", "data")
    )


def collect(receiver, count, seconds=10.0):
    got, deadline = [], time.monotonic() + seconds
    while sum(map(len, got)) < count and time.monotonic() < deadline:
        got.append(receiver.receive(0.1).copy())
    return np.concatenate(got)


@pytest.fixture
def unix():
    """A receiver and the socket that sends to it."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there:
        configure_socket(here)
        receiver = SocketReceiver(here, batch=16)
        yield receiver, there
        receiver.close()


@pytest.fixture
def udp():
    """The same over UDP on this machine, which has kernel time stamps and drop counts."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there,
    ):
        here.bind(("127.0.0.1", 0))
        there.connect(here.getsockname())
        configure_socket(here, receive_buffer=8192)
        receiver = SocketReceiver(here, batch=16)
        yield receiver, there
        receiver.close()


CASES = [
    (classic(0x123, b"\x01\x02"), 0x123, 0, b"\x01\x02", 2),
    (classic(0x1ABCDEF0 | EFF, bytes(range(8))), 0x1ABCDEF0, FrameFlag.EXTENDED, bytes(range(8)), 8),
    (classic(0x7FF | RTR, b"\xff\xff", 5), 0x7FF, FrameFlag.REMOTE, b"", 5),
    (classic(0x40 | ERR, bytes(8)), 0x40, FrameFlag.ERROR, bytes(8), 8),
    (flexible(0x10, bytes(range(64)), 1), 0x10, FrameFlag.FD | FrameFlag.BITRATE_SWITCH, bytes(range(64)), 64),
    (flexible(0x10 | EFF, b"\xaa" * 12, 2), 0x10, FrameFlag.FD | FrameFlag.ERROR_STATE | FrameFlag.EXTENDED,
     b"\xaa" * 12, 12),
    (classic(0x1, b"\xff" * 8, 3), 0x1, 0, b"\xff" * 3, 3),  # what is behind the length is nobody's
    (classic(0x1, b"\xff" * 8, 200), 0x1, 0, b"\xff" * 8, 8),
]  # fmt: skip


@pytest.mark.parametrize(("raw", "can_id", "flags", "data", "length"), CASES, ids=range(len(CASES)))
def test_raw_frame(unix, raw, can_id, flags, data, length):
    receiver, sender = unix
    sender.send(raw)
    [frame] = receiver.receive(1.0)
    assert (frame["can_id"], frame["flags"], frame["length"], frame["reserved"]) == (can_id, flags, length, 0)
    assert frame["data"].tobytes() == data.ljust(64, b"\0")


def test_batches_keep_every_frame_in_order(unix):
    receiver, sender = unix
    wanted = random_frames(300)
    thread = threading.Thread(target=replay, args=([wanted], sender, 0))
    thread.start()
    got = collect(receiver, len(wanted))
    thread.join()
    assert same_but_time(got, wanted)
    assert np.all(np.diff(got["t_ns"]) >= 0)
    assert receiver.lost == 0


def test_nothing_of_an_earlier_batch_stays(unix):
    receiver, sender = unix
    for raw in (flexible(1, b"\xff" * 64), classic(2, b"\x01"), flexible(3, b"\x02" * 9)):
        sender.send(raw)
        [frame] = receiver.receive(1.0)
        length = int(frame["length"])
        assert not frame["data"][length:].any()


def test_without_kernel_stamps_the_batch_bears_its_own_time():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there:
        receiver = SocketReceiver(here)  # the socket was asked for nothing
        there.send(classic(1))
        before = receiver.clock.now_ns()
        [frame] = receiver.receive(1.0)
        assert before <= frame["t_ns"] <= receiver.clock.now_ns()
        receiver.close()


def test_kernel_stamp_is_the_arrival_not_the_reading(udp):
    receiver, sender = udp
    time.sleep(0.2)  # the system switches stamping on a moment after it was asked for
    before = receiver.clock.now_ns()
    sender.send(classic(1))
    after = receiver.clock.now_ns()
    time.sleep(0.05)
    [frame] = receiver.receive(1.0)
    assert before - 100_000 <= frame["t_ns"] <= after + 100_000


def test_drops_are_counted_exactly_and_told_in_band(udp):
    receiver, sender = udp
    sent = 200
    for i in range(sent):
        sender.send(classic(i))
    first = collect(receiver, 1)
    first = np.concatenate([first, collect(receiver, 10_000, seconds=0.3)])
    sender.send(classic(0x7FF))
    frames = np.concatenate([first, collect(receiver, 1)])
    events = frames[frames["flags"] == FrameFlag.ERROR]
    received = frames[frames["flags"] == 0]
    told = sum(int.from_bytes(event["data"][2:6].tobytes(), "little") for event in events)
    assert receiver.lost > 0
    assert len(received) + receiver.lost == sent + 1
    assert told == receiver.lost
    assert {int(event["can_id"]) for event in events} == {CAN_ERR_CRTL}
    assert describe_error(events[0]) == ["controller problem", "receive overflow"]


def test_drops_at_the_end_of_a_burst_do_not_wait_for_the_next_frame(udp):
    receiver, sender = udp
    for i in range(200):
        sender.send(classic(i))
    frames = collect(receiver, 10_000, seconds=0.3)
    assert (frames["flags"] == 0).sum() + receiver.lost == 200


def test_malformed_datagrams_are_counted_and_skipped(unix):
    receiver, sender = unix
    for raw in (b"x" * 15, classic(7), b"", b"y" * 71):
        sender.send(raw)
    assert collect(receiver, 2, seconds=0.3)["can_id"].tolist() == [7]
    assert receiver.malformed == 3


def test_silent_socket_returns_after_the_timeout(unix):
    receiver, _ = unix
    start = time.monotonic()
    assert len(receiver.receive(0.1)) == 0
    assert 0.09 <= time.monotonic() - start < 2


def test_wake_ends_a_long_wait_and_is_used_up(unix):
    receiver, _ = unix
    threading.Timer(0.05, receiver.wake).start()
    start = time.monotonic()
    assert len(receiver.receive(30)) == 0
    assert time.monotonic() - start < 5
    start = time.monotonic()
    receiver.receive(0.1)
    assert time.monotonic() - start >= 0.09


def test_other_threads_run_while_we_wait(unix):
    receiver, _ = unix
    count = 0

    def work():
        nonlocal count
        end = time.monotonic() + 0.2
        while time.monotonic() < end:
            count += 1

    thread = threading.Thread(target=work)
    thread.start()
    receiver.receive(0.2)
    thread.join()
    assert count > 1000


def test_socket_errors_come_up(unix):
    receiver, _ = unix
    os.close(receiver.sock.detach())
    with pytest.raises(OSError, match="Bad file"):
        receiver.receive(0.1)


def test_no_descriptor_is_left():
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        with here, there:
            receiver = SocketReceiver(here)
            receiver.close()
            receiver.close()
    assert len(os.listdir("/proc/self/fd")) == before


def filled_workspace(stamps_ns, kind=kernels.SCM_TIMESTAMPNS, hardware_ns=None):
    """A workspace as recvmmsg leaves it: one frame for each time stamp (host's clock) in a control message."""
    clock = SteadyClock()
    space = kernels.Workspace(len(stamps_ns), 0, 0, clock)
    batch = len(stamps_ns)
    for slot, stamp in enumerate(stamps_ns):
        header = kernels.STATE_WORDS + kernels.HEADER_WORDS * slot
        space.words[header + 7] = kernels.CLASSIC_SIZE
        space.words[kernels.raw_word(batch, slot)] = slot
        control = kernels.control_word(batch, slot)
        message = [divmod(int(stamp), 10**9)]
        if hardware_ns is not None:
            message += [(0, 0), divmod(int(hardware_ns[slot]), 10**9)]
        words = np.array(message, np.int64).ravel()
        space.words[control] = 16 + words.nbytes
        space.words[control + 1] = kernels.SOL_SOCKET | kind << 32
        space.words[control + 2 : control + 2 + len(words)] = words
        space.words[header + 5] = 16 + words.nbytes
    return clock, space


def take(space, count):
    rows = kernels.take_batch(space.words, space.address, space.frame_words, count)
    return space.frames[:rows].copy()


@pytest.mark.parametrize("step_s", [3600, -3600, -2])
def test_clock_step_between_stamps_reaches_no_time(step_s):
    """Five frames 10 ms apart; the host's clock was set between the second and the third."""
    step_ns = step_s * 10**9
    true_ns = time.time_ns() - 50_000_000 + 10_000_000 * np.arange(5)
    clock, space = filled_workspace(true_ns)
    # the clock as it was before the step: what the stamps of frames 0 and 1 were read from
    space.words[kernels.HOST_OFFSET] -= step_ns
    space.words[kernels.OFFSET] = clock.offset_ns
    space.words[kernels.LAST_BATCH] = clock.now_ns() - 60_000_000
    for slot in (0, 1):
        control = kernels.control_word(5, slot)
        space.words[control + 2 : control + 4] = divmod(int(true_ns[slot]) - step_ns, 10**9)
    frames = take(space, 5)
    assert frames["can_id"][0] == CLOCK_STEP_ID
    told = int.from_bytes(frames["data"][0, :8].tobytes(), "little", signed=True)
    assert told == pytest.approx(step_ns, abs=10**6)
    assert np.abs(frames["t_ns"][1:] - true_ns).max() < 1_000_000
    assert len(take(space, 0)) == 0  # told once


def test_hardware_stamps_are_mapped_onto_the_steady_clock():
    """An adapter's clock of its own epoch, 50 ppm fast; arrivals are late by 0 to 0.4 ms."""
    rng = np.random.default_rng(11)
    count = 400
    true_ns = time.time_ns() - 5_000_000_000 + 10_000_000 * np.arange(count)
    hardware_ns = 77_000_000_000 + np.rint((true_ns - true_ns[0]) * (1 + 50e-6)).astype(np.int64)
    delay_ns = rng.integers(0, 400_000, count)
    _, space = filled_workspace(true_ns + delay_ns, kernels.SCM_TIMESTAMPING, hardware_ns)
    frames = take(space, count)
    error_ns = (frames["t_ns"] - true_ns)[50:]
    assert error_ns.std() < 0.4 * delay_ns.std()  # steadier than the arrivals
    assert error_ns.min() > -100_000
    assert error_ns.max() < 400_000
    assert np.all(np.diff(frames["t_ns"]) >= 0)


def test_hardware_clock_reset_is_survived():
    true_ns = time.time_ns() - 5_000_000_000 + 10_000_000 * np.arange(20)
    hardware_ns = 900_000_000_000 + true_ns - true_ns[0]
    hardware_ns[10:] -= 880_000_000_000
    _, space = filled_workspace(true_ns, kernels.SCM_TIMESTAMPING, hardware_ns)
    assert np.abs(take(space, 20)["t_ns"] - true_ns).max() < 1_000_000


def test_no_time_lies_in_the_future_or_goes_back():
    now = time.time_ns()
    stamps = np.array([now - 3_000_000, now - 5_000_000, now + 10**12])
    clock, space = filled_workspace(stamps)
    frames = take(space, 3)
    assert np.all(np.diff(frames["t_ns"]) >= 0)
    assert frames["t_ns"][-1] <= clock.now_ns()


def test_loopback_has_no_hardware_stamps():
    assert not stamps_in_hardware("lo")
    assert not stamps_in_hardware("rtcomp_absent0")


# on vcan0: run them with `python -m tools.vcan -- python -m pytest -m vcan`


def shell(*command):
    subprocess.run(command, check=True)


def open_vcan():
    source = open_bus("socketcan:vcan0")
    assert isinstance(source, SocketCanSource)
    return source


@pytest.fixture
def vcan():
    """A batch source on vcan0 and a python-can bus that sends there."""
    with open_vcan() as source, open_can("socketcan:vcan0?fd=true") as sender:
        replay([random_frames(1)], sender, 0)  # what has to be compiled is compiled before time counts
        collect(source, 1, seconds=300)
        yield source, sender


@pytest.mark.vcan
def test_vcan_receives_what_was_sent(vcan):
    source, sender = vcan
    wanted = random_frames(3000)
    thread = threading.Thread(target=replay, args=([wanted], sender, 0))
    thread.start()
    got = collect(source, len(wanted), seconds=60)
    thread.join()
    assert source.lost == 0
    assert same_but_time(got, wanted)
    assert np.all(np.diff(got["t_ns"]) >= 0)


@pytest.mark.vcan
def test_vcan_stamps_are_those_of_the_arrival(vcan):
    source, sender = vcan
    clock = SteadyClock()
    before = clock.now_ns()
    replay([random_frames(1)], sender, 0)
    after = clock.now_ns()
    time.sleep(0.5)
    [frame] = source.receive(5.0)
    assert before - 10_000_000 <= frame["t_ns"] <= after + 10_000_000


@pytest.mark.vcan
def test_vcan_flood_beyond_capacity_is_counted_exactly():
    with open_vcan() as source, open_can("socketcan:vcan0?fd=true") as sender:
        assert source._bus is not None
        source._bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sent = replay([random_frames(20_000)], sender, 0).sent
        frames = collect(source, 10**6, seconds=3)
        assert sent == 20_000
        assert source.lost > 0
        assert (frames["flags"] != FrameFlag.ERROR).sum() + source.lost == sent
        events = frames[frames["can_id"] == CAN_ERR_CRTL]
        events = events[events["flags"] == FrameFlag.ERROR]
        assert sum(int.from_bytes(row["data"][2:6].tobytes(), "little") for row in events) == source.lost


@pytest.mark.vcan
def test_vcan_down_and_up_is_survived_and_told(vcan, caplog):
    source, sender = vcan
    try:
        shell("ip", "link", "set", "vcan0", "down")
        deadline = time.monotonic() + 10
        while source.downs == 0 and time.monotonic() < deadline:
            assert len(source.receive(0.2)) == 0
        assert source.downs == 1
        assert len(source.receive(0.1)) == 0
    finally:
        shell("ip", "link", "set", "vcan0", "up")
    replay([random_frames(3)], sender, 0)
    assert len(collect(source, 3)) == 3
    assert "is down" in caplog.text
    assert "is up again" in caplog.text


@pytest.mark.vcan
def test_vcan_unplugged_interface_is_opened_again():
    shell("ip", "link", "add", "dev", "vcan7", "type", "vcan")
    try:
        shell("ip", "link", "set", "vcan7", "up")
        with open_bus("socketcan:vcan7") as source:
            shell("ip", "link", "del", "vcan7")
            for _ in range(5):
                assert len(source.receive(0.2)) == 0
            shell("ip", "link", "add", "dev", "vcan7", "type", "vcan")
            shell("ip", "link", "set", "vcan7", "up")
            for _ in range(5):
                source.receive(0.3)
            with open_can("socketcan:vcan7") as sender:
                replay([random_frames(1)], sender, 0)
            assert len(collect(source, 1)) == 1
    finally:
        subprocess.run(["ip", "link", "del", "vcan7"], check=False)


@pytest.mark.vcan
def test_vcan_filters_work_in_the_kernel():
    wanted = random_frames(500)
    chosen, extended = 0x100, 0x12340000
    with (
        open_bus("socketcan:vcan0", [(chosen, 0x700, False), (extended, 0x1FFF0000, True)]) as source,
        open_can("socketcan:vcan0?fd=true") as sender,
    ):
        wanted["can_id"][::5] = np.where(wanted["flags"][::5] & FrameFlag.EXTENDED, extended + 7, chosen + 7)
        is_extended = wanted["flags"] & FrameFlag.EXTENDED != 0
        fits = np.where(
            is_extended, wanted["can_id"] & 0x1FFF0000 == extended, wanted["can_id"] & 0x700 == chosen
        )
        replay([wanted], sender, 0)
        got = collect(source, int(fits.sum()), seconds=5)
        assert len(source.receive(0.2)) == 0
    assert same_but_time(got, wanted[fits])


@pytest.mark.vcan
@pytest.mark.parametrize(
    ("can_id", "data", "words"),
    [
        (0x40, bytes(8), ["bus-off"]),
        (0x04, b"\0\x10" + bytes(6), ["controller problem", "error-passive (receive)"]),
        (0x100, bytes(8), ["restarted"]),
    ],
)
def test_vcan_error_frames_are_decoded(vcan, caplog, can_id, data, words):
    source, sender = vcan
    sender.socket.send(classic(can_id | ERR, data))
    [frame] = collect(source, 1)
    assert describe_error(frame) == words
    assert words[-1] in caplog.text


@pytest.mark.vcan
def test_vcan_wake_and_close_leave_nothing():
    before = len(os.listdir("/proc/self/fd"))
    with open_vcan() as source:
        threading.Timer(0.1, source.wake).start()
        start = time.monotonic()
        assert len(source.receive(60)) == 0
        assert time.monotonic() - start < 20
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.vcan
def test_vcan_that_is_not_there_is_refused_without_leaving_a_descriptor():
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(RequestError, match="no interface with this name"):
        open_bus("socketcan:rtcomp_absent0")
    assert len(os.listdir("/proc/self/fd")) == before
