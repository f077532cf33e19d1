"""The real chamber recording on a CAN bus: `python -m tools.chamber_on_bus RECORDING --json`.

The recording's rate and temperature are sent as FOG frames over a bus (python-can's in-process one, faster than
real time, with the recorded times kept as the frames' times of reception), a model trained on two branches
(first cooling and heating) corrects them, and the third branch (second cooling) is scored: true rate 0. The model's
thermal state runs through the whole recording, as it would in a vehicle; nothing of the third branch trained it.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp import fog_format
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from rtcomp.sources.bus import open_bus, open_can
from rtcomp.sources.transmit import replay
from training.dynamic import branches, fit_dynamic
from training.inputs import check
from training.table import read_recording
from training.ts import TsOptions

START_NS = 1_767_225_600_000_000_000
TRAINED, TESTED = (0, 1), 2
AXES = "xyz"
RULES = 4


def over_a_bus(frames: np.ndarray) -> np.ndarray:
    """The frames after a way over a real (in-process) CAN bus, their times of reception as recorded."""
    received = []
    with open_bus("virtual:chamber") as source, open_can("virtual:chamber") as sender:
        for start in range(0, len(frames), 256):
            replay(frames[start : start + 256], sender, speed=0)
            while sum(map(len, received)) < min(start + 256, len(frames)):
                received.append(source.receive(1.0).copy())
    arrived = np.concatenate(received)
    arrived["t_ns"] = frames["t_ns"]
    return arrived


def axis_scores(path: Path, axis: str) -> dict[str, Any]:
    """RMS [°/s] of one axis on the tested branch, over the bus: raw, corrected, and less two constants.

    One constant is the mean of the trained rows, which a vehicle could have; the other is the tested branch's own mean,
    which nobody knows beforehand: what is left of it is the drift within the branch.
    """
    recording = read_recording(path, {"rate_dps": f"gyro_{axis}_dps", "temp_degC": "temp_C"})
    branch = branches(recording["temp_degC"])
    found = fit_dynamic([check(recording, static=True)], [np.isin(branch, TRAINED)], TsOptions(rules=RULES))
    t_ns = START_NS + np.rint(recording["t_s"] * 1e9).astype(np.int64)
    rate = fog_format.encode_rate(t_ns, recording["rate_dps"])
    temperature = fog_format.encode_temperature(t_ns, recording["temp_degC"], recording["temp_degC"])
    frames = over_a_bus(fog_format.merge(temperature, rate))
    pipeline = Pipeline(compile_map(load_map("fog")), {"yaw": [found.model]}, START_NS)
    samples = pipeline.process_all(frames).corrected
    held = samples[branch == TESTED]
    rms = {name: float(np.sqrt(np.mean(held[name] ** 2))) for name in ("rate_raw_dps", "rate_dps")}
    known = float(np.mean(recording["rate_dps"][np.isin(branch, TRAINED)]))
    return {
        "rms_raw_dps": rms["rate_raw_dps"],
        "rms_known_constant_dps": float(np.sqrt(np.mean((held["rate_raw_dps"] - known) ** 2))),
        "std_raw_dps": float(np.std(held["rate_raw_dps"])),
        "rms_corrected_dps": rms["rate_dps"],
        "samples": len(held),
        "rejected": pipeline.rejected,
        "trained": found.sentence,
    }


def main() -> None:
    """Print the scores of the three axes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args()
    scores = {axis: axis_scores(options.recording, axis) for axis in AXES}
    if options.json:
        print(json.dumps(scores))
        return
    for axis, score in scores.items():
        print(
            "{}: before {rms_raw_dps:.4f} °/s rms, after {rms_corrected_dps:.4f}; less the mean of the trained rows "
            "{rms_known_constant_dps:.4f}, about the branch's own mean {std_raw_dps:.4f}".format(
                axis, **score
            )
        )
        if score["rms_corrected_dps"] > score["std_raw_dps"]:
            print(
                "   the branch lies apart from the trained ones by more than it varies in itself: an offset between"
            )
            print(
                "   thermal cycles, which no model of temperature carries; an offset seen at rest would remove it"
            )
        print(f"   {score['trained']}")


if __name__ == "__main__":
    main()
