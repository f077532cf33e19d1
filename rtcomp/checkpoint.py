"""Thermal states across a restart: written now and then, taken up again while they still say something.

A checkpoint is bound to the models (by hash), the map's channels and its own contents (by hash); one that is
corrupt, foreign or stale is refused with its reason and the run goes on as if newly started, flagged unsettled.

How old it may be. What happened between the last temperature and the first new one is taken as linear, as in any gap
of a running stream. Up to `GAP_S` that is all the loop asks for; beyond, it flags the states unsettled, but they are
still nearer to the truth than a start as if soaked, until the gap reaches the slowest time constant: then the past
that they carry is mostly forgotten, and what they would add is mostly the guess. `OLDEST_S` bounds it where time
constants are long, for the sensor may have been switched off and on meanwhile.
"""

import glob
import hashlib
import logging
import threading
import time
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from rtcomp.atomic import write_atomically
from rtcomp.compiled import SETTLE_TAUS
from rtcomp.errors import RequestError
from rtcomp.frames import Flag
from rtcomp.model import document_hash, model_document
from rtcomp.pipeline import Pipeline
from rtcomp.plan import REFERENCE
from rtcomp.thermal import NEVER, T_POWER_ON, T_THERMAL

log = logging.getLogger(__name__)

PERIOD_S = 10.0
OLDEST_S = 300.0
CLOCK_SLACK_NS = 2_000_000_000
MAX_BYTES = 1 << 22
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
Numbers = list[list[float | None]]


class Checkpoint(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The file. Times are int64 ns of the frames' clock, as in `rtcomp.step.State`; null is NaN."""

    schema: Literal["rtcomp.state/1"]
    t_ns: int  # of the last frame
    boot: str | None  # which start of the machine this was
    boot_ns: int | None  # the machine's time since then, None for a log
    channels: list[str]
    models: list[list[str]]  # hashes of each channel's stack
    values: Numbers
    times: list[list[int]]
    filters: Numbers  # rows of a group: state and output of each input filter
    terms: Numbers
    held: Numbers  # latest temperatures of each channel, and when they and the last rate came
    held_times: list[list[int]]
    sha256: str = ""


class Snapshot(NamedTuple):
    """What the receiving thread hands over: copies, nothing that still changes."""

    t_ns: int
    boot_ns: int | None
    channels: tuple[str, ...]
    stacks: list[Any]
    arrays: tuple[np.ndarray, ...]


def take_snapshot(pipeline: Pipeline, t_ns: int, boot_ns: int | None) -> Snapshot:
    """Copy the states of a pipeline; quick, for the thread that corrects."""
    state, loop = pipeline.state, pipeline.loop
    held, held_times = loop.values.copy(), loop.times.copy()
    held[:, REFERENCE], held_times[:, REFERENCE] = np.nan, NEVER  # a truth of the past scores nothing
    arrays = (*(array.copy() for array in state), held, held_times)
    return Snapshot(t_ns, boot_ns, pipeline.names, list(pipeline.stacks), arrays)


def encode(snapshot: Snapshot) -> bytes:
    """The file's contents."""
    values, times, filters, terms, held, held_times = snapshot.arrays
    checkpoint = Checkpoint(
        "rtcomp.state/1",
        snapshot.t_ns,
        boot_id(),
        snapshot.boot_ns,
        list(snapshot.channels),
        model_hashes(snapshot.stacks),
        values.tolist(),
        times.tolist(),
        filters.reshape(-1, 4).tolist(),
        terms.tolist(),
        held.tolist(),
        held_times.tolist(),
    )
    return msgspec.json.encode(msgspec.structs.replace(checkpoint, sha256=_hash(checkpoint))) + b"\n"


def decode(content: bytes) -> Checkpoint:
    """Check a file's contents; RequestError says what is wrong."""
    try:
        checkpoint = msgspec.json.decode(content, type=Checkpoint)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RequestError(f"it is corrupt: {error}") from error
    if checkpoint.sha256 != _hash(checkpoint):
        raise RequestError("it is corrupt: its sha256 does not match its contents")
    return checkpoint


def seal(document: dict[str, Any]) -> bytes:
    """A checkpoint's document (the file's JSON) with the hash of what it holds; RequestError for anything else."""
    try:
        checkpoint = msgspec.convert(document, Checkpoint)
    except msgspec.ValidationError as error:
        raise RequestError(f"it is corrupt: {error}") from error
    return msgspec.json.encode(msgspec.structs.replace(checkpoint, sha256=_hash(checkpoint)))


def _hash(checkpoint: Checkpoint) -> str:
    return hashlib.sha256(msgspec.json.encode(msgspec.structs.replace(checkpoint, sha256=""))).hexdigest()


def model_hashes(stacks: list[Any]) -> list[list[str]]:
    """The hash of every model in every channel's stack."""
    return [[model.sha256 or document_hash(model_document(model)) for model in stack] for stack in stacks]


def boot_id() -> str | None:
    """Which start of the machine this is; None where the system does not say."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return None


def oldest_s(pipeline: Pipeline) -> float:
    """How old a checkpoint may be [s]: no older than the slowest memory of the fastest channel, or `OLDEST_S`."""
    slowest = pipeline.compiled.settle_s[pipeline.compiled.settle_s > 0] / SETTLE_TAUS
    return float(min(OLDEST_S, *slowest)) if len(slowest) else OLDEST_S


def check_fits(checkpoint: Checkpoint, pipeline: Pipeline, t_ns: int, boot_ns: int | None) -> None:
    """Refuse what is foreign or stale at the first frame's `t_ns`; RequestError says which."""
    if checkpoint.channels != list(pipeline.names):
        raise RequestError(
            f"it is of channels {', '.join(checkpoint.channels)}, the map has {pipeline.names}"
        )
    if checkpoint.models != model_hashes(pipeline.stacks):
        raise RequestError("it was made with other models")
    age_s, limit_s = (t_ns - checkpoint.t_ns) * 1e-9, oldest_s(pipeline)
    if not 0.0 <= age_s <= limit_s:
        raise RequestError(f"it is stale: {age_s:.1f} s old at the first frame, wanted 0 to {limit_s:.0f} s")
    if boot_ns is None or checkpoint.boot_ns is None or checkpoint.boot != boot_id():
        return
    jump_ns = (t_ns - checkpoint.t_ns) - (boot_ns - checkpoint.boot_ns)
    if abs(jump_ns) > CLOCK_SLACK_NS:
        raise RequestError(f"the host's clock was set by {jump_ns * 1e-9:.1f} s since it was written")


def restore(checkpoint: Checkpoint, pipeline: Pipeline, power_on: bool) -> None:
    """Put the states into a pipeline; RequestError when they do not fit, and nothing has changed then.

    With `power_on` the time of power-on is taken too: the one that was known, or unknown if the machine was started
    since, for then the sensor was probably switched off as well.
    """
    state, loop = pipeline.state, pipeline.loop
    targets = (*state, loop.values, loop.times)
    groups = [checkpoint.values, checkpoint.times, checkpoint.filters, checkpoint.terms]
    arrays = [
        _array(rows, to)
        for rows, to in zip((*groups, checkpoint.held, checkpoint.held_times), targets, strict=True)
    ]
    if not all(np.isfinite(array).all() for array in arrays[2:4]):
        raise RequestError("it is corrupt: a state is not finite")
    times = arrays[1]
    if (times[:, T_THERMAL] > checkpoint.t_ns).any() or (arrays[5] > checkpoint.t_ns).any():
        raise RequestError("it is corrupt: a state is later than the last frame")
    if not power_on:
        times[:, T_POWER_ON] = state.times[:, T_POWER_ON]
    elif checkpoint.boot is None or checkpoint.boot != boot_id():
        times[:, T_POWER_ON] = NEVER
    for target, array in zip(targets, arrays, strict=True):
        target[...] = array


def _array(rows: list[Any], like: np.ndarray) -> np.ndarray:
    try:
        flat = np.array([np.nan if x is None else x for row in rows for x in row], like.dtype)
        return flat.reshape(like.shape)
    except (ValueError, OverflowError) as error:
        raise RequestError(f"it is corrupt: {error}") from error


class Checkpointer:
    """A run's checkpoint file; `counts` is what became of it.

    `start` before the first frame is taken in, `offer` after every array of frames, `close` at the end. Writing
    happens in a thread of its own: the one that corrects never waits for a disk.
    """

    def __init__(self, path: str, live: bool) -> None:
        """`live` tells that frames come now, not out of a log.

        Raises RequestError when the file's folder is not there, or something else bears its name.
        """
        self.path, self._live = Path(path), live
        if not self.path.absolute().parent.is_dir():
            raise RequestError(f"cannot write {path}: no such folder; give a file in a folder that exists")
        if (
            self.path.is_dir() or self.path.is_fifo() or self.path.is_socket()
        ):  # would hold up the run, or refuse it
            raise RequestError(
                f"cannot keep states in {path}: it is no file; give one, or a name that is free"
            )
        self.counts = {"restored": 0, "refused": 0, "written": 0, "failed": 0}
        for left in self.path.parent.glob(f".{glob.escape(self.path.name)}.????????"):
            left.unlink(missing_ok=True)  # half written by one that was killed
        self._due = time.monotonic() + PERIOD_S
        self._last: tuple[int, int | None] | None = None
        self._pending: Snapshot | None = None
        self._wake, self._ended = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="checkpoint", daemon=True)

    def start(self, pipeline: Pipeline, t_ns: int, power_on: bool) -> bool:
        """Restore what is fresh (True); otherwise flag the first sample of every channel as unsettled."""
        self._thread.start()
        try:
            restored = self._restore(pipeline, t_ns, power_on)
        except RequestError as error:
            self.counts["refused"] += 1
            log.warning("state %s refused, starting unsettled: %s", self.path, error)
            restored = False
        self.counts["restored"] += restored
        if not restored:
            pipeline.loop.marks[:] |= int(Flag.UNSETTLED)
        return restored

    def _restore(self, pipeline: Pipeline, t_ns: int, power_on: bool) -> bool:
        try:
            with self.path.open("rb") as file:
                content = file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            log.info("no state %s yet, starting unsettled", self.path)
            return False
        except OSError as error:
            raise RequestError(f"it cannot be read: {error.strerror}") from error
        if len(content) > MAX_BYTES:
            raise RequestError(f"it has more than {MAX_BYTES} bytes")
        checkpoint = decode(content)
        check_fits(checkpoint, pipeline, t_ns, self._now_ns())
        restore(checkpoint, pipeline, power_on)
        return True

    def _now_ns(self) -> int | None:
        """The machine's time since its start, suspended or not."""
        clock = getattr(time, "CLOCK_BOOTTIME", None)
        return time.clock_gettime_ns(clock) if self._live and clock is not None else None

    def offer(self, pipeline: Pipeline, t_ns: int) -> None:
        """Frames up to `t_ns` have been taken in; hands a copy to the writer when it is time."""
        self._last = (t_ns, self._now_ns())
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + PERIOD_S
            self._pending = take_snapshot(pipeline, *self._last)
            self._wake.set()

    def _run(self) -> None:
        while not self._ended:
            self._wake.wait()
            self._wake.clear()
            pending, self._pending = self._pending, None
            if pending is not None:
                self._write(pending)

    def _write(self, snapshot: Snapshot) -> None:
        try:
            write_atomically(self.path, encode(snapshot))
        except RequestError as error:
            self.counts["failed"] += 1
            if self.counts["failed"] == 1:
                log.warning("state not written, the run goes on: %s", error)
            return
        self.counts["written"] += 1

    def close(self, pipeline: Pipeline) -> None:
        """Write the last states."""
        if self._thread.is_alive():
            self._ended = True
            self._wake.set()
            self._thread.join()
        if self._last is not None:
            self._write(take_snapshot(pipeline, *self._last))
            self._last = None
