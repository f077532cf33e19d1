"""Before any physics: time stamps, wraps, frozen and dropped frames, sentinels, units.

What is found is repaired or masked, and masked samples never vote.  Each check says what it saw in one sentence and,
where it is a mismatch of its own, under which effect id.
"""

import numpy as np
from numpy.typing import NDArray

from training.diagnose.checked import Checked, Fault
from training.diagnose.frames import check_frozen, check_gaps
from training.diagnose.work import FloatArray

WRAPS_S = tuple(
    2.0**k * tick for tick in (1e-6, 1e-3, 1.0, 1e-2, 1e-4, 1e-5) for k in (8, 10, 12, 15, 16, 20, 24, 31, 32)
)
GAINS = {
    "rad/s taken for °/s": np.pi / 180.0,
    "°/s taken for rad/s": 180.0 / np.pi,
    "sign": -1.0,
    "per 1000": 1e-3,
    "times 1000": 1e3,
    "°/h taken for °/s": 3600.0,
    "°/s taken for °/h": 1.0 / 3600.0,
    **{f"2^{k}": 2.0**k for k in (-16, -8, -4, -3, -2, -1, 1, 2, 3, 4, 8, 16)},
    "sign and rad/s": -np.pi / 180.0,
    "sign and °/s": -180.0 / np.pi,
    "rpm": 1.0 / 6.0,
    "from rpm": 6.0,
}
GAIN_TOLERANCE = 0.03
BRIDGED = (
    "temp_degC",
    "coil_temp_degC",
    "heading_deg",
    "speed_mps",
    "accel_lat_mps2",
    "vibration_rms_mps2",
)
KELVIN_FROM = 200.0  # no gyro's housing is this warm in °C, and every one is in K
SLOW_S = 2.0  # steps of this length for so many days (turning, at rest): not a recording, but one with its time in ms
LONG_DAYS = (2.0, 10.0)
MIN_ROWS = 40
USABLE = 0.3


def check(columns: dict[str, FloatArray], static: bool) -> Checked:
    """Run all checks on one recording's columns (each of shape `(n,)`)."""
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    count = len(columns["rate_dps"])
    result = Checked(columns, np.ones(count, dtype=bool), np.arange(count))
    if static and "ref_rate_dps" not in columns:
        columns["ref_rate_dps"] = np.zeros(len(result.valid))
    _missing(result)
    if len(result.valid) < (8 if "t_s" not in columns else MIN_ROWS):
        result.unusable = (
            f"only {len(result.valid)} rows: too few to tell physics from noise; record at least minutes"
        )
        return result
    if result.valid.mean() < USABLE:
        result.unusable = f"only {100 * result.valid.mean():.0f} % of the samples have values; record again"
        return result
    if "t_s" in columns:
        _clock(result)
    if result.unusable is None:
        _temperature_unit(result)
        _sentinels(result)
        _unit(result)
        if "t_s" in columns:
            check_frozen(result)
            check_gaps(result)
    if result.unusable is None and result.valid.mean() < USABLE:
        result.unusable = f"only {100 * result.valid.mean():.0f} % of the samples are usable; record again"
    return result


def _missing(result: Checked) -> None:
    for name in ("rate_dps", "ref_rate_dps", "sim_rate_dps", "t_s"):
        values = result.columns.get(name)
        if values is None:
            continue
        bad = ~np.isfinite(values)
        if bad.any():
            result.valid &= ~bad
            result.remarks.append(f"{int(bad.sum())} values of {name} are missing or not finite: masked")
    for name in BRIDGED:
        values = result.columns.get(name)
        if values is not None and not np.isfinite(values).all():
            _bridge(result, name, np.isfinite(values))
    if "temp_degC" not in result.columns:
        result.remarks.append("no temperature (temp_degC): no thermal effect can show")


def _bridge(result: Checked, name: str, good: NDArray[np.bool_]) -> None:
    """Fill the gaps of a slow driver from both sides; a driver without any value is none."""
    result.remarks.append(f"{int((~good).sum())} values of {name} are missing: bridged")
    if good.any():
        index = np.arange(len(good))
        result.columns[name] = np.interp(index, index[good], result.columns[name][good])
    else:
        del result.columns[name]


def _select(result: Checked, rows: NDArray[np.int64] | NDArray[np.bool_]) -> None:
    result.columns = {name: values[rows] for name, values in result.columns.items()}
    result.valid, result.rows = result.valid[rows], result.rows[rows]


def _clock(result: Checked) -> None:
    finite = np.isfinite(result.columns["t_s"])
    if not finite.all():
        _select(result, finite)
    _unwrap(result)
    t = result.columns["t_s"]
    steps = np.diff(t)
    backwards, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    if backwards > 0.2 * len(t) or repeated > 0.5 * len(t):
        result.unusable = (
            f"the clock is at fault: {backwards} of {len(t)} time stamps run backwards and {repeated} repeat; "
            "record with monotonic time stamps"
        )
        return
    if backwards:
        order = np.argsort(t, kind="stable")
        _select(result, order)
        result.remarks.append(f"{backwards} time stamps were out of order: sorted")
    steps = np.diff(result.columns["t_s"])
    if (steps <= 0).any():
        _select(result, np.concatenate([[True], steps > 0]))
        result.remarks.append(f"{int((steps <= 0).sum())} repeated time stamps: the first row of each kept")
    steps = np.diff(result.columns["t_s"])
    if len(steps) < MIN_ROWS // 2:
        result.unusable = "fewer than 20 distinct time stamps; record again"
        return
    median = float(np.median(steps))
    days = float(np.ptp(result.columns["t_s"])) / 86400.0
    turning = np.ptp(result.columns["ref_rate_dps"][result.valid]) > 1.0
    if median >= SLOW_S and days > LONG_DAYS[0 if turning else 1]:
        result.unusable = (
            f"t_s rises by {median:.6g} from row to row and spans {days:.4g} days: in ms, µs or ns, not in seconds; "
            "convert it"
        )
        return
    spread = float(np.std(steps[steps < 3.0 * median]) / median)
    if spread > 0.02:
        result.remarks.append(f"intervals between rows vary by {100 * spread:.1f} % (median {median:.6g} s)")


def _unwrap(result: Checked) -> None:
    t = result.columns["t_s"].copy()
    steps = np.diff(t)
    median = float(np.median(steps))
    for i in np.flatnonzero(steps < -10.0 * abs(median) - 1e-9):
        jump = t[i + 1] - t[i] - median
        for wrap in WRAPS_S:
            if abs(jump + wrap) <= max(3.0 * median, 1e-4 * wrap):
                t[i + 1 :] += wrap
                result.faults.append(
                    Fault(
                        "counter_wrap",
                        f"the time stamp falls back by {wrap:.9g} s at row {i + 1}: a counter wrapped; unwrapped",
                        1,
                        [(float(t[i]), float(t[i + 1]))],
                        {"wrap_s": (float(wrap), "s")},
                    )
                )
                break
    result.columns["t_s"] = t


def _temperature_unit(result: Checked) -> None:
    temp = result.columns.get("temp_degC")
    if temp is not None and np.median(temp) > KELVIN_FROM:
        result.columns["temp_degC"] = temp - 273.15
        result.faults.append(
            Fault(
                "unit_error",
                f"temp_degC has a median of {np.median(temp):.4g}: kelvin, not °C; 273.15 taken off",
                len(temp),
                [],
                {"offset_K": (273.15, "K")},
            )
        )
        if "coil_temp_degC" in result.columns and np.median(result.columns["coil_temp_degC"]) > KELVIN_FROM:
            result.columns["coil_temp_degC"] = result.columns["coil_temp_degC"] - 273.15


def _sentinels(result: Checked) -> None:
    rate, ref = result.columns["rate_dps"], result.columns["ref_rate_dps"]
    error = rate - ref
    good = result.valid
    middle = np.median(error[good])
    spread = 1.4826 * np.median(np.abs(error[good] - middle)) + 1e-9
    reach = 1.5 * np.max(np.abs(ref[good])) + 60.0 * spread + 1.0
    ratio = abs(float(np.dot(rate[good], ref[good]) / max(np.dot(ref[good], ref[good]), 1e-9)))
    if ratio < 1.6:
        far = good & (np.abs(rate) > reach)
        if far.any() and far.sum() < 0.2 * len(far):
            values, counts = np.unique(rate[far], return_counts=True)
            top = int(np.argmax(counts))
            result.remarks.append(
                f"{int(far.sum())} sentinel codes or spikes (most often {values[top]:.6g} °/s): masked"
            )
            result.valid = good & ~far
    temp = result.columns.get("temp_degC")
    if temp is not None:
        odd = (temp < -90.0) | (temp > 180.0)
        if odd.any() and not odd.all():
            index = np.arange(len(temp))
            result.columns["temp_degC"] = np.interp(index, index[~odd], temp[~odd])
            result.remarks.append(
                f"{int(odd.sum())} temperatures outside −90…180 °C: taken for sentinel codes and bridged"
            )


def _unit(result: Checked) -> None:
    good = result.valid
    ref, rate = result.columns["ref_rate_dps"][good], result.columns["rate_dps"][good]
    if np.ptp(ref) < 1.0:
        return
    centred = ref - ref.mean()
    gain = float(np.dot(centred, rate - rate.mean()) / np.dot(centred, centred))
    fits = 1.0 - np.var(rate - rate.mean() - gain * centred) / max(np.var(rate), 1e-300)
    for name, factor in GAINS.items():
        if fits > 0.9 and abs(gain / factor - 1.0) < GAIN_TOLERANCE:
            result.columns["rate_dps"] = result.columns["rate_dps"] / factor
            result.faults.append(
                Fault(
                    "unit_error",
                    f"the rate is {gain:.6g} times the reference: {name}; divided out",
                    int(good.sum()),
                    [],
                    {"factor": (float(factor), "1")},
                )
            )
            return
