"""The compiled live loop and its ring, on datagram sockets that carry struct can_frame."""

import socket
import threading
import time

import numpy as np
import pytest

from rtcomp import sample_queue
from rtcomp.frames import CORRECTED, FrameFlag
from rtcomp.latency import DONE, FRAME, OUT, PUT, TAKEN
from rtcomp.live import LiveLoop
from rtcomp.pipeline import Pipeline
from rtcomp.sample_queue import NOTHING, BatchQueue, SampleRing
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.socketcan import SocketReceiver, configure_socket
from rtcomp.sources.transmit import replay


@pytest.fixture
def pair():
    """A receiver and the socket that sends to it."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there:
        configure_socket(here)
        receiver = SocketReceiver(here)
        yield receiver, there
        receiver.close()


def samples(count, first=0):
    made = np.zeros(count, CORRECTED)
    made["seq"] = made["t_ns"] = first + np.arange(count)
    made["rate_dps"] = np.arange(count) * 0.5
    return made


@pytest.fixture(params=["batches", "ring"])
def queue(request, monkeypatch):
    """Both kinds, with room for ten samples."""
    monkeypatch.setattr(sample_queue, "ROOM", 10)
    queue = BatchQueue() if request.param == "batches" else SampleRing(10)
    yield queue
    queue.close()


def put(queue, count, first=0):
    return queue.put(samples(count, first), np.full(count, 3, np.uint8), 100, 200)


def take(queue, timeout_s=0.0):
    content, channel = queue.take(timeout_s)
    taken = np.frombuffer(content, CORRECTED)
    assert channel == bytes([3]) * len(taken)
    return taken


def test_queue_gives_what_was_put_in_order(queue):
    seen = []
    for first in range(0, 40, 4):
        assert put(queue, 4, first)
        while len(taken := take(queue)):
            seen += taken["seq"].tolist()
            queue.passed()
    assert seen == list(range(40))


def test_queue_gives_the_next_before_the_last_is_done_with(queue):
    seen, undone = [], 0
    for first in range(0, 40, 4):
        assert put(queue, 4, first)
        while len(taken := take(queue)):
            seen += taken["seq"].tolist()
            undone += len(taken)
        if undone > 4:
            assert len(queue.passed()) == undone
            undone = 0
    assert seen == list(range(40))


def test_queue_without_room_takes_nothing_until_there_is(queue):
    assert put(queue, 8)
    assert not put(queue, 3, 8)
    assert put(queue, 2, 8)
    queue.take(0.0)
    assert not put(queue, 1, 10)  # taken is not done with
    queue.passed()
    assert put(queue, 1, 10)


def test_queue_knows_when_each_sample_passed(queue):
    clock, rows = SteadyClock(), []
    for first in (0, 6, 12):  # the third goes round the end of the ring
        before = clock.now_ns()
        put(queue, 3, first)
        put(queue, 3, first + 3)
        published = np.concatenate([take(queue)["t_pub_ns"] for _ in range(4)])
        rows = queue.passed()
        assert rows[:, FRAME].tolist() == [first + k for k in range(3)] + [first + 3 + k for k in range(3)]
        assert set(rows[:, TAKEN]) == {100}
        assert set(rows[:, DONE]) == {200}
        assert published.tolist() == rows[:, PUT].tolist()
        assert before <= rows[0, PUT] <= rows[0, OUT] <= clock.now_ns()
        assert (np.diff(rows[:, PUT]) >= 0).all()
        assert (rows[:, OUT] >= rows[:, PUT]).all()
    assert len(queue.passed()) == 0


def test_queue_waits_for_what_comes_and_no_longer(queue):
    start = time.monotonic()
    assert queue.take(0.05) is NOTHING
    assert time.monotonic() - start >= 0.045
    threading.Timer(0.05, put, (queue, 1)).start()
    assert len(take(queue, 30.0)) == 1


def test_queue_gives_all_before_its_end(queue):
    put(queue, 3)
    queue.end()
    assert len(take(queue, 1.0)) == 3
    assert queue.take(1.0) is None


def drain(ring):
    parts = []
    while (batch := ring.take(0.0)) is not None and batch[1]:
        parts.append(np.frombuffer(bytearray(batch[0]), CORRECTED))
        ring.passed()
    return np.concatenate(parts) if parts else np.zeros(0, CORRECTED)


@pytest.mark.parametrize("each_batch", [False, True])
def test_live_loop_gives_the_bits_of_the_pipeline(pair, fog_map, lag_model, fog_frames, each_batch):
    receiver, sender = pair
    frames = fog_frames(20.0)
    live = LiveLoop(Pipeline(fog_map, {"yaw": [lag_model]}), SampleRing(), each_batch)
    receiver.receive(0.0, live)  # the first call compiles
    thread = threading.Thread(target=replay, args=([frames], sender, 0))
    thread.start()
    got, kept, deadline = [], [], time.monotonic() + 120
    while live.pipeline.counts["frames"] < len(frames) and time.monotonic() < deadline:
        kept.append(receiver.receive(0.1, live).copy())
        got.append(drain(live.ring))
    thread.join()
    live.ring.close()
    online = np.concatenate(got)
    rates = Pipeline(fog_map).process_all(frames).corrected
    assert online["seq"].tolist() == rates["seq"].tolist()
    assert online["rate_raw_dps"].tobytes() == rates["rate_raw_dps"].tobytes()
    assert live.last_t_ns == receiver.last_t_ns
    if each_batch:  # then every frame comes back too, and gives the same bits offline
        offline = Pipeline(fog_map, {"yaw": [lag_model]}).process_all(np.concatenate(kept)).corrected
        assert (online["t_pub_ns"] >= online["t_ns"]).all()
        online["t_pub_ns"] = 0
        assert offline.tobytes() == online.tobytes()


def test_live_loop_comes_back_at_once_for_an_error_frame_and_when_woken(pair, fog_map):
    receiver, sender = pair
    ring = SampleRing()
    live = LiveLoop(Pipeline(fog_map), ring)
    receiver.receive(0.0, live)
    sender.send(bytes([0x40, 0, 0, 0x20, 8]) + bytes(11))
    start = time.monotonic()
    [frame] = receiver.receive(60.0, live)
    assert receiver.error_seen
    assert frame["flags"] == FrameFlag.ERROR
    assert live.pipeline.rejected == {"error_frame": 1}
    threading.Timer(0.05, receiver.wake).start()
    assert len(receiver.receive(60.0, live)) == 0
    assert time.monotonic() - start < 30
    ring.close()


def test_live_loop_counts_samples_that_find_no_room(pair, fog_map, fog_frames):
    receiver, sender = pair
    frames = fog_frames(0.1)
    ring = SampleRing(16)
    live = LiveLoop(Pipeline(fog_map), ring)
    for _ in range(3):
        replay([frames], sender, 0)
        while len(receiver.receive(0.0, live)):
            pass
    assert live.pipeline.counts["frames"] == 3 * len(frames)
    assert len(drain(ring)) == 10  # what came as one was taken or lost as one
    assert ring.lost == live.pipeline.counts["samples"] - 10
    ring.close()
