"""`rtcomp run`: one thread receives and corrects, another publishes; everything lost is counted."""

import contextlib
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rtcomp.checkpoint import Checkpointer
from rtcomp.config import RunConfig
from rtcomp.errors import RequestError
from rtcomp.frames import CORRECTED, FRAME
from rtcomp.loop_state import FRAMES
from rtcomp.model import Model, model_document
from rtcomp.pipeline import Pipeline
from rtcomp.plan import CompiledMap, compile_map
from rtcomp.publisher import Publisher
from rtcomp.realtime import realtime
from rtcomp.sample_queue import BatchQueue, SampleQueue, SampleRing
from rtcomp.signal_map import load_map
from rtcomp.sources.bus import is_socketcan, open_bus
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.logs import log_format, read_log
from rtcomp.stacks import load_stacks, trusted_keys
from rtcomp.swap import Swapper

if TYPE_CHECKING:
    from rtcomp.live import LiveLoop

log = logging.getLogger(__name__)

RECEIVE_S = 0.2  # a silent bus holds up a stop no longer than this
SLOW_COMPILE_S = 1.5
WAIT_SUBSCRIBER_S = 2.0


@contextlib.contextmanager
def saying_when_slow(say: Callable[[str], None]) -> Iterator[None]:
    """Tell a person who waits that the first start compiles."""
    text = "compiling for this machine: the first start takes about half a minute, later ones do not …"
    timer = threading.Timer(SLOW_COMPILE_S, say, [text])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def warm_up(compiled_map: CompiledMap) -> None:
    """Run the loop once on a throw-away pipeline, so that no frame waits for the compiler."""
    list(Pipeline(compiled_map).process(np.zeros(1, FRAME)))


def warm_up_live(compiled_map: CompiledMap) -> None:
    """The same for the loop that takes frames from a socket: on a pair of them, for a moment."""
    import socket

    from rtcomp.live import LiveLoop
    from rtcomp.sources.socketcan import SocketReceiver

    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there, contextlib.closing(SocketReceiver(here)) as receiver:
        receiver.receive(0.0)
        with contextlib.closing(SampleRing(1)) as ring:
            receiver.receive(0.0, LiveLoop(Pipeline(compiled_map), ring))
            ring.put(np.zeros(1, CORRECTED), np.zeros(1, np.uint8), 0, 0)
            ring.take(0.0)


class Runner:
    """Everything of one run, from the configuration to the summary.

    `start` opens what there is to open (RequestError when it cannot), `loop` runs until `stop` is called, the log
    ends or the time is over, `close` gives everything back; `summary` is what `--json` prints.
    """

    def __init__(self, config: RunConfig, say: Callable[[str], None] = log.info) -> None:
        if (config.bus is None) == (config.log is None):
            raise RequestError("wanted either --bus INTERFACE:CHANNEL or --log FILE, got both or neither")
        self.config, self.say = config, say
        self.map: CompiledMap = compile_map(load_map(config.map), config.dbc)
        self._trust = trusted_keys(config.trust)
        self.pipeline = Pipeline(self.map, self._load_stacks())
        self.checkpoint = Checkpointer(config.state, config.bus is not None) if config.state else None
        self.clock = SteadyClock()
        self.stopped = threading.Event()
        self._resources = contextlib.ExitStack()
        self._source: Any = None
        self.recorder: Any = None
        self._swap: dict[str, list[Model]] = {}
        self.swapper = Swapper(self._load_stacks, self._swap_soon, config.sensor, self._trust)
        self._live: LiveLoop | None = None
        self._cpu_s = 0.0
        self._started = self._ended = time.monotonic()
        self._begun = False
        if isinstance(config.power_on, float):
            self.pipeline.power_on(round(config.power_on * 1e9))

    def start(self, session: Any = None) -> None:
        """Open bus or log, recorder and zenoh (or use `session`), and compile or load the kernels."""
        from rtcomp.recorder import Recorder
        from rtcomp.zenoh_session import open_session

        for warning in self.map.warnings:
            self.say(f"warning: {warning}")
        with saying_when_slow(self.say):
            self._warm_up()
        self._open_source()
        try:
            if self.config.record:
                self.recorder = Recorder(self.config.record)
                self._resources.callback(self.recorder.close)
            if session is None:
                session = open_session(self.config.zenoh)
                self._resources.callback(session.close)
            self.publisher = self._publisher(session)
            if self.config.allow_swap:
                if not self._trust:
                    self.say("warning: models are swapped in from whoever reaches this zenoh session; hold them "
                             "to a key with --trust PUBLIC_KEY")  # fmt: skip
                keys = {name: self.publisher.key(name, "model/swap") for name in self.map.channel_names}
                self.swapper.listen(session, keys)
                self._resources.callback(self.swapper.close)
        except BaseException:
            self._resources.close()
            raise

    def _warm_up(self) -> None:
        if self.config.log is not None:
            log_format(Path(self.config.log))  # a missing log is refused before half a minute is spent on it
        warm_up(self.map)
        if self.config.bus is not None and is_socketcan(self.config.bus):
            open_bus(self.config.bus).close()  # and so is a missing bus
            warm_up_live(self.map)

    def _open_source(self) -> None:
        if self.config.bus is not None:
            self._source = self._resources.enter_context(
                open_bus(self.config.bus, self.map.filters, self.clock)
            )
        else:
            self._log = iter(read_log(str(self.config.log)))
            self._first = next(
                self._log, None
            )  # a log that cannot be read is refused before anything is opened

    def _queue(self) -> SampleQueue:
        """What samples wait in: on SocketCAN a ring that compiled code fills."""
        if self.config.bus is None or not is_socketcan(self.config.bus):
            return BatchQueue(self.clock)
        from rtcomp.live import LiveLoop

        ring = SampleRing(clock=self.clock)
        self._resources.callback(ring.close)
        self._live = LiveLoop(self.pipeline, ring, each_batch=self.recorder is not None)
        return ring

    def _publisher(self, session: Any) -> Publisher:
        publisher = Publisher(
            session,
            self.config.prefix,
            self.map.channel_names,
            self.clock,
            encoding=self.config.encoding,
            lossless=self.config.log is not None,
            aliases=self.config.keys,
            queue=self._queue(),
        )
        publisher.health = self.health
        publisher.models = self._documents()
        return publisher

    def _documents(self) -> dict[str, Any]:
        stacks = zip(self.map.channel_names, self.pipeline.stacks, strict=True)
        documents = {name: [model_document(model) for model in stack] for name, stack in stacks}
        return {name: stack[0] if len(stack) == 1 else (stack or None) for name, stack in documents.items()}

    def loop(self) -> None:
        """Receive, correct, offer to the publisher; ends with `stop`, the end of the log, or the time given."""
        wait_s = self.config.wait_subscriber_s
        if wait_s is None:
            wait_s = WAIT_SUBSCRIBER_S if self.config.log and self.config.zenoh else 0.0
        if wait_s and not self.publisher.wait_for_subscribers(wait_s):
            self.say(
                f"no subscriber of {self.publisher.key('*', 'rate')} after {wait_s:g} s; going on without"
            )
        self.publisher.start()
        keys = ", ".join(self.publisher.key(name, "rate") for name in self.map.channel_names)
        self.say(
            f"{self.config.bus or self.config.log}: publishing {keys}"
            + ("" if self.config.log else "; stop with Ctrl-C")
        )
        with realtime(self.say) if self.config.realtime else contextlib.nullcontext():
            self._started, cpu_s = time.monotonic(), time.thread_time()
            try:
                for frames in self._frames():
                    self._take(frames)
                    if self.stopped.is_set():
                        break
            finally:
                self._ended, self._cpu_s = time.monotonic(), time.thread_time() - cpu_s

    def _frames(self) -> Iterator[np.ndarray]:
        """Arrays of frames to be corrected; on SocketCAN, from the second on, compiled code does that itself."""
        if self._source is None:
            if self._first is not None:
                yield self._first
            yield from self._log
            return
        deadline = time.monotonic() + self.config.seconds if self.config.seconds else float("inf")
        while not self.stopped.is_set() and (left := deadline - time.monotonic()) > 0.0:
            if self._live is not None and self._begun:
                self._take_live(self._live, min(RECEIVE_S, left))
                continue
            frames = self._source.receive(min(RECEIVE_S, left))
            if len(frames):
                yield frames

    def _take_live(self, live: "LiveLoop", timeout_s: float) -> None:
        before = self._frames_taken()
        if self._swap:
            self._swap_models()
        frames = self._source.receive(timeout_s, live)
        if self.recorder is not None and len(frames):
            self.recorder.append(frames)
        if self.checkpoint is not None and self._frames_taken() > before:
            self.checkpoint.offer(self.pipeline, live.last_t_ns)

    def _frames_taken(self) -> int:
        return int(self.pipeline.loop.totals[FRAMES])

    def _take(self, frames: np.ndarray) -> None:
        received_ns = self.clock.now_ns()
        if not self._begun:
            self._begin(int(frames["t_ns"][0]))
        if self._swap:
            self._swap_models()
        for samples in self.pipeline.process(frames):
            self.publisher.offer(samples.corrected, samples.channel, received_ns)
        if self.recorder is not None:
            self.recorder.append(frames)
        if self.checkpoint is not None:
            self.checkpoint.offer(self.pipeline, int(frames["t_ns"][-1]))

    def _begin(self, t_ns: int) -> None:
        """The first frame came at `t_ns`: take up what is known from before, or start anew."""
        self._begun = True
        powered_now = self.config.power_on == "first-frame"
        if self.checkpoint is not None and self.checkpoint.start(self.pipeline, t_ns, powered_now):
            return
        if powered_now:
            self.pipeline.power_on(t_ns)

    def _load_stacks(self) -> dict[str, list[Model]]:
        return load_stacks(self.config.model, self.map.channel_names, self.config.sensor, self._trust)

    def _swap_soon(self, stacks: dict[str, list[Model]]) -> None:
        self._swap.update(stacks)
        if self._source is not None:
            self._source.wake()

    def _swap_models(self) -> None:
        """Between two arrays of frames, so no sample sees half a model."""
        changed = {name: self._swap.pop(name) for name in list(self._swap)}
        stacks = dict(zip(self.map.channel_names, self.pipeline.stacks, strict=True)) | changed
        self.pipeline.swap(stacks)
        self.publisher.models = self._documents()

    def stop(self) -> None:
        """End the loop soon (any thread, or a signal handler)."""
        self.stopped.set()
        if self._source is not None:
            self._source.wake()

    def close(self) -> None:
        """Publish what is left, then give everything back."""
        try:
            if self.checkpoint is not None:
                self.checkpoint.close(self.pipeline)
            self.publisher.close()
        finally:
            self._resources.close()

    def health(self, name: str) -> dict[str, Any]:
        """What `…/health` says."""
        return self._common() | {"channel": name, "stages_us": self.publisher.latency_us()}

    def _common(self) -> dict[str, Any]:
        counts = self.pipeline.counts
        losses = {"receiver": self.pipeline.lost_frames, "queue": self.publisher.lost}
        return {
            "frames": self._frames_taken(),
            "samples": counts["samples"],
            "published": self.publisher.published,
            "ignored": counts["ignored"],
            "lost": sum(losses.values()),
            "losses": losses,
            "rejected": self.pipeline.rejected | self._unreadable(),
            "flags": self.pipeline.flags,
            "clock_steps": counts["clock_steps"],
            "swaps": dict(self.swapper.counts),
            "record": self.recorder.counts if self.recorder else None,
            "state": dict(self.checkpoint.counts) if self.checkpoint else None,
        }

    def _unreadable(self) -> dict[str, int]:
        """Lines of a log that were no frames."""
        skipped = getattr(self._log, "skipped", 0) if self.config.log is not None else 0
        return {"unreadable_line": skipped} if skipped else {}

    def summary(self) -> dict[str, Any]:
        """The document of `--json`, after `close`."""
        rms = self.pipeline.rms_dps or (None, None)
        stages = self.publisher.latency_us()
        live = self.config.log is None
        return self._common() | {
            "rms_raw_dps": rms[0],
            "rms_corrected_dps": rms[1],
            "latency_us": (stages["total"] if live else None) or {"p50": None, "p99": None},
            "stages_us": stages if live else None,
            "seconds": self._ended - self._started,
            "receive_cpu_s": self._cpu_s,
            "channels": {
                n: int(s) for n, s in zip(self.map.channel_names, self.pipeline.loop.seq, strict=True)
            },
        }


@contextlib.contextmanager
def stopping_on_signals(runner: Runner) -> Iterator[None]:
    """SIGINT and SIGTERM end the run cleanly; SIGHUP reads the model files again."""
    actions = {"SIGINT": runner.stop, "SIGTERM": runner.stop, "SIGHUP": runner.swapper.reload}
    numbers = {getattr(signal, name): act for name, act in actions.items() if hasattr(signal, name)}
    handlers = {n: signal.signal(n, lambda *_, act=act: act()) for n, act in numbers.items()}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
