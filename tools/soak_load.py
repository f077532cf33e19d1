"""What a soak does to a run: a full bus with temperature ramps, model swaps, and subscribers that come and go.

All of it happens in this process; the run is in another and is reached over a socket and over zenoh only, so that
what these clients take does not count as the run's.
"""

import json
import socket
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp import fog_format
from rtcomp.frames import CORRECTED
from rtcomp.model import model_document
from rtcomp.zenoh_session import open_session
from tools.faults.runs import peer_config, wait_for
from tools.faults.trace import START_NS, make_model

CYCLE_S = 15  # a whole number of counter rounds of both frames
SWAP_S, CHURN_S = 3.0, 4.0
HURRY = (
    10.0  # times as often at first: an allocator has its pools full after so many events, not after a time
)
CLOSING, CLOSING_S = 100, 3.0  # frames sent slowly at the end, so that a loss before lies between two samples
BURST = 3  # cycles sent at first as fast as it goes: every queue is once as full as it can be, and frames are lost
PARTS = ("frames", "swaps", "visitors")


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
    """A subscriber that keeps the latencies of the present window, the gaps of all time and the latest health."""

    def __init__(self, session: Any) -> None:
        self.received = self.gaps = self.next = 0
        self.health: dict[str, Any] = {}
        self._payloads: list[bytes] = []
        self._subscribers = [
            session.declare_subscriber("rtcomp/yaw/rate", self._take),
            session.declare_subscriber("rtcomp/yaw/health", self._take_health),
        ]

    def _take(self, message: Any) -> None:
        self._payloads.append(message.payload.to_bytes())

    def _take_health(self, message: Any) -> None:
        self.health = json.loads(message.payload.to_bytes())

    def p99_us(self) -> float:
        """Of what came since the last call, reception to publication; counts it and its gaps."""
        payloads, self._payloads = self._payloads, []
        samples = np.frombuffer(b"".join(payloads), CORRECTED)
        if not len(samples):
            return float("nan")
        steps = np.diff(samples["seq"].astype(np.int64), prepend=self.next - 1)
        self.gaps += int((steps - 1).sum())
        self.received += len(samples)
        self.next = int(samples["seq"][-1]) + 1
        return float(np.percentile(samples["t_pub_ns"] - samples["t_ns"], 99)) / 1e3


class Load:
    """Sender, swaps and churn, each in a thread, from `start` to `finish`.

    `bus` is where frames go to (a connected datagram socket or a python-can bus), `endpoint` the run's zenoh one, and
    `parts` what there is to be of `PARTS`.
    """

    def __init__(
        self, folder: Path, bus: Any, endpoint: str, rate_hz: int, parts: Sequence[str] = PARTS
    ) -> None:
        self.frames, self.bus = cycle(rate_hz), bus
        self.sent = self.failed = self.visitors = 0
        self.swaps = {"accepted": 0, "refused": 0}
        self._config = folder / "visit.json5"
        client = {"mode": "client", "connect": {"endpoints": [endpoint]}}
        self._config.write_text(json.dumps(peer_config(client)))
        self.session = open_session(self._config)
        self.listener = Listener(self.session)
        self.pace = HURRY  # of swaps and visits; 1 is theirs
        self._over = threading.Event()
        work = {"frames": self._send, "swaps": self._swap, "visitors": self._churn}
        self._threads = [threading.Thread(target=work[part], name=part, daemon=True) for part in parts]

    def start(self) -> None:
        """Begin as soon as the run answers."""
        wait_for(lambda: any(reply.ok for reply in self.session.get("rtcomp/yaw/schema", timeout=1.0)))
        for thread in self._threads:
            thread.start()

    def finish(self) -> None:
        """End it, and let everything arrive."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        took_s = CLOSING / len(self.frames) * CYCLE_S
        self._replay([self.frames[:CLOSING]], took_s / CLOSING_S, threading.Event())
        wait_for(lambda: self.listener.health.get("swaps") == self.swaps)
        wait_for(self._has_settled)

    def _has_settled(self) -> bool:
        """Whether two healths say the same, and the last sample they speak of is here."""
        before = self.listener.health
        wait_for(lambda: self.listener.health is not before)
        self.listener.p99_us()
        samples = self.listener.health.get("samples")
        return before.get("samples") == samples == self.listener.next

    def close(self) -> None:
        """Give the session back."""
        self.session.close()

    def _replay(self, arrays: Any, speed: float, stop: threading.Event) -> None:
        from rtcomp.sources.transmit import replay

        report = replay(arrays, self.bus, speed=speed, stop=stop)
        self.sent += report.sent
        self.failed += report.failed

    def _send(self) -> None:
        from rtcomp.sources.transmit import repeated

        self._replay(repeated(lambda: [self.frames], BURST), 0.0, self._over)
        self._replay(repeated(lambda: [self.frames], 1 << 30), 1.0, self._over)

    def _swap(self) -> None:
        import zenoh

        models = [json.dumps(model_document(make_model(residual_std_dps=std))) for std in (0.02, 0.03)]
        with self.session.declare_publisher(
            "rtcomp/yaw/model/swap", congestion_control=zenoh.CongestionControl.BLOCK
        ) as publisher:
            while not self._over.wait(SWAP_S / self.pace):
                publisher.put(models[self.swaps["accepted"] % 2])
                publisher.put(b"{broken")
                self.swaps = {name: number + 1 for name, number in self.swaps.items()}

    def _churn(self) -> None:
        while not self._over.wait(CHURN_S / 2 / self.pace):
            with open_session(self._config) as session:
                subscriber = session.declare_subscriber("rtcomp/**", lambda sample: None)
                self._over.wait(CHURN_S / 2 / self.pace)
                subscriber.undeclare()
            self.visitors += 1


def datagram_pair() -> tuple[socket.socket, socket.socket]:
    """Two connected datagram sockets on the loopback interface: the run's end and ours."""
    run, ours = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    run.bind(("127.0.0.1", 0))
    ours.bind(("127.0.0.1", 0))
    ours.connect(run.getsockname())
    run.connect(ours.getsockname())
    return run, ours


def free_endpoint() -> str:
    """A zenoh endpoint on this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
