"""A scenario's gyro on a real recording's own drivers: the simulation that a diagnosis compares with."""

from dataclasses import replace

import numpy as np

from rtcomp.errors import RequestError
from training.effects.truth import Truth
from training.simulator.draw import Draw
from training.simulator.environment import coil_temperature, housing_temperature, turned
from training.simulator.gyro import gyro_output
from training.simulator.motion import Replay
from training.simulator.scenario import Scenario
from training.table import Recording, read_recording

_DRIVERS = ("heading_deg", "speed_mps", "accel_lat_mps2", "vibration_rms_mps2")


def truth_of(recording: Recording, scenario: Scenario, static: bool = False) -> Truth:
    """Return the truth a recording implies: its reference as the rate, its sensors as the temperatures.

    `static` means a true rate of zero where there is no reference. Rows without `t_s` are soaked points. Gaps
    (NaN) are bridged linearly, since a lag never forgets one. The coil is where the recording says, else it
    follows the housing with the scenario's coil lag.

    Raises RequestError without a reference (and not `static`) or without a temperature.
    """
    soaked = "t_s" not in recording
    t = np.arange(len(recording), dtype=np.float64) if soaked else bridged(recording, "t_s")
    if "ref_rate_dps" not in recording and not static:
        raise RequestError(
            f"{recording.name}: no ref_rate_dps to simulate from; add it, or say the unit stood still"
        )
    rate = bridged(recording, "ref_rate_dps") if "ref_rate_dps" in recording else np.zeros_like(t)
    housing = bridged(recording, "temp_degC")
    measured_coil = "coil_temp_degC" in recording and bool(np.isfinite(recording["coil_temp_degC"]).any())
    coil = bridged(recording, "coil_temp_degC") if measured_coil else coil_temperature(t, housing, scenario)
    truth = Truth(t, rate, housing, coil, soaked=soaked)
    return replace(truth, **{name: bridged(recording, name) for name in _DRIVERS if name in recording})


def replayed_course(scenario: Scenario, replay: Replay) -> Truth:
    """Return the truth of a scenario that replays a recording, timed from the recording's first row.

    Raises RequestError for a recording without rising `t_s`, or without the column that is to be the truth.
    """
    source = replay.signal_map or None, replay.channel or None
    recording = read_recording(
        replay.recording,
        replay.columns,
        signal_map=source[0],
        channel=source[1],
        require=("t_s", replay.truth),
    )
    t = recording["t_s"] - recording["t_s"][0]
    if not np.all(np.diff(t) > 0.0):
        raise RequestError(f"{replay.recording}: t_s does not rise from row to row; sort it to replay it")
    columns = recording.columns | {"t_s": t, "ref_rate_dps": bridged(recording, replay.truth)}
    if replay.temperature == "environment":
        columns["temp_degC"] = housing_temperature(t, scenario.environment)
        columns.pop("coil_temp_degC", None)
    truth = truth_of(Recording(recording.name, columns), scenario)
    return truth if truth.heading_deg.size else replace(truth, heading_deg=turned(t, truth.rate_dps))


def bridged(recording: Recording, column: str) -> np.ndarray:
    """Return a column with NaNs bridged linearly over the rows; RequestError if it has no value."""
    values = recording.get(column)
    if values is None or not np.isfinite(values).any():
        raise RequestError(
            f"{recording.name}: no values in column {column}, which the simulation needs; add it"
        )
    good = np.isfinite(values)
    rows = np.arange(values.size)
    return values if good.all() else np.interp(rows, rows[good], values[good])


def simulated_rate(
    scenario: Scenario,
    recording: Recording,
    *,
    static: bool = False,
    noise: bool = False,
    seed: int | None = None,
) -> np.ndarray:
    """Return the scenario's gyro [°/s] on the recording's drivers, one value per row, shape `(n,)`.

    By default without any random part: subtracting a drawn noise would only add to the residual. With `noise`
    it is drawn from `seed` (the scenario's if None), for comparing spectra. Effects on rows (frozen, dropped
    and wrapped frames) are not simulated: the recording's rows are what they are.
    """
    draw = Draw(scenario.seed if seed is None else seed) if noise else None
    return gyro_output(scenario.gyro, truth_of(recording, scenario, static), draw)
