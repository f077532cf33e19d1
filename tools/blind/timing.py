"""Errors of time: the motion itself is resampled at the moments when it was really measured."""

from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter

from tools.blind.effect import Effect, Known, Parameters
from tools.blind.scenes import Scene

MOVING = ("drive/constant", "drive/cold_start", "table/constant")


def _seen_at(m: np.ndarray, s: Scene, moments_s: np.ndarray) -> np.ndarray:
    return m + s.road().rate(moments_s) - s.omega_dps


def _queue(frames: int, load: float, service_s: float, period_s: float, seed: int) -> np.ndarray:
    """Waiting times [s] of periodic frames in a bus's queue among Poisson traffic (Lindley's recursion)."""
    rng = np.random.default_rng(seed)
    work = rng.poisson(load * min(period_s, 40 * service_s) / service_s, frames) * service_s
    free = min(period_s, 40 * service_s)
    wait = np.cumsum(work - free)
    backlog = wait - np.minimum.accumulate(np.minimum(wait, 0.0))
    return backlog + rng.uniform(0, service_s, frames)


def _skew_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"seed": int(rng.integers(1 << 30)), "load": float(rng.uniform(0.2, 0.5))}


def _skew(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A gateway hands frames on after a fixed age, give or take its queue."""
    wait = _queue(len(m), p["load"], 2.5e-4, s.dt_s, p["seed"])
    return _seen_at(m, s, s.t_s - p["strength"] * (1 + 0.002 * (wait - wait.mean()) / wait.std()))


def _skew_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"delay_s": Known(p["strength"])}


def _crystal_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"sign": float(rng.choice([-1, 1])), "turnover_degC": float(rng.uniform(20, 30))}


def _crystal(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A tuning-fork crystal: off by a constant, and by −0.035 ppm/K² away from its turnover."""
    off = 1e-6 * (
        p["sign"] * p["strength"] - 0.035 * (s.temp_degC - p["turnover_degC"]) ** 2 * p["strength"] / 100
    )
    slipped = np.concatenate([[0.0], np.cumsum(off[:-1] * np.diff(s.t_s))])
    return _seen_at(m, s, s.t_s + np.clip(slipped, -5, 5))


def _crystal_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"clock_ppm": Known(p["strength"], exact=False, magnitude=True)}


def _jitter_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"seed": int(rng.integers(1 << 30))}


def _jitter(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Arbitration lost at random: gamma-distributed waits, their mean already known to the receiver."""
    wait = np.random.default_rng(p["seed"]).standard_gamma(2.0, len(m)) - 2.0
    return _seen_at(m, s, s.t_s - p["strength"] * np.clip(wait / np.sqrt(2), -3, 8))


def _jitter_variance(s: Scene, p: Parameters) -> np.ndarray:
    return (p["strength"] * s.road().rate(s.t_s, 1)) ** 2


def _jitter_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"sigma_s": Known(p["strength"], exact=False)}


def _filter_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"order": int(rng.choice([1, 2]))}


def _filtered(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The sensor's own low pass, run on the finely sampled motion; `strength` is its time constant [s]."""
    road, tau = s.road(), p["strength"]
    analog = ([1.0], [tau, 1.0]) if p["order"] == 1 else ([1.0], [tau**2, np.sqrt(2) * tau, 1.0])
    discrete: Any = cont2discrete(analog, road.grid_s[1] - road.grid_s[0], method="foh")
    fine = road.rate(road.grid_s)
    out = np.asarray(lfilter(np.ravel(discrete[0]), np.ravel(discrete[1]), fine - fine[0])) + fine[0]
    return m + np.interp(s.t_s, road.grid_s, out - fine)


def _filter_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"cutoff_hz": Known(1 / (2 * np.pi * p["strength"]), exact=False)}


TIMING = (
    Effect(
        "timestamp_skew",
        ("angular_acceleration",),
        "motion",
        MOVING,
        _skew_draw,
        _skew,
        0.005,
        linear=False,
        delay_is_point=True,
        truth=_skew_truth,
        limit=0.5,
    ),
    Effect(
        "clock_drift",
        ("angular_acceleration", "time"),
        "motion",
        MOVING,
        _crystal_draw,
        _crystal,
        10.0,
        linear=False,
        delay_is_point=True,
        truth=_crystal_truth,
        limit=400.0,
    ),
    Effect(
        "timing_jitter",
        ("angular_acceleration",),
        "motion",
        MOVING,
        _jitter_draw,
        _jitter,
        0.005,
        linear=False,
        transferable=False,
        variance=_jitter_variance,
        truth=_jitter_truth,
        limit=0.3,
    ),
    Effect(
        "bandwidth",
        ("angular_acceleration",),
        "motion",
        MOVING,
        _filter_draw,
        _filtered,
        0.02,
        linear=False,
        delay_is_point=True,
        truth=_filter_truth,
        limit=1.0,
    ),
)
