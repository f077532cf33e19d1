"""Live buses as sources of FRAME arrays: every interface python-can knows, named in one short text."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from rtcomp.errors import RequestError, WorkError
from rtcomp.frames import FRAME
from rtcomp.sources import events
from rtcomp.sources.clock import SteadyClock
from rtcomp.sources.messages import fill_frames
from rtcomp.sources.python_can import import_can

if TYPE_CHECKING:
    import can

log = logging.getLogger(__name__)

BATCH = 512  # frames taken at once
SLICE_S = 0.1  # the longest a silent bus keeps us from noticing `wake`
RETRY_S = 0.02  # pause after a receive error
MAX_ERRORS = 100  # in a row, after which a bus is given up

Filter = tuple[int, int, bool]  # id, mask, extended


class Source(Protocol):
    """Where frames come from while they happen.

    `receive` waits at most `timeout_s` for frames and returns what there is by then, perhaps nothing: a view
    of shape `(n,)` of FRAME that is good until the next call. Losses, clock steps and controller errors are
    in it as error frames (see `rtcomp.frames`). `lost` counts the frames that the receiver's buffers dropped.
    """

    @property
    def lost(self) -> int:
        """Frames known to be lost before we could take them."""
        ...

    def receive(self, timeout_s: float) -> NDArray[Any]:
        """Wait for frames; see the class."""
        ...

    def wake(self) -> None:
        """Let a `receive` that waits in another thread, or the next one, return soon."""
        ...

    def close(self) -> None:
        """Give the bus back; closing twice does no harm."""
        ...

    def describe(self) -> str:
        """What this is, for a person."""
        ...

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


@dataclass(frozen=True)
class BusSpec:
    """A bus as named on the command line: `interface:channel?key=value&…`."""

    interface: str
    channel: str | None
    options: dict[str, Any] = field(default_factory=dict)
    text: str = ""


def parse_spec(text: str) -> BusSpec:
    """Take `interface:channel?key=value&…` apart; the channel may hold colons. Raises RequestError."""
    cast_from_string = import_can().util.cast_from_string
    address, _, query = text.partition("?")
    interface, _, channel = address.partition(":")
    try:
        pairs = parse_qsl(query, strict_parsing=True, keep_blank_values=True) if query else []
    except ValueError:
        interface, pairs = "", []
    if not interface:
        raise RequestError(
            f"bus {text!r}: wanted interface:channel?key=value&…, like socketcan:can0 or "
            "udp_multicast:239.0.0.1?port=43113"
        )
    return BusSpec(interface, channel or None, {key: cast_from_string(value) for key, value in pairs}, text)


def is_socketcan(text: str) -> bool:
    """Whether a bus is received from in batches, by compiled code."""
    return text.partition("?")[0].partition(":")[0] == "socketcan"


def open_can(text: str, **options: Any) -> "can.BusABC":
    """Open a python-can bus by its spec. Raises RequestError where it cannot be had."""
    spec = parse_spec(text)
    import can

    try:
        if spec.interface == "socketcan":
            from rtcomp.sources.socketcan import check_interface

            check_interface(spec.channel)
        return can.Bus(
            channel=spec.channel, interface=spec.interface, ignore_config=True, **(spec.options | options)
        )
    except (
        can.CanError,
        OSError,
        ValueError,
        TypeError,
        KeyError,
        ImportError,
        NotImplementedError,
    ) as error:
        reason = f"{error}" or type(error).__name__
        raise RequestError(
            f"bus {text!r} cannot be opened: {reason}; see `rtcomp doctor` for what this machine has"
        ) from error


def open_bus(text: str, filters: Sequence[Filter] | None = None, clock: SteadyClock | None = None) -> Source:
    """Open `interface:channel?key=value&…` as a source of frames.

    Args:
        text: any python-can interface: `socketcan:can0?fd=true`, `virtual:rtcomp`, `udp_multicast:239.0.0.1`,
            `pcan:PCAN_USBBUS1?bitrate=500000`, …
        filters: ids to receive, as (id, mask, extended); None for all. The kernel or the adapter applies them
            where it can; other frames may still come.
        clock: what the frames' time is read from; one of its own if not given.

    Raises:
        RequestError: the text is malformed or there is no such bus.
    """

    def opened() -> "can.BusABC":
        bus = open_can(text)
        if filters is not None:
            bus.set_filters([{"can_id": i, "can_mask": mask, "extended": ext} for i, mask, ext in filters])
        return bus

    if not is_socketcan(text):
        return PythonCanSource(opened(), text, clock)
    from rtcomp.sources.socketcan import SocketCanSource

    try:
        return SocketCanSource(opened, text, clock)
    except OSError as error:
        raise RequestError(f"bus {text!r} cannot be received from: {error}; see `rtcomp doctor`") from error


class PythonCanSource:
    """Any python-can bus as a `Source`: waits for one message, then takes what else is queued.

    Frames bear the time at which we took them, on the steady clock; the interfaces' own float times are of
    many epochs and too coarse.
    """

    def __init__(self, bus: "can.BusABC", name: str, clock: SteadyClock | None = None, batch: int = BATCH):
        self.bus = bus
        self.lost = 0  # python-can tells of no losses
        self.errors = 0
        self._name = name
        self._clock = clock or SteadyClock()
        self._batch = batch
        self._frames = np.zeros(batch + 1, FRAME)  # and room for a clock step
        self._errors_in_a_row = 0
        self._woken = False
        self._closed = False

    def receive(self, timeout_s: float) -> NDArray[Any]:
        """Wait at most `timeout_s` for frames; see `Source`."""
        messages, times = self._wait(time.monotonic() + timeout_s)
        first = 0
        if step := self._clock.host_step():
            log.warning("the host's clock stepped by %+.3f s; the frames' time does not", step / 1e9)
            self._frames[0:1] = events.clock_step(times[0] if times else self._clock.now_ns(), step)
            first = 1
        if messages:
            fill_frames(messages, self._frames[first:])
            self._frames["t_ns"][first : first + len(times)] = times
        return self._frames[: first + len(messages)]

    def _wait(self, deadline: float) -> tuple[list["can.Message"], list[int]]:
        messages: list[can.Message] = []
        times: list[int] = []
        while not self._woken:
            wait_s = 0.0 if messages else max(0.0, min(SLICE_S, deadline - time.monotonic()))
            message = self._next_message(wait_s)
            if message is not None:
                messages.append(message)
                times.append(self._clock.now_ns())
                if len(messages) == self._batch:
                    break
            elif messages or time.monotonic() >= deadline:
                break
        self._woken = False
        return messages, times

    def _next_message(self, wait_s: float) -> "can.Message | None":
        """One message; from the interface itself, since `recv` measures its timeout on the host's clock."""
        import can

        try:
            message, _ = self.bus._recv_internal(wait_s)
        except can.CanOperationError as error:
            self.errors += 1
            self._errors_in_a_row += 1
            if self._errors_in_a_row == 1:
                log.warning("%s: %s", self._name, error)
            if self._errors_in_a_row >= MAX_ERRORS:
                raise WorkError(
                    f"bus {self._name!r}: gone after {MAX_ERRORS} errors in a row: {error}"
                ) from error
            time.sleep(min(wait_s, RETRY_S))
            return None
        if message is not None:
            self._errors_in_a_row = 0
        return message

    def wake(self) -> None:
        """Let a waiting `receive` return within a tenth of a second."""
        self._woken = True

    def close(self) -> None:
        """Shut the bus down."""
        if not self._closed:
            self._closed = True
            self.bus.shutdown()

    def describe(self) -> str:
        """The bus as given and as python-can calls it."""
        return f"{self._name} ({self.bus.channel_info})"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
