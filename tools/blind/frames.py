"""Faults of frames, clocks and units, done to the finished recording."""

import numpy as np

from tools.blind.effect import Effect, Parameters
from tools.blind.scenes import Scene

ROADS = ("drive/constant", "drive/cold_start")
COUNTER = 256.0
MICRO_WRAP_S = 2**32 * 1e-6
MILLI_WRAP_S = 2**16 * 1e-3
Columns = dict[str, np.ndarray]


def _seed(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"seed": int(rng.integers(1 << 30)), "strength": 1.0}


def _freeze(columns: Columns, p: Parameters) -> Columns:
    """The sender repeats its last frame for a while, several times: rate, temperature and counter stand still."""
    rng = np.random.default_rng(p["seed"])
    n, dt = len(columns["t_s"]), columns["t_s"][1] - columns["t_s"][0]
    moving = np.flatnonzero(np.abs(columns["rate_dps"]) > 0.5)
    out = {name: values.copy() for name, values in columns.items()}
    fresh = np.ones(n, bool)
    for first in rng.choice(moving, 6, replace=False):
        last = min(n, int(first + rng.uniform(4, 25) / dt))
        fresh[first + 1 : last] = False
        for name in ("rate_dps", "temp_degC"):
            out[name][first:last] = out[name][first]
    out["counter"] = np.mod(np.cumsum(fresh) - 1, COUNTER)
    return out


def _drop(columns: Columns, p: Parameters) -> Columns:
    """Frames are lost singly and in bursts; the counter tells."""
    rng = np.random.default_rng(p["seed"])
    n = len(columns["t_s"])
    keep = rng.random(n) > 0.01
    for first in rng.integers(1, n - 1, 8):
        keep[first : first + int(rng.integers(5, 200))] = False
    keep[0] = True
    return {name: values[keep] for name, values in columns.items()}


def _wrap(columns: Columns, p: Parameters) -> Columns:
    """The time stamp is a counter of 32 bits of µs, or of 16 bits of ms in shorter recordings, and wraps."""
    t = columns["t_s"]
    period = MICRO_WRAP_S if t[-1] > 1.05 * MICRO_WRAP_S else MILLI_WRAP_S
    return columns | {"t_s": np.mod(t, period)}


def _unit_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"strength": float(rng.choice([np.pi / 180, 180 / np.pi, -1.0, 0.5, 2.0]))}


def _unit(columns: Columns, p: Parameters) -> Columns:
    return columns | {"rate_dps": columns["rate_dps"] * p["strength"]}


FAULTS = {"frozen_frames": _freeze, "dropped_frames": _drop, "counter_wrap": _wrap, "unit_error": _unit}
"""What each frames-stage effect does to the columns."""
FRAMES = (
    Effect("frozen_frames", ("time",), "frames", ROADS, _seed, transferable=False),
    Effect("dropped_frames", ("time",), "frames", ROADS, _seed, transferable=False),
    Effect("counter_wrap", ("time",), "frames", ROADS, _seed, transferable=False),
    Effect("unit_error", ("rate",), "frames", ROADS, _unit_draw, transferable=True),
)
