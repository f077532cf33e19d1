"""What untrusted bytes may reach, one function per door: it must do its work or raise RequestError, and nothing else.

Used by the suite (hypothesis) and by `python -m tools.fuzz` (coverage-guided). A door that opens is walked through:
a model that is accepted must also compile and correct, a map that is accepted must also decode frames.
"""

import contextlib
import json
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from rtcomp.errors import RequestError
from rtcomp.frames import FRAME
from rtcomp.model import Model, model_document, parse_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import CompiledMap, compile_map
from rtcomp.signal_map import data_folder, load_map
from tools.faults.trace import START_NS, is_honest, make_model, make_trace


@cache
def folder() -> Path:
    """A folder for what can only be read from a file; in memory where there is such a place."""
    memory = Path("/dev/shm")  # noqa: S108 - a folder of our own is made in it
    return Path(tempfile.mkdtemp(prefix="rtcomp-fuzz-", dir=memory if memory.is_dir() else None))


@cache
def fog() -> CompiledMap:
    """The bundled map that most frames are for."""
    return compile_map(load_map("fog"))


@cache
def few_frames() -> np.ndarray:
    """Ten temperatures and some rates."""
    return make_trace().frames()[:110]


@contextlib.contextmanager
def as_file(data: bytes, name: str) -> Iterator[Path]:
    """The bytes as a file."""
    path = folder() / name
    path.write_bytes(data)
    yield path


def correct(
    models: list[Model], compiled: CompiledMap | None = None, frames: np.ndarray | None = None
) -> None:
    """Run frames through; only an overflow of absurd coefficients may make a rate no number."""
    compiled = compiled or fog()
    channels = dict.fromkeys(compiled.channel_names, models)
    pipeline = Pipeline(compiled, channels, START_NS)
    samples = pipeline.process_all(few_frames() if frames is None else frames)
    if compiled is fog() and not models and not is_honest(samples.corrected, pipeline.flags):
        raise AssertionError("a sample does not say what it is")


def model(data: bytes) -> None:
    """A model file's text."""
    accepted = parse_model(data.decode("utf-8", "replace"), "fuzz")
    json.dumps(model_document(accepted))  # as it is served
    correct([accepted])


def swap(data: bytes) -> None:
    """A model put to a run's key."""
    from rtcomp.swap import Swapper

    taken: dict[str, list[Model]] = {}
    swapper = Swapper(dict, taken.update, None)
    swapper.take("yaw", data)
    if sum(swapper.counts.values()) != 1 or bool(taken) != bool(swapper.counts["accepted"]):
        raise AssertionError(f"a swap is not counted: {swapper.counts}")
    pipeline = Pipeline(fog(), {"yaw": [make_model()]}, START_NS)
    pipeline.process_all(few_frames())
    pipeline.swap(taken)
    for stack in taken.values():
        json.dumps([model_document(model) for model in stack])  # as the run serves it from then on
    pipeline.process_all(few_frames())


def frames(data: bytes) -> None:
    """Anything a bus may carry, 80 bytes a frame."""
    count = len(data) // FRAME.itemsize
    array = np.frombuffer(data[: count * FRAME.itemsize], FRAME).copy()
    array["length"] %= 65
    correct([], frames=array)
    correct([make_model()], frames=array)


def signal_map(data: bytes) -> None:
    """A signal map, its DBC found or not."""
    with as_file(
        data.replace(b'dbc = "', b'dbc = "' + str(data_folder()).encode() + b"/"), "map.toml"
    ) as path:
        correct([], compile_map(load_map(path)))


def dbc(data: bytes) -> None:
    """A DBC file under the bundled map."""
    with as_file(data, "fuzz.dbc") as path:
        correct([], compile_map(load_map("fog"), path))


def config(data: bytes) -> None:
    """A run's configuration."""
    from rtcomp.config import load_config

    with as_file(data, "run.toml") as path:
        load_config(path)


def candump(data: bytes) -> None:
    """A candump log, packed or not."""
    from rtcomp.sources.candump import read_candump

    with as_file(data, "fuzz.log") as path:
        for array in read_candump(path, 4096):
            if (array["length"] > 64).any():
                raise AssertionError("a frame longer than any")


def asc(data: bytes) -> None:
    """A log that python-can reads."""
    _log_of(data, "asc")


def trc(data: bytes) -> None:
    """A log that python-can reads."""
    _log_of(data, "trc")


def blf(data: bytes) -> None:
    """A binary log that python-can reads."""
    _log_of(data, "blf")


def can_csv(data: bytes) -> None:
    """A log that python-can reads."""
    _log_of(data, "csv")


def _log_of(data: bytes, suffix: str) -> None:
    from rtcomp.sources.logs import read_log

    with as_file(data, f"fuzz.{suffix}") as path:
        for array in read_log(path):
            if (array["length"] > 64).any():
                raise AssertionError("a frame longer than any")


def recording(data: bytes) -> None:
    """A recorded table."""
    from training.table import read_recording

    with as_file(data, "fuzz.csv") as path:
        read_recording(path)


def parquet(data: bytes) -> None:
    """A recorded table in binary."""
    from training.table import read_recording

    with as_file(data, "fuzz.parquet") as path:
        read_recording(path)


def scenario(data: bytes) -> None:
    """A scenario of the gyro simulator."""
    from training.simulator.scenario import load_scenario

    with as_file(data, "fuzz.toml") as path:
        load_scenario(path)


def key(data: bytes) -> None:
    """A key file, taken for either kind."""
    from rtcomp.signing import load_private_key, load_public_keys

    with as_file(data, "fuzz.key") as path:
        with contextlib.suppress(RequestError):
            load_private_key(path)
        load_public_keys([path])


def checkpoint(data: bytes) -> None:
    """A file of thermal states; with its hash mended, so that what is behind it is reached."""
    from rtcomp.checkpoint import decode, restore, seal

    with contextlib.suppress(ValueError):
        document = json.loads(data)
        if isinstance(document, dict):
            data = seal(document)
    pipeline = Pipeline(fog(), {"yaw": [make_model()]}, START_NS)
    restore(decode(data), pipeline, power_on=True)
    pipeline.process_all(few_frames())


DOORS = (
    model, swap, frames, signal_map, dbc, config, candump, asc, trc, blf, can_csv, recording, parquet, scenario, key,
    checkpoint,
)  # fmt: skip
TARGETS: dict[str, Callable[[bytes], None]] = {door.__name__: door for door in DOORS}


def run(name: str, data: bytes) -> bool:
    """Whether the door opened; anything but RequestError is a finding and escapes."""
    try:
        TARGETS[name](data)
    except RequestError:
        return False
    return True
