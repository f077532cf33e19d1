"""Faults around a run: files that lie, disks that are full, peers that are slow or gone, models under load."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rtcomp.config import RunConfig
from rtcomp.errors import RequestError
from rtcomp.model import model_document, save_model
from rtcomp.run import Runner
from rtcomp.signing import new_key, sign_model
from rtcomp.sources.candump import write_candump
from rtcomp.stacks import load_stacks, trusted_keys
from rtcomp.zenoh_session import open_session
from tools.faults.trace import RATES, TEMPERATURES, Scenario, make_model, make_trace

FRAMES = RATES + TEMPERATURES
Documents = tuple[dict[str, Any], dict[str, Any]]


class Context(NamedTuple):
    """Where a scenario may write, and whether it is to be short."""

    folder: Path
    quick: bool


def scenarios() -> list[Scenario]:
    """Every fault of this module."""
    return [Scenario(name, run) for name, run in RUNS]


RUNS: list[tuple[str, Callable[[Context], Documents]]] = []


def fault(name: str) -> Callable[[Callable[[Context], Documents]], Callable[[Context], Documents]]:
    """Register a fault."""

    def register(run: Callable[[Context], Documents]) -> Callable[[Context], Documents]:
        RUNS.append((name, run))
        return run

    return register


def model_file(context: Context, name: str = "model.json", **changes: Any) -> Path:
    """The trace's model as a file of its own folder."""
    save_model(make_model(**changes), context.folder / name)
    return context.folder / name


def run_log(context: Context, frames: np.ndarray | None = None, **options: Any) -> Runner:
    """A whole run over the trace as a log."""
    log = context.folder / "trace.log"
    write_candump(log, make_trace().frames() if frames is None else frames)
    runner = Runner(RunConfig(log=str(log), **options))
    runner.start()
    try:
        runner.loop()
    finally:
        runner.close()
    return runner


@contextlib.contextmanager
def live(bus: str, session: Any = None, **options: Any) -> Iterator[Runner]:
    """A run on a virtual bus, stopped at the end."""
    runner = Runner(RunConfig(bus=f"virtual:{bus}-{os.getpid()}", **options))
    runner.start(session)
    loop = threading.Thread(target=runner.loop)
    loop.start()
    try:
        yield runner
    finally:
        runner.stop()
        loop.join()
        runner.close()


def send(runner: Runner, frames: np.ndarray, speed: float = 0) -> None:
    """Put frames on the run's bus and wait until they are taken."""
    from rtcomp.sources.bus import open_can
    from rtcomp.sources.transmit import replay

    wanted = runner.pipeline.counts["frames"] + len(frames)
    with open_can(str(runner.config.bus)) as bus:
        replay([frames], bus, speed=speed, stop=threading.Event())
    wait_for(lambda: runner.pipeline.counts["frames"] >= wanted)


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether it came true in time."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def refused(work: Callable[[], Any]) -> str:
    """The reason given, shortened; "taken" when there was none."""
    try:
        work()
    except RequestError as error:
        return str(error)
    return "taken"


@fault("wrong model for the sensor")
def _wrong_sensor(context: Context) -> Documents:
    path = model_file(context, sensor="A1")
    reason = refused(lambda: load_stacks([str(path)], ("yaw",), "B2"))
    return {"reason": "sensor A1, but this is B2"}, {"reason": reason.partition("of ")[2].partition(";")[0]}


@fault("models that are broken, unsigned, or signed by a stranger")
def _bad_models(context: Context) -> Documents:
    key, _ = new_key(context.folder / "fleet.key")
    stranger, _ = new_key(context.folder / "stranger.key")
    good = model_file(context)
    unsigned, changed, foreign, torn = (context.folder / f"{name}.json" for name in "ucft")
    for path in (unsigned, changed, foreign):
        path.write_bytes(good.read_bytes())
    sign_model(good, key)
    sign_model(foreign, stranger)
    document = json.loads(good.read_text()) | {"residual_std_dps": 0.0}
    del document["sha256"]
    changed.write_text(json.dumps(document))
    torn.write_bytes(good.read_bytes()[:200])
    keys = trusted_keys([f"{key}.pub"])
    got = {
        path.stem: refused(lambda path=path: load_stacks([str(path)], ("yaw",), None, keys)) == "taken"
        for path in (good, unsigned, changed, foreign, torn)
    }
    return {"model": True, "u": False, "c": False, "f": False, "t": False}, got


@fault("model swap under load with broken files")
def _swap(context: Context) -> Documents:
    frames, bad = make_trace().frames(), 4
    other = json.dumps(model_document(make_model(sensor="B2"))).encode()
    good = json.dumps(model_document(make_model(residual_std_dps=0.5))).encode()
    model = model_file(context, sensor="A1")
    rounds = 5
    with live("swap", model=[str(model)], sensor="A1", allow_swap=True) as runner:
        done = threading.Event()

        def put() -> None:
            session = runner.publisher.session
            for number in range(1, rounds + 1):
                for payload in (b"{", good[:-20], b"\xff" * 100, other, good):
                    session.put("rtcomp/yaw/model/swap", payload)
                    time.sleep(0.02)
                # two swaps before one frame would be one; so each is seen in a sample before the next is sent
                wait_for(lambda k=number: runner.pipeline.flags.get("model_swapped", 0) >= k)
            done.set()

        threading.Thread(target=put).start()
        while not done.is_set():
            send(runner, frames[:220])
        send(runner, frames)
    summary = runner.summary()
    return (
        {"accepted": rounds, "refused": bad * rounds, "swapped": rounds, "lost": 0, "all_published": True},
        {
            "accepted": summary["swaps"]["accepted"],
            "refused": summary["swaps"]["refused"],
            "swapped": summary["flags"].get("model_swapped", 0),
            "lost": summary["lost"],
            "all_published": summary["published"] == summary["samples"],
        },
    )


@fault("model files reloaded while one is broken")
def _reload(context: Context) -> Documents:
    path = model_file(context)
    with live("reload", model=[str(path)]) as runner:
        send(runner, make_trace().frames()[:1100])
        path.write_text("{broken")
        runner.swapper.reload()
        send(runner, make_trace().frames()[1100:])
    summary = runner.summary()
    keys = ("samples", "published", "swaps")
    return (
        {"samples": RATES, "published": RATES, "swaps": {"accepted": 0, "refused": 1}, "kept": True},
        {key: summary[key] for key in keys}
        | {"kept": runner.pipeline.stacks[0][0].terms == make_model().terms},
    )


@fault("disk full for the recording from the start")
def _full(context: Context) -> Documents:
    summary = run_log(context, record="/dev/full", model=[str(model_file(context))]).summary()
    record = {"frames": 0, "lost": FRAMES, "error": "No space left on device"}
    return (
        {"samples": RATES, "published": RATES, "record": record},
        {key: summary[key] for key in ("samples", "published", "record")},
    )


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
from rtcomp.cli import main
main(sys.argv[1:])
"""


@fault("disk full in the middle of the recording")
def _fills(context: Context) -> Documents:
    log, kept = context.folder / "trace.log", context.folder / "kept.log"
    write_candump(log, make_trace().frames())
    command = [sys.executable, "-c", LIMITED, "run", "--log", str(log), "--record", str(kept), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    summary = json.loads(done.stdout.splitlines()[-1])
    record = summary["record"]
    got = {
        "status": done.returncode,
        "samples": summary["samples"],
        "adds_up": record["frames"] + record["lost"] == FRAMES and 0 < record["frames"] < FRAMES,
        "error": record["error"],
        "whole_file": kept.exists(),
        "said": "correction goes on" in done.stderr,
    }
    return {
        "status": 0, "samples": RATES, "adds_up": True, "error": "File too large", "whole_file": False, "said": True,
    }, got  # fmt: skip


@fault("disk full for the thermal states")
def _full_state(context: Context) -> Documents:
    summary = run_log(context, state="/dev/full", model=[str(model_file(context))]).summary()
    return (
        {"samples": RATES, "failed": 1},
        {"samples": summary["samples"], "failed": summary["state"]["failed"]},
    )


def _second_half(context: Context, spoil: Callable[[Path], None]) -> dict[str, Any]:
    """Run half of the trace, do something to the states, run the rest."""
    frames, state, model = make_trace().frames(), context.folder / "state.json", model_file(context)
    run_log(context, frames[:1100], state=str(state), model=[str(model)])
    spoil(state)
    summary = run_log(context, frames[1100:], state=str(state), model=[str(model)]).summary()
    flags = summary["flags"]
    return {key: summary["state"][key] for key in ("restored", "refused")} | {
        "unsettled": flags.get("unsettled", 0),
        "temperature_missing": flags.get("temperature_missing", 0),
    }


@fault("restart with fresh states")
def _fresh(context: Context) -> Documents:
    return {"restored": 1, "refused": 0, "unsettled": 0, "temperature_missing": 0}, _second_half(
        context, lambda path: None
    )


@fault("restart with corrupt states")
def _corrupt(context: Context) -> Documents:
    def spoil(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 4
        path.write_bytes(content)

    return {"restored": 0, "refused": 1, "unsettled": 500, "temperature_missing": 0}, _second_half(
        context, spoil
    )


@fault("restart with states of another model")
def _foreign(context: Context) -> Documents:
    def spoil(path: Path) -> None:
        other = model_file(context, "other.json", residual_std_dps=0.5)
        run_log(context, make_trace().frames()[:1100], state=str(path), model=[str(other)])

    return {"restored": 0, "refused": 1, "unsettled": 500, "temperature_missing": 0}, _second_half(
        context, spoil
    )


@fault("a log that ends in the middle of its gzip stream")
def _torn_log(context: Context) -> Documents:
    log = context.folder / "trace.log.gz"
    write_candump(log, make_trace().frames())
    log.write_bytes(log.read_bytes()[:-3000])
    command = [sys.executable, "-m", "rtcomp", "run", "--log", str(log), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    got = {"status": done.returncode, "reason": "gzip stream ends early" in done.stderr}
    return {"status": 2, "reason": True}, got


@fault("requests that are wrong")
def _requests(context: Context) -> Documents:
    log, model = context.folder / "trace.log", model_file(context)
    write_candump(log, make_trace().frames())
    (context.folder / "bad.toml").write_text("bus = 1")
    (context.folder / "bad.dbc").write_bytes(bytes(range(256)))
    (context.folder / "bad.json5").write_text("{mode: 'nobody'}")
    options: list[dict[str, Any]] = [
        {"model": ["absent.json"]}, {"model": [f"pitch={model}x"]}, {"map": "absent"}, {"dbc": "absent.dbc"},
        {"map": str(context.folder / "bad.toml")}, {"dbc": str(context.folder / "bad.dbc")},
        {"trust": [str(model)]}, {"record": "/absent/x.log"}, {"state": "/absent/state.json"},
        {"zenoh": str(context.folder / "bad.json5")}, {"zenoh": "absent.json5"}, {"bus": "virtual:x"},
    ]  # fmt: skip
    got = sum(refused(lambda extra=extra: _started(str(log), extra)) != "taken" for extra in options)
    return {"refused": len(options)}, {"refused": got}


def _started(log: str, extra: dict[str, Any]) -> None:
    runner = Runner(msgspec.convert({"log": log} | extra, RunConfig))
    runner.start()
    runner.close()


def open_peer(context: Context, name: str, port: int, script: str) -> "subprocess.Popen[str]":
    """A subscriber in a process of its own, ready."""
    path = context.folder / f"{name}.json5"
    path.write_text(json.dumps(peer_config({"connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}})))
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    )
    if process.stdout is None or process.stdout.readline().strip() != "ready":
        raise RequestError(f"peer {name} did not come up")
    return process


def peer_config(more: dict[str, Any]) -> dict[str, Any]:
    """A zenoh configuration that knows nothing but its endpoints."""
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    return {"mode": "peer", "scouting": quiet, "listen": {"endpoints": []}} | more


PEER = """
import json, sys, time, zenoh
import numpy as np
from rtcomp.frames import CORRECTED
pause = PAUSE
seen = []
def take(message):
    seen.append(int(np.frombuffer(message.payload.to_bytes(), CORRECTED)[0]["seq"]))
    time.sleep(pause)
with zenoh.open(zenoh.Config.from_file(sys.argv[1])) as session:
    subscriber = session.declare_subscriber("rtcomp/yaw/rate", take)
    print("ready", flush=True)
    sys.stdin.readline()
    gaps = sum(b - a - 1 for a, b in zip(seen, seen[1:]))
    print(json.dumps({"received": len(seen), "gaps": gaps, "first": seen[0], "last": seen[-1]}), flush=True)
"""


def report(process: "subprocess.Popen[str]") -> dict[str, int]:
    """What a peer has seen, after which it goes."""
    out, _ = process.communicate("\n", timeout=60)
    return json.loads(out.splitlines()[-1])


@contextlib.contextmanager
def listening(context: Context) -> Iterator[tuple[Any, int]]:
    """A session that peers can reach, and its port."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    path = context.folder / "listen.json5"
    path.write_text(json.dumps(peer_config({"listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]}})))
    session = open_session(path)
    try:
        yield session, port
    finally:
        session.close()


@fault("a zenoh peer that is gone, and one that comes back")
def _gone(context: Context) -> Documents:
    frames = make_trace().frames()
    quick = PEER.replace("PAUSE", "0.0")
    with listening(context) as (session, port), live("gone", session) as runner:
        peer = open_peer(context, "first", port, quick)
        wait_for(lambda: runner.publisher.wait_for_subscribers(0.0))
        send(runner, frames[:600], speed=2)
        with peer:  # closes its pipes and waits for it
            peer.kill()
        send(runner, frames[600:1200], speed=2)
        peer = open_peer(context, "second", port, quick)
        wait_for(lambda: runner.publisher.wait_for_subscribers(0.0))
        before = int(runner.pipeline.loop.seq[0])
        send(runner, frames[1200:], speed=2)
        wait_for(lambda: runner.publisher.published == runner.pipeline.counts["samples"])
        time.sleep(0.5)
        seen = report(peer)
    summary = runner.summary()
    return (
        {"samples": RATES, "published": RATES, "lost": 0, "first": before, "accounted": RATES - before},
        {key: summary[key] for key in ("samples", "published", "lost")}
        | {
            "first": seen["first"],
            "accounted": seen["received"] + seen["gaps"],
        },  # a gap is a loss it can count
    )


@fault("a zenoh peer that is too slow")
def _slow(context: Context) -> Documents:
    frames = make_trace().frames()
    with listening(context) as (session, port), live("slow", session) as runner:
        peer = open_peer(context, "slow", port, PEER.replace("PAUSE", "0.005"))
        wait_for(lambda: runner.publisher.wait_for_subscribers(0.0))
        started = time.monotonic()
        send(runner, frames, speed=20)
        took = time.monotonic() - started
        wait_for(lambda: runner.publisher.published + runner.publisher.lost == RATES)
        time.sleep(RATES * 0.006)
        seen = report(peer)
    summary = runner.summary()
    got = {
        "samples": summary["samples"],
        "adds_up": summary["published"] + summary["losses"]["queue"] == RATES,
        "peer_adds_up": seen["received"] + seen["gaps"] == seen["last"] - seen["first"] + 1,
        "held_up": took > 10.0,  # the peer needs 10 s for what comes in one
    }
    return {"samples": RATES, "adds_up": True, "peer_adds_up": True, "held_up": False}, got
