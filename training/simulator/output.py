"""A run written down: a table, or a candump log of FOG frames; and what to say about it."""

from pathlib import Path
from typing import Any

import numpy as np

from rtcomp import fog_format
from rtcomp.errors import RequestError
from rtcomp.sources.candump import CandumpWriter
from training.simulator.run import Run
from training.simulator.scenario import Scenario
from training.table import TABLES, write_recording

LOGS = (".log", ".log.gz", ".candump")
START_NS = 1_767_225_600_000_000_000
"""Power-on of every simulated log: 2026-01-01 00:00:00 UTC, so that the same seed gives the same bytes."""

REFERENCE_ID = 0x0A3
"""The reference rate in a log: a frame laid out and protected like FOG_RATE, on its own id."""


def write(run: Run, scenario: Scenario, path: Path) -> int | None:
    """Write a run by its file name's ending; returns the number of frames of a log, None for a table.

    Raises RequestError for another ending, for a rate table asked for as a log, and for values that a frame
    cannot carry.
    """
    if path.name.lower().endswith(TABLES):
        write_recording(run.recording, path)
        return None
    if not path.name.lower().endswith(LOGS):
        raise RequestError(f"cannot write {path}: its name must end in one of {', '.join(TABLES + LOGS)}")
    frames = log_frames(run, scenario)
    with CandumpWriter(path) as writer:
        writer.append(frames)
    return len(frames)


def log_frames(run: Run, scenario: Scenario) -> np.ndarray:
    """Return the run as FOG frames in the order of reception, shape `(n_frames,)` of FRAME.

    Rate frames at the sampling rate, temperature frames every `record.temperature_period_s`, reference frames
    beside the rate frames. A lost frame's counter is missing, a frozen frame repeats its bytes.
    """
    if run.slot.size == 0:
        raise RequestError("a rate table of soaked averages has no frames; write it as .csv or .parquet")
    sent_ns = START_NS + np.rint(run.sent["t_s"] * 1e9).astype(np.int64)
    rate = fog_format.encode_rate(sent_ns, run.sent["rate_dps"])[run.source]
    rate["t_ns"] = sent_ns[run.slot]
    every = max(round(scenario.record.temperature_period_s / run.truth.dt_s), 1)
    coil = run.sent.get("coil_temp_degC")
    temperature = fog_format.encode_temperature(
        sent_ns[::every], run.sent["temp_degC"][::every], None if coil is None else coil[::every]
    )
    due = run.slot % every == 0
    temperature = temperature[run.source[due] // every]
    temperature["t_ns"] = sent_ns[run.slot[due]]
    streams = [temperature, rate]
    if "ref_rate_dps" in run.sent:
        reference = fog_format.encode_rate(sent_ns, run.sent["ref_rate_dps"])
        reference["can_id"] = REFERENCE_ID
        streams.insert(1, reference)
    return fog_format.merge(*streams)


def describe(
    run: Run, scenario: Scenario, seed: int | None, path: Path, frames: int | None
) -> dict[str, Any]:
    """Return what a person or a program wants to know about a written run."""
    recording, gyro = run.recording, scenario.gyro
    error = run.sent["rate_dps"] - run.truth.rate_dps
    temp = recording["temp_degC"]
    return {
        "simulated": True,
        "title": scenario.title,
        "seed": scenario.seed if seed is None else seed,
        "file": str(path),
        "rows": len(recording),
        "frames": frames,
        "seconds": float(recording["t_s"].max() - recording["t_s"].min()) if "t_s" in recording else None,
        "columns": list(recording.columns),
        "effects": [switch.effect for switch in gyro.effects],
        "surface": gyro.surface if isinstance(gyro.surface, str) else gyro.surface.kind,
        "temp_degC": [float(temp.min()), float(temp.max())],
        "rms_error_dps": float(np.sqrt(np.mean(error**2))),
        "max_error_dps": float(np.abs(error).max()),
    }
