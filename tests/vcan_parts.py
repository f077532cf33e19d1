"""What the vcan suites share: runs on vcan0, and processes that listen to them."""

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time

import numpy as np

from rtcomp.config import RunConfig
from rtcomp.frames import CORRECTED
from rtcomp.run import Runner
from rtcomp.sources.bus import open_can
from rtcomp.sources.transmit import replay
from rtcomp.zenoh_session import open_session

BUS = "socketcan:vcan0"
PATIENCE_S = 120.0  # an emulated guest on a busy machine

COLLECTOR = """
import sys, time, zenoh
pause, seen = float(sys.argv[2]), []
def take(message):
    seen.append((str(message.key_expr), message.payload.to_bytes()))
    time.sleep(pause)
with zenoh.open(zenoh.Config.from_file(sys.argv[1])) as session:
    subscriber = session.declare_subscriber("**/rate", take)
    print("ready", flush=True)
    for line in sys.stdin:
        word, _, argument = line.strip().partition(" ")
        if word == "count":
            print(len(seen), flush=True)
        elif word == "clear":
            seen.clear()
            print("cleared", flush=True)
        else:
            key, _, path = argument.partition(" ")
            with open(path, "wb") as file:
                file.write(b"".join(payload for of, payload in list(seen) if of == key))
            print("saved", flush=True)
"""

ROUTER = """
import sys, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])) as session:
    print("ready", flush=True)
    sys.stdin.read()
"""


def wait_for(condition, what, seconds=PATIENCE_S):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"timed out waiting for {what}"
        time.sleep(0.02)


def free_endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def zenoh_config(path, mode="peer", connect=(), listen=(), patient=True):
    """`patient` lets the publisher's thread wait for a slow network instead of dropping after a millisecond."""
    scouting = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    ends = {"connect": {"endpoints": list(connect)}, "listen": {"endpoints": list(listen)}}
    if connect:  # go on trying, as one does in a vehicle
        ends["connect"] |= {"timeout_ms": -1, "exit_on_failure": False}
    queue = {"congestion_control": {"drop": {"wait_before_drop": 10_000_000}}} if patient else {}
    document = {"mode": mode, "scouting": scouting, "transport": {"link": {"tx": {"queue": queue}}}}
    path.write_text(json.dumps(document | ends))
    return path


class Process:
    """A Python process that says `ready`."""

    def __init__(self, script, *arguments):
        command = [sys.executable, "-c", script, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout.readline().strip() == "ready"

    def ask(self, line):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()

    def kill(self):
        self.process.kill()
        with self.process:  # closes its pipes and waits for it
            pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()


class Collector(Process):
    """A subscriber in a process of its own."""

    def __init__(self, config, pause_s=0.0):
        super().__init__(COLLECTOR, config, pause_s)

    def count(self):
        return int(self.ask("count"))

    def settle(self, at_least=0):
        """Wait until nothing has come for half a second."""
        wait_for(lambda: self.count() >= at_least, f"{at_least} samples in another process")
        seen = -1
        while (now := self.count()) != seen:
            seen = now
            time.sleep(0.5)

    def samples(self, key, path):
        assert self.ask(f"save {key} {path}") == "saved"
        return np.frombuffer(path.read_bytes(), CORRECTED)


@contextlib.contextmanager
def running(session=None, **options):
    """A run on vcan0 in a thread of its own, stopped and closed at the end."""
    own = open_session(None) if session is None else None
    runner = Runner(RunConfig(**({"bus": BUS} | options)))
    runner.start(own or session)
    loop = threading.Thread(target=runner.loop)
    loop.start()
    try:
        yield runner
    finally:
        runner.stop()
        loop.join()
        runner.close()
        if own:
            own.close()


def send(frames, speed=0, error_frames=False):
    """Put frames on vcan0; how many went."""
    with open_can(f"{BUS}?fd=true") as bus:
        return replay([frames], bus, speed, error_frames=error_frames).sent


def taken(runner, frames):
    """Wait until the run has taken so many frames, and published what came of them."""
    wait_for(lambda: runner.pipeline.counts["frames"] >= frames, f"{frames} frames taken")
    publisher = runner.publisher
    wait_for(lambda: publisher.published + publisher.lost >= runner.pipeline.counts["samples"], "published")


def same_but_publishing(online, offline):
    """Names of the fields that differ in a bit."""
    if len(online) != len(offline):
        return [f"{len(online)} samples for {len(offline)}"]
    return [n for n in CORRECTED.names if n != "t_pub_ns" and online[n].tobytes() != offline[n].tobytes()]
