"""Temperatures: what surrounds the gyro, and what its housing and its own sensor make of it."""

from dataclasses import dataclass

import numpy as np

from tools.blind.thermal import ladder

STEP_S = 2.0


@dataclass(frozen=True)
class Climate:
    """Surroundings and housing over a grid of STEP_S from power-on, shape (n_grid,), without sensor noise."""

    grid_s: np.ndarray
    air_degC: np.ndarray
    housing_degC: np.ndarray


def _path(grid: np.ndarray, temps: list[float], speeds: list[float], holds: list[float]) -> np.ndarray:
    """Ramps between `temps` at `speeds` [K/s before rescaling] with `holds` [s] after each, fitted to the grid."""
    times = [0.0]
    values = [temps[0]]
    for target, speed, hold in zip(temps[1:], speeds, holds, strict=True):
        times += [times[-1] + abs(target - values[-1]) / speed]
        times += [times[-1] + hold]
        values += [target, target]
    return np.interp(grid, np.array(times) * grid[-1] / times[-1], values)


def cycle(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Chamber cycle: two ramp speeds, both directions, holds, one inner reversal."""
    start, cold, hot = rng.uniform(15, 30), rng.uniform(-30, -5), rng.uniform(45, 68)
    slow, fast = rng.uniform(0.8, 1.3) / 60, rng.uniform(2.4, 3.6) / 60
    middle = rng.uniform(0.4, 0.6) * (hot - cold) + cold
    back = middle + rng.uniform(12, 22)
    temps = [start, cold, hot, middle, back, cold + rng.uniform(2, 10), start]
    order = [fast, slow, fast, fast, slow * 1.5, fast]
    holds = [rng.uniform(300, 700) for _ in order]
    if rng.random() < 0.5:
        temps = [start] + [hot + cold - value for value in temps[1:-1]] + [start]
    return _path(grid, [float(v) for v in temps], order, holds)


def ramp(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One ramp at one speed from a short hold to the end: nothing is ever revisited."""
    low, span = rng.uniform(-20, 5), rng.uniform(35, 60)
    ends = [low, low + span] if rng.random() < 0.5 else [low + span, low]
    return np.interp(grid, [0, 0.06 * grid[-1], 0.97 * grid[-1]], [ends[0], *ends])


def warm_up(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Constant surroundings hotter than the gyro was: a monotone approach from power-on."""
    low, span = rng.uniform(-15, 15), rng.uniform(25, 45)
    return low + span * (1 - np.exp(-grid / (rng.uniform(0.12, 0.3) * grid[-1])))


def cold_start(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Engine bay: warms from the cold, then breathes with stops and speed."""
    low, span = rng.uniform(-20, 10), rng.uniform(35, 55)
    base = low + span * (1 - np.exp(-grid / rng.uniform(500, 1100)))
    events = rng.uniform(-14, 8, int(grid[-1] / 500) + 2)
    return base + np.interp(grid, np.arange(len(events)) * 500.0, np.concatenate([[0.0], events[1:]]))


def constant(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A room: a few tenths of a kelvin."""
    return rng.uniform(15, 40) + 0.3 * np.sin(
        2 * np.pi * grid / rng.uniform(1500, 4000) + rng.uniform(0, 6.3)
    )


def pulse(grid: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A room, and one thermal event in 10–20 % of the recording."""
    start, length = rng.uniform(0.35, 0.6) * grid[-1], rng.uniform(0.08, 0.13) * grid[-1]
    rise = rng.uniform(18, 30) * rng.choice([-1, 1])
    times = np.array([0, 0.3, 0.7, 1.0]) * length + start
    return rng.uniform(20, 30) + np.interp(grid, times, [0, rise, rise, 0])


CLIMATES = {
    "cycle": cycle,
    "ramp": ramp,
    "warm_up": warm_up,
    "cold_start": cold_start,
    "constant": constant,
    "pulse": pulse,
}


def make_climate(kind: str, duration_s: float, rng: np.random.Generator) -> Climate:
    """Surroundings of a kind in CLIMATES, through the walls of the housing, warmed by its own electronics."""
    grid = np.arange(0, duration_s + 2 * STEP_S, STEP_S)
    air = CLIMATES[kind](grid, rng)
    walls = (rng.uniform(70, 110), rng.uniform(50, 90)) if kind != "pulse" else (30.0, 20.0)
    heated = air + (0.0 if kind == "constant" else rng.uniform(1, 4)) * (
        1 - np.exp(-grid / rng.uniform(300, 600))
    )
    return Climate(grid, air, ladder(heated, STEP_S, walls))
