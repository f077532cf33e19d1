"""Corrected samples out on zenoh, from a bounded queue and a thread of its own."""

import json
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from rtcomp.batches import Batches
from rtcomp.encodings import ENCODERS, MIME
from rtcomp.frames import c_declaration, schema
from rtcomp.latency import Timeline
from rtcomp.probe import LEAF, read_told
from rtcomp.sample_queue import Batch, BatchQueue, SampleQueue
from rtcomp.sources.clock import SteadyClock

log = logging.getLogger(__name__)

HEALTH_S = 1.0
MOST_UNSETTLED = 8192  # samples that keep their room in the queue after they went out
SETTLE_S = 0.0625  # between two looks at the latencies


class Publisher:
    """Publishes `…/rate` per sample, `…/batch`, `…/health` at 1 Hz, and answers `…/model` and `…/schema`.

    `offer` is called by the thread that corrects; all else happens in the publisher's own thread.
    """

    def __init__(
        self,
        session: Any,
        prefix: str,
        names: tuple[str, ...],
        clock: SteadyClock,
        *,
        encoding: str = "struct",
        lossless: bool = False,
        aliases: dict[str, str] | None = None,
        queue: SampleQueue | None = None,
    ) -> None:
        """What to publish with, where, and of which channels.

        `lossless` makes publishing wait for slow subscribers (logs); else they lose samples, by sequence number.
        `aliases` names keys that carry a channel's rate instead of `<prefix>/<channel>/rate` (ROS 2, VSS).
        `queue` is what the samples come through; one of its own if not given.
        """
        import zenoh

        self.session, self.prefix, self.names = session, prefix.strip("/"), names
        self.published = 0
        self.timeline = Timeline()
        self.models: dict[str, Any] = dict.fromkeys(names)
        self.health: Callable[[str], dict[str, Any]] = lambda name: {}
        self._clock, self._lossless = clock, lossless
        self._encoding, self._encode, mime = encoding, ENCODERS[encoding], MIME[encoding]
        self.queue: SampleQueue = queue or BatchQueue(clock)
        self._lost = self._unsettled = 0
        control = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
        self._rates = [
            session.declare_publisher(
                (aliases or {}).get(name, self.key(name, "rate")),
                encoding=zenoh.Encoding(mime),
                congestion_control=control,
                express=not lossless,
            )
            for name in names
        ]
        self._puts = [rate.put for rate in self._rates]
        self._batches = Batches(
            [
                session.declare_publisher(
                    self.key(name, "batch"),
                    encoding=zenoh.Encoding(MIME["struct"]),
                    congestion_control=control,
                    priority=zenoh.Priority.DATA_LOW,
                )
                for name in names
            ]
        )
        self._healths = [session.declare_publisher(self.key(name, "health")) for name in names]
        self._declared = [self._declare(name) for name in names]
        self._received: dict[str, float] | None = None
        self._thread = threading.Thread(target=self._run, name="publisher", daemon=True)

    def key(self, name: str, leaf: str) -> str:
        """`<prefix>/<channel>/<leaf>`."""
        return f"{self.prefix}/{name}/{leaf}"

    def _declare(self, name: str) -> tuple[Any, ...]:
        layout = schema() | {"c": c_declaration(), "encoding": self._encoding}
        answers = {"schema": lambda: layout, "model": lambda: self.models[name]}
        queryables = [
            self.session.declare_queryable(key := self.key(name, leaf), partial(_reply, key, answer))
            for leaf, answer in answers.items()
        ]
        told = self.session.declare_subscriber(self.key(name, LEAF), self._hear)
        return (*queryables, told, self.session.liveliness().declare_token(self.key(name, "alive")))

    def _hear(self, message: Any) -> None:
        """Another process says when it had the samples; the last word counts."""
        told = read_told(message.payload.to_bytes())
        self._received = told.latency_us if told else self._received

    def start(self) -> None:
        """Start the thread."""
        self._batches.watched()
        self._thread.start()

    def wait_for_subscribers(self, timeout_s: float) -> bool:
        """Wait until every channel's rate or batch has a subscriber, at most `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not all(
            rate.matching_status.matching or watched
            for rate, watched in zip(self._rates, self._batches.watched(), strict=True)
        ):
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.02)
        return True

    def offer(self, corrected: np.ndarray, channel: np.ndarray, t_received_ns: int) -> None:
        """Queue samples (copied). When the queue is full they are lost and counted; a lossless one waits instead."""
        t_corrected_ns = self._clock.now_ns()
        while not self.queue.put(corrected, channel, t_received_ns, t_corrected_ns):
            if not self._lossless or not self._thread.is_alive():
                self._lost += len(corrected)
                return
            time.sleep(0.001)

    @property
    def lost(self) -> int:
        """Samples that the full queue had no room for."""
        return self._lost + self.queue.lost

    def close(self) -> None:
        """Publish what is queued and the last health, then undeclare everything."""
        if self._thread.is_alive():
            self.queue.end()
            self._thread.join()
        self._settle()
        self._publish_health()
        self._batches.close()
        for declared in (*self._rates, *self._healths, *(item for group in self._declared for item in group)):
            declared.undeclare()

    def _run(self) -> None:
        """As little as can be between a sample and the next; the rest is done when it is due."""
        take, due, health_due, settle_due = self.queue.take, 0.0, time.monotonic() + HEALTH_S, 0.0
        while (batch := take(due - time.monotonic())) is not None:
            if batch[1]:
                self._publish(batch)
            if (now := time.monotonic()) < due:
                continue
            if now >= health_due:
                self._publish_health()
                health_due = time.monotonic() + HEALTH_S
            elif now >= settle_due:
                self._settle()
                settle_due = now + SETTLE_S
            due = min(health_due, settle_due, self._batches.flush(now))

    def _publish(self, batch: Batch) -> None:
        """What is not needed for the samples to go out comes after they have."""
        content, channel = batch
        for index, payload in zip(channel, self._encode(content, channel, self.names), strict=True):
            self._puts[index](payload)
        self._batches.add(content, channel)
        self.published += len(channel)
        self._unsettled += len(channel)
        if self._unsettled > MOST_UNSETTLED:
            self._settle()

    def _settle(self) -> None:
        """Look at the times of what went out, and give its room back."""
        self.timeline.add(self.queue.passed())
        self._unsettled = 0

    def _publish_health(self) -> None:
        for name, publisher in zip(self.names, self._healths, strict=True):
            publisher.put(json.dumps(self.health(name)), encoding="application/json")

    def latency_us(self) -> dict[str, dict[str, float] | None]:
        """Percentiles per stage [µs] of what was settled; call it in the publisher's thread or when that has ended."""
        return {**self.timeline.summary_us(), **({LEAF: self._received} if self._received else {})}


def _reply(key: str, answer: Callable[[], Any], query: Any) -> None:
    query.reply(key, json.dumps(answer()), encoding="application/json")
