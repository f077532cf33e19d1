"""Other models while running: the files again on SIGHUP, or a put to an opt-in zenoh key.

A swap is whole or not at all: what cannot be read, is of another sensor, fails its hash or is signed by nobody
trusted is refused, counted and said, and the old model stays. Nothing in a message names a file. A put is smaller
than a file may be: it is parsed while frames come in.
"""

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any

from rtcomp.errors import RequestError, printable
from rtcomp.model import Model, check_sensor, parse_model

log = logging.getLogger(__name__)

MAX_BYTES = 1 << 20  # three times what the most rules take
Stacks = dict[str, list[Model]]


class Swapper:
    """Accepts and refuses new models for a run; `counts` is what became of them."""

    def __init__(
        self,
        load: Callable[[], Stacks],
        swap: Callable[[Stacks], None],
        sensor: str | None,
        trust: Sequence[Any] = (),
    ) -> None:
        """`load` reads the run's model files again, `swap` hands stacks to the run; `trust` as in `parse_model`."""
        self.counts = {"accepted": 0, "refused": 0}
        self._load, self._swap, self._sensor, self._trust = load, swap, sensor, trust
        self._subscribers: list[Any] = []
        self._lock = threading.RLock()  # puts come in threads of zenoh's, a reload in a signal's handler

    def reload(self) -> None:
        """Take the run's model files as they are now."""
        self._try(self._load)

    def listen(self, session: Any, keys: dict[str, str]) -> None:
        """Accept models put to `keys[channel]`."""
        for channel, key in keys.items():
            self._subscribers.append(
                session.declare_subscriber(
                    key, lambda sample, channel=channel: self.take(channel, sample.payload.to_bytes())
                )
            )

    def take(self, channel: str, payload: bytes) -> None:
        """Use the model in `payload` for `channel`."""
        self._try(lambda: {channel: [self._parse(payload)]})

    def _parse(self, payload: bytes) -> Model:
        if len(payload) > MAX_BYTES:
            raise RequestError(f"a model of {len(payload)} bytes; at most {MAX_BYTES} are taken")
        try:
            text = payload.decode()
        except UnicodeDecodeError as error:
            raise RequestError(f"the model put is not UTF-8 text: {error.reason}") from error
        model = parse_model(text, "the model put", self._trust)
        check_sensor(model, self._sensor, "the model put")
        return model

    def _try(self, read: Callable[[], Stacks]) -> None:
        try:
            stacks = read()
        except RequestError as error:
            self._count("refused")
            log.warning("model not swapped, the old one stays: %s", printable(str(error)))
            return
        self._swap(stacks)
        self._count("accepted")

    def _count(self, what: str) -> None:
        with self._lock:
            self.counts[what] += 1

    def close(self) -> None:
        """Stop listening."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()
