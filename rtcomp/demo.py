"""`rtcomp demo`: the whole chain in one process, on a simulated trace that comes with the package.

A sender replays the trace on a virtual CAN bus; the ordinary run receives, corrects and publishes it; an ordinary
subscriber takes the samples from zenoh and scores them against the true rate that the trace carries.
"""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.config import RunConfig
from rtcomp.frames import CORRECTED
from rtcomp.run import Runner
from rtcomp.sources.logs import read_log
from rtcomp.zenoh_session import open_session

DATA = Path(__file__).parent / "demo_data"
TRACE, MODEL = DATA / "demo_drive.log.gz", DATA / "model.json"
MAP = "fog_simulated"
SECONDS = 20.0


class Tally:
    """A subscriber's view: samples, gaps in their sequence, and error before and after against the reference."""

    def __init__(self, session: Any, key: str) -> None:
        self.samples = self.gaps = 0
        self.squares = np.zeros(2)
        self.recent = np.zeros(2)
        self._next: int | None = None
        self._subscriber = session.declare_subscriber(key, self._take)

    def _take(self, message: Any) -> None:
        sample = np.frombuffer(message.payload.to_bytes(), CORRECTED)[0]
        if self._next is not None:
            self.gaps += int(sample["seq"]) - self._next
        self._next = int(sample["seq"]) + 1
        self.samples += 1
        if np.isfinite(sample["ref_rate_dps"]):
            errors = np.array([sample["rate_raw_dps"], sample["rate_dps"]]) - sample["ref_rate_dps"]
            self.squares += errors**2
            self.recent += 0.02 * (errors**2 - self.recent)

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()


class Demo:
    """The demo's parts; `run` is over after the seconds given or with `stop`."""

    def __init__(
        self,
        seconds: float = SECONDS,
        model: str | None = None,
        zenoh: str | None = None,
        prefix: str = "rtcomp",
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Open everything; RequestError where model or zenoh configuration do not do."""
        self.bus = f"virtual:rtcomp-demo-{os.getpid()}"
        config = RunConfig(bus=self.bus, map=MAP, model=[model or str(MODEL)], prefix=prefix, seconds=seconds)
        self.runner = Runner(config, say)
        self.session = open_session(zenoh)
        self.runner.start(self.session)
        self._frames = np.concatenate(list(read_log(TRACE)))  # compiles the reader before the seconds run
        self.tally = Tally(self.session, self.runner.publisher.key("*", "rate"))
        self._sender = threading.Thread(target=self._send, name="sender", daemon=True)

    def run(self) -> None:
        """Replay, correct, publish, subscribe."""
        self._sender.start()
        try:
            self.runner.loop()
        finally:
            self.runner.stop()
            self._sender.join()
            self.runner.close()

    def stop(self) -> None:
        """End soon."""
        self.runner.stop()

    def close(self) -> None:
        """Give subscriber and session back."""
        self.tally.close()
        self.session.close()

    def _send(self) -> None:
        from rtcomp.sources.bus import open_can
        from rtcomp.sources.transmit import replay

        with open_can(self.bus) as bus:
            while not self.runner.stopped.is_set():
                replay([self._frames], bus, speed=1.0, stop=self.runner.stopped)

    def summary(self) -> dict[str, Any]:
        """What `--json` prints; losses on the way to the subscriber are in it."""
        summary = self.runner.summary()
        missed = summary["published"] - self.tally.samples
        losses = summary["losses"] | {"transport": missed}
        return summary | {"losses": losses, "lost": sum(losses.values()), "received": self.tally.samples}
