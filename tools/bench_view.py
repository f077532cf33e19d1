"""What the viewer costs: its memory, its time per value, and what it does to the compensator's latency.

    python -m tools.bench_view --json                     # 12 pairs of 6 s, then 2 minutes of viewing
    python -m tools.bench_view --minutes 10 --pairs 0     # the memory alone, over the whole length
    python -m tools.bench_view --nobody --minutes 0       # pairs without any viewer: what chance alone gives

A compensator process corrects 1 kHz of frames with three rates each (map of the Xsens MTi, simulated values, with a
model for every channel) and publishes them on zenoh; `rtcomp view --web` watches from a process of its own.

One compensator runs through all pairs, so that both halves of a pair meet the same process; what is compared are
stretches of its latencies, taken when the viewer has been logging for a while (its start is not measured), with the
viewer first in every other pair. Nobody else subscribes: the half without a viewer has the least there is to do.
"""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from rtcomp import latency
from rtcomp.sources.clock import SteadyClock
from rtcomp.view.sinks import LOOPBACK, free_port

RATE_HZ = 1000
SETTLE_S = 3.0
MODEL = "rtcomp/demo_data/model.json"
LATENCIES = "latencies.npy"
ROWS = 4_000_000  # latencies that are kept: 20 minutes of three channels


class Kept(latency.Timeline):
    """A timeline that also keeps every latency with the monotonic time when it was put, shape `(used, 2)` [ns]."""

    def __init__(self, clock: SteadyClock) -> None:
        self._offset_ns = clock.offset_ns
        self.rows, self.used = np.zeros((ROWS, 2), np.int64), 0
        super().__init__()

    def add(self, passages: np.ndarray) -> None:
        """Take in passages `(n, 5)` [ns]."""
        super().add(passages)
        stretch = self.rows[self.used : self.used + len(passages)]
        kept = passages[: len(stretch)]
        stretch[:, 0] = kept[:, latency.OUT] - self._offset_ns
        stretch[:, 1] = kept[:, latency.PUT] - kept[:, latency.FRAME]
        self.used += len(stretch)


def compensate(folder: Path) -> None:
    """Correct and publish live until stdin ends; keeps the latencies in `folder` (numpy)."""
    from rtcomp.frames import FRAME
    from rtcomp.model import load_model, model_document
    from rtcomp.pipeline import Pipeline
    from rtcomp.plan import compile_map
    from rtcomp.publisher import Publisher
    from rtcomp.signal_map import load_map
    from rtcomp.zenoh_session import open_session

    plan = compile_map(load_map("xsens_mti"))
    model = load_model(MODEL)
    rates, temperature = _messages()
    list(Pipeline(plan, {name: [model] for name in plan.channel_names}).process(rates[:1]))  # compiles
    pipeline = Pipeline(plan, {name: [model] for name in plan.channel_names})
    frames = np.zeros(2, FRAME)
    with open_session(folder / "peer.json5") as session:
        publisher = Publisher(session, "rtcomp", plan.channel_names, clock := SteadyClock())
        publisher.models = {name: model_document(model) for name in plan.channel_names}
        publisher.health = lambda name: {"stages_us": publisher.latency_us()}
        publisher.timeline = kept = Kept(clock)
        publisher.start()
        print("ready", flush=True)
        total, started = 0, time.monotonic()
        while total % 100 or not select.select([sys.stdin], [], [], 0.0)[0]:
            due = started + total / RATE_HZ
            time.sleep(max(due - time.monotonic(), 0.0))
            t_ns = clock.now_ns()
            frames[0], frames[1] = temperature, rates[total % len(rates)]
            frames["t_ns"] = t_ns
            wanted = frames if total % 100 == 0 else frames[1:]
            for samples in pipeline.process(wanted):
                publisher.offer(samples.corrected, samples.channel, t_ns)
            total += 1
        publisher.close()
    np.save(folder / LATENCIES, kept.rows[: kept.used])
    print(json.dumps({"frames": total, "lost": publisher.lost, "published": publisher.published}))


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


class Compensator:
    """The process that corrects; `end` returns its counts and latencies, shape `(n, 2)`: monotonic time, latency."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        self.client = _write_network(folder)
        command = [sys.executable, "-m", "tools.bench_view", "--compensate", str(folder)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        out: Any = self.process.stdout
        if out.readline().strip() != "ready":
            raise click.ClickException("the compensator did not start")

    def end(self) -> tuple[dict[str, Any], np.ndarray]:
        """Let it finish."""
        out, _ = self.process.communicate(timeout=120)
        with self._folder:
            return json.loads(out.strip().splitlines()[-1]), np.load(Path(self._folder.name) / LATENCIES)


def _write_network(folder: Path) -> Path:
    """zenoh configurations for a port that nobody else uses: `peer.json5`, and the client's, which is returned."""
    at = f'["tcp/{LOOPBACK}:{free_port(LOOPBACK)}"]'
    quiet = "scouting: {multicast: {enabled: false}}"
    (folder / "peer.json5").write_text(f'{{mode: "peer", {quiet}, listen: {{endpoints: {at}}}}}')
    (folder / "client.json5").write_text(f'{{mode: "client", {quiet}, connect: {{endpoints: {at}}}}}')
    return folder / "client.json5"


class Watching:
    """`rtcomp view` until `end`, with the largest memory of it and of the rerun program it starts."""

    def __init__(self, client: Path, limit: str, window: bool) -> None:
        command = [sys.executable, "-m", "rtcomp", "view", "--zenoh", str(client), "--wait", "60", "--json"]
        command += ["--memory-limit", limit]
        command += [] if window else ["--web", "--port", "0"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True, text=True
        )
        self.trace: list[tuple[float, float, float]] = []
        self._started = time.monotonic()
        if not window:
            told: Any = self.process.stderr
            while "open http" not in (line := told.readline()):
                if not line:
                    raise click.ClickException("the viewer did not start")

    def look(self) -> None:
        """Take the resident memory [MiB] now."""
        import psutil

        own = psutil.Process(self.process.pid)
        viewer, rerun = (
            round(sum(p.memory_info().rss for p in group) / 2**20, 1) for group in ([own], own.children(True))
        )
        self.trace.append((round(time.monotonic() - self._started, 1), viewer, rerun))

    def end(self) -> dict[str, Any]:
        """The viewer's own report and its memory."""
        self.process.send_signal(signal.SIGTERM)
        out, errors = self.process.communicate(timeout=60)
        if self.process.returncode:
            raise click.ClickException(f"the viewer ended with {self.process.returncode}: {errors.strip()}")
        told = json.loads(out.strip().splitlines()[-1])
        if self.trace:
            told["viewer_peak_MiB"], told["rerun_peak_MiB"] = np.array(self.trace)[:, 1:].max(axis=0).tolist()
            told["memory_MiB"] = self.trace[:: max(len(self.trace) // 20, 1)]
        return told


def long_view(seconds: float, limit: str, window: bool) -> dict[str, Any]:
    """Watch for so long and look at the memory every second."""
    compensator = Compensator()
    watching = Watching(compensator.client, limit, window)
    end = time.monotonic() + seconds
    while time.monotonic() < end and watching.process.poll() is None:
        watching.look()
        time.sleep(1.0)
    return compensator.end()[0] | {"seconds": seconds} | watching.end()


@contextlib.contextmanager
def _watched(client: Path, limit: str, nobody: bool, told: list[dict[str, Any]]) -> Iterator[None]:
    """A viewer that has settled, for the time of the block."""
    if nobody:
        yield
        return
    watching = Watching(client, limit, window=False)
    time.sleep(SETTLE_S)
    try:
        yield
    finally:
        told.append(watching.end())


def compare(pairs: int, seconds: float, limit: str, nobody: bool) -> dict[str, Any]:
    """Interleaved pairs: the ratios of with to without, medians with 95 % intervals and a signed-rank test."""
    compensator, spans, reports = Compensator(), [], []
    for k in range(pairs):
        span = {}
        for watched in (True, False) if k % 2 else (False, True):
            with (
                _watched(compensator.client, limit, nobody, reports) if watched else contextlib.nullcontext()
            ):
                time.sleep(SETTLE_S)
                start = time.monotonic_ns()
                time.sleep(seconds)
                span[watched] = (start, time.monotonic_ns())
        spans.append(span)
        click.echo(f"pair {k + 1} of {pairs}, load average {os.getloadavg()[0]:.1f}", err=True)
    told, latencies = compensator.end()
    cost = [report["us_per_value"] for report in reports if report.get("us_per_value")]
    return told | _ratios(spans, latencies) | {"us_per_value": float(np.median(cost)) if cost else None}


def _ratios(spans: list[dict[bool, tuple[int, int]]], latencies: np.ndarray) -> dict[str, Any]:
    from scipy.stats import wilcoxon

    rng, told = np.random.default_rng(1), {}
    for percentile in (50, 99):
        table = np.array(
            [[_percentile(latencies, span[w], percentile) for w in (True, False)] for span in spans]
        )
        ratio = table[:, 0] / table[:, 1]
        drawn = np.median(ratio[rng.integers(0, len(ratio), (4000, len(ratio)))], axis=1)
        tested: Any = wilcoxon(np.log(ratio))
        told[f"p{percentile}"] = {
            "ratio": float(np.median(ratio)),
            "ci95": np.quantile(drawn, [0.025, 0.975]).tolist(),
            "p_value": float(tested.pvalue),
            "with_without_us": np.round(table, 1).tolist(),
        }
    return told


def _percentile(latencies: np.ndarray, span: tuple[int, int], percentile: int) -> float:
    start, end = np.searchsorted(latencies[:, 0], span)
    return float(np.percentile(latencies[start:end, 1], percentile)) / 1000.0


@click.command()
@click.option("--pairs", default=12, show_default=True, help="Interleaved pairs; 0 leaves them out.")
@click.option("--seconds", default=6.0, show_default=True, help="Length of one half of a pair.")
@click.option("--minutes", default=2.0, show_default=True, help="Length of the long view; 0 leaves it out.")
@click.option("--memory-limit", default="256MiB", show_default=True, help="The viewer's memory limit.")
@click.option("--window", is_flag=True, help="Long view in the native window (needs a display).")
@click.option("--nobody", is_flag=True, help="Pairs without any viewer.")
@click.option(
    "--compensate", "alone", type=click.Path(path_type=Path), hidden=True, help="Be the compensator."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document (else an indented one).")
def main(
    pairs: int,
    seconds: float,
    minutes: float,
    memory_limit: str,
    window: bool,
    nobody: bool,
    alone: Path | None,
    as_json: bool,
) -> None:
    """Measure what the viewer costs, at 1 kHz × 3 sensors."""
    if alone is not None:
        compensate(alone)
        return
    told: dict[str, Any] = {"load_average_before": os.getloadavg()[0]}
    if minutes:
        told["long"] = long_view(60.0 * minutes, memory_limit, window)
    if pairs:
        told["latency"] = compare(pairs, seconds, memory_limit, nobody)
    told["load_average_after"] = os.getloadavg()[0]
    click.echo(json.dumps(told, indent=None if as_json else 1))


if __name__ == "__main__":
    main()
