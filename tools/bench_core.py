"""FRAME → CORRECTED against C and against Python as people write it: `python -m tools.bench_core --json`.

Generated FOG frames in memory (1 kHz rate, 10 Hz temperature), CRC and counter checked, four rules and one lag term.
All are timed in turns in one run; figures are medians over the turns.
"""

import argparse
import ctypes
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cantools
import numpy as np

from rtcomp import fog_format
from rtcomp.compensator import FIRST, Compensator
from rtcomp.frames import CORRECTED
from rtcomp.jit import hot_kernel
from rtcomp.model import Model, Rules, Term, new_model
from rtcomp.pipeline import BATCH, Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import data_folder, load_map
from rtcomp.step import predict_error

FRAMES, PEER_FRAMES, CALLS = 45_000, 300, 500  # short turns: a busy machine then spares some of them
PERIOD_NS = 1_000_000
START_NS = 1_767_225_600_000_000_000
SOURCE = Path(__file__).parent / "c" / "core.c"


def bench_model() -> Model:
    """Four rules and a lag."""
    rules = Rules(
        [[-10.0, -90.0], [-10.0, 90.0], [40.0, -90.0], [40.0, 90.0]],
        [[25.0, 80.0]] * 4,
        [[0.1, 0.01, 0.02], [0.2, -0.02, 0.01], [-0.1, 0.02, 0.03], [0.05, 0.01, -0.02]],
    )
    limits = {"temp_degC": (-40.0, 70.0), "rate_dps": (-200.0, 200.0)}
    lag = Term("thermal_lag", {"tau_s": 280.0, "scale_ppm_per_K": -1263.0})
    return new_model(
        inputs=["temp_degC", "rate_dps"], rules=rules, validity=limits, terms=[lag], residual_std_dps=0.03
    )


def bench_frames(n: int) -> np.ndarray:
    """`n` frames, about; seeded."""
    t_ns = START_NS + np.arange(n) * PERIOD_NS
    rate = np.random.default_rng(0).uniform(-180, 180, n)
    slow = t_ns[::100]
    temp = 20.0 + 20.0 * np.sin(np.arange(len(slow)) / 500.0)
    return fog_format.merge(
        fog_format.encode_temperature(slow, temp, temp), fog_format.encode_rate(t_ns, rate)
    )


class CModel(ctypes.Structure):
    """`struct model` of core.c."""

    _fields_ = (
        ("centers", ctypes.c_double * 8),
        ("inverse_widths", ctypes.c_double * 8),
        ("consequents", ctypes.c_double * 12),
        ("rest", ctypes.c_double * 7),
    )


class CLoop:
    """core.c, built with `cc -O3` and called on the same arrays."""

    def __init__(self, model: Model, folder: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            raise SystemExit("bench_core needs a C compiler called cc: apt-get install gcc")
        library = folder / "core.so"
        subprocess.run([compiler, "-O3", "-shared", "-fPIC", "-o", library, SOURCE, "-lm"], check=True)
        self._c = ctypes.CDLL(str(library))
        self._c.run.restype = ctypes.c_int64
        rules, limits = model.rules, model.validity
        parameters = model.terms[0].parameters
        rest = [*limits["temp_degC"], *limits["rate_dps"], parameters["tau_s"], -1263e-6, 0.03]
        flat = [
            np.ravel(rows).tolist()
            for rows in (rules.centers, 1.0 / np.array(rules.widths), rules.consequents)
        ]
        self._model = CModel(*((ctypes.c_double * len(v))(*v) for v in (*flat, rest)))
        self._state = ctypes.create_string_buffer(1024)
        self._out = np.zeros(BATCH, CORRECTED)

    def start(self) -> None:
        """Forget everything."""
        self._c.prepare(self._state)

    def run(self, frames: np.ndarray, out: np.ndarray | None = None) -> int:
        """Take the frames; returns the number of samples, the last of them in a ring the size of `out`."""
        out = self._out if out is None else out
        arguments = (frames.ctypes.data_as(ctypes.c_void_p), ctypes.c_int64(len(frames)))
        room = (out.ctypes.data_as(ctypes.c_void_p), ctypes.c_int64(len(out)))
        return int(self._c.run(self._state, ctypes.byref(self._model), *arguments, *room))


class Peer:
    """python-can's Message, cantools and numpy: no CRC, no counter, which would only slow it down."""

    def __init__(self, model: Model) -> None:
        self.database: Any = cantools.database.load_file(data_folder() / "fog.dbc")
        rules = model.rules
        self.centers, self.widths, self.consequents = map(
            np.array, (rules.centers, rules.widths, rules.consequents)
        )
        self.lagged = self.temp = 20.0
        self.t_s = START_NS * 1e-9

    def run(self, frames: list[tuple[int, float, bytes]]) -> list[float]:
        """Corrected rates of (id, time, payload)."""
        import can

        corrected = []
        for can_id, t_s, payload in frames:
            message = can.Message(timestamp=t_s, arbitration_id=can_id, data=payload, is_extended_id=False)
            values: Any = self.database.decode_message(
                message.arbitration_id, message.data, decode_choices=False
            )
            if "Rate" in values:
                corrected.append(self._correct(values["Rate"]))
            else:
                self._take(values["HousingTemp"], t_s)
        return corrected

    def _take(self, temp: float, t_s: float) -> None:
        self.lagged += (temp - self.lagged) * (1.0 - np.exp(-(t_s - self.t_s) / 280.0))
        self.temp, self.t_s = temp, t_s

    def _correct(self, rate: float) -> float:
        x = np.array([self.temp, rate])
        firing = np.exp(-0.5 * ((x - self.centers) / self.widths) ** 2).prod(axis=1)
        total = firing @ (self.consequents[:, 0] + self.consequents[:, 1:] @ x) / firing.sum()
        return rate - total - (rate - total) * -1263e-6 * (self.lagged - self.temp)


@hot_kernel
def empty_call(c, s, ch, t_ns, rate):
    """A call with the arguments of `predict_error`."""
    return rate, ch


def check_same_work(c: CLoop, pipeline: Pipeline, frames: np.ndarray) -> None:
    """The two are compared only if they give the same samples in every field.

    Of the frames some are spoilt: a bad checksum, a lost frame, a late one, a sensor fault, a rate out of range.
    """
    spoilt = frames.copy()
    spoilt["data"][100::1000, 5] ^= 1
    spoilt["t_ns"][5000:] += 40_000_000
    spoilt = np.delete(spoilt, [200, 3000, 3001])
    late = fog_format.encode_rate([int(spoilt["t_ns"][-1]) + 3_000_000_000], [450.0], status=3, counter=3)
    spoilt = np.concatenate([spoilt, late])
    ours = pipeline.process_all(spoilt).corrected
    theirs = np.zeros(len(spoilt), CORRECTED)
    c.start()
    theirs = theirs[: c.run(spoilt, theirs)]
    if len(theirs) != len(ours) or not (ours["flags"] == theirs["flags"]).all():
        raise SystemExit("the C loop and ours disagree on the samples or their flags")
    for name in CORRECTED.names or ():
        if not np.allclose(ours[name], theirs[name], rtol=0, atol=1e-9, equal_nan=True):
            raise SystemExit(f"the C loop and ours disagree on {name}")


def seconds(action: Callable[[], Any]) -> float:
    """CPU time of one call: what a shared machine does meanwhile does not count."""
    start = time.thread_time()
    action()
    return time.thread_time() - start


def next_piece(frames: np.ndarray) -> None:
    """Move the frames on in time, so that they follow themselves: `FRAMES` is a multiple of the counters' period."""
    frames["t_ns"] += FRAMES * PERIOD_NS


def measure(turns: int) -> dict[str, float]:
    """Medians over interleaved turns; ours and C go on with one stream, and take turns in being first."""
    model, frames = bench_model(), bench_frames(FRAMES)
    compiled_map = compile_map(load_map("fog"))
    pipeline, other = (Pipeline(compiled_map, {"yaw": [model]}, START_NS) for _ in range(2))
    few = [(int(f["can_id"]), int(f["t_ns"]) * 1e-9, f["data"][:8].tobytes()) for f in frames[:PEER_FRAMES]]
    scalar = Compensator([model], START_NS)
    scalar.temperature(START_NS, 20.0)
    arguments = (scalar.compiled, scalar.state, FIRST, START_NS + 1, 12.5)

    def ours() -> int:
        return sum(len(part.corrected) for part in pipeline.process(frames))

    def many(function: Any) -> None:
        for _ in range(CALLS):
            function(*arguments)

    with tempfile.TemporaryDirectory() as folder:
        c = CLoop(model, Path(folder))
        check_same_work(c, other, frames)
        c.start()
        actions = {
            "ours": ours,
            "c": lambda: c.run(frames),
            "peer": lambda: Peer(model).run(few),
            "scalar": lambda: many(predict_error),
            "empty": lambda: many(empty_call),
        }
        times: dict[str, list[float]] = {name: [] for name in actions}
        for turn in range(-1, turns):
            next_piece(frames)
            for name in sorted(actions, reverse=turn % 2 == 0):
                times[name].append(seconds(actions[name]))
    taken = {name: np.array(values[1:]) for name, values in times.items()}  # the first turn warms up
    median = {name: float(np.median(values)) for name, values in taken.items()}
    return {
        "ns_per_frame": median["ours"] / len(frames) * 1e9,
        "scalar_ns": median["scalar"] / CALLS * 1e9,
        "empty_call_ns": median["empty"] / CALLS * 1e9,
        "times_peer": float(np.median(taken["peer"] / taken["ours"])) * len(frames) / len(few),
        "times_c": float(np.median(taken["ours"] / taken["c"])),
        "c_ns_per_frame": median["c"] / len(frames) * 1e9,
        "peer_ns_per_frame": median["peer"] / len(few) * 1e9,
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--turns", type=int, default=61)
    options = parser.parse_args()
    figures = measure(options.turns)
    if options.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:20s} {value:12.2f}")


if __name__ == "__main__":
    main()
