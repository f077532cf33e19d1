"""One simulated experiment: scenario to recording, with the truth kept for tests."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from training.effects.base import Columns, FrameEffect
from training.effects.truth import Truth
from training.simulator.draw import Draw
from training.simulator.environment import sensed, true_course
from training.simulator.gyro import active, gyro_output
from training.simulator.motion import Replay
from training.simulator.on_recording import replayed_course, simulated_rate
from training.simulator.scenario import Scenario, load_scenario
from training.simulator.table_run import table_columns
from training.table import COLUMNS, Recording


@dataclass(frozen=True)
class Run:
    """A simulated recording with what it was made from.

    `sent` are the columns before frames were lost or frozen; `source` says for each recorded row which sent
    row it shows, and `slot` which one it should have been (both empty for rate tables). `truth` is on the
    grid of `sent`.
    """

    recording: Recording
    truth: Truth
    sent: Columns
    source: np.ndarray
    slot: np.ndarray


def simulate(scenario: Scenario, seed: int | None = None, name: str = "simulated") -> Recording:
    """Return the scenario's recording; the same seed (the scenario's if None) gives the same bits."""
    return run(scenario, seed, name).recording


def run(scenario: Scenario, seed: int | None = None, name: str = "simulated") -> Run:
    """Return the scenario's recording together with its truth.

    Raises RequestError for effects that need a driver or a clock which the scenario does not have.
    """
    if seed is not None:
        scenario = msgspec.structs.replace(scenario, seed=seed)
    draw = Draw(scenario.seed)
    if scenario.table is not None:
        truth, columns = table_columns(scenario, draw)
        nothing = np.empty(0, np.int64)
        return Run(Recording(name, columns), truth, columns, nothing, nothing)
    if isinstance(scenario.motion, Replay):
        truth = replayed_course(scenario, scenario.motion)
    else:
        truth = true_course(scenario, draw)
    sent = sent_columns(scenario, truth, draw)
    rows = {"source": np.arange(truth.t_s.size), "slot": np.arange(truth.t_s.size)}
    received = recorded(scenario, sent | rows, draw)
    source, slot = received.pop("source"), received.pop("slot")
    ordered = {column: received[column] for column in COLUMNS if column in received}
    return Run(Recording(name, ordered), truth, sent, source, slot)


def sent_columns(scenario: Scenario, truth: Truth, draw: Draw) -> Columns:
    """Return every column as the sensors send it, before any frame is lost; each of shape `(n,)`."""
    record, sensor, t = scenario.record, scenario.sensor, truth.t_s
    columns: Columns = {
        "t_s": t,
        "rate_dps": gyro_output(scenario.gyro, truth, draw),
        "temp_degC": sensed(t, truth.temp_degC, sensor, draw.of("temperature sensor")),
    }
    if record.reference:
        noise = record.reference_noise_dps * draw.of("reference").standard_normal(t.size)
        columns["ref_rate_dps"] = truth.rate_dps + noise
    if sensor.coil:
        at_coil = msgspec.structs.replace(sensor, lag_s=0.0)
        columns["coil_temp_degC"] = sensed(t, truth.coil_temp_degC, at_coil, draw.of("coil sensor"))
    if record.drivers:
        names = ("heading_deg", "speed_mps", "accel_lat_mps2", "vibration_rms_mps2")
        columns |= {name: getattr(truth, name) for name in names if getattr(truth, name).size}
    if record.counter_modulus:
        columns["counter"] = np.arange(t.size) % float(record.counter_modulus)
    if record.simulation:
        other = load_scenario(record.simulation)
        columns["sim_rate_dps"] = simulated_rate(other, Recording("sent", columns))
    return columns


def recorded(scenario: Scenario, columns: Columns, draw: Draw) -> Columns:
    """Return the columns after frames were frozen, dropped or re-stamped, in that order."""
    chosen = [(entry, values) for entry, values in active(scenario.gyro) if isinstance(entry, FrameEffect)]
    for entry, values in sorted(chosen, key=lambda pair: pair[0].order):
        columns = entry.alter(columns, values, draw.of(entry.id))
    return columns


def simulate_file(name: str | Path, output: Path, seed: int | None = None) -> dict[str, Any]:
    """Simulate a scenario (bundled name or file) into a table or a candump log, and describe it.

    Raises RequestError for a bad scenario or an output whose ending is not known.
    """
    from training.simulator.output import describe, write

    scenario = load_scenario(name)
    done = run(scenario, seed, output.name.split(".")[0])
    frames = write(done, scenario, output)
    return describe(done, scenario, seed, output, frames)
