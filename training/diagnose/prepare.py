"""From a recording to its working view: true rate, residual, blocks, and the columns that regressors share."""

import numpy as np
from numpy.typing import NDArray

from training.diagnose.library import Survey, low_pass
from training.diagnose.work import FloatArray, Work, block_average, smooth

MAX_BLOCKS = 40_000
MIN_STEP_S = 0.05
GRAVITY = 9.80665
STANDING_MPS, STOP_S = 0.1, 4.0
SMOOTHING_S = (
    (0.03, 1.5, 8.0),
    (0.2, 4.0, 25.0),
    (np.inf, 20.0, 40.0),
)  # (grain [K] below which, widths [s])


def prepare(
    name: str,
    columns: dict[str, FloatArray],
    measured: FloatArray,
    simulated: FloatArray,
    true_rate: FloatArray,
    valid: NDArray[np.bool_],
    power_on_known: bool = True,
    max_blocks: int = MAX_BLOCKS,
) -> Work:
    """Build the working view; all arrays have shape `(n,)`, `valid` marks the samples that may vote."""
    if "t_s" not in columns:
        return _points(name, columns, measured - simulated, true_rate, valid)
    t = columns["t_s"]
    step = max(MIN_STEP_S, float(np.median(np.diff(t))), (t[-1] - t[0]) / max_blocks)
    native = float(np.median(np.diff(t)))
    step = native * np.ceil(step / native - 1e-6)
    labels = np.floor((t - t[0]) / step + 0.5 * native / step).astype(np.int64)
    blocks = int(labels[-1]) + 1
    average = block_average(labels, valid, blocks)
    raw = average(measured - simulated)
    keep = np.isfinite(raw)
    grid = t[0] + (np.arange(blocks) + 0.5) * step - 0.5 * native

    def kept(values: FloatArray) -> FloatArray:
        return average(values)[keep]

    temp, slow = _temperature(columns.get("temp_degC"), t, average, step)
    work = Work(
        name=name,
        t=grid[keep],
        y=raw[keep],
        w=kept(true_rate),
        temp=temp[keep],
        slow_temp=slow[keep],
        step_s=step,
        points=False,
        power_on_known=power_on_known,
        average=kept,
        keep=keep,
        full={"w": true_rate, "w_max": np.asarray([float(np.max(np.abs(true_rate)))])},
        spread=np.ones(int(keep.sum())),
    )
    if "coil_temp_degC" in columns:
        work.extra["coil"] = _temperature(columns["coil_temp_degC"], t, average, step)[0][keep]
    _motion(work, columns, true_rate)
    return work


def _temperature(
    temp: FloatArray | None, t: FloatArray, average, step: float
) -> tuple[FloatArray, FloatArray]:
    """Block temperature, gaps bridged: smoothed lightly for its value, more for its slope.

    A wide filter rounds off the corners of a ramp, which a large scale error over temperature would show.
    """
    if temp is None:
        level = np.full(len(average(np.zeros(len(t)))), 25.0)
        return level, level
    mean = average(temp)
    index = np.arange(len(mean))
    good = np.isfinite(mean)
    mean = np.interp(index, index[good], mean[good])
    light, wide = smoothing_s(temp)
    return smooth(mean, step, light), smooth(mean, step, wide)


def smoothing_s(temp: FloatArray) -> tuple[float, float]:
    """Widths [s] of the temperature's smoothing, for its value and for its slope, by its codes' steps and noise."""
    good = temp[np.isfinite(temp)]
    changes = np.abs(np.diff(good))
    lsb = float(np.min(changes[changes > 0.0], initial=np.inf)) if changes.size else 0.0
    grain = max(lsb if np.isfinite(lsb) else 0.0, 2.0 * float(np.median(changes)) if changes.size else 0.0)
    return next((light, wide) for limit, light, wide in SMOOTHING_S if grain < limit)


def _points(
    name: str, columns: dict[str, FloatArray], y: FloatArray, w: FloatArray, valid: NDArray[np.bool_]
) -> Work:
    keep = valid.copy()
    temp = columns.get("temp_degC", np.full(len(y), 25.0))[keep]
    work = Work(
        name=name,
        t=np.arange(int(keep.sum()), dtype=float),
        y=y[keep],
        w=w[keep],
        temp=temp,
        slow_temp=temp,
        step_s=1.0,
        points=True,
        power_on_known=False,
        average=lambda values: values[keep],
        keep=keep,
        full={"w": w, "w_max": np.asarray([float(np.max(np.abs(w)))])},
        spread=np.ones(int(keep.sum())),
    )
    work.clusters = soaks(temp)
    return work


def soaks(temp: FloatArray, tolerance_K: float = 1.0) -> NDArray[np.int64]:
    """Soak number of every point: sorted temperatures split where they jump by more than the tolerance."""
    order = np.argsort(temp, kind="stable")
    labels = np.empty(len(temp), dtype=np.int64)
    labels[order] = np.cumsum(np.diff(temp[order], prepend=temp[order[0]]) > tolerance_K)
    sizes = np.bincount(labels)
    while sizes.min() < 3 and len(sizes) > 1:
        small = int(np.argmin(sizes))
        labels[labels == small] = small - 1 if small else 1
        labels = np.unique(labels, return_inverse=True)[1]
        sizes = np.bincount(labels)
    return labels


def _motion(work: Work, columns: dict[str, FloatArray], w: FloatArray) -> None:
    """Heading harmonics, lateral acceleration, vibration: whatever this recording offers."""
    if np.ptp(w) > 0.0:
        heading = columns.get("heading_deg")
        if heading is None:
            heading = np.concatenate([[0.0], np.cumsum(np.diff(columns["t_s"]) * 0.5 * (w[1:] + w[:-1]))])
        psi = work.full["psi"] = np.deg2rad(heading)
        for k in (1, 2):
            for kind, function in (("cos", np.cos), ("sin", np.sin)):
                wave = function(k * psi)
                work.extra[f"{kind}{k}"], work.extra[f"w{kind}{k}"] = (
                    work.average(wave),
                    work.average(w * wave),
                )
    accel = columns.get("accel_lat_mps2")
    if accel is None and "speed_mps" in columns:
        accel = columns["speed_mps"] * np.deg2rad(w)
    if accel is not None:
        work.extra["accel"], work.extra["accel2"] = (
            work.average(accel / GRAVITY),
            work.average((accel / GRAVITY) ** 2),
        )
        work.extra["roll_rate"] = np.gradient(low_pass(work.extra["accel"], work.step_s, 0.3), work.step_s)
    if "speed_mps" in columns:
        work.extra["speed"] = work.average(columns["speed_mps"])
        work.full["stops"] = _stops(columns["t_s"], columns["speed_mps"])
    if "vibration_rms_mps2" in columns:
        work.extra["vib2"] = work.average(columns["vibration_rms_mps2"] ** 2)


def _stops(t: FloatArray, speed: FloatArray) -> FloatArray:
    """When every standstill of some seconds ended [s]."""
    still = np.nan_to_num(speed, nan=np.inf) < STANDING_MPS
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    ends = [
        min(b, len(t) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if t[b - 1] - t[a] > STOP_S
    ]
    return t[ends]


def _coil_tau(works: list[Work]) -> float:
    """Time constant [s] by which a sensor at the coil follows the reported temperature; 0 without one."""
    if not all("coil" in work.extra for work in works):
        return 0.0
    taus = np.geomspace(5.0, 2000.0, 40)
    misfit = [
        sum(float(np.sum((low_pass(w.temp, w.step_s, tau) - w.extra["coil"]) ** 2)) for w in works)
        for tau in taus
    ]
    return float(taus[int(np.argmin(misfit))])


def survey(works: list[Work]) -> Survey:
    """What all recordings together span."""
    rates = np.abs(np.concatenate([w.full["w"][:: max(1, len(w.full["w"]) // 20_000)] for w in works]))
    temps = np.concatenate([w.temp for w in works])
    has = {"rate"} if rates.max() > 0.5 else set()
    has |= {"temperature"} if np.ptp(temps) > 2.0 else set()
    has |= set() if works[0].points else {"clock"}
    has |= {"surface"} if all(w.elsewhere is not None for w in works) else set()
    has |= {"power_on"} if all(w.power_on_known and not w.points for w in works) else set()
    names = {"cos1": "heading", "accel": "acceleration", "vib2": "vibration", "speed": "speed"}
    has |= {label for key, label in names.items() if all(key in w.extra for w in works)}
    turning = rates[rates > 0.02 * rates.max()] if rates.max() > 0.0 else np.ones(1)
    by_rank = np.quantile(turning, [0.5, 0.7, 0.8, 0.87, 0.92, 0.95, 0.97, 0.985, 0.995])
    knees = np.concatenate(
        [by_rank, rates.max() * np.asarray([0.45, 0.55, 0.62, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95])]
    )
    return Survey(
        duration_s=max(float(w.t[-1] - w.t[0]) for w in works),
        step_s=max(w.step_s for w in works),
        temp_low=float(temps.min()),
        temp_high=float(temps.max()),
        rate_max=float(rates.max()),
        rate_quantiles=tuple(float(k) for k in np.unique(knees)),
        start_s=min(float(w.t[0]) for w in works),
        has=frozenset(has),
        points=works[0].points,
        recordings=len(works),
        rate_noise_dps=max(w.rate_noise_dps for w in works),
        coil_tau_s=_coil_tau(works),
        stops=tuple((float(i), float(end)) for i, w in enumerate(works) for end in w.full.get("stops", ())),
    )
