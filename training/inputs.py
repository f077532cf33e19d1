"""From recordings to the arrays a model is trained on: checked, named, with the truth taken off."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtcomp.compiled import FILTER_TAU_S
from rtcomp.errors import RequestError
from rtcomp.jit import kernel
from rtcomp.thermal import low_pass
from training.table import Recording

log = logging.getLogger(__name__)
UNITS = {  # what a column's name ends in → the unit it says
    "dps": "°/s",
    "degC": "°C",
    "s": "s",
    "radps": "rad/s",
    "rad_s": "rad/s",
    "rads": "rad/s",
    "mdps": "m°/s",
    "degph": "°/h",
    "dph": "°/h",
    "degF": "°F",
    "F": "°F",
    "K": "K",
    "C": "°C",
    "ms": "ms",
    "us": "µs",
    "ns": "ns",
}
ROTATING_DPS = 1.0  # standard deviation of the true rate, below which the rate carries the error only
NEEDED = {"rate_dps": "°/s", "ref_rate_dps": "°/s", "temp_degC": "°C", "coil_temp_degC": "°C", "t_s": "s"}
STEMS = {
    "rate_dps": "rate|gyro|omega",
    "ref_rate_dps": "ref_rate|ref",
    "temp_degC": "temp|temperature",
    "t_s": "t|time",
}


@dataclass(frozen=True)
class Checked:
    """A recording fit for training or scoring: finite, in order of time, with its truth [°/s]."""

    recording: Recording
    true_dps: np.ndarray

    @property
    def error_dps(self) -> np.ndarray:
        """Gyro output error y = measured − true [°/s]."""
        return self.recording["rate_dps"] - self.true_dps


def check(recording: Recording, static: bool = False, drop_nan: bool = False) -> Checked:
    """Check a recording; `static` says that the true rate is 0 throughout.

    Raises RequestError for a missing column (or one in another unit), for rows that are not finite unless
    `drop_nan` (then they are left out with a warning), and for time that does not rise.
    """
    needed = ["rate_dps", "temp_degC", *([] if static else ["ref_rate_dps"])]
    for name in needed:
        if name not in recording:
            raise RequestError(_missing(recording, name))
    timed = ["t_s"] if "t_s" in recording else []
    recording = _finite(recording, [*needed, *timed], drop_nan)
    if timed:
        check_time(recording)
    true = np.zeros(len(recording)) if static else recording["ref_rate_dps"]
    return Checked(recording, true)


def rotating(recordings: Sequence[Checked]) -> bool:
    """Whether the true rate moves enough to learn anything from the rate."""
    return float(np.std(np.concatenate([item.true_dps for item in recordings]))) > ROTATING_DPS


def check_time(recording: Recording) -> None:
    """Raises RequestError where `t_s` does not rise."""
    back = np.flatnonzero(np.diff(recording["t_s"]) <= 0)
    if len(back):
        row = int(back[0]) + 1
        before, after = recording["t_s"][row - 1], recording["t_s"][row]
        raise RequestError(
            f"{recording.name}: t_s goes from {before:g} to {after:g} s at row {row} ({len(back)} such steps): "
            "sort the recording by time and remove repeated rows"
        )


def check_units(columns: Mapping[str, str]) -> None:
    """Refuse a renaming {our name: name in the file} whose file name states another unit. Raises RequestError."""
    for ours, theirs in columns.items():
        unit = stated_unit(theirs)
        if ours in NEEDED and unit and unit != NEEDED[ours]:
            raise RequestError(
                f"--columns {ours}={theirs}: {theirs} says {unit}, {ours} is in {NEEDED[ours]}: convert it first"
            )


def stated_unit(name: str) -> str | None:
    """The unit a column's name ends in, None when it says none."""
    for ending in sorted(UNITS, key=len, reverse=True):
        if name.endswith("_" + ending):
            return UNITS[ending]
    return None


def _missing(recording: Recording, name: str) -> str:
    stem = STEMS.get(name, "")
    for other in recording.ignored:
        unit = stated_unit(other)
        if stem and unit and unit != NEEDED[name] and re.match(rf"({stem})(_|$)", other):
            return (
                f"{recording.name}: no column {name}, but {other} in {unit}: the header mixes units; "
                f"convert that column to {NEEDED[name]} and call it {name}"
            )
    hint = (
        "give it with --columns, or --static when the gyro stood still"
        if name == "ref_rate_dps"
        else "see --columns"
    )
    return f"{recording.name}: no column {name}: {hint}"


def _finite(recording: Recording, names: Sequence[str], drop_nan: bool) -> Recording:
    bad = {name: ~np.isfinite(recording[name]) for name in names}
    counts = {name: int(rows.sum()) for name, rows in bad.items() if rows.any()}
    if not counts:
        return recording
    told = ", ".join(f"{name} {count}" for name, count in counts.items())
    if not drop_nan:
        raise RequestError(
            f"{recording.name}: rows that are not finite numbers: {told} of {len(recording)}; "
            "repair them, or give --drop-nan to leave those rows out"
        )
    kept = ~np.any(list(bad.values()), axis=0)
    if not kept.any():
        raise RequestError(
            f"{recording.name}: no row is finite in all of {', '.join(names)}; repair the recording"
        )
    log.warning("%s: %d of %d rows left out, not finite: %s", recording.name, (~kept).sum(), len(kept), told)
    return recording.take(kept)


def input_columns(
    recording: Recording, names: Sequence[str], filters: Mapping[str, float] | None = None
) -> np.ndarray:
    """Inputs of the rules, shape `(n_samples, n_inputs)`, as the compiled step would see them.

    Raises RequestError for an input the recording cannot give.
    """
    taus = FILTER_TAU_S | dict(filters or {})
    return np.column_stack([_input(recording, name, taus) for name in names])


def _input(recording: Recording, name: str, taus: Mapping[str, float]) -> np.ndarray:
    if name in recording:
        return recording[name]
    if name not in ("lag_temp_degC", "temp_rate_degC_per_s", "time_since_power_on_s"):
        raise RequestError(
            f"{recording.name}: no column for input {name}; see --columns, or choose other --inputs"
        )
    if "t_s" not in recording:
        raise RequestError(f"{recording.name}: input {name} needs t_s; soaked points have no history")
    if name == "time_since_power_on_s":
        return recording["t_s"]
    slow = lagged(recording["temp_degC"], recording["t_s"], taus[name])
    return slow if name == "lag_temp_degC" else (recording["temp_degC"] - slow) / taus[name]


def lagged(temp_degC: np.ndarray, t_s: np.ndarray, tau_s: float) -> np.ndarray:
    """LP_τ(T) [°C], settled at first; exact for a temperature linear between samples."""
    return _lagged(np.ascontiguousarray(temp_degC), np.ascontiguousarray(t_s), float(tau_s))


@kernel
def _lagged(temp, t, tau):
    slow = np.empty_like(temp)
    slow[0] = temp[0]
    for i in range(1, len(temp)):
        slow[i] = low_pass(slow[i - 1], temp[i - 1], temp[i], t[i] - t[i - 1], tau)
    return slow
