"""Live from zenoh: batches of samples of every channel wait in a bounded ring and are logged ten times a second."""

import logging
import math
import threading
import time
from collections import defaultdict
from typing import Any

import numpy as np

from rtcomp.compensator import predict
from rtcomp.errors import WorkError
from rtcomp.frames import CORRECTED, Flag
from rtcomp.model import new_model
from rtcomp.view.asking import active_models, read_document, sample_layout
from rtcomp.view.channel_scene import ChannelScene, style_operating_point
from rtcomp.view.layout import live_blueprint
from rtcomp.view.report import about_models
from rtcomp.view.rerun_sdk import load_rerun
from rtcomp.view.sinks import Sink
from rtcomp.view.streams import ChannelStreams, history_columns
from rtcomp.view.thinning import History, thin

log = logging.getLogger(__name__)

BATCH_S = 0.1
RING = 1 << 10  # batches that may wait; older ones give way, and are counted by their sequence numbers
BACKLOG = 3  # so many waiting batches of a channel are still logged one by one; more are thinned together
PAUSE_S = 2.0
ASK_AGAIN_S = 5.0
LAST_S = 30.0  # how long the last data may take
HISTORY_EVERY_S = 60.0
NOTHING = np.zeros(0)


class Channel:
    """One channel: its streams, scene and past. Counts: samples `logged`, `missed` on the way, `thinned` here."""

    def __init__(self, sink: Sink, name: str) -> None:
        self.sink, self.name = sink, name
        self.streams = ChannelStreams(sink.stream, name)
        self.scene = ChannelScene(sink.stream, name, ())
        self.past = History(4)
        self.logged = self.missed = self.thinned = 0
        self.log_s = 0.0  # processor time spent in logging the streams' values
        self.dtype: np.dtype[Any] = CORRECTED
        self.heard = time.monotonic()
        self.running = False
        self._next_seq: int | None = None
        self._last_ns = 0
        style_operating_point(sink.stream, f"{name}/surface")

    def add(self, samples: np.ndarray) -> bool:
        """Log a batch of CORRECTED samples `(n,)`; True when the publisher has started anew or changed its model."""
        anew = self._count(samples["seq"]) or bool((samples["flags"] & Flag.MODEL_SWAPPED).any())
        self.past.add(samples["t_ns"], history_columns(samples))
        rows = samples
        if self.sink.rows_per_batch is not None and len(samples) > self.sink.rows_per_batch:
            rows = samples[thin(samples["rate_raw_dps"], self.sink.rows_per_batch)]
        started = time.thread_time()
        self.streams.add(rows)
        self.log_s += time.thread_time() - started
        self.scene.add(samples)
        if not self.running:
            self.streams.mark(int(samples["t_ns"][0]), "running")
        self.logged += len(rows)
        self.thinned += len(samples) - len(rows)
        self.heard, self.running, self._last_ns = time.monotonic(), True, int(samples["t_ns"][-1])
        return anew

    def _count(self, seq: np.ndarray) -> bool:
        steps = np.diff(
            seq.astype(np.int64), prepend=int(seq[0]) if self._next_seq is None else self._next_seq - 1
        )
        if self._next_seq is None:
            steps[0] = 1
        self.missed += int((steps[steps > 1] - 1).sum())
        self._next_seq = int(seq[-1]) + 1
        return bool((steps < 1).any())

    def health(self, document: dict[str, Any]) -> None:
        """Log the channel's health, at the time of its last sample."""
        if self._last_ns:
            self.streams.health(self._last_ns, document, self.missed, self.thinned)

    def pause(self) -> None:
        """Say that nothing comes any more."""
        self.running = False
        self.streams.mark(self._last_ns + 1, "paused")

    def log_history(self) -> None:
        """Log the whole past again, thinned: the viewer drops its oldest rows when its memory is full."""
        t_ns, means = self.past.rows()
        if len(t_ns):
            self.streams.history(t_ns, means)


class Viewer:
    """Shows every channel under a prefix. `start`, then it runs in a thread of its own until `stop`.

    Nothing is asked of the publisher but what any subscriber asks. `session` stays the caller's.
    """

    def __init__(self, session: Any, prefix: str, sink: Sink, window_s: float | None = 30.0) -> None:
        """`window_s` is how much of the past the plots show, None the whole."""
        self.session, self.prefix, self.sink = session, prefix.strip("/"), sink
        self.channels: dict[str, Channel] = {}
        self.error: Exception | None = None
        self._window_s = window_s
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._history_due = time.monotonic() + 1.0
        self._unsure: dict[str, float] = {}  # channels whose layout and models are to be asked for, and when

    def start(self) -> None:
        """Subscribe and begin to log."""
        import zenoh

        predict(
            new_model(), NOTHING, NOTHING
        )  # compiles, or loads what was compiled, before samples wait for it
        ring = zenoh.handlers.RingChannel
        self._batches = self.session.declare_subscriber(f"{self.prefix}/*/batch", ring(RING))
        self._healths = self.session.declare_subscriber(f"{self.prefix}/*/health", ring(256))
        self._alive = self.session.liveliness().declare_subscriber(
            f"{self.prefix}/*/alive", ring(64), history=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Log what has come in up to now and unsubscribe.

        Raises the error that ended the thread, if one did, and WorkError when rerun takes no data any more.
        """
        self._stopped.set()
        self._thread.join(LAST_S)
        if self._thread.is_alive():
            raise WorkError(
                f"rerun's viewer has taken no data for {LAST_S:g} s; it stands still or is stopped"
            )
        for subscriber in (self._batches, self._healths, self._alive):
            subscriber.undeclare()
        if self.error is not None:
            raise self.error

    def running(self) -> bool:
        """Whether it is still logging."""
        return self._thread.is_alive()

    def seen(self) -> bool:
        """Whether any channel has been heard of."""
        return any(channel.logged for channel in self.channels.values())

    def counts(self) -> dict[str, Any]:
        """What was logged, in all and per channel."""
        rows = {
            n: {"logged": c.logged, "missed": c.missed, "thinned": c.thinned}
            for n, c in self.channels.items()
        }
        values = sum(channel.streams.values for channel in self.channels.values())
        spent = sum(channel.log_s for channel in self.channels.values())
        return {"channels": rows, "values": values, "us_per_value": spent / values * 1e6 if values else None}

    def _run(self) -> None:
        try:
            while not self._stopped.wait(BATCH_S) and self.sink.alive():
                self._tick()
            self._tick()
            for channel in self.channels.values():
                channel.scene.finish()
                channel.log_history()
        except Exception as error:  # noqa: BLE001 - handed over to whoever calls stop
            self.error = error

    def _tick(self) -> None:
        for event in self._drain(self._alive):
            if not str(event.kind).endswith("DELETE"):
                self._unsure[_channel_of(event)] = 0.0
        batches: dict[str, list[bytes]] = defaultdict(list)
        for sample in self._drain(self._batches):
            batches[_channel_of(sample)].append(sample.payload.to_bytes())
        for name in sorted({*batches, *self._unsure}):
            self._meet(name)
        for name, payloads in batches.items():
            for part in payloads if len(payloads) <= BACKLOG else [b"".join(payloads)]:
                self._log(self.channels[name], part)
        for sample in self._drain(self._healths):
            if (channel := self.channels.get(_channel_of(sample))) is not None:
                document = read_document(sample.payload.to_bytes(), str(sample.key_expr))
                channel.health(document if isinstance(document, dict) else {})
        self._watch()

    @staticmethod
    def _drain(subscriber: Any) -> Any:
        for _ in range(2 * RING):
            sample = subscriber.try_recv()
            if sample is None:
                return
            yield sample

    def _meet(self, name: str) -> None:
        """Make the channel if it is new, and learn its layout and models if they are not known."""
        if name not in self.channels:
            self.channels[name] = Channel(self.sink, name)
            self.sink.stream.send_blueprint(live_blueprint(sorted(self.channels), self._window_s))
            self._unsure[name] = 0.0
        if time.monotonic() >= self._unsure.get(name, math.inf):
            self._ask(self.channels[name])

    def _ask(self, channel: Channel) -> None:
        """Learn a channel's layout and models; where nobody answers, ours are assumed until asked again."""
        key = f"{self.prefix}/{channel.name}"
        layout = sample_layout(self.session, key)
        if layout is None:
            self._unsure[channel.name] = time.monotonic() + ASK_AGAIN_S
            return
        del self._unsure[channel.name]
        channel.dtype = layout
        models = active_models(self.session, key)
        channel.scene.swap(models)
        text = load_rerun().TextDocument(about_models(channel.name, models), media_type="text/markdown")
        self.sink.stream.log(f"{channel.name}/about", text, static=True)

    def _log(self, channel: Channel, payload: bytes) -> None:
        if len(payload) % channel.dtype.itemsize:
            raise WorkError(
                f"{self.prefix}/{channel.name}/batch: {len(payload)} bytes are not samples of "
                f"{channel.dtype.itemsize} bytes as …/schema states; is it another program's key?"
            )
        if payload and channel.add(np.frombuffer(payload, channel.dtype)):
            self._unsure[channel.name] = 0.0

    def _watch(self) -> None:
        now = time.monotonic()
        for channel in self.channels.values():
            if channel.running and now - channel.heard > PAUSE_S:
                channel.pause()
        if now >= self._history_due:
            self._history_due = now + HISTORY_EVERY_S
            for channel in self.channels.values():
                channel.log_history()


def _channel_of(sample: Any) -> str:
    return str(sample.key_expr).split("/")[-2]
