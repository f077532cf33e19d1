"""From the chosen parts to what is told of them: parameters, waveform, size, and where it is felt."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from training.diagnose.document import Parameter, Regime, Where
from training.diagnose.generic import VALUES, temperature_rate
from training.diagnose.intervals import Estimates
from training.diagnose.naming import Model, Part
from training.diagnose.work import FloatArray, Work

SHAPE_KEYS = {"order", "high", "with_bias", "on_surface", "with_static", "shape", "recording"}
UNITS = {
    "tau_s": "s",
    "play_K": "K",
    "period_K": "K",
    "chirp_per_K": "1/K",
    "lock_dps": "dps",
    "limit_dps": "dps",
    "soft_dps": "dps",
    "phase_K": "K",
    "at_share": "1",
    "tau2_s": "s",
    "coil_tau_s": "s",
    "t0_s": "s",
}
ACTIVE = 0.3


def parameters_of(part_index: int, model: Model, estimate: Estimates) -> dict[str, Parameter]:
    """Named parameters of one part; further points of the same shape get _2, _3 behind the name."""
    found: dict[str, Parameter] = {}
    units = {
        name: unit
        for point in model.parts[part_index].points
        for name, unit in model.parts[part_index].group.linear(point)
    }
    for index, (i, j, name) in enumerate(estimate.names):
        if i == part_index:
            key = name if j == 0 else f"{name}_{j + 1}"
            found[key] = Parameter(
                float(estimate.values[index]), units.get(name, UNITS.get(name, "1")), estimate.interval(index)
            )
    part = model.parts[part_index]
    if part.effect == "thermal_lag" and len(part.points) > 1:
        found = as_one_lag(part_index, estimate, units)
    for point in part.points:
        if "at_share" in point:
            work = model.frame.domains[int(point["recording"])].work
            at = float(work.t[min(int(point["at_share"] * len(work)), len(work) - 1)])
            found["t0_s"] = Parameter(at, "s", (at - 2.0 * work.step_s, at + 2.0 * work.step_s))
        fixed = [
            k for k in point if k not in SHAPE_KEYS and k not in found and k in UNITS and k != "at_share"
        ]
        for key in fixed:
            found[key] = Parameter(float(point[key]), UNITS[key], (float(point[key]), float(point[key])))
    return found


def as_one_lag(part_index: int, estimate: Estimates, units: dict[str, str]) -> dict[str, Parameter]:
    """A coil's poles as what is well known of them: on a slow ramp they are one, c = Σ c_i and τ = Σ c_i τ_i / c."""
    places: dict[str, dict[int, int]] = {}
    for index, (i, j, name) in enumerate(estimate.names):
        if i == part_index:
            places.setdefault(name, {})[j] = index
    found: dict[str, Parameter] = {}
    for name in (n for n in places if n != "tau_s"):
        weights = np.zeros(len(estimate.values))
        weights[list(places[name].values())] = 1.0
        found[name] = Parameter(float(weights @ estimate.values), units[name], estimate.along(weights))
    scale, taus = places["scale_ppm_per_K"], places.get("tau_s", {})
    total = sum(estimate.values[index] for index in scale.values())
    if taus and total != 0.0:
        tau = sum(estimate.values[scale[j]] * estimate.values[taus[j]] for j in taus) / total
        slope = np.zeros(len(estimate.values))
        for j in taus:
            slope[scale[j]] = (estimate.values[taus[j]] - tau) / total
            slope[taus[j]] = estimate.values[scale[j]] / total
        low, high = estimate.along(slope)
        shift = tau - float(slope @ estimate.values)
        found["tau_s"] = Parameter(float(tau), "s", (low + shift, high + shift))
    return found


def waveform(part: Part, beta: FloatArray, work: Work) -> FloatArray:
    """The part's predicted error in one recording [dps], shape `(n,)`."""
    columns = [c for point in part.points for c in part.group.columns(work, point)]
    return np.stack(columns, axis=1) @ beta


def visible_part(wave: FloatArray, work: Work) -> FloatArray:
    """The waveform without what the recording's own offset and scale factor take of it."""
    design = np.stack([np.ones(len(work)), *([work.w] if np.ptp(work.w) > 0 else [])], axis=1)
    return wave - design @ np.linalg.lstsq(design, wave, rcond=None)[0]


def where_of(waves: Sequence[FloatArray], works: Sequence[Work], driver: str) -> Where:
    """Time segments and driver regimes in which the effect exceeds `ACTIVE` of its strongest local level."""
    level = 0.0
    locals_ = []
    for wave, work in zip(waves, works, strict=True):
        width = 1.0 if work.points else max(60.0 / work.step_s, len(work) / 200.0)
        power = ndimage.uniform_filter1d(wave**2, max(1, int(width)), mode="nearest")
        local = np.sqrt(np.maximum(power, 0.0))  # a running sum leaves a little less than nothing
        locals_.append(local)
        level = max(level, float(np.quantile(local, 0.98)))
    segments = [_segments(local > ACTIVE * level, work) for local, work in zip(locals_, works, strict=True)]
    return Where(segments, _regimes(waves, works, driver))


def _segments(active: np.ndarray, work: Work) -> list[tuple[float, float]]:
    gap = max(1, len(active) // 50)
    closed = ndimage.binary_closing(np.pad(active, gap), np.ones(gap, bool))[gap:-gap]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], closed.astype(np.int8), [0]])))
    last = len(active) - 1
    return [
        (float(work.t[a]), float(work.t[min(b - 1, last)]))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def driver_values(driver: str, work: Work) -> FloatArray | None:
    """The driver along one recording, where it has it."""
    if driver in ("heading", "rate_times_heading"):
        return (
            np.rad2deg(np.arctan2(work.extra["sin1"], work.extra["cos1"])) if "cos1" in work.extra else None
        )
    if driver == "temperature_rate":
        return temperature_rate(work)
    if driver in ("time_since_power_on", "time", "rate_times_time"):
        return work.t
    if driver not in VALUES:
        return None
    try:
        return VALUES[driver][0](work)
    except KeyError:
        return None


def _regimes(waves: Sequence[FloatArray], works: Sequence[Work], driver: str) -> list[Regime]:
    pairs = [(driver_values(driver, work), wave) for work, wave in zip(works, waves, strict=True)]
    if any(values is None for values, _ in pairs):
        return []
    values = np.concatenate([v for v, _ in pairs if v is not None])
    power = np.concatenate([wave**2 for _, wave in pairs])
    if np.ptp(values) <= 0.0:
        return []
    edges = np.linspace(values.min(), values.max(), 25)
    place = np.clip(np.digitize(values, edges) - 1, 0, 23)
    count = np.bincount(place, minlength=24)
    level = np.sqrt(np.bincount(place, weights=power, minlength=24) / np.maximum(count, 1))
    active = (level > 0.5 * level[count > 20].max(initial=level.max())) & (count > 0)
    marks = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(np.int8), [0]])))
    return [
        Regime(driver, float(edges[a]), float(edges[b])) for a, b in zip(marks[::2], marks[1::2], strict=True)
    ]
