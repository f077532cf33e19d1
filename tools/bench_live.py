"""Latency and CPU time on SocketCAN, against a floor, a forwarder and a peer: `python -m tools.bench_live --json`.

floor: C that receives in batches, decodes and evaluates, nothing else. bare: raw `recv` and a zenoh put of the payload
of the rate's id. peer: python-can Notifier, cantools, numpy and zenoh, as people write it. ours: `rtcomp run`. They run
in turns, one at a time, on the same simulated traffic; figures are medians over the rounds, ratios medians of each
round's. Where the kernel has no SocketCAN everything runs in the guest of tools.vcan.

`cpu_us_per_frame` is of receiving, decoding and correcting, per frame taken from the socket: the floor's process, our
receiving thread with its hand-over, the peer's thread without its puts, the forwarder's thread with them.
`latency_us` goes from sending to arrival in another process (the floor's: from the kernel's time stamp to corrected).
`lost` are rate frames sent but never seen there, `behind_s` how long after the last frame samples still came.

An emulated guest is so slow that at 1000 frames/s its cores are full, and latencies are those of waiting for one.
`--datagrams` measures bare and ours on this machine's own kernel, with frames through a datagram socket instead.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools import vcan
from tools.bench_core import CModel
from tools.bench_live_traffic import LOADS, Load, Sent, Traffic, make_frames, model, numbers, options_of

BUS = "socketcan:vcan0"
PROGRAMS = ("floor", "bare", "peer", "ours")
RATIO_LOAD = "1000"
DRAIN_S = 6.0
FLOOR_C = Path(__file__).parent / "c" / "live.c"
Result = dict[str, Any]


class Served:
    """A program in a process of its own that serves runs (see tools.bench_live_programs)."""

    def __init__(self, name: str, config: Path, bus: str) -> None:
        line = [sys.executable, "-m", "tools.bench_live_programs", name, str(config), bus]
        self._process = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdin is not None  # noqa: S101 - for the type checker
        assert self._process.stdout is not None  # noqa: S101
        self._in, self._out = self._process.stdin, self._process.stdout

    def wait_for(self, word: str) -> None:
        """Until it says so."""
        line = self._out.readline().strip()
        if line != word:
            raise SystemExit(f"tools.bench_live: a program said {line!r}, wanted {word!r}")

    def begin(self, request: Result) -> None:
        """Begin a run; the bus is open when this returns."""
        self._tell(json.dumps(request))
        self.wait_for("ready")

    def end(self) -> Result:
        """End the run: what it tells."""
        self._tell("")
        return json.loads(self._out.readline())

    def _tell(self, line: str) -> None:
        self._in.write(line + "\n")
        self._in.flush()

    def close(self) -> None:
        """Let it go."""
        self._in.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._out.close()


class Floor:
    """The C program, started for every run."""

    def __init__(self, folder: Path) -> None:
        self._program, self._model = folder / "live", folder / "model.bin"
        vcan.run_quietly(["cc", "-O3", "-o", str(self._program), str(FLOOR_C), "-lm"])
        self._model.write_bytes(bytes(c_model()))

    def begin(self, request: Result) -> None:
        """Start it; its socket is open when this returns."""
        line = [
            str(self._program),
            BUS.partition(":")[2],
            "fd" if request["fd"] else "classic",
            str(self._model),
        ]
        self._process = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None  # noqa: S101 - for the type checker
        self._process.stdout.readline()

    def end(self) -> Result:
        """End it: what it tells."""
        time.sleep(0.3)  # nobody waits for its samples, so let the last ones in
        out, _ = self._process.communicate()
        return json.loads(out)


def c_model() -> CModel:
    """`struct model` of core.c."""
    ours = model()
    rules, limits = ours.rules, ours.validity
    lag: Any = ours.terms[0].parameters
    rest = [*limits["temp_degC"], *limits["rate_dps"], lag["tau_s"], lag["scale_ppm_per_K"] * 1e-6, 0.03]
    rows = rules.centers, 1.0 / np.array(rules.widths), rules.consequents, rest
    filled = CModel()
    for name, values in zip(("centers", "inverse_widths", "consequents", "rest"), rows, strict=True):
        getattr(filled, name)[:] = np.ravel(values).tolist()
    return filled


class Bench:
    """All programs, the bus and the listener, for as many runs as asked for."""

    def __init__(
        self, folder: Path, programs: list[str], seconds: float, realtime: bool, datagrams: bool
    ) -> None:
        self.seconds, self._realtime, self._folder = seconds, realtime, folder
        bus = str(folder / "bus") if datagrams else BUS
        ours, theirs = zenoh_configs(folder)
        self.listener = Served("listener", theirs, bus)
        self.listener.wait_for("up")
        served = {name: Served(name, ours, bus) for name in programs if name != "floor"}
        floor: dict[str, Any] = {"floor": Floor(folder)} if "floor" in programs else {}
        self.traffic = Traffic(bus)
        self.programs: dict[str, Any] = floor | served
        for program in served.values():
            program.wait_for("up")

    def close(self) -> None:
        """Let everything go."""
        for program in (*self.programs.values(), self.listener):
            if isinstance(program, Served):
                program.close()
        self.traffic.close()

    def run(self, name: str, load: Load, frames: np.ndarray) -> Result:
        """One program under one load."""
        program, out = self.programs[name], self._folder / "arrivals.npz"
        request = options_of(load) | {
            "program": name,
            "out": str(out),
            "drain_s": DRAIN_S,
            "realtime": self._realtime,
        }
        if name != "floor":
            self.listener.begin(request)
        program.begin(request)
        sent = self.traffic.send(frames, load.rate_id)
        if name == "floor":
            return self._of_floor(program.end(), sent)
        self.listener.end()
        told = program.end()
        with np.load(out) as arrivals:
            return figures(told, sent, arrivals["at_ns"], arrivals["rate_dps"])

    def _of_floor(self, told: Result, sent: Sent) -> Result:
        return {
            "cpu_us_per_frame": told["cpu_s"] / max(told["frames"], 1) * 1e6,
            "latency_us": {"p50": told["p50_us"], "p99": told["p99_us"]},
            "lost": int((sent.rate_at_ns >= 0).sum()) - told["samples"],
            "frames": told["frames"],
            "sent": sent.frames,
        }


def figures(told: Result, sent: Sent, at_ns: np.ndarray, rate_dps: np.ndarray) -> Result:
    """What one run of a program comes to; a sample that came twice or that nobody sent is an error of ours."""
    which = numbers(rate_dps, len(sent.rate_at_ns))
    if len(which) and not (np.diff(which) > 0).all():
        raise SystemExit("tools.bench_live: samples came twice or out of order")
    latency_us = (at_ns - sent.rate_at_ns[which]) / 1e3
    latency = {
        name: float(np.percentile(latency_us, p)) for name, p in (("p50", 50), ("p99", 99)) if len(which)
    }
    taken = max(told["frames"], 1)
    last_ns = sent.rate_at_ns.max()
    result = {
        "cpu_us_per_frame": told["cpu_s"] / taken * 1e6,
        "latency_us": latency or None,
        "lost": int((sent.rate_at_ns >= 0).sum()) - len(which),
        "process_cpu_us_per_frame": told["process_cpu_s"] / taken * 1e6,
        "frames": told["frames"],
        "sent": sent.frames,
        "behind_s": max(0.0, float(at_ns[-1] - last_ns) / 1e9) if len(which) else None,
    }
    return result | ({"stages_us": told["stages_us"], "losses": told["losses"]} if "losses" in told else {})


def zenoh_configs(folder: Path) -> tuple[Path, Path]:
    """A configuration for the programs and one for the listener, on this machine only."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = [f"tcp/127.0.0.1:{probe.getsockname()[1]}"]
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    queue = {"link": {"tx": {"queue": {"size": {"data": 16}}}}}  # batches, at most; a busy machine needs them
    paths = folder / "ours.json5", folder / "theirs.json5"
    ends: tuple[Result, Result] = (
        {"connect": {"endpoints": endpoint}, "listen": {"endpoints": []}},
        {"listen": {"endpoints": endpoint}},
    )
    for path, end in zip(paths, ends, strict=True):
        path.write_text(json.dumps({"mode": "peer", "scouting": quiet, "transport": queue} | end))
    return paths


def measure(
    loads: list[Load],
    programs: list[str],
    seconds: float,
    rounds: int,
    realtime: bool = False,
    datagrams: bool = False,
) -> Result:
    """Every program under every load in turns, the order shifted by one each round."""
    runs: dict[str, dict[str, list[Result]]] = {load.name: {name: [] for name in programs} for load in loads}
    with tempfile.TemporaryDirectory(prefix="rtcomp-bench-") as folder:
        bench = Bench(Path(folder), programs, seconds, realtime, datagrams)
        with contextlib.closing(bench):
            for turn in range(rounds):
                for load in loads:
                    frames = make_frames(load, seconds)
                    for name in shifted(programs, turn):
                        runs[load.name][name].append(result := bench.run(name, load, frames))
                        vcan.say(f"round {turn + 1}, {load.name}/s, {name}: {brief(result)}")
    rates = {load: {name: medians(results) for name, results in of.items()} for load, of in runs.items()}
    return {"rates": rates} | ratios(runs.get(RATIO_LOAD, {})) | {"seconds": seconds, "rounds": rounds}


def shifted(programs: list[str], turn: int) -> Iterator[str]:
    """The programs, beginning with another one each round."""
    first = turn % len(programs)
    yield from programs[first:] + programs[:first]


def brief(result: Result) -> str:
    """One line for a person."""
    latency = result["latency_us"] or {"p50": float("nan"), "p99": float("nan")}
    return (
        f"{result['cpu_us_per_frame']:.1f} µs CPU a frame, latency {latency['p50']:.0f}/{latency['p99']:.0f} µs, "
        f"lost {result['lost']}"
    )


def medians(results: list[Result]) -> Result:
    """Of figures the median over the rounds, of losses and frames the sum."""
    merged: Result = {}
    for key, first in results[0].items():
        values = [result[key] for result in results]
        if key in ("lost", "frames", "sent"):
            merged[key] = sum(values)
        elif isinstance(first, dict) and all(isinstance(value, dict) for value in values):
            merged[key] = medians(values)
        elif any(value is None for value in values):
            merged[key] = None
        else:
            merged[key] = float(np.median(values))
    return merged


def ratios(runs: dict[str, list[Result]]) -> Result:
    """Ours to the others at 1000 frames/s; a latency only where the forwarder lost nothing."""
    ours = runs.get("ours", [])

    def median(of: list[float]) -> float | None:
        return float(np.median(of)) if of else None

    def cpu(other: str) -> float | None:
        pairs = zip(ours, runs.get(other, []), strict=False)
        return median([a["cpu_us_per_frame"] / b["cpu_us_per_frame"] for a, b in pairs])

    def latency(name: str) -> float | None:
        pairs = [(a, b) for a, b in zip(ours, runs.get("bare", []), strict=False) if not b["lost"]]
        return median([a["latency_us"][name] / b["latency_us"][name] for a, b in pairs if a["latency_us"]])

    return {
        "cpu_to_floor": cpu("floor"),
        "cpu_to_peer": cpu("peer"),
        "p50_to_bare": latency("p50"),
        "p99_to_bare": latency("p99"),
        "lost": sum(result["lost"] for result in ours) if ours else None,
    }


def warm_up() -> None:
    """Compile everything that the bench needs, without a bus."""
    import socket

    from rtcomp.latency import Timeline
    from rtcomp.plan import compile_map
    from rtcomp.run import warm_up as warm_up_loop
    from rtcomp.run import warm_up_live
    from rtcomp.signal_map import load_map
    from rtcomp.sources.transmit import replay

    Timeline()
    for load in LOADS:
        make_frames(load, 0.1)
        compiled = compile_map(load_map(load.map))
        warm_up_loop(compiled)
        warm_up_live(compiled)
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there:
        replay([make_frames(LOADS[0], 0.05)], there, 0)


def in_guest(words: list[str]) -> int:
    """The same command in the guest; only its JSON reaches standard output."""
    again = ["-m", "tools.bench_live"]
    warm = " ".join([sys.executable, *again, "--warm-up"])
    return vcan.main(["--guest", "--warm-up", warm, "--", sys.executable, *again, *words])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document on standard output")
    parser.add_argument("--seconds", type=float, default=4.0, help="of traffic in each run (default 4)")
    parser.add_argument("--rounds", type=int, default=3)
    names = [load.name for load in LOADS]
    parser.add_argument("--loads", nargs="+", choices=names, default=names)
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS))
    parser.add_argument("--realtime", action="store_true", help="ours with --realtime")
    parser.add_argument(
        "--datagrams",
        action="store_true",
        help="bare and ours on this kernel, without a CAN interface: frames through a datagram socket",
    )
    parser.add_argument("--warm-up", action="store_true", help="only compile what the bench needs")
    options = parser.parse_args()
    if options.warm_up:
        warm_up()
        return
    if options.datagrams:
        options.programs = [name for name in options.programs if name in ("bare", "ours")]
    elif not os.environ.get("RTCOMP_GUEST") and not vcan.host_has_vcan():
        sys.exit(in_guest(sys.argv[1:]))
    loads = [load for load in LOADS if load.name in options.loads]
    how = options.seconds, options.rounds, options.realtime, options.datagrams
    results = measure(loads, options.programs, *how)
    if options.json:
        print(json.dumps(results))
        return
    for name in ("cpu_to_floor", "cpu_to_peer", "p50_to_bare", "p99_to_bare", "lost"):
        print(f"{name:14s} {results[name]}")


if __name__ == "__main__":
    main()
