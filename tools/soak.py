"""Long runs under load: `python -m tools.soak --minutes 60 --json`.

A run on a virtual bus takes a stream with temperature ramps for as long as it is told, while subscribers come and go
over TCP and models, good and broken, are put to the swap key. Judged are: memory (robust slope with its 95 % interval,
after a warm-up of a quarter), file descriptors and threads, the latency's p99 over time, and whether every frame sent
is a sample or counted as lost. Simulated frames, seed 7.
"""

import json
import os
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from rtcomp import fog_format
from rtcomp.config import RunConfig
from rtcomp.frames import CORRECTED
from rtcomp.model import model_document, save_model
from rtcomp.run import Runner
from rtcomp.zenoh_session import open_session
from tools.faults.runs import peer_config, wait_for
from tools.faults.trace import START_NS, make_model

CYCLE_S = 15  # a whole number of counter rounds of both frames
WINDOWS = 60
SWAP_S, CHURN_S = 3.0, 4.0
FLAT_MB_PER_H = 5.0


def cycle(rate_hz: int) -> np.ndarray:
    """Frames of one cycle: rates, and temperatures at 10 Hz going up and down by half a kelvin per second."""
    t_ns = START_NS + np.arange(CYCLE_S * rate_hz) * (1_000_000_000 // rate_hz)
    rate = 50.0 * np.sin(np.arange(len(t_ns)) * 2 * np.pi / len(t_ns))
    rate += np.random.default_rng(7).normal(0.0, 0.05, len(t_ns))
    slow = np.arange(CYCLE_S * 10)
    ramp = 20.0 + 0.05 * np.abs(slow - len(slow) / 2)
    temperatures = fog_format.encode_temperature(START_NS + slow * 100_000_000, ramp, ramp)
    return fog_format.merge(temperatures, fog_format.encode_rate(t_ns, rate))


class Listener:
    """A subscriber that keeps latencies of the present window and the gaps of all time."""

    def __init__(self, session: Any) -> None:
        self.received = self.gaps = 0
        self._next, self._payloads = 0, []
        self._subscriber = session.declare_subscriber("rtcomp/yaw/rate", self._take)

    def _take(self, message: Any) -> None:
        self._payloads.append(message.payload.to_bytes())

    def p99_us(self) -> float:
        """Of what came since the last call, reception to publication."""
        payloads, self._payloads = self._payloads, []
        samples = np.frombuffer(b"".join(payloads), CORRECTED)
        if not len(samples):
            return float("nan")
        steps = np.diff(samples["seq"].astype(np.int64), prepend=self._next - 1)
        self.gaps += int((steps - 1).sum())
        self.received += len(samples)
        self._next = int(samples["seq"][-1]) + 1
        return float(np.percentile(samples["t_pub_ns"] - samples["t_ns"], 99)) / 1e3


class Soak:
    """The run, those who load it, and what is measured of it."""

    def __init__(self, folder: Path, seconds: float, rate_hz: int) -> None:
        self.seconds, self.frames = seconds, cycle(rate_hz)
        self.sent = self.accepted = self.refused = self.visitors = 0
        self.over = threading.Event()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self._visit = self._config(folder, "visit", {"mode": "client", "connect": {"endpoints": [endpoint]}})
        own = self._config(folder, "own", {"listen": {"endpoints": [endpoint]}})
        save_model(make_model(), folder / "model.json")
        bus = f"virtual:soak-{os.getpid()}"
        config = RunConfig(
            bus=bus, model=[str(folder / "model.json")], allow_swap=True, state=str(folder / "state")
        )
        self.runner = Runner(config)
        self.session = open_session(own)
        self.runner.start(self.session)
        self.listener = Listener(self.session)
        self.rows: list[tuple[float, ...]] = []  # s, MB, descriptors, threads, p99 µs

    @staticmethod
    def _config(folder: Path, name: str, own: dict[str, Any]) -> Path:
        path = folder / f"{name}.json5"
        path.write_text(json.dumps(peer_config(own)))
        return path

    def run(self) -> None:
        """Load it for as long as it was told, then let everything arrive."""
        work = [self.runner.loop, self._send, self._swap, self._churn]
        threads = [threading.Thread(target=one) for one in work]
        for thread in threads:
            thread.start()
        started = time.monotonic()
        while (now := time.monotonic() - started) < self.seconds:
            time.sleep(min(self.seconds / WINDOWS, self.seconds - now))
            self._measure(time.monotonic() - started)
        self.over.set()
        for thread in threads[1:]:
            thread.join()
        wait_for(lambda: self.runner.pipeline.counts["frames"] >= self.sent)
        self.runner.stop()
        threads[0].join()
        self.runner.close()
        self.listener.p99_us()
        self.session.close()

    def _measure(self, now: float) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        megabytes = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        descriptors = len(os.listdir("/proc/self/fd"))
        tasks = len(os.listdir("/proc/self/task"))
        self.rows.append((now, megabytes, descriptors, tasks, self.listener.p99_us()))

    def _send(self) -> None:
        from rtcomp.sources.bus import open_can
        from rtcomp.sources.transmit import replay

        with open_can(str(self.runner.config.bus)) as bus:
            while not self.over.is_set():
                self.sent += replay(self.frames, bus, speed=1.0, stop=self.over).sent

    def _swap(self) -> None:
        models = [json.dumps(model_document(make_model(residual_std_dps=std))) for std in (0.02, 0.03)]
        while not self.over.wait(SWAP_S):
            self.session.put("rtcomp/yaw/model/swap", models[self.accepted % 2])
            self.session.put("rtcomp/yaw/model/swap", b"{broken")
            self.accepted, self.refused = self.accepted + 1, self.refused + 1

    def _churn(self) -> None:
        while not self.over.wait(CHURN_S / 2):
            with open_session(self._visit) as session:
                subscriber = session.declare_subscriber("rtcomp/**", lambda sample: None)
                self.over.wait(CHURN_S / 2)
                subscriber.undeclare()
            self.visitors += 1

    def report(self) -> dict[str, Any]:
        """Figures and verdicts."""
        rows = np.array(self.rows)[len(self.rows) // 4 :]
        summary = self.runner.summary()
        slope = memory_slope(rows)
        half = len(rows) // 2
        p99 = [float(np.nanmedian(part)) for part in (rows[:half, 4], rows[half:, 4])]
        uncounted = self.sent - summary["frames"] - summary["losses"]["receiver"]
        unseen = summary["published"] - self.listener.received - self.listener.gaps
        report = {
            "seconds": self.seconds,
            "frames": summary["frames"],
            "samples": summary["samples"],
            "rss_mb": float(rows[-1, 1]),
            "rss_slope_mb_per_h": slope,
            "descriptors": [int(rows[0, 2]), int(rows[-1, 2])],
            "threads": [int(rows[0, 3]), int(rows[-1, 3])],
            "p99_us": p99,
            "swaps": summary["swaps"],
            "visitors": self.visitors,
            "lost": summary["lost"],
            "uncounted": {"frames": uncounted, "samples": unseen},
        }
        return report | {"verdicts": self._verdicts(report, rows)}

    def _verdicts(self, report: dict[str, Any], rows: np.ndarray) -> dict[str, bool]:
        low, high = report["rss_slope_mb_per_h"]["ci95"]
        half = len(rows) // 2
        grows = [float(np.median(rows[half:, k]) - np.median(rows[:half, k])) for k in (2, 3)]
        swaps = {"accepted": self.accepted, "refused": self.refused}
        return {
            "memory is flat": low <= 0.0 or high < FLAT_MB_PER_H,
            "descriptors do not grow": grows[0] <= 0.0,
            "threads do not grow": grows[1] <= 0.0,
            "p99 is steady": report["p99_us"][1] < 2.0 * report["p99_us"][0],
            "every loss is counted": not any(report["uncounted"].values()),
            "every swap is counted": report["swaps"] == swaps,
        }


def memory_slope(rows: np.ndarray) -> dict[str, Any]:
    """Theil-Sen slope of the resident memory [MB/h] with its 95 % interval; rows are (s, MB, …)."""
    from scipy.stats import theilslopes

    found: Any = theilslopes(rows[:, 1], rows[:, 0] / 3600.0, 0.95)
    return {"value": float(found.slope), "ci95": [float(found.low_slope), float(found.high_slope)]}


@click.command()
@click.option("--minutes", default=60.0, show_default=True, help="How long.")
@click.option("--rate-hz", default=1000, show_default=True, help="Rate frames per second.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def main(minutes: float, rate_hz: int, as_json: bool) -> None:
    """Soak; exit status 1 when a verdict is negative."""
    import logging
    import tempfile

    from rich.console import Console

    logging.getLogger("rtcomp.swap").setLevel(logging.ERROR)  # half of the swaps are broken on purpose
    with tempfile.TemporaryDirectory(prefix="rtcomp-soak-") as folder:
        soak = Soak(Path(folder), minutes * 60.0, rate_hz)
        soak.run()
        report = soak.report()
    if as_json:
        click.echo(json.dumps(report))
    else:
        Console(highlight=False).print_json(data=report)
    sys.exit(not all(report["verdicts"].values()))


if __name__ == "__main__":
    main()
