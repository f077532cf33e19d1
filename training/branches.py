"""Static against dynamic TS across branches and recordings: what was learnt on one thermal history, on another."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rtcomp.compensator import predict
from rtcomp.model import Model
from training.baselines import FILTERS, SURFACES
from training.build import ts_model
from training.dynamic import branches, fit_dynamic
from training.inputs import Checked, check, input_columns, rotating
from training.scores import ratio_interval
from training.simulator.run import simulate
from training.simulator.scenario import Environment, Scenario, load_scenario
from training.table import read_recording
from training.ts import TsOptions, fit

CHAMBER_AXES = ("x", "y", "z")
AMBIENTS = {  # °C over s; two thermal histories to train on, a third to test
    "cold start": [(0.0, -15.0), (300.0, -15.0), (1500.0, 25.0), (3600.0, 25.0)],
    "hot start": [(0.0, 55.0), (600.0, 25.0), (1800.0, 15.0), (2400.0, 35.0), (3600.0, 10.0)],
    "garage and back": [(0.0, 15.0), (600.0, 35.0), (1500.0, -5.0), (2400.0, 30.0), (3600.0, 0.0)],
}
BLOCK_ROWS = 20  # blocks for intervals


def chamber(path: Path, tell: Callable[[str], None]) -> dict[str, Any]:
    """The real chamber recording: trained on the first cooling and the heating, tested on the second cooling.

    RMS [°/s] on the test branch per axis, and what the trainer claims from the training branches alone.
    """
    told = {}
    for axis in CHAMBER_AXES:
        tell(f"chamber, axis {axis}")
        columns = {"rate_dps": f"gyro_{axis}_dps", "temp_degC": "temp_C"}
        item = check(read_recording(path, columns), static=True)
        told[axis] = compare([item], [branches(item.recording["temp_degC"]) < 2])
    return told


def drives(tell: Callable[[str], None], rate_hz: float = 10.0) -> dict[str, Any]:
    """Simulated vehicle drives with a coil behind its sensor: trained on two thermal histories, tested on a third."""
    recordings = []
    for seed, name in enumerate(AMBIENTS, 1):
        tell(f"simulated drive, {name}")
        recordings.append(check(simulate(drive(name, rate_hz), seed, name)))
    masks = [np.full(len(item.recording), k < len(recordings) - 1) for k, item in enumerate(recordings)]
    told = compare(recordings, masks)
    test = recordings[-1]
    filtered = {name: smooth(test.recording["rate_dps"]) - test.true_dps for name, smooth in FILTERS.items()}
    return told | {"filters_rms_dps": {name: _rms(left) for name, left in filtered.items()}}


def drive(ambient: str, rate_hz: float) -> Scenario:
    """The bundled cold-start drive under another ambient temperature; no reference noise, no skew."""
    base = load_scenario("cold_start_drive")
    return msgspec.structs.replace(
        base,
        title=f"Drive, {ambient}",
        rate_hz=rate_hz,
        environment=Environment(ambient_degC=AMBIENTS[ambient]),
        gyro=msgspec.structs.replace(base.gyro, effects=[]),
        record=msgspec.structs.replace(base.record, reference_noise_dps=0.0),
    )


def compare(recordings: Sequence[Checked], masks: Sequence[np.ndarray]) -> dict[str, Any]:
    """Cubic in T, static TS and TS with a lag, trained on the rows of `masks`, tested on all others."""
    options = TsOptions()
    dynamic = fit_dynamic(recordings, masks, options)
    models = {"ts_static": _static(recordings, masks, options), "ts_dynamic": dynamic.model}
    error = np.concatenate([item.error_dps for item in recordings])
    train = np.concatenate(masks)
    left = {"uncompensated": error, "cubic_temperature": error - _cubic(recordings, error, train)}
    left |= {name: error - _predicted(model, recordings) for name, model in models.items()}
    blocks = np.arange((~train).sum()) * BLOCK_ROWS // (~train).sum()
    tested = {name: values[~train] for name, values in left.items()}
    return {
        "rms_dps": {name: _rms(values) for name, values in tested.items()},
        "dynamic_better_than_cubic": _rms(tested["cubic_temperature"]) / _rms(tested["ts_dynamic"]),
        "ci95": ratio_interval(tested["ts_dynamic"], tested["cubic_temperature"], blocks),
        "claimed": dynamic.claimed,
        "sentence": dynamic.sentence,
    }


def _static(recordings: Sequence[Checked], masks: Sequence[np.ndarray], options: TsOptions) -> Model:
    names = ["temp_degC", "rate_dps"] if rotating(recordings) else ["temp_degC"]
    pairs = list(zip(recordings, masks, strict=True))
    inputs = np.concatenate([input_columns(item.recording, names)[mask] for item, mask in pairs])
    error = np.concatenate([item.error_dps[mask] for item, mask in pairs])
    return ts_model(fit(inputs, error, names, options), names, inputs)


def _cubic(recordings: Sequence[Checked], error: np.ndarray, train: np.ndarray) -> np.ndarray:
    temp = np.concatenate([item.recording["temp_degC"] for item in recordings])
    inputs = np.column_stack([temp, np.zeros(len(temp))])
    return SURFACES["cubic_temperature"].fit(inputs[train], error[train])(inputs)


def _predicted(model: Model, recordings: Sequence[Checked]) -> np.ndarray:
    tables = [item.recording for item in recordings]
    return np.concatenate([predict(model, t["rate_dps"], t["temp_degC"], t["t_s"]).error_dps for t in tables])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
