"""What the viewer costs: its memory, its time per value, and what it does to the compensator's latency.

    python -m tools.bench_view --json                 # 12 pairs of 6 s, then 2 minutes of viewing
    python -m tools.bench_view --minutes 10 --json    # the whole length

A compensator process corrects 1 kHz of frames with three rates each (map of the Xsens MTi, simulated values, with a
model for every channel) and publishes them on zenoh; `rtcomp view --web` watches from a process of its own. The order
of with and without alternates from pair to pair.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

RATE_HZ = 1000
WARM_S = 2.0
MODEL = "rtcomp/demo_data/model.json"


def compensate(seconds: float) -> dict[str, Any]:
    """Correct and publish live for so long; latencies [µs] from a frame's time to its publication."""
    from rtcomp.frames import FRAME
    from rtcomp.model import load_model, model_document
    from rtcomp.pipeline import Pipeline
    from rtcomp.plan import compile_map
    from rtcomp.publisher import Publisher
    from rtcomp.signal_map import load_map
    from rtcomp.zenoh_session import open_session

    plan = compile_map(load_map("xsens_mti"))
    model = load_model(MODEL)
    pipeline = Pipeline(plan, {name: [model] for name in plan.channel_names})
    rates, temperature = _messages()
    frames = np.zeros(2, FRAME)
    list(Pipeline(plan, {name: [model] for name in plan.channel_names}).process(rates[:1]))  # compiles
    with open_session("local") as session:
        publisher = Publisher(session, "rtcomp", plan.channel_names, time.time_ns)
        publisher.models = {name: model_document(model) for name in plan.channel_names}
        publisher.health = lambda name: {"stages_us": publisher.latency_us()}
        publisher.start()
        total, started = 0, time.monotonic()
        warm = True
        while (now := time.monotonic()) - started < WARM_S + seconds:
            if warm and now - started > WARM_S:
                warm = False
                publisher.stages["total"] = type(publisher.stages["total"])()
            due = started + total / RATE_HZ
            if due > now:
                time.sleep(due - now)
            t_ns = time.time_ns()
            frames[0], frames[1] = temperature, rates[total % len(rates)]
            frames["t_ns"] = t_ns
            wanted = frames if total % 100 == 0 else frames[1:]
            for samples in pipeline.process(wanted):
                publisher.offer(samples.corrected, samples.channel, t_ns)
            total += 1
        publisher.close()
        latency = publisher.latency_us()["total"] or {}
    return {"frames": total, "lost": publisher.lost, "published": publisher.published} | latency


def _messages() -> tuple[np.ndarray, np.ndarray]:
    """A second of rate frames and a temperature frame, encoded by cantools from the bundled DBC."""
    import cantools

    from rtcomp.frames import FRAME

    base: Any = cantools.database.load_file(Path("can_dbc/xsens_mti.dbc"))
    frames = np.zeros(RATE_HZ, FRAME)
    for k, frame in enumerate(frames):
        turn = 0.5 * np.sin(2 * np.pi * k / RATE_HZ)
        _fill(frame, base.get_message_by_name("XCDI_RateOfTurn"), turn)
    temperature = np.zeros((), FRAME)
    _fill(temperature, base.get_message_by_name("XCDI_Temperature"), 21.0)
    return frames, temperature


def _fill(frame: Any, message: Any, value: float) -> None:
    data = message.encode({signal.name: value for signal in message.signals}, strict=False)
    frame["can_id"], frame["length"] = message.frame_id, len(data)
    frame["flags"] = 1 if message.is_extended_frame else 0
    frame["data"][: len(data)] = np.frombuffer(data, np.uint8)


class Watching:
    """`rtcomp view --web` for so long, with the largest memory of it and of rerun's server beside it."""

    def __init__(self, seconds: float, limit: str) -> None:
        command = [sys.executable, "-m", "rtcomp", "view", "--web", "--port", "0", "--memory-limit", limit]
        command += ["--seconds", str(seconds), "--wait", "60", "--json"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.peak = {"viewer_MiB": 0.0, "server_MiB": 0.0}
        self.trace: list[tuple[float, float, float]] = []
        self._started = time.monotonic()

    def look(self) -> None:
        """Take the resident memory now."""
        import psutil

        own = server = 0.0
        for process in [psutil.Process(self.process.pid), *psutil.Process(self.process.pid).children()]:
            used = process.memory_info().rss / 2**20
            own, server = (used, server) if process.pid == self.process.pid else (own, server + used)
        self.peak["viewer_MiB"] = max(self.peak["viewer_MiB"], own)
        self.peak["server_MiB"] = max(self.peak["server_MiB"], server)
        self.trace.append((round(time.monotonic() - self._started, 1), round(own, 1), round(server, 1)))

    def result(self) -> dict[str, Any]:
        """The viewer's own report."""
        text = self.process.communicate(timeout=60)[0].strip().splitlines()
        return json.loads(text[-1]) if text else {}


def leg(seconds: float, watched: bool, limit: str = "512MiB") -> dict[str, Any]:
    """One run of the compensator, watched or not."""
    command = [sys.executable, "-m", "tools.bench_view", "--compensate", str(seconds)]
    watching = Watching(seconds + WARM_S, limit) if watched else None
    compensator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    while compensator.poll() is None:
        time.sleep(1.0)
        if watching is not None and watching.process.poll() is None:
            watching.look()
    told = json.loads((compensator.stdout.read() if compensator.stdout else "{}").strip().splitlines()[-1])
    if watching is not None:
        told |= {"watching": watching.result() | watching.peak, "memory": watching.trace}
    return told


def compare(pairs: int, seconds: float) -> dict[str, Any]:
    """Interleaved pairs: the ratios of with to without, medians with 95 % intervals and a signed-rank test."""
    from scipy.stats import wilcoxon

    rows = []
    for k in range(pairs):
        order = (True, False) if k % 2 else (False, True)
        legs = {watched: leg(seconds, watched) for watched in order}
        rows.append({f"{p}_{'with' if w else 'without'}": legs[w][p] for p in ("p50", "p99") for w in legs})
        click.echo(f"pair {k + 1}: {rows[-1]}", err=True)
    told: dict[str, Any] = {"pairs": rows}
    rng = np.random.default_rng(1)
    for p in ("p50", "p99"):
        ratio = np.array([row[f"{p}_with"] / row[f"{p}_without"] for row in rows])
        drawn = np.median(ratio[rng.integers(0, pairs, (2000, pairs))], axis=1)
        tested: Any = wilcoxon(np.log(ratio))
        told[p] = {
            "ratio": float(np.median(ratio)),
            "ci95": np.quantile(drawn, [0.025, 0.975]).tolist(),
            "p_value": float(tested.pvalue),
        }
    return told


@click.command()
@click.option("--pairs", default=12, show_default=True, help="Interleaved pairs; 0 leaves them out.")
@click.option("--seconds", default=6.0, show_default=True, help="Length of one run of a pair.")
@click.option("--minutes", default=2.0, show_default=True, help="Length of the long view; 0 leaves it out.")
@click.option("--memory-limit", default="512MiB", show_default=True, help="The viewer's memory limit.")
@click.option(
    "--compensate", "alone", type=float, hidden=True, help="Be the compensator for so many seconds."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document (else an indented one).")
def main(
    pairs: int, seconds: float, minutes: float, memory_limit: str, alone: float | None, as_json: bool
) -> None:
    """Measure what the viewer costs, at 1 kHz × 3 sensors."""
    if alone is not None:
        click.echo(json.dumps(compensate(alone)))
        return
    told: dict[str, Any] = {"load_average_before": os.getloadavg()[0]}
    if minutes:
        told["long"] = leg(60.0 * minutes, True, memory_limit)
        told["long"]["memory"] = told["long"]["memory"][:: max(len(told["long"]["memory"]) // 20, 1)]
        click.echo(f"long: {json.dumps(told['long'])}", err=True)
    if pairs:
        told["latency"] = compare(pairs, seconds)
    click.echo(json.dumps(told, indent=None if as_json else 1))


if __name__ == "__main__":
    main()
