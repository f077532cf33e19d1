"""Corrected samples out on zenoh, from a bounded queue and a thread of its own."""

import json
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from rtcomp.batches import Batches
from rtcomp.encodings import ENCODERS, MIME
from rtcomp.frames import c_declaration, schema
from rtcomp.latency import Stage

log = logging.getLogger(__name__)

ROOM = 1 << 16  # samples that may wait to be published
HEALTH_S = 1.0
STAGES = ("receive", "correct", "publish", "total")


class Batch(NamedTuple):
    """Samples on their way out, and when their frames were handed over and corrected [ns]."""

    corrected: np.ndarray
    channel: np.ndarray
    t_received_ns: int
    t_corrected_ns: int


class Publisher:
    """Publishes `…/rate` per sample, `…/batch`, `…/health` at 1 Hz, and answers `…/model` and `…/schema`.

    `offer` is called by the thread that corrects; all else happens in the publisher's own thread.
    """

    def __init__(
        self,
        session: Any,
        prefix: str,
        names: tuple[str, ...],
        clock_ns: Callable[[], int],
        *,
        encoding: str = "struct",
        lossless: bool = False,
        aliases: dict[str, str] | None = None,
    ) -> None:
        """`lossless` makes publishing wait for slow subscribers (logs); else they lose samples, by sequence number.

        `aliases` names keys that carry a channel's rate instead of `<prefix>/<channel>/rate` (ROS 2, VSS).
        """
        import zenoh

        self.session, self.prefix, self.names = session, prefix.strip("/"), names
        self.lost = 0
        self.published = 0
        self.stages = {stage: Stage() for stage in STAGES}
        self.models: dict[str, Any] = dict.fromkeys(names)
        self.health: Callable[[str], dict[str, Any]] = lambda name: {}
        self._clock_ns, self._lossless = clock_ns, lossless
        self._encoding, self._encode, mime = encoding, ENCODERS[encoding], MIME[encoding]
        self._queue: SimpleQueue[Batch | None] = SimpleQueue()
        self._offered = 0
        self._taken = 0
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
        return (*queryables, self.session.liveliness().declare_token(self.key(name, "alive")))

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
        while self._offered - self._taken + len(corrected) > ROOM:
            if not self._lossless or not self._thread.is_alive():
                self.lost += len(corrected)
                return
            time.sleep(0.001)
        self._offered += len(corrected)
        self._queue.put(Batch(corrected.copy(), channel.copy(), t_received_ns, self._clock_ns()))

    def close(self) -> None:
        """Publish what is queued and the last health, then undeclare everything."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        self._publish_health()
        self._batches.close()
        for declared in (*self._rates, *self._healths, *(item for group in self._declared for item in group)):
            declared.undeclare()

    def _run(self) -> None:
        due = time.monotonic() + HEALTH_S
        batch_due = 0.0
        while True:
            try:
                batch = self._queue.get(timeout=max(0.0, min(due, batch_due) - time.monotonic()))
            except Empty:
                batch = Batch(np.zeros(0), np.zeros(0), 0, 0)
            if batch is None:
                return
            if len(batch.corrected):
                self._publish(batch)
            batch_due = self._batches.flush(now := time.monotonic())
            if now >= due:
                self._publish_health()
                due = time.monotonic() + HEALTH_S

    def _publish(self, batch: Batch) -> None:
        corrected = batch.corrected
        for index, name in enumerate(self.names):
            mine = corrected if len(self.names) == 1 else corrected[batch.channel == index]
            if not len(mine):
                continue
            now = self._clock_ns()
            mine["t_pub_ns"] = now
            put = self._rates[index].put
            for payload in self._encode(mine, name):
                put(payload)
            self.stages["total"].add(now - mine["t_ns"])
            self._batches.add(index, mine)
        self.published += len(corrected)
        self._taken += len(corrected)
        self.stages["receive"].add(batch.t_received_ns - corrected["t_ns"])
        self.stages["correct"].add(np.array([batch.t_corrected_ns - batch.t_received_ns]))
        self.stages["publish"].add(np.array([self._clock_ns() - batch.t_corrected_ns]))

    def _publish_health(self) -> None:
        for name, publisher in zip(self.names, self._healths, strict=True):
            publisher.put(json.dumps(self.health(name)), encoding="application/json")

    def latency_us(self) -> dict[str, dict[str, float] | None]:
        """Percentiles per stage [µs]; call it in the publisher's thread or when that has ended."""
        return {name: stage.summary_us() for name, stage in self.stages.items()}


def _reply(key: str, answer: Callable[[], Any], query: Any) -> None:
    query.reply(key, json.dumps(answer()), encoding="application/json")
