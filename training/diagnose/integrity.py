"""Before any physics: time stamps, wraps, frozen and dropped frames, sentinels, units.

What is found is repaired or masked, and masked samples never vote.  Each check says what it saw in one sentence and,
where it is a mismatch of its own, under which effect id.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from training.diagnose.work import FloatArray

WRAPS_S = tuple(2.0**k * tick for tick in (1e-6, 1e-3, 1.0, 1e-2, 1e-4, 1e-5) for k in (8, 10, 12, 15, 16, 20, 24, 31, 32))
GAINS = {
    "rad/s taken for °/s": np.pi / 180.0, "°/s taken for rad/s": 180.0 / np.pi, "sign": -1.0, "per 1000": 1e-3,
    "times 1000": 1e3, "°/h taken for °/s": 3600.0, "°/s taken for °/h": 1.0 / 3600.0,
    **{f"2^{k}": 2.0**k for k in (-16, -8, -4, -3, -2, -1, 1, 2, 3, 4, 8, 16)},
    "sign and rad/s": -np.pi / 180.0, "sign and °/s": -180.0 / np.pi, "rpm": 1.0 / 6.0, "from rpm": 6.0,
}
GAIN_TOLERANCE = 0.03
PAUSE_S = 5.0
MIN_ROWS = 40
USABLE = 0.3
LONG_RUN = 1e-9
RARE = 0.02  # repeats rarer than this are not the codes' coarseness


@dataclass
class Fault:
    """One integrity finding: the effect id, what was seen, how many samples, where, and its measured size."""

    effect: str
    text: str
    samples: int
    segments: list[tuple[float, float]] = field(default_factory=list)
    parameters: dict[str, tuple[float, str]] = field(default_factory=dict)


@dataclass
class Checked:
    """A recording after the checks: repaired columns, the mask of samples that may vote, faults and remarks."""

    columns: dict[str, FloatArray]
    valid: NDArray[np.bool_]
    faults: list[Fault] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    unusable: str | None = None


def check(columns: dict[str, FloatArray], static: bool) -> Checked:
    """Run all checks on one recording's columns (each of shape `(n,)`)."""
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in columns.items()}
    result = Checked(columns, np.ones(len(columns["rate_dps"]), dtype=bool))
    if static and "ref_rate_dps" not in columns:
        columns["ref_rate_dps"] = np.zeros(len(result.valid))
    _missing(result)
    if len(result.valid) < (8 if "t_s" not in columns else MIN_ROWS):
        result.unusable = f"only {len(result.valid)} rows: too few to tell physics from noise; record at least minutes"
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
            _frozen(result)
            _gaps(result)
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
    temp = result.columns.get("temp_degC")
    if temp is not None and not np.isfinite(temp).all():
        good = np.isfinite(temp)
        result.remarks.append(f"{int((~good).sum())} temperatures are missing: bridged")
        if good.any():
            index = np.arange(len(temp))
            result.columns["temp_degC"] = np.interp(index, index[good], temp[good])
        else:
            del result.columns["temp_degC"]


def _select(result: Checked, rows: NDArray[np.int64] | NDArray[np.bool_]) -> None:
    result.columns = {name: values[rows] for name, values in result.columns.items()}
    result.valid = result.valid[rows]


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
                result.faults.append(Fault(
                    "counter_wrap", f"the time stamp falls back by {wrap:.9g} s at row {i + 1}: a counter wrapped; unwrapped",
                    1, [(float(t[i]), float(t[i + 1]))], {"wrap_s": (float(wrap), "s")},
                ))
                break
    result.columns["t_s"] = t


def _temperature_unit(result: Checked) -> None:
    temp = result.columns.get("temp_degC")
    if temp is not None and np.median(temp) > 200.0:
        result.columns["temp_degC"] = temp - 273.15
        result.remarks.append("temperatures above 200: taken for kelvin and converted")


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
                f"{int(far.sum())} rates far outside what the motion allows (most often {values[top]:.6g} °/s): masked as sentinel codes"
            )
            result.valid = good & ~far
    temp = result.columns.get("temp_degC")
    if temp is not None:
        odd = (temp < -90.0) | (temp > 180.0)
        if odd.any() and not odd.all():
            index = np.arange(len(temp))
            result.columns["temp_degC"] = np.interp(index, index[~odd], temp[~odd])
            result.remarks.append(f"{int(odd.sum())} temperatures outside −90…180 °C: taken for sentinel codes and bridged")


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
            result.faults.append(Fault(
                "unit_error", f"the rate is {gain:.6g} times the reference: {name}; divided out", int(good.sum()),
                [], {"factor": (float(factor), "1")},
            ))
            return


def _frozen(result: Checked) -> None:
    rate, ref, t = (result.columns[k] for k in ("rate_dps", "ref_rate_dps", "t_s"))
    same = np.concatenate([[False], np.diff(rate) == 0.0]) & result.valid
    if not same.any():
        return
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    starts, ends = edges[::2] - 1, edges[1::2] - 1
    lengths = ends - starts + 1
    chance = min(0.95, max(float(same.mean()), 1.0 / len(rate)))
    rails = np.abs(rate) >= 0.999 * np.max(np.abs(rate[result.valid]))
    resting = _resting_code(rate, ref)
    changes = np.diff(rate - ref)[result.valid[1:] & result.valid[:-1]]
    jitter = max(1.4826 * float(np.median(np.abs(changes))), float(np.quantile(np.abs(changes), 0.9)) / 1.65)
    steps = np.unique(np.abs(np.diff(rate[result.valid])))
    lsb = float(steps[1]) if len(steps) > 1 else 0.0
    chosen = []
    for start, end, length in zip(starts, ends, lengths, strict=True):
        moved = float(np.ptp(ref[start : end + 1]))
        unlikely = chance < RARE and len(rate) * chance ** (length - 1) < LONG_RUN
        contradicted = length >= 4 and moved > 4.0 * jitter + 2.0 * lsb
        parked = rate[start] == resting and np.max(np.abs(ref[start : end + 1])) < 1.0
        if _counter_stuck(result, start, end) or (not rails[start] and not parked and (unlikely or contradicted)):
            chosen.append((start, end))
    if not chosen:
        return
    for start, end in chosen:
        result.valid[start + 1 : end + 1] = False
    count = int(sum(end - start for start, end in chosen))
    result.faults.append(Fault(
        "frozen_frames", f"{count} samples in {len(chosen)} runs repeat the value before them: masked", count,
        [(float(t[a]), float(t[b])) for a, b in chosen],
        {"share": (count / len(rate), "1"), "longest_s": (float(max(t[b] - t[a] for a, b in chosen)), "s")},
    ))


def _resting_code(rate: FloatArray, ref: FloatArray) -> float:
    """The code most often read at low rates: a dead band sticks there, and that is physics and not a frozen frame."""
    slow = rate[np.abs(ref) < 0.5]
    if not len(slow):
        return float("nan")
    values, counts = np.unique(slow, return_counts=True)
    return float(values[np.argmax(counts)])


def _counter_stuck(result: Checked, start: int, end: int) -> bool:
    """Whether the frame counter stood still as well: then the frame was frozen whatever the rate did."""
    counter = result.columns.get("counter")
    return counter is not None and end > start and float(np.ptp(counter[start : end + 1])) == 0.0


def _gaps(result: Checked) -> None:
    t = result.columns["t_s"]
    steps = np.diff(t)
    median = float(np.median(steps))
    long = steps > 1.6 * median
    pauses = steps > max(PAUSE_S, 20.0 * median)
    drops = long & ~pauses
    lost = int(np.sum(np.rint(steps[drops] / median) - 1))
    if pauses.any():
        result.remarks.append(f"{int(pauses.sum())} pauses, the longest {float(steps.max()):.4g} s")
    counted = _counter_losses(result)
    missing = max(lost, counted)
    if missing >= 5 and missing > 2e-4 * len(t):
        where = np.flatnonzero(drops)
        result.faults.append(Fault(
            "dropped_frames", f"{missing} frames are missing in {int(drops.sum())} places", missing,
            [(float(t[i]), float(t[i + 1])) for i in where[:200]], {"share": (missing / (len(t) + missing), "1")},
        ))
    elif missing:
        result.remarks.append(f"{missing} frames are missing")


def _counter_losses(result: Checked) -> int:
    counter = result.columns.get("counter")
    if counter is None or not np.isfinite(counter).all():
        return 0
    top = float(counter.max()) + 1.0
    modulus = 2.0 ** np.ceil(np.log2(top)) if top > 2 else top
    modulus = top if abs(top - modulus) > 0.02 * modulus else modulus
    advance = np.mod(np.diff(counter), modulus) if np.any(np.diff(counter) < 0) else np.diff(counter)
    usual = float(np.median(advance))
    lost = advance[(advance > usual) & (advance < 0.5 * modulus)] / max(usual, 1.0) - 1.0
    return int(np.sum(lost))
