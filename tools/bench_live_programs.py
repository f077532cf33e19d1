"""The programs that tools.bench_live compares, each a process that serves runs until its input ends.

A line of JSON on standard input begins a run, `ready` says that the bus is open, another line ends it, and a line of
JSON tells what it did. So a process starts once, which in an emulated guest takes a quarter of a minute.

bare: raw recv and a zenoh put of the payload of the rate's id. peer: python-can's Notifier, cantools, numpy and zenoh,
as people write it. ours: `rtcomp run`. listener: what receives all that in another process.
"""

import json
import os
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Run = dict[str, Any]
POLL_S = 0.1
QUIET_POLLS = 10  # without an arrival, after which nothing more is expected


def serve(run: Callable[[Run, Callable[[], None]], Run]) -> None:
    """Serve runs; `run` gets the request and what waits for its end, having said that it is ready."""

    def until_told() -> None:
        print("ready", flush=True)
        sys.stdin.readline()

    print("up", flush=True)
    while line := sys.stdin.readline():
        print(json.dumps(run(json.loads(line), until_told)), flush=True)


def timed(work: Callable[[], None], until_told: Callable[[], None], stop: Callable[[], None]) -> Run:
    """Let `work` go on in a thread of its own; the CPU time of that thread and of the process."""
    spent = [0.0]

    def measured() -> None:
        start = time.thread_time()
        work()
        spent[0] = time.thread_time() - start

    thread = threading.Thread(target=measured)
    before = time.process_time()
    thread.start()
    until_told()
    stop()
    thread.join()
    return {"cpu_s": spent[0], "process_cpu_s": time.process_time() - before}


def listening(bus: str) -> socket.socket:
    """A socket that gets the bus's frames: of a CAN interface, or bound to a path (see Traffic)."""
    if bus.startswith("/"):
        Path(bus).unlink(missing_ok=True)
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        sock.bind(bus)
        return sock
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    sock.bind((bus.partition(":")[2],))
    return sock


def bare(session: Any, bus: str) -> None:
    """Forward the payload of one id."""
    publisher = session.declare_publisher("bench/bare/yaw/rate", express=True)

    def run(request: Run, until_told: Callable[[], None]) -> Run:
        frames, over = 0, False
        wanted = request["rate_id"]
        with listening(bus) as sock:
            sock.settimeout(POLL_S)

            def work() -> None:
                nonlocal frames
                while not over:
                    try:
                        raw = sock.recv(72)
                    except TimeoutError:
                        continue
                    frames += 1
                    if int.from_bytes(raw[:4], "little") == wanted:
                        publisher.put(raw[8 : 8 + raw[4]])

            def stop() -> None:
                nonlocal over
                over = True

            figures = timed(work, until_told, stop)
        return figures | {"frames": frames}

    serve(run)


class Peer:
    """A listener of python-can's Notifier."""

    def __init__(self, publisher: Any, fd: bool) -> None:
        from rtcomp.signal_map import data_folder
        from tools.bench_core import Peer as Arithmetic
        from tools.bench_live_traffic import model

        self.arithmetic = Arithmetic(model())
        if fd:
            import cantools

            self.arithmetic.database = cantools.database.load_file(data_folder() / "fog_fd.dbc")
        self.publisher = publisher
        self.frames, self.cpu_s, self.put_s, self._start = 0, 0.0, 0.0, 0.0
        self.ids = {message.frame_id for message in self.arithmetic.database.messages}

    def __call__(self, message: Any) -> None:
        """Decode, correct, publish; the thread's CPU time is taken beside, without that of the put."""
        if not self.frames:
            self._start = time.thread_time()
        self.frames += 1
        if message.arbitration_id in self.ids:
            self._take(message)
        self.cpu_s = time.thread_time() - self._start - self.put_s

    def _take(self, message: Any) -> None:
        arithmetic = self.arithmetic
        values = arithmetic.database.decode_message(
            message.arbitration_id, message.data, decode_choices=False
        )
        if "HousingTemp" in values:
            arithmetic._take(values["HousingTemp"], message.timestamp)
        if "Rate" in values:
            rate = values["Rate"]
            corrected = arithmetic._correct(rate)
            document = {"t": message.timestamp, "raw": rate, "rate": float(corrected)}
            before = time.thread_time()
            self.publisher.put(json.dumps(document))
            self.put_s += time.thread_time() - before


def peer(session: Any, bus: str) -> None:
    """As people write it."""
    import can

    publisher = session.declare_publisher("bench/peer/yaw/rate")

    def run(request: Run, until_told: Callable[[], None]) -> Run:
        listener = Peer(publisher, request["fd"])
        before = time.process_time()
        with can.Bus(channel=bus.partition(":")[2], interface="socketcan", fd=request["fd"]) as opened:
            notifier = can.Notifier(opened, [listener])
            until_told()
            figures = {"cpu_s": listener.cpu_s, "process_cpu_s": time.process_time() - before}
            notifier.stop()
        return figures | {"frames": listener.frames}

    serve(run)


def runner_on(bus: str) -> Any:
    """What makes a run on this bus; on a path it differs in where the socket comes from and in nothing else."""
    from rtcomp.run import Runner, warm_up, warm_up_live
    from rtcomp.sources.socketcan import SocketReceiver, configure_socket

    if not bus.startswith("/"):
        return Runner

    class OnPath(Runner):
        """A run that takes its frames from a datagram socket."""

        def _warm_up(self) -> None:
            warm_up(self.map)
            warm_up_live(self.map)

        def _open_source(self) -> None:
            sock = self._resources.enter_context(listening(bus))
            configure_socket(sock)
            self._source = SocketReceiver(sock, self.clock)
            self._resources.callback(self._source.close)

    return OnPath


def ours(session: Any, bus: str) -> None:
    """`rtcomp run`, in this process."""
    from rtcomp.config import RunConfig
    from rtcomp.model import save_model
    from tools.bench_live_traffic import model

    folder = tempfile.mkdtemp(prefix="rtcomp-bench-")
    path = Path(folder) / "model.json"
    save_model(model(), path)
    make, name = runner_on(bus), "socketcan:path" if bus.startswith("/") else bus

    def run(request: Run, until_told: Callable[[], None]) -> Run:
        config = RunConfig(
            bus=f"{name}?fd=true" if request["fd"] else name, map=request["map"], model=[str(path)],
            prefix="bench/ours", realtime=request.get("realtime", False), power_on="unknown",
        )  # fmt: skip
        runner = make(config)
        runner.start(session)
        figures = timed(runner.loop, until_told, runner.stop)
        runner.close()
        summary = runner.summary()
        figures |= {"cpu_s": summary["receive_cpu_s"], "frames": summary["frames"]}
        return figures | {key: summary[key] for key in ("samples", "published", "losses", "stages_us")}

    serve(run)


RATES: dict[str, Callable[[bytes], float]] = {
    "bare": lambda payload: struct.unpack_from("<i", payload, 4 if len(payload) > 8 else 2)[0] * 1e-6,
    "peer": lambda payload: json.loads(payload)["raw"],
    "ours": lambda payload: struct.unpack_from("<d", payload, 24)[0],
}
"""How each says which rate it is about [°/s]."""


def listener(session: Any, bus: str) -> None:
    """Take the time of every arrival, and say afterwards of which rate it was."""
    arrivals: list[tuple[int, bytes]] = []
    subscriber = session.declare_subscriber(
        "bench/*/yaw/rate", lambda m: arrivals.append((time.monotonic_ns(), m.payload.to_bytes()))
    )

    def run(request: Run, until_told: Callable[[], None]) -> Run:
        arrivals.clear()
        until_told()
        seen, quiet, deadline = -1, 0, time.monotonic() + request["drain_s"]
        while quiet < QUIET_POLLS and time.monotonic() < deadline:
            quiet = quiet + 1 if len(arrivals) == seen else 0
            seen = len(arrivals)
            time.sleep(POLL_S)
        taken = list(arrivals)
        rate_of = RATES[request["program"]]
        columns = np.array([t for t, _ in taken], np.int64), np.array([rate_of(p) for _, p in taken])
        np.savez(request["out"], at_ns=columns[0], rate_dps=columns[1])
        return {"arrivals": len(taken)}

    serve(run)
    subscriber.undeclare()


def main() -> None:
    """`python -m tools.bench_live_programs NAME ZENOH_CONFIG BUS`."""
    from rtcomp.zenoh_session import open_session

    name, config, bus = sys.argv[1:]
    with open_session(config) as session:
        {"bare": bare, "peer": peer, "ours": ours, "listener": listener}[name](session, bus)
        sys.stdout.flush()
    os._exit(0)  # python-can and zenoh have threads that would be waited for


if __name__ == "__main__":
    main()
