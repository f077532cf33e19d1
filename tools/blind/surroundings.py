"""Errors from where the gyro is and how it moves: acceleration, vibration, fields, the Earth, the table."""

import numpy as np
from scipy.signal import lfilter

from tools.blind.effect import Effect, Known, Parameters
from tools.blind.scenes import Scene

HOUR = 3600.0
GRAVITY = 9.81
EARTH_DPH = 15.041
ROADS = ("drive/constant", "drive/cold_start")
CIRCLES = ("circles/constant",)


def _sign(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"sign": float(rng.choice([-1, 1]))}


def _on_road(s: Scene, series: np.ndarray | None) -> np.ndarray:
    if series is None:
        raise ValueError(f"scene {s.kind} has no road; plant this effect in a drive")
    return np.interp(s.t_s, s.road().grid_s, series)


def _tilted_mass(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] * p["sign"] / HOUR * _on_road(s, s.road().accel_lat) / GRAVITY


def _tilted_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"c1_dps_per_g": Known(p["strength"] * p["sign"] / HOUR)}


def _shake_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"seed": int(rng.integers(1 << 30)), "sign": float(rng.choice([-1, 1])), "bandwidth_hz": 40.0}


def _rectified(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Mean product of phase and intensity at the coil's resonance: the power of narrow-band shaking in a sample.

    The power of Gaussian shaking of bandwidth B averaged over dt has 2·B·dt degrees of freedom.
    """
    freedom = max(2 * p["bandwidth_hz"] * s.dt_s, 1.0)
    power = np.random.default_rng(p["seed"]).chisquare(freedom, len(m)) / freedom
    shaking = np.zeros(len(m)) if s.vibration is None else s.vibration
    settled = np.asarray(lfilter([0.5], [1, -0.5], power - 1)) * 0.05 + 1
    return m + p["strength"] * p["sign"] / HOUR * shaking**2 * settled


def _cross_axis(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    tilt = p["strength"] * 1e-3
    return m * np.cos(tilt) + p["sign"] * np.sin(tilt) * _on_road(s, s.road().roll_rate)


def _heading_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"phase_deg": float(rng.uniform(0, 360)), "iron": float(rng.uniform(0.0, 0.04))}


def _heading(s: Scene) -> np.ndarray:
    if s.heading_deg is None:
        raise ValueError(f"scene {s.kind} has no heading; plant this effect where the gyro turns")
    return np.radians(s.heading_deg)


def _faraday(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The horizontal field along the coil's sensitive direction, bent by induced iron (a field vector, turned)."""
    psi, axis = _heading(s), np.radians(p["phase_deg"])
    north, east = np.cos(psi) * (1 + p["iron"]), -np.sin(psi) * (1 - p["iron"])
    return m + p["strength"] / HOUR * (north * np.cos(axis) + east * np.sin(axis))


def _earth_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"latitude_deg": float(rng.uniform(30, 60)), "phase_deg": float(rng.uniform(0, 360))}


def _earth(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The Earth's rotation vector on a sensing axis tilted by `strength` degrees, turned with the heading."""
    tilt, azimuth = np.radians(p["strength"]), _heading(s) + np.radians(p["phase_deg"])
    latitude = np.radians(p["latitude_deg"])
    axis = np.array([np.sin(tilt) * np.cos(azimuth), np.full(len(m), np.cos(tilt))])
    spin = EARTH_DPH / HOUR * np.array([np.cos(latitude), np.sin(latitude)])
    return m + spin @ axis


def _eccentric_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"phase_deg": float(rng.uniform(0, 360))}


def _eccentric(ref: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A grating whose centre is off the axis by `strength` millionths of its radius: exact angle, differentiated."""
    psi = _heading(s) + np.radians(p["phase_deg"])
    off = 1e-6 * p["strength"]
    slope = (1 + off * np.cos(psi)) / (1 + 2 * off * np.cos(psi) + off**2)
    return ref + s.omega_dps * (slope - 1)


def _eccentric_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"eccentricity": Known(1e-6 * p["strength"], magnitude=True)}


SURROUNDINGS = (
    Effect("acceleration", ("acceleration",), "optics", ROADS, _sign, _tilted_mass, 3.0, truth=_tilted_truth),
    Effect("vibration_rectification", ("vibration", "speed"), "optics", ROADS, _shake_draw, _rectified, 3.0),
    Effect(
        "misalignment", ("acceleration", "angular_acceleration"), "motion", ROADS, _sign, _cross_axis, 5.0
    ),
    Effect("magnetic", ("heading",), "optics", CIRCLES, _heading_draw, _faraday, 3.0),
    Effect("earth_rate", ("heading",), "optics", CIRCLES, _earth_draw, _earth, 5.0, linear=False, limit=89.0),
    Effect(
        "table_eccentricity",
        ("rate_times_heading",),
        "reference",
        ("circles/constant", "table/constant"),
        _eccentric_draw,
        _eccentric,
        100.0,
        truth=_eccentric_truth,
    ),
)
