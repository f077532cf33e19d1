"""The diagnosis on a real chamber recording, proved across branches: `python -m tools.chamber_diagnosis RECORDING`.

A still MEMS gyro goes through one thermal cycle (first cooling, heating, second cooling). Each axis is diagnosed on
the branches that are not tested; what was found goes into extended.json, whose terms run through the whole recording
as they would in a vehicle, and the tested branch is scored about its own mean, beside polynomials in temperature
fitted to the same branches. With `--inject`, known effects are added to the real recording: what the diagnosis
predicts more than without them is held against what was added.
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from rtcomp.compensator import predict
from rtcomp.model import load_model
from training.diagnose.document import Diagnosis
from training.diagnose.run import run_diagnose
from training.diagnose.settings import Settings
from training.dynamic import branches
from training.effects.base import ErrorEffect
from training.effects.catalogue import effect
from training.effects.truth import Truth
from training.table import Recording, read_recording, write_recording

AXES = ("x", "y", "z")
BRANCHES = ("first cooling", "heating", "second cooling")
ORDERS = (1, 3)
SETTINGS = Settings(static=True, power_on_known=False)
INJECTED: Mapping[str, Mapping[str, float]] = {
    "polarization_ripple": {"period_K": 11.0, "cos_dps": 0.06, "sin_dps": 0.03},
    "bias_hysteresis": {"play_K": 6.0, "c_dps_per_K": 0.012},
    "shupe": {"tau_s": 120.0, "c1_dps_s_per_K": 1.2},
}
"""Sizes between the white noise of 9 to 21 m°/s and the drift of some 100 m°/s of that sensor."""


def diagnosed(recording: Recording, rows: np.ndarray) -> tuple[Diagnosis, np.ndarray]:
    """(what the diagnosis says of these rows, what it predicts on all rows [°/s])."""
    edges = np.flatnonzero(np.diff(rows.astype(np.int8))) + 1
    pieces = [p for p in np.split(np.arange(len(rows)), edges) if rows[p[0]]]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = [folder / f"piece{k}.csv" for k in range(len(pieces))]
        for path, piece in zip(paths, pieces, strict=True):
            write_recording(recording.take(piece), path)
        found = run_diagnose(paths, folder / "found", settings=SETTINGS)
        model = load_model(folder / "found/extended.json")
    r = recording
    return found, predict(model, r["rate_dps"], r["temp_degC"], r["t_s"], None, False).error_dps


def scored(recording: Recording, tested: int) -> dict[str, Any]:
    """RMS [°/s] about its own mean of the tested branch: raw, by polynomials, and by what the diagnosis found."""
    branch = branches(recording["temp_degC"])
    seen, held = branch != tested, branch == tested
    found, predicted = diagnosed(recording, seen)
    rate, temp = recording["rate_dps"], recording["temp_degC"]
    left = {"raw": rate, "diagnosis": rate - predicted}
    for order in ORDERS:
        left[f"polynomial {order}"] = rate - np.polyval(np.polyfit(temp[seen], rate[seen], order), temp)
    return {
        "tested": BRANCHES[tested],
        "verdict": found.verdict,
        "findings": [f.alternatives for f in found.findings],
        "rms_dps": {name: float(np.std(values[held])) for name, values in left.items()},
    }


def recovered(recording: Recording, injected: str, without: np.ndarray) -> dict[str, Any]:
    """What an effect added to the whole recording makes the diagnosis say and predict beyond `without` it."""
    n = len(recording)
    truth = Truth(recording["t_s"], np.zeros(n), recording["temp_degC"])
    entry = effect(injected)
    assert isinstance(entry, ErrorEffect)  # noqa: S101 (it is one of INJECTED)
    wave = entry.error(truth, INJECTED[injected])
    columns = {**recording.columns, "rate_dps": recording["rate_dps"] + wave}
    found, predicted = diagnosed(Recording(recording.name, columns), np.ones(n, dtype=bool))
    more = (predicted - without) - np.mean(predicted - without)
    wave = wave - wave.mean()
    return {
        "injected": injected,
        "rms_dps": float(np.std(wave)),
        "findings": [f.alternatives for f in found.findings],
        "in_a_class": any(injected in f.alternatives for f in found.findings),
        "share_predicted": float(np.dot(more, wave) / np.dot(wave, wave)),
        "left_share": float(np.std(more - wave) / np.std(wave)),
    }


def examine(path: Path, axis: str, tests: Sequence[int], inject: bool) -> dict[str, Any]:
    """All that is told of one axis."""
    recording = read_recording(path, {"rate_dps": f"gyro_{axis}_dps", "temp_degC": "temp_C"})
    told: dict[str, Any] = {"across": [scored(recording, tested) for tested in tests]}
    if inject:
        _, without = diagnosed(recording, np.ones(len(recording), dtype=bool))
        told["injections"] = [recovered(recording, name, without) for name in INJECTED]
    return told


def _show(axis: str, told: dict[str, Any]) -> None:
    for row in told["across"]:
        rms = row["rms_dps"]
        names = "; ".join(" | ".join(names) for names in row["findings"]) or "nothing"
        figures = ", ".join(f"{name} {1e3 * value:.1f}" for name, value in rms.items())
        gain = rms["polynomial 3"] / rms["diagnosis"]
        click.echo(f"{axis}, tested on the {row['tested']}: found {names}")
        click.echo(f"   rms about the mean [m°/s]: {figures}; cubic/diagnosis {gain:.2f}")
    for row in told.get("injections", ()):
        verdict = "in a class" if row["in_a_class"] else "NOT FOUND"
        click.echo(
            f"   injected {row['injected']} ({1e3 * row['rms_dps']:.1f} m°/s rms): {verdict}, "
            f"{100 * row['share_predicted']:.0f} % predicted, {100 * row['left_share']:.0f} % left"
        )


@click.command(help=__doc__)
@click.argument("recording", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--axis", type=click.Choice(AXES), multiple=True, help="Only these axes.")
@click.option("--every-branch", is_flag=True, help="Test every branch in turn, not only the second cooling.")
@click.option("--inject", is_flag=True, help="Add known effects to the recording and recover them.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def main(recording: Path, axis: tuple[str, ...], every_branch: bool, inject: bool, as_json: bool) -> None:
    """Print the table of all axes."""
    tests = range(len(BRANCHES)) if every_branch else (2,)
    told = {}
    for name in axis or AXES:
        told[name] = examine(recording, name, tests, inject)
        if not as_json:
            _show(name, told[name])
    if as_json:
        click.echo(json.dumps(told))


if __name__ == "__main__":
    main()
