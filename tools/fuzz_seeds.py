"""Good inputs that fuzzing starts from, for every door of `tools.fuzz_targets`."""

import json
from collections.abc import Callable
from functools import cache

from rtcomp import fog_format
from rtcomp.model import model_document
from rtcomp.pipeline import Pipeline
from rtcomp.signal_map import data_folder
from tools.faults.trace import START_NS, make_model
from tools.fuzz_targets import few_frames, fog, folder


@cache
def seeds(name: str) -> tuple[bytes, ...]:
    """Good inputs to start from."""
    return tuple(_SEEDS[name]())


def _models() -> list[bytes]:
    from rtcomp.demo import MODEL
    from rtcomp.terms import TERMS

    terms = [
        {"effect": effect, "parameters": dict.fromkeys(kind.names, 1.5)}
        for effect, kind in TERMS.items()
        if effect != "unknown"
    ]
    shape = {"driver": "rate", "knots": [0.0, 1.0], "values": [1.0, 2.0], "times_rate": True}
    full = model_document(make_model()) | {"terms": [*terms, {"effect": "unknown", "parameters": shape}]}
    del full["sha256"]
    table = {"temp_degC": [0.0, 20.0, 40.0], "rate_dps": [-9.0, 9.0], "std_dps": [[0.1], [0.2]]}
    sine = full | {"base": {"kind": "open_loop_sine", "K0_s": 0.5}, "residual_std_dps": table, "terms": []}
    demo = json.loads(MODEL.read_text())
    del demo["sha256"]
    return [json.dumps(document).encode() for document in (full, sine, demo)]


def _checkpoints() -> list[bytes]:
    from rtcomp.checkpoint import encode, take_snapshot

    pipeline = Pipeline(fog(), {"yaw": [make_model()]}, START_NS)
    pipeline.process_all(few_frames())
    return [encode(take_snapshot(pipeline, int(few_frames()["t_ns"][-1]), None))]


def _log() -> bytes:
    from rtcomp.sources.candump import write_candump

    write_candump(folder() / "seed.log", few_frames())
    return (folder() / "seed.log").read_bytes()


def _log_by_python_can(suffix: str) -> list[bytes]:
    import can

    path = folder() / f"seed.{suffix}"
    with can.Logger(path) as logger:
        for k, length in enumerate((8, 3, 0)):
            logger(can.Message(1767225600.0 + k, 0xA0 + k, data=bytes(range(length)), is_extended_id=k == 1))
    return [path.read_bytes()]


def _parquet() -> list[bytes]:
    import pyarrow as pa
    import pyarrow.parquet

    columns = {"t_s": [0.0, 0.01], "rate_dps": [1.0, 1.5], "temp_degC": [20.0, 20.1]}
    pyarrow.parquet.write_table(pa.table(columns), folder() / "seed.parquet")
    return [(folder() / "seed.parquet").read_bytes()]


def _scenarios() -> list[bytes]:
    from training.simulator.scenario import BUNDLED

    return [path.read_bytes() for path in sorted(BUNDLED.glob("*.toml"))[:4]]


def _keys() -> list[bytes]:
    from rtcomp.signing import new_key

    private = folder() / "seed.key"
    if not private.exists():
        new_key(private)
    return [(folder() / "seed.key.pub").read_bytes()]


def _bundled(pattern: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted(data_folder().glob(pattern))]


ASC = b"""date Sat Sep 30 10:06:13.191 PM 2017
base hex  timestamps absolute
internal events logged
  0.000000 Start of measurement
  0.015991 1  0A0             Rx   d 8 01 02 03 04 05 06 07 08
  0.016991 CANFD   1 Rx  0A2  Msg  1 0 9 12 00 01 02 03 04 05 06 07 08 09 0a 0b 0 0 3000 0 0 0 0 0
  0.020000 1  ErrorFrame
"""
CONFIG = (
    b'bus = "virtual:x"\nmodel = ["yaw=m.json"]\ntrust = ["k.pub"]\nseconds = 3.5\nkeys = {yaw = "a/b"}\n'
)
CSV = b"t_s,rate_dps,temp_degC,ref_rate_dps\n0.0,1.0,20.0,1.1\n0.01,1.5,20.1,1.4\n0.02,-1e3,nan,\n"

_SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "model": _models,
    "swap": _models,
    "frames": lambda: [few_frames()[:20].tobytes(), fog_format.encode_fd([START_NS], [1.0]).tobytes()],
    "signal_map": lambda: _bundled("*.toml"),
    "dbc": lambda: _bundled("fog.dbc"),
    "config": lambda: [CONFIG],
    "candump": lambda: [_log()],
    "asc": lambda: [ASC],
    "trc": lambda: _log_by_python_can("trc"),
    "blf": lambda: _log_by_python_can("blf"),
    "can_csv": lambda: _log_by_python_can("csv"),
    "recording": lambda: [CSV],
    "parquet": _parquet,
    "scenario": _scenarios,
    "key": _keys,
    "checkpoint": _checkpoints,
}
