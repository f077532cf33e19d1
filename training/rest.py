"""Allan deviation of the output at rest (allantools): what a filter or a model does to noise and bias stability."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from training.inputs import Checked

STILL_DPS = 0.05  # true rate below which the gyro is at rest
SHORTEST = 64  # samples of rest that are worth an Allan deviation


def allan(recordings: Sequence[Checked], left: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Overlapping Allan deviation [°/s] over the longest rest of each recording, per method.

    Recordings without `t_s` or without rest have no entry. Bias instability is the smallest deviation / 0.664.
    """
    entries, first = [], 0
    for item in recordings:
        count = len(item.recording)
        rest = longest_rest(item)
        if rest is not None:
            start, stop = rest
            interval = float(np.median(np.diff(item.recording["t_s"][start:stop])))
            curves = {
                name: _curve(values[first + start : first + stop], interval) for name, values in left.items()
            }
            entries.append(
                {"recording": item.recording.name, "seconds": (stop - start) * interval, "methods": curves}
            )
        first += count
    return entries


def longest_rest(item: Checked) -> tuple[int, int] | None:
    """First row and row after the last of the longest rest; None where there is none long enough."""
    if "t_s" not in item.recording:
        return None
    still = np.concatenate([[False], np.abs(item.true_dps) < STILL_DPS, [False]])
    edges = np.flatnonzero(np.diff(still.astype(np.int8)))
    if not len(edges):
        return None
    starts, stops = edges[::2], edges[1::2]
    longest = int(np.argmax(stops - starts))
    start, stop = int(starts[longest]), int(stops[longest])
    return (start, stop) if stop - start >= SHORTEST else None


def _curve(error_dps: np.ndarray, interval_s: float) -> dict[str, Any]:
    import allantools

    taus, deviations, _, _ = allantools.oadev(error_dps, rate=1 / interval_s, data_type="freq", taus="octave")
    return {
        "tau_s": [float(tau) for tau in taus],
        "adev_dps": [float(value) for value in deviations],
        "bias_instability_dps": float(np.min(deviations) / 0.664),
    }
