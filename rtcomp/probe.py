"""A subscriber in a process of its own that tells a run when its samples got there: `python -m rtcomp.probe`.

It measures from the kernel's time stamp of the frame to the arrival in this process, and puts percentiles [µs] to
`<prefix>/<channel>/received` once a second; the run shows them as its stage `received`, in health and at the end.
Clocks of one machine agree by themselves; between machines they have to be synchronised (PTP).
"""

import json
import struct
import threading
from typing import Any

import click
import msgspec
import numpy as np

from rtcomp.frames import CORRECTED
from rtcomp.latency import PERCENTILES, Timeline
from rtcomp.sources.clock import SteadyClock
from rtcomp.zenoh_session import open_session

LEAF = "received"
PERIOD_S = 1.0
MAX_BYTES = 4096
HEAD = struct.Struct("<qqQ")  # t_ns, t_pub_ns, seq of a corrected sample


class Told(msgspec.Struct):
    """What a probe puts: how many samples it has, how many it missed by their numbers, and its latencies."""

    received: int
    missed: int
    latency_us: dict[str, float]


def read_told(payload: bytes) -> Told | None:
    """What a probe put; None for anything else, since everyone on the network may put here."""
    try:
        told = msgspec.json.decode(payload[:MAX_BYTES], type=Told)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
    return told if set(told.latency_us) == set(PERCENTILES) else None


class Stream:
    """Samples of one channel as they arrive; zenoh's thread takes, another reports."""

    def __init__(self, clock: SteadyClock) -> None:
        self.received = self.missed = 0
        self._clock, self._timeline = clock, Timeline({LEAF: (0, 1)})
        self._passages: list[tuple[int, int]] = []  # time stamp and arrival [ns]
        self._next: int | None = None

    def take(self, message: Any) -> None:
        """One sample."""
        now_ns = self._clock.now_ns()
        payload = message.payload.to_bytes()
        if len(payload) != CORRECTED.itemsize:
            return
        t_ns, _, seq = HEAD.unpack_from(payload)
        if self._next is not None and seq > self._next:
            self.missed += seq - self._next
        self._next = seq + 1
        self.received += 1
        self._passages.append((t_ns, now_ns))

    def report(self) -> Told | None:
        """So far; None before the first sample."""
        passages, self._passages = self._passages, []
        self._timeline.add(np.array(passages, np.int64).reshape(-1, 2))
        percentiles = self._timeline.summary_us()[LEAF]
        return Told(self.received, self.missed, percentiles) if percentiles else None


class Probe:
    """Subscribes to every channel under a prefix and tells once a second."""

    def __init__(self, session: Any, prefix: str) -> None:
        self.streams: dict[str, Stream] = {}
        self._session, self._clock = session, SteadyClock()
        self._subscriber = session.declare_subscriber(f"{prefix}/*/rate", self._take)

    def _take(self, message: Any) -> None:
        channel = str(message.key_expr).removesuffix("/rate")
        if channel not in self.streams:
            self.streams[channel] = Stream(self._clock)
        self.streams[channel].take(message)

    def tell(self) -> dict[str, Any]:
        """Put what is known so far; the same as a document, by channel."""
        reports = {channel: stream.report() for channel, stream in list(self.streams.items())}
        told = {channel: report for channel, report in reports.items() if report}
        for channel, report in told.items():
            self._session.put(f"{channel}/{LEAF}", msgspec.json.encode(report))
        return msgspec.to_builtins(told)

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()


@click.command()
@click.option("--zenoh", help="zenoh configuration file, or 'local'.  [default: local]", default="local")
@click.option("--prefix", help="First part of every key.", default="rtcomp", show_default=True)
def main(zenoh: str, prefix: str) -> None:
    """Measure until Ctrl-C or SIGTERM, then print one JSON document: per channel samples, misses, latencies."""
    import signal

    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    with open_session(zenoh, listen=False) as session:
        probe = Probe(session, prefix)
        click.echo(f"rtcomp.probe: listening to {prefix}/*/rate", err=True)
        while not over.wait(PERIOD_S):
            probe.tell()
        click.echo(json.dumps(probe.tell()))
        probe.close()


if __name__ == "__main__":
    main()
