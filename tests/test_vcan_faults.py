"""Faults around a run on vcan0, by name, each with what must come of it."""

import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
import time

import msgspec
import numpy as np
import pytest
from vcan_parts import (
    BUS,
    ROUTER,
    Collector,
    Process,
    free_endpoint,
    running,
    send,
    taken,
    wait_for,
    zenoh_config,
)

from rtcomp.checkpoint import decode, seal
from rtcomp.config import RunConfig
from rtcomp.fog_format import RATE_ID
from rtcomp.frames import FrameFlag
from rtcomp.model import save_model
from rtcomp.run import Runner
from rtcomp.sources.logs import read_log
from rtcomp.zenoh_session import open_session

pytestmark = pytest.mark.vcan

BUS_OFF = struct.pack("=IB3x8s", 0x40 | 0x20000000, 8, bytes(8))  # linux/can/error.h
SCENARIOS = {}


def scenario(name):
    """Register a fault; it returns two documents, what is expected and what came."""

    def register(function):
        SCENARIOS[name] = function
        return function

    return register


class Context:
    """What a scenario works with."""

    def __init__(self, folder, make_frames, model):
        self.folder, self.frames, self.longer = folder, make_frames(4.0), make_frames(16.0)
        self.rates = int((self.frames["can_id"] == RATE_ID).sum())
        self.model = str(folder / "model.json")
        save_model(model, self.model)


def chosen(runner, *names):
    """Of a run's summary, these; flags and rejections only where there are any."""
    summary = runner.summary()
    return {name: summary[name] for name in names}


@scenario("bus-off")
def _bus_off(context):
    half = len(context.frames) // 2
    with running() as runner:
        send(context.frames[:half])
        taken(runner, half)
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as controller:
            controller.bind((BUS.partition(":")[2],))
            controller.send(BUS_OFF)
        wait_for(lambda: runner.pipeline.rejected, "the error frame")
        send(context.frames[half:])
        taken(runner, len(context.frames) + 1)
    flags = {name: runner.pipeline.flags.get(name, 0) for name in ("bad_frame_before", "frames_lost")}
    return (
        {
            "rejected": {"error_frame": 1},
            "samples": context.rates,
            "lost": 0,
            "bad_frame_before": 1,
            "frames_lost": 0,
        },
        chosen(runner, "rejected", "samples", "lost") | flags,
    )


@scenario("interface down and up")
def _down_and_up(context):
    half, state = len(context.frames) // 2, {}
    try:
        with running() as runner:
            send(context.frames[:half])
            taken(runner, half)
            subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
            wait_for(lambda: runner._source.downs, "the interface to be seen down")
            state["sent while down"] = send(context.frames[:3])
            subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
            send(context.frames[half:])
            taken(runner, len(context.frames))
            state["downs"] = runner._source.downs
    finally:
        subprocess.run(["ip", "link", "set", "vcan0", "up"], check=False)
    return (
        {"sent while down": 0, "downs": 1, "samples": context.rates, "lost": 0, "rejected": {}},
        state | chosen(runner, "samples", "lost", "rejected"),
    )


@scenario("flood beyond capacity")
def _flood(context):
    """A full receive buffer before the run gets its turn, and again while it runs."""
    runner = Runner(RunConfig(bus=BUS))
    with open_session(None) as session:
        runner.start(session)
        runner._source._bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sent = sum(send(context.frames) for _ in range(5))
        with contextlib.closing(runner), _thread(runner):
            wait_for(lambda: runner.pipeline.counts["frames"] > 0, "frames")
            sent += sum(send(context.frames) for _ in range(20))
            wait_for(lambda: _accounted(runner) == sent, "every frame to be accounted for", seconds=20)
    lost = runner.summary()["losses"]["receiver"]
    return (
        {"sent": 25 * len(context.frames), "accounted": sent, "some were lost": True, "flagged": True},
        {
            "sent": sent,
            "accounted": _accounted(runner),
            "some were lost": lost > 0,
            "flagged": runner.pipeline.flags.get("frames_lost", 0) > 0,
        },
    )


def _accounted(runner):
    return runner.pipeline.counts["frames"] + runner.pipeline.lost_frames


@contextlib.contextmanager
def _thread(runner):
    import threading

    loop = threading.Thread(target=runner.loop)
    loop.start()
    try:
        yield
    finally:
        runner.stop()
        loop.join()


@scenario("subscriber slow, then gone")
def _slow_then_gone(context):
    endpoint = free_endpoint()
    config = zenoh_config(context.folder / "ours.json5", listen=[endpoint], patient=False)
    theirs = zenoh_config(context.folder / "slow.json5", connect=[endpoint])
    half, rates = len(context.longer) // 2, int((context.longer["can_id"] == RATE_ID).sum())
    with open_session(config) as session, running(session) as runner:
        with Collector(theirs, pause_s=0.02):
            wait_for(lambda: runner.publisher.wait_for_subscribers(0.0), "the subscriber")
            send(context.longer[:half], speed=8)
            wait_for(lambda: runner.pipeline.counts["frames"] >= half, "all frames")
        send(context.longer[half:])
        taken(runner, len(context.longer))
    got = chosen(runner, "frames", "samples", "losses")
    queue = got["losses"].pop("queue")
    return (
        {
            "frames": len(context.longer),
            "samples": rates,
            "losses": {"receiver": 0},
            "adds up": True,
        },
        got | {"adds up": runner.publisher.published + queue == got["samples"]},
    )


@scenario("router stopped and restarted")
def _router(context):
    endpoint, third = free_endpoint(), len(context.frames) // 3
    config = zenoh_config(context.folder / "router.json5", mode="router", listen=[endpoint])
    client = zenoh_config(context.folder / "client.json5", mode="client", connect=[endpoint])
    with (
        Process(ROUTER, config) as router,
        Collector(client) as collector,
        open_session(client) as session,
        running(session) as runner,
    ):
        wait_for(lambda: runner.publisher.wait_for_subscribers(0.0), "the subscriber")
        send(context.frames[:third], speed=2)
        taken(runner, third)
        first = runner.pipeline.counts["samples"]
        collector.settle(first)
        router.kill()
        send(context.frames[third : 2 * third], speed=2)
        taken(runner, 2 * third)
        with Process(ROUTER, config):
            wait_for(lambda: runner.publisher.wait_for_subscribers(0.0), "the subscriber to come back")
            before = runner.pipeline.counts["samples"]
            send(context.frames[2 * third :], speed=2)
            taken(runner, len(context.frames))
            collector.settle(first + context.rates - before)
            samples = collector.samples("rtcomp/yaw/rate", context.folder / "samples")
    return (
        {"samples": context.rates, "lost": 0, "before": True, "after": context.rates - before},
        chosen(runner, "samples", "lost")
        | {"before": (samples["seq"] < first).sum() == first, "after": int((samples["seq"] >= before).sum())},
    )


@scenario("clock of the host set")
def _clock_set(context):
    if not os.environ.get("RTCOMP_GUEST"):
        pytest.skip(
            "the clock of this machine is not ours to set; run it with `python -m tools.vcan --guest`"
        )
    half, hour_ns = len(context.frames) // 2, 3600 * 10**9
    before = time.monotonic_ns(), time.time_ns()
    try:
        with running(record=str(context.folder / "kept.log")) as runner:
            send(context.frames[:half])
            taken(runner, half)
            time.clock_settime_ns(time.CLOCK_REALTIME, time.time_ns() + hour_ns)
            wait_for(lambda: runner.pipeline.counts["clock_steps"], "the step to be seen")
            send(context.frames[half:])
            taken(runner, len(context.frames))
    finally:
        time.clock_settime_ns(time.CLOCK_REALTIME, before[1] + time.monotonic_ns() - before[0])
    kept = np.concatenate(list(read_log(context.folder / "kept.log")))
    times = kept["t_ns"][kept["flags"] & FrameFlag.ERROR == 0]
    return (
        {
            "samples": context.rates,
            "lost": 0,
            "clock_steps": 1,
            "flagged": 1,
            "ascending": True,
            "an hour": False,
        },
        chosen(runner, "samples", "lost", "clock_steps")
        | {
            "flagged": runner.pipeline.flags.get("clock_step", 0),
            "ascending": bool((np.diff(times) >= 0).all()),
            "an hour": bool(times[-1] - times[0] > hour_ns // 2),
        },
    )


@scenario("two runs on one bus")
def _two(context):
    with running(prefix="a") as a, running(prefix="b", model=[context.model]) as b:
        sent = send(context.frames)
        taken(a, sent)
        taken(b, sent)
    keys = ("frames", "samples", "published", "lost")
    each = {"frames": sent, "samples": context.rates, "published": context.rates, "lost": 0}
    return {"a": each, "b": each}, {"a": chosen(a, *keys), "b": chosen(b, *keys)}


KILLED = """
import sys
import rtcomp.checkpoint
rtcomp.checkpoint.PERIOD_S = 0.2
from rtcomp.cli import main
main(sys.argv[1:])
"""


@scenario("killed and restarted")
def _killed(context):
    """With states that are fresh the first sample is settled or not as they were; with stale ones it is not."""
    state = context.folder / "state.json"
    command = [
        sys.executable,
        "-c",
        KILLED,
        "run",
        "--bus",
        BUS,
        "--model",
        context.model,
        "--state",
        str(state),
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while "publishing" not in (line := process.stderr.readline()):
            assert line, "the run ended before it began"
        send(context.frames, speed=2)
        wait_for(state.exists, "states on the disk")
        process.send_signal(signal.SIGKILL)
    document = msgspec.to_builtins(decode(state.read_bytes()))
    fresh = _again(context, state)
    aged = [shift_times(document[key], -3600 * 10**9) for key in ("times", "held_times")]
    stale = document | {"t_ns": document["t_ns"] - 3600 * 10**9, "boot": None}
    state.write_bytes(seal(stale | dict(zip(("times", "held_times"), aged, strict=True))))
    old = _again(context, state)
    return (
        {"fresh": {"restored": 1, "refused": 0, "temperature known": True},
         "old": {"restored": 0, "refused": 1, "temperature known": False}, "first unsettled": [True, True]},
        {"fresh": fresh[0], "old": old[0], "first unsettled": [fresh[1], old[1]]},
    )  # fmt: skip


def shift_times(rows, by_ns):
    """Times that were ever set, moved."""
    return [[t + by_ns if t > 0 else t for t in row] for row in rows]


def _again(context, state):
    """What a new run makes of the states, and of a rate that comes before any temperature."""
    rates = context.frames[context.frames["can_id"] == RATE_ID][:5]
    with running(model=[context.model], state=str(state)) as runner:
        send(rates)
        taken(runner, len(rates))
        counts = dict(runner.checkpoint.counts)
    flags = runner.pipeline.flags
    known = {"temperature known": "temperature_missing" not in flags}
    return {key: counts[key] for key in ("restored", "refused")} | known, flags.get("unsettled", 0) >= 1


@pytest.mark.parametrize("name", SCENARIOS)
def test_vcan_fault(name, tmp_path, fog_frames, lag_model):
    expected, got = SCENARIOS[name](Context(tmp_path, fog_frames, lag_model))
    assert got == expected
