"""True rates: a rate table, a vehicle, heading circles, a creep through zero. Smooth enough to be resampled exactly."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import fftconvolve, lfilter

PAD_S = 6.0
GRAVITY = 9.81


@dataclass(frozen=True)
class Motion:
    """True motion over a fine grid that overlaps the recording by PAD_S at both ends.

    rate is a spline [°/s] over time [s]; speed [m/s], accel_lat [m/s²] and roll_rate [°/s] are None off the road.
    """

    grid_s: np.ndarray
    rate: CubicSpline
    speed: np.ndarray | None = None
    accel_lat: np.ndarray | None = None
    roll_rate: np.ndarray | None = None
    standing: np.ndarray | None = None


def _grid(duration_s: float, fs_hz: float) -> np.ndarray:
    return np.arange(-PAD_S, duration_s + PAD_S, 1 / (4 * max(fs_hz, 2.0)))


def _smooth(values: np.ndarray, dt_s: float, window_s: float) -> np.ndarray:
    n = max(3, round(window_s / dt_s) | 1)
    hann = np.hanning(n + 2)[1:-1]
    padded = np.concatenate([np.full(n // 2, values[0]), values, np.full(n // 2, values[-1])])
    return np.asarray(fftconvolve(padded, hann / hann.sum(), mode="valid"))


def _steps(grid: np.ndarray, dwell_s: np.ndarray, levels: np.ndarray) -> np.ndarray:
    index = np.searchsorted(np.cumsum(dwell_s), grid - grid[0], side="right")
    return levels[np.minimum(index, len(levels) - 1)]


def zero(duration_s: float, fs_hz: float, rng: np.random.Generator) -> Motion:
    """At rest."""
    grid = _grid(duration_s, fs_hz)
    return Motion(grid, CubicSpline(grid[:: len(grid) - 1], [0.0, 0.0]))


def table(duration_s: float, fs_hz: float, rng: np.random.Generator, top_dps: float = 180.0) -> Motion:
    """Rate table: dwells at levels of both signs with rests between, slewed smoothly."""
    grid = _grid(duration_s, fs_hz)
    count = int(duration_s / 12) + 10
    levels = rng.choice([0.03, 0.06, 0.12, 0.25, 0.45, 0.65, 0.85, 1.0], count) * top_dps
    levels *= rng.choice([-1.0, 1.0], count)
    levels[rng.random(count) < 0.3] = 0.0
    dwell = rng.uniform(14, 45, count)
    rate = _smooth(_steps(grid, dwell, levels), grid[1] - grid[0], max(1.6, 8 / fs_hz))
    return Motion(grid, CubicSpline(grid, rate))


def low_table(duration_s: float, fs_hz: float, rng: np.random.Generator) -> Motion:
    """Rate table with an hour-scale alternation of long rests and bursts of high rates (for giants and dwarfs)."""
    base = table(duration_s, fs_hz, rng)
    dt = base.grid_s[1] - base.grid_s[0]
    rest = (base.grid_s // 400).astype(int) % 3 != 1
    rate = _smooth(np.where(rest, 0.0, base.rate(base.grid_s)), dt, max(1.6, 8 / fs_hz))
    return Motion(base.grid_s, CubicSpline(base.grid_s, rate))


def circles(duration_s: float, fs_hz: float, rng: np.random.Generator) -> Motion:
    """Full circles at several rates in both directions, rests between."""
    grid = _grid(duration_s, fs_hz)
    levels, dwell, spent = [0.0], [PAD_S + 20.0], 0.0
    while spent < duration_s + PAD_S:
        level = float(rng.choice([3.0, 6.0, 12.0, 30.0]))
        levels += [level * float(rng.choice([-1, 1])), 0.0]
        dwell += [360 / level * int(rng.integers(1, 4)), rng.uniform(8, 30)]
        spent += sum(dwell[-2:])
    rate = _smooth(_steps(grid, np.array(dwell), np.array(levels)), grid[1] - grid[0], max(2.0, 8 / fs_hz))
    return Motion(grid, CubicSpline(grid, rate))


def creep(duration_s: float, fs_hz: float, rng: np.random.Generator) -> Motion:
    """Parking: slow sweeps through zero of changing size, with standstills."""
    grid = _grid(duration_s, fs_hz)
    sweep = sum(
        rng.uniform(0.3, 1.0) * np.sin(2 * np.pi * grid / period + rng.uniform(0, 6.3))
        for period in rng.uniform((15, 40, 90), (30, 80, 200))
    )
    size = np.exp(
        _steps(
            grid, np.full(int(duration_s / 60) + 9, 60.0), rng.uniform(-2.5, 1.2, int(duration_s / 60) + 9)
        )
    )
    size[
        _steps(grid, np.full(int(duration_s / 30) + 9, 30.0), rng.random(int(duration_s / 30) + 9)) < 0.15
    ] = 0.0
    return Motion(grid, CubicSpline(grid, _smooth(sweep * size, grid[1] - grid[0], 6.0)))


def gentle(duration_s: float, fs_hz: float, rng: np.random.Generator) -> Motion:
    """Slow weaving only: no rate content anywhere near a sensor's bandwidth."""
    grid = _grid(duration_s, fs_hz)
    dt = grid[1] - grid[0]
    weave = _relaxed(len(grid), dt, 6.0, rng)
    return Motion(grid, CubicSpline(grid, 12.0 * _smooth(weave, dt, 8.0)))


def _relaxed(n: int, dt_s: float, tau_s: float, rng: np.random.Generator) -> np.ndarray:
    phi = np.exp(-dt_s / tau_s)
    return np.asarray(lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.normal(size=n)))


def _speed(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    knots, values, now = [grid[0]], [0.0], grid[0] + rng.uniform(10, 40)
    while now < grid[-1]:
        cruise = rng.choice([8.0, 14.0, 22.0, 32.0], p=[0.35, 0.3, 0.2, 0.15]) * rng.uniform(0.8, 1.2)
        drive, up = rng.exponential(90) + 25, cruise / rng.uniform(1.0, 2.2)
        knots += [now, now + up, now + up + drive, now + 2 * up + drive]
        values += [0.0, cruise, cruise, 0.0]
        now += 2 * up + drive + (rng.uniform(6, 45) if rng.random() < 0.8 else 0.5)
    return np.interp(grid, knots, values)


def _turns(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    yaw = np.zeros(len(grid))
    dt = grid[1] - grid[0]
    for start in np.cumsum(rng.exponential(22, int((grid[-1] - grid[0]) / 22) + 5)) + grid[0]:
        length = rng.uniform(2.5, 9)
        first, count = int((start - grid[0]) / dt), int(length / dt)
        if first + count >= len(yaw):
            break
        pulse = np.sin(np.pi * np.arange(count) / count) ** 2
        yaw[first : first + count] += rng.choice([-1, 1]) * rng.uniform(15, 100) * pulse * 2 / length
    return yaw


def drive(duration_s: float, fs_hz: float, rng: np.random.Generator) -> Motion:
    """A car: stops, turns, lane keeping; lateral acceleration with banked roads, body roll on its suspension."""
    grid = _grid(duration_s, fs_hz)
    dt = grid[1] - grid[0]
    smooth = max(0.6, 6 / fs_hz)
    speed = _smooth(_speed(grid, rng), dt, 1.5)
    moving = np.clip(speed / 4, 0, 1)
    fast = np.clip(14 / np.maximum(speed, 4), 0.25, 1)
    rate = moving * (_turns(grid, rng) * fast + 0.8 * _relaxed(len(grid), dt, 3.0, rng))
    spline = CubicSpline(grid, _smooth(rate, dt, smooth))
    accel = speed * np.radians(spline(grid)) + 0.25 * moving * _relaxed(len(grid), dt, 40.0, rng)
    return Motion(grid, spline, speed, accel, _roll_rate(accel, dt), speed < 0.02)


def _roll_rate(accel: np.ndarray, dt_s: float) -> np.ndarray:
    """Body roll rate [°/s]: a damped mass on its springs (1.3 Hz, ζ 0.35), 4° per g, stepped exactly enough."""
    from scipy.signal import cont2discrete

    w0, zeta = 2 * np.pi * 1.3, 0.35
    system: Any = cont2discrete(
        ([4 / GRAVITY * w0**2, 0.0], [1, 2 * zeta * w0, w0**2]), dt_s, method="bilinear"
    )
    return np.asarray(lfilter(np.ravel(system[0]), system[1], accel))


MOTIONS = {
    "zero": zero,
    "table": table,
    "low_table": low_table,
    "circles": circles,
    "creep": creep,
    "gentle": gentle,
    "drive": drive,
}
