"""What is wrong with a request as a whole, found before any work: truth, columns, kinds, shared rows, one sensor."""

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from rtcomp.errors import RequestError
from training.diagnose.integrity import check
from training.diagnose.settings import Settings
from training.diagnose.work import FloatArray
from training.inputs import check_units
from training.table import Recording

logger = logging.getLogger(__name__)
DRIVERS = ("coil_temp_degC", "heading_deg", "speed_mps", "accel_lat_mps2", "vibration_rms_mps2")
WINDOW, PLACES = 48, 9  # rows compared at a time, and at how many places of a held-out recording
VARIED = 12  # different values among them, below which equal rows can be a coincidence of coarse codes
SHARED = 0.5  # of soaked points without time
SHARED_POWERS = (1, 3, 5, 7, 9)  # of the rate, which all recordings of a sensor share
LEAST_OWN = 0.01  # share of a column that the others must not explain
COMMON_K, COMMON_ROWS = 3.0, 200  # range of temperature and rows that two recordings must have in common
ENOUGH_ROWS = 50_000  # of a recording, to tell its offset and scale factor
TOLERANCES = 2.0  # of one sensor, each within its tolerance, two recordings differ by no more than this


def check_request(
    recordings: Sequence[Recording],
    heldout: Sequence[Recording],
    settings: Settings,
    columns: Mapping[str, str] | None = None,
) -> tuple[list[Recording], list[Recording]]:
    """The recordings with the columns that all of them have; raises RequestError for what cannot be diagnosed."""
    if not recordings:
        raise RequestError("no recording given; name at least one table or CAN log")
    check_units(columns or {})
    everything = [*recordings, *heldout]
    for recording in everything:
        _truth(recording, settings.static)
    _kinds(everything)
    _distinct(everything)
    _names(heldout)
    for held in heldout:
        for recording in recordings:
            _no_shared_rows(held, recording)
    _temperatures(everything)
    everything = _common(everything)
    one_sensor(everything, settings)
    return everything[: len(recordings)], everything[len(recordings) :]


def _truth(recording: Recording, static: bool) -> None:
    if "ref_rate_dps" not in recording and not static:
        raise RequestError(
            f"{recording.name}: no ref_rate_dps to compare with; record a reference, rename a column with "
            "--columns ref_rate_dps=NAME, or say --static if the unit did not turn"
        )


def _kinds(recordings: Sequence[Recording]) -> None:
    timed = ["t_s" in r for r in recordings]
    if any(timed) and not all(timed):
        raise RequestError(
            f"{recordings[timed.index(False)].name} has no t_s and {recordings[timed.index(True)].name} has; "
            "diagnose soaked points and time series apart"
        )


def _distinct(recordings: Sequence[Recording]) -> None:
    hashes = [r.sha256 for r in recordings if r.sha256]
    if len(set(hashes)) < len(hashes):
        raise RequestError(
            "the same recording was given twice (as fit and held out, or twice); give each file once"
        )


def _names(heldout: Sequence[Recording]) -> None:
    names = [r.name for r in heldout]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise RequestError(
            f"two held-out recordings are called {twice[0]}, as the table of their correction would be; rename one"
        )


def _no_shared_rows(held: Recording, recording: Recording) -> None:
    """A held-out recording must not be a piece of one that is fitted, whatever its clock says."""
    a, b = held["rate_dps"], recording["rate_dps"]
    shared = _shared_windows(a, b) if "t_s" in held else _shared_points(held, recording)
    if shared:
        raise RequestError(
            f"held-out {held.name} shares rows with {recording.name} ({shared}); a proof needs rows that had no "
            "part in the fit: hold out another recording, or cut them apart"
        )


def _shared_windows(a: FloatArray, b: FloatArray) -> str:
    """How many windows of `a`, as said to a person, stand row for row in `b`; empty without any."""
    length = min(WINDOW, len(a), len(b))
    starts = np.unique(np.linspace(0, len(a) - length, PLACES).astype(int))
    tried = hit = 0
    for start in starts:
        window = a[start : start + length]
        if not np.isfinite(window).all() or len(np.unique(window)) < min(VARIED, length):
            continue
        tried += 1
        begins = np.flatnonzero(b[: len(b) - length + 1] == window[0])
        hit += any(np.array_equal(b[k : k + length], window) for k in begins)
    return f"{hit} of {tried} stretches of {length} equal rows" if hit else ""


def _shared_points(held: Recording, recording: Recording) -> str:
    """The same for points in any order, by all their values."""
    names = [n for n in ("rate_dps", "temp_degC", "ref_rate_dps") if n in held and n in recording]
    known = {tuple(row) for row in np.stack([recording[n] for n in names], axis=1)}
    equal = sum(tuple(row) in known for row in np.stack([held[n] for n in names], axis=1))
    return f"{equal} of {len(held)} points" if equal > SHARED * len(held) else ""


def _temperatures(recordings: Sequence[Recording]) -> None:
    have = ["temp_degC" in r for r in recordings]
    if any(have) and not all(have):
        raise RequestError(
            f"{recordings[have.index(False)].name} has no temp_degC and {recordings[have.index(True)].name} has; "
            "rename its column with --columns temp_degC=NAME, or diagnose it on its own"
        )


def _common(recordings: Sequence[Recording]) -> list[Recording]:
    """Leave out the drivers that not every recording has: an effect of theirs could not be carried over."""
    spare = [n for n in DRIVERS if any(n in r for r in recordings) and not all(n in r for r in recordings)]
    if not spare:
        return list(recordings)
    logger.warning("not used, since not every recording has it: %s", ", ".join(spare))
    return [
        Recording(r.name, {k: v for k, v in r.columns.items() if k not in spare}, r.path, r.sha256, r.ignored)
        for r in recordings
    ]


def one_sensor(recordings: Sequence[Recording], settings: Settings) -> None:
    """Refuse recordings whose offsets or scale factors, at the temperatures they share, no one sensor has."""
    parts = [_rows(r, settings.static) for r in recordings] if len(recordings) > 1 else []
    for i, first in enumerate(parts):
        for k in range(i + 1, len(parts)):
            second = parts[k]
            if first is None or second is None:
                continue
            found = differences(first, second)
            if found is None:
                continue
            offset, scale = found
            if (
                abs(offset) > TOLERANCES * settings.offset_tol_dps
                or abs(scale) > TOLERANCES * settings.scale_tol_ppm
            ):
                raise RequestError(
                    f"{recordings[i].name} and {recordings[k].name} look like recordings of different sensors: at "
                    f"the same temperatures their offsets differ by {abs(offset):.3g} °/s and their scale factors by "
                    f"{1e-4 * abs(scale):.3g} %; diagnose each sensor on its own, or allow the difference with "
                    "--offset-tol and --scale-tol"
                )


def _rows(recording: Recording, static: bool) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """(error, true rate, temperature) of the sound rows; None for a recording that is of no use anyway."""
    thinned = recording.take(np.arange(0, len(recording), 1 + len(recording) // ENOUGH_ROWS))
    checked = check(dict(thinned.columns), static)
    if checked.unusable:
        return None
    c, valid = checked.columns, checked.valid
    temp = c.get("temp_degC", np.full(len(valid), 25.0))
    simulated = c.get("sim_rate_dps", c["ref_rate_dps"])
    return (c["rate_dps"] - simulated)[valid], c["ref_rate_dps"][valid], temp[valid]


def differences(
    first: tuple[FloatArray, FloatArray, FloatArray], second: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[float, float] | None:
    """(offset [°/s], scale [ppm]) of the second less the first over their common temperatures and rates.

    Beside functions of both that the two share: a bent one is another line where the rates are others.  A scale factor
    of which those functions leave nothing of its own (one turned this way only, the other that) is not compared.
    """
    low, high = max(first[2].min(), second[2].min()), min(first[2].max(), second[2].max())
    if high < low:
        return None
    middle = 0.5 * (low + high)
    low, high = max(low, middle - COMMON_K), min(high, middle + COMMON_K)
    top = min(float(np.max(np.abs(rate))) for _, rate, _ in (first, second))
    parts = []
    for error, rate, temp in (first, second):
        rows = (temp >= low) & (temp <= high) & (np.abs(rate) <= top)
        if rows.sum() < COMMON_ROWS:
            return None
        parts.append((error[rows], rate[rows], (temp[rows] - middle) / COMMON_K))
    if any(np.ptp(rate) < 1.0 for _, rate, _ in parts):
        return float(np.median(parts[1][0]) - np.median(parts[0][0])), 0.0
    error, x, h = (np.concatenate([part[i] for part in parts]) for i in range(3))
    x, mine = x / top, np.repeat([0.0, 1.0], [len(part[0]) for part in parts])
    shared = [np.ones(len(x)), np.abs(x), *(x**n for n in SHARED_POWERS), h, h * x, h * x**3]
    others, column = np.stack([mine, *shared], axis=1), mine * x
    own = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
    if own @ own < LEAST_OWN * (column @ column):
        return float(np.linalg.lstsq(others, error, rcond=None)[0][0]), 0.0
    solution = np.linalg.lstsq(np.column_stack([others, column]), error, rcond=None)[0]
    return float(solution[0]), float(1e6 * solution[-1] / top)
