"""Effects that no catalogue has, each with a known driver. Keep changing them."""

import numpy as np

from tools.blind.climates import STEP_S
from tools.blind.effect import Effect, Parameters
from tools.blind.scenes import Scene
from tools.blind.thermal import ladder

HOUR = 3600.0


def _mode_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    edges = np.cumsum(rng.uniform(4, 12, 12)) - 40.0
    return {"edges_degC": [float(v) for v in edges], "levels": [float(v) for v in rng.uniform(-1, 1, 13)]}


def _mode_hops(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The source jumps between longitudinal modes at temperatures of its own."""
    return m + p["strength"] / HOUR * np.array(p["levels"])[np.searchsorted(p["edges_degC"], s.temp_degC)]


def _line_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    low, high = np.quantile(scene.temp_degC, [0.2, 0.8])
    return {
        "centre_degC": float(rng.uniform(low, high)),
        "width_K": float(rng.uniform(1.2, 3.5)),
        "asymmetry": float(rng.uniform(0.5, 2.0) * rng.choice([-1, 1])),
    }


def _fano(s: Scene, p: Parameters) -> np.ndarray:
    x = (s.temp_degC - p["centre_degC"]) / p["width_K"]
    return (p["asymmetry"] + x) ** 2 / (1 + x**2) - 1


def _spurious_cavity(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A parasitic cavity passes through resonance: a Fano line over temperature."""
    return m + p["strength"] / HOUR * _fano(s, p)


def _gain_cavity(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The same line in the detected power, so in the scale factor."""
    return m + 1e-6 * p["strength"] * _fano(s, p) * s.omega_dps


def _beat_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    size = float(np.std(scene.omega_dps))
    return {"spacing_dps": size * float(rng.uniform(0.25, 0.6)), "phase": float(rng.uniform(0, 6.28))}


def _reset_beat(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Ramp resets beat with the sampling: the error swings with the rate and fades at high rates."""
    x = s.omega_dps / p["spacing_dps"]
    return m + p["strength"] / HOUR * np.cos(2 * np.pi * x + p["phase"]) * np.exp(-np.abs(x) / 4)


def _thermostat_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    period = float(scene.duration_s * rng.uniform(0.06, 0.16))
    return {"period_s": period, "duty": float(rng.uniform(0.3, 0.7)), "phase": float(rng.uniform(0, 1))}


def _thermostat(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A neighbouring heater that switches by its own clock and warms what no sensor watches."""
    grid = s.weather().grid_s
    on = ((grid / p["period_s"] + p["phase"]) % 1 < p["duty"]).astype(float)
    warmed = ladder(on, STEP_S, (0.06 * p["period_s"],))
    return m + p["strength"] / HOUR * s.sampled(warmed)


def _speed_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"speed_mps": float(rng.choice([10.0, 14.0, 20.0])), "width_mps": float(rng.uniform(1.2, 2.2))}


def _wheel_resonance(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A wheel order meets a mode of the bracket at one speed."""
    road = s.road()
    speed = np.interp(s.t_s, road.grid_s, np.zeros(len(road.grid_s)) if road.speed is None else road.speed)
    return m + p["strength"] / HOUR / (1 + ((speed - p["speed_mps"]) / p["width_mps"]) ** 4)


def _poles_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"poles": int(rng.choice([5, 7, 9])), "phase": float(rng.uniform(0, 6.28))}


def _motor_poles(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Stray field of the table's motor: as many periods per turn as it has pole pairs."""
    psi = np.radians(s.heading_deg if s.heading_deg is not None else np.zeros(len(m)))
    return m + p["strength"] / HOUR * np.tanh(2 * np.sin(p["poles"] * psi + p["phase"]))


def _worm_gear(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Pitch error of a worm gear in the axis itself: proportional to the rate, several periods per turn."""
    psi = np.radians(s.heading_deg if s.heading_deg is not None else np.zeros(len(m)))
    return m + 1e-6 * p["strength"] * s.omega_dps * np.sin(p["poles"] * psi + p["phase"])


def _slewing(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The loop slips while it is accelerated, one way whatever the direction."""
    slew = s.road().rate(s.t_s, 1)
    return m + p["strength"] / HOUR * (slew / np.std(slew)) ** 2 / (1 + (slew / np.std(slew)) ** 2)


def _boot_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {
        "at_s": float(scene.duration_s * rng.uniform(0.25, 0.5)),
        "width_s": float(scene.duration_s * 0.04),
    }


def _late_calibration(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Some time after power-on a self-test disturbs the zero for a while."""
    return m + p["strength"] / HOUR / np.cosh((s.t_s - p["at_s"]) / p["width_s"])


def _gap_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"knee_K_per_s": float(rng.uniform(0.3, 0.8)) / 60, "sign": float(rng.choice([-1, 1]))}


def _buckling(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """The spool distorts with any gradient, whichever way: even in the temperature's rate of change."""
    slope = s.sampled(np.gradient(s.weather().housing_degC, STEP_S)) / p["knee_K_per_s"]
    return m + p["strength"] * p["sign"] / HOUR * slope**2 / (1 + slope**2)


STILL = ("zero/cycle",)
ROAD = ("drive/constant",)
FOREIGN = (
    Effect("mode_hops", ("temperature",), "optics", STILL, _mode_draw, _mode_hops),
    Effect("spurious_cavity", ("temperature",), "optics", STILL, _line_draw, _spurious_cavity),
    Effect(
        "gain_cavity", ("rate_times_temperature",), "optics", ("table/cycle",), _line_draw, _gain_cavity, 50.0
    ),
    Effect("reset_beat", ("rate",), "optics", ("creep/constant", *ROAD), _beat_draw, _reset_beat),
    Effect(
        "thermostat",
        ("time",),
        "optics",
        ("zero/constant", "zero/cycle"),
        _thermostat_draw,
        _thermostat,
        transferable=False,
    ),
    Effect("wheel_resonance", ("speed",), "optics", ROAD, _speed_draw, _wheel_resonance),
    Effect("motor_poles", ("heading",), "optics", ("circles/constant",), _poles_draw, _motor_poles),
    Effect(
        "worm_gear",
        ("rate_times_heading",),
        "optics",
        ("circles/constant", "table/constant"),
        _poles_draw,
        _worm_gear,
        50.0,
    ),
    Effect("slewing", ("angular_acceleration",), "optics", ROAD, apply=_slewing),
    Effect(
        "late_calibration", ("time_since_power_on", "time"), "optics", STILL, _boot_draw, _late_calibration
    ),
    Effect("buckling", ("temperature_rate",), "optics", STILL, _gap_draw, _buckling),
)
