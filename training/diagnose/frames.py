"""Frozen and dropped frames, from the codes, the frame counter and the time stamps."""

import numpy as np
from numpy.typing import NDArray

from training.diagnose.checked import Checked, Fault
from training.diagnose.work import FloatArray

IntArray = NDArray[np.int64]
PAUSE_S = 5.0
LONG_RUN = 1e-9
RARE = 0.02  # repeats rarer than this are not the codes' coarseness


def check_frozen(result: Checked) -> None:
    """Find and mask runs that repeat a value although the motion, the counter or chance speak against it."""
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
    highest, lowest = _over_runs(np.maximum, ref, starts, ends), _over_runs(np.minimum, ref, starts, ends)
    unlikely = (chance < RARE) & (len(rate) * chance ** (lengths - 1.0) < LONG_RUN)
    contradicted = (lengths >= 4) & (highest - lowest > 4.0 * jitter + 2.0 * lsb)
    parked = (rate[starts] == resting) & (np.maximum(np.abs(highest), np.abs(lowest)) < 1.0)
    frozen = ~rails[starts] & ~parked & (unlikely | contradicted) | _counter_stuck(result, starts, ends)
    chosen = list(zip(starts[frozen].tolist(), ends[frozen].tolist(), strict=True))
    if not chosen:
        return
    for start, end in chosen:
        result.valid[start + 1 : end + 1] = False
    count = int(sum(end - start for start, end in chosen))
    result.faults.append(
        Fault(
            "frozen_frames",
            f"{count} samples in {len(chosen)} runs repeat the value before them: masked",
            count,
            [(float(t[a]), float(t[b])) for a, b in chosen],
            {
                "share": (count / len(rate), "1"),
                "longest_s": (float(max(t[b] - t[a] for a, b in chosen)), "s"),
            },
        )
    )


def _resting_code(rate: FloatArray, ref: FloatArray) -> float:
    """The code most often read at low rates: a dead band sticks there, and that is physics and not a frozen frame."""
    slow = rate[np.abs(ref) < 0.5]
    if not len(slow):
        return float("nan")
    values, counts = np.unique(slow, return_counts=True)
    return float(values[np.argmax(counts)])


def _counter_stuck(result: Checked, starts: IntArray, ends: IntArray) -> NDArray[np.bool_]:
    """Where the frame counter stood still as well: then the frame was frozen whatever the rate did."""
    counter = result.columns.get("counter")
    if counter is None:
        return np.zeros(len(starts), dtype=bool)
    highest, lowest = (_over_runs(f, counter, starts, ends) for f in (np.maximum, np.minimum))
    return (ends > starts) & (highest == lowest)


def _over_runs(function: np.ufunc, values: FloatArray, starts: IntArray, ends: IntArray) -> FloatArray:
    """`function` reduced over rows starts..ends, both included, of every run (runs do not overlap)."""
    cuts = np.stack([starts, ends + 1], axis=1).ravel()
    padded = np.append(values, values[-1])  # a run may end with the last row
    return function.reduceat(padded, cuts)[::2]


def check_gaps(result: Checked) -> None:
    """Count missing frames by time stamps and counter; long pauses are remarked, not counted."""
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
        result.faults.append(
            Fault(
                "dropped_frames",
                f"{missing} frames are missing in {int(drops.sum())} places",
                missing,
                [(float(t[i]), float(t[i + 1])) for i in where[:200]],
                {"share": (missing / (len(t) + missing), "1")},
            )
        )
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
