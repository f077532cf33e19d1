"""Errors that come at a moment or with the firmware: steps, seepage, look-up table, auto-zero."""

import numpy as np

from tools.blind.effect import Effect, Known, Parameters
from tools.blind.materials import pick_up
from tools.blind.scenes import Scene

HOUR = 3600.0
ROADS = ("drive/constant", "drive/cold_start")


def _step_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {
        "at": float(rng.uniform(0.3, 0.7)),
        "settling_s": float(rng.uniform(0.1, 1.5)),
        "sign": float(rng.choice([-1, 1])),
    }


def _switched(s: Scene, p: Parameters) -> np.ndarray:
    late = np.maximum(s.t_s - p["at"] * s.duration_s, 0.0)
    return p["sign"] * (1 - np.exp(-late / p["settling_s"]))


def _bias_step(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] / HOUR * _switched(s, p)


def _scale_step(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + 1e-6 * p["strength"] * _switched(s, p) * s.omega_dps


def _step_truth(name: str, factor: float):
    def truth(s: Scene, p: Parameters) -> dict[str, Known]:
        size = Known(p["strength"] * p["sign"] * factor)
        return {"time_s": Known(p["at"] * s.duration_s, exact=False), name: size}

    return truth


def _seep_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"knee": float(rng.uniform(5, 15)), "sign": float(rng.choice([-1, 1]))}


def _seep(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Moisture creeping in: a relaxation much slower than the recording."""
    tau = p["knee"] * s.duration_s
    return m + p["strength"] * p["sign"] / HOUR * p["knee"] * (1 - np.exp(-s.t_s / tau))


def _seep_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    mean_slope = p["knee"] * (1 - np.exp(-1 / p["knee"])) / s.duration_s
    return {"c_dps_per_s": Known(p["strength"] * p["sign"] / HOUR * mean_slope, exact=False)}


def _lookup_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {
        "spacing_K": float(rng.uniform(6, 14)),
        "origin_K": float(rng.uniform(0, 10)),
        "law": [float(rng.uniform(500, 900)), 1.8, float(rng.uniform(1e-4, 3e-4))],
        "sign": float(rng.choice([-1, 1])),
    }


def _lookup(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A bias law less the firmware's table of it, which holds each entry until the next knot."""
    cell = np.floor((s.temp_degC - p["origin_K"]) / p["spacing_K"]) + 0.5
    entry = p["origin_K"] + p["spacing_K"] * cell
    left = pick_up(s.temp_degC, *p["law"]) - pick_up(entry, *p["law"])
    return m + p["strength"] * p["sign"] / HOUR * left


def _lookup_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"period_K": Known(p["spacing_K"], exact=False)}


def _stops(s: Scene) -> list[tuple[int, int]]:
    road = s.road()
    still = np.interp(s.t_s, road.grid_s, np.asarray(road.standing, float)) > 0.99
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if (b - a) * s.dt_s > 4]


def _auto_zero(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """At the end of every stop the firmware takes a short, badly averaged reading for the new zero."""
    rng = np.random.default_rng(p["seed"])
    zero = np.zeros(len(m))
    for _, end in _stops(s):
        zero[end:] = rng.normal(0, p["strength"] / HOUR)
    return m - zero


def _seed(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"seed": int(rng.integers(1 << 30))}


CHANGES = (
    Effect(
        "bias_step",
        ("time",),
        "electronics",
        ("zero/cycle", "drive/constant", "zero/constant"),
        _step_draw,
        _bias_step,
        transferable=False,
        truth=_step_truth("step_dps", 1 / HOUR),
    ),
    Effect(
        "scale_step",
        ("rate_times_time", "time"),
        "electronics",
        ("table/cycle", "table/constant"),
        _step_draw,
        _scale_step,
        50.0,
        transferable=False,
        truth=_step_truth("step_ppm", 1.0),
    ),
    Effect("bias_drift", ("time",), "electronics", ("zero/cycle",), _seep_draw, _seep, truth=_seep_truth),
    Effect(
        "compensation_table",
        ("temperature",),
        "code",
        ("zero/cycle",),
        _lookup_draw,
        _lookup,
        50.0,
        truth=_lookup_truth,
    ),
    Effect(
        "auto_zero",
        ("time", "speed"),
        "code",
        ROADS,
        _seed,
        _auto_zero,
        transferable=False,
    ),
)
