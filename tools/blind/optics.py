"""Errors of coil, light and material: the thermal, hysteretic and optical families."""

import numpy as np

from tools.blind.effect import Effect, Known, Parameters
from tools.blind.materials import fringes, optical_gain, pick_up
from tools.blind.relays import preisach
from tools.blind.scenes import Scene
from tools.blind.thermal import mohr

HOUR = 3600.0
STILL = ("zero/cycle",)
TURNING = ("table/cycle",)


def draw_law(rng: np.random.Generator) -> Parameters:
    """Parameters of a source and modulator, for gain_error and the pick-up bias."""
    return {
        "characteristic_K": float(rng.uniform(90, 300)),
        "depth_rad": float(rng.uniform(1.2, 2.2)),
        "slope_per_K": float(rng.uniform(2e-4, 1.2e-3)),
        "sign": float(rng.choice([-1, 1])),
    }


def _law(rng: np.random.Generator, scene: Scene) -> Parameters:
    return draw_law(rng)


def _law_of(p: Parameters) -> tuple[float, float, float]:
    return p["characteristic_K"], p["depth_rad"], p["slope_per_K"]


def _bias_temperature(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] * p["sign"] / HOUR * pick_up(s.temp_degC, *_law_of(p))


def gain_error(temp_degC: np.ndarray, p: Parameters) -> np.ndarray:
    """Relative change of the optical gain since room temperature, by the law in `p`, shape of temp_degC."""
    return optical_gain(temp_degC, *_law_of(p)) - 1


def _scale_temperature(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] * p["sign"] * gain_error(s.temp_degC, p) * s.omega_dps


def _winding(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {
        "thickness_m": float(rng.uniform(0.005, 0.010)),
        "kappa_m2ps": float(rng.uniform(1.0e-7, 2.0e-7)),
        "hub": float(rng.uniform(0.05, 0.5)),
    }


def _wound(s: Scene, p: Parameters):
    return s.coil(p["thickness_m"], p["kappa_m2ps"], p["hub"])


def _shupe_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    imperfect = {
        "offset_m": float(rng.uniform(0.1, 0.8)),
        "lead_m": float(rng.uniform(0.0, 2.0)),
        "stress": float(rng.uniform(-0.25, 0.25)),
    }
    return _winding(rng, scene) | imperfect


def _shupe(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    face = s.weather().housing_degC
    bias = mohr(_wound(s, p), face, p["offset_m"], p["lead_m"], p["stress"])
    return m + p["strength"] * s.sampled(bias)


def _lag_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return _winding(rng, scene) | draw_law(rng)


def _thermal_lag(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    coil = s.sampled(_wound(s, p).mean_degC)
    behind = (1 + gain_error(coil, p)) / (1 + gain_error(s.temp_degC, p)) - 1
    return m + p["strength"] * p["sign"] * behind * s.omega_dps


def _lag_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    around = np.quantile(s.temp_degC, [0.5]) + np.array([-1.0, 1.0])
    slope = p["strength"] * p["sign"] * float(np.diff(np.log1p(gain_error(around, p)))[0]) / 2
    return {
        "tau_s": Known(_wound(s, p).lag_s, exact=False),
        "scale_ppm_per_K": Known(1e6 * slope, exact=False),
    }


def _relay_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {
        "half_width_K": float(rng.uniform(2.5, 8)),
        "spread": float(rng.uniform(0.1, 0.35)),
        "seed": int(rng.integers(1 << 30)),
        "sign": float(rng.choice([-1, 1])),
    }


def _memory(s: Scene, p: Parameters) -> np.ndarray:
    every = 3
    climate = s.weather()
    drive = climate.housing_degC[::every]
    lag = preisach(drive, p["half_width_K"], p["spread"], p["seed"])
    return p["sign"] * np.interp(s.t_s, climate.grid_s[::every], lag)


def _bias_hysteresis(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] / HOUR * _memory(s, p)


def _scale_hysteresis(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + 1e-6 * p["strength"] * _memory(s, p) * s.omega_dps


def _play_truth(name: str, factor: float):
    def truth(s: Scene, p: Parameters) -> dict[str, Known]:
        size = p["strength"] * p["sign"] * factor
        return {"play_K": Known(p["half_width_K"], exact=False), name: Known(size, exact=False)}

    return truth


def _ripple_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    period = float(rng.uniform(5, 16))
    main = 3e-3 / (1e-3 * period)
    return {
        "lengths_m": [float(main * rng.uniform(0.2, 0.5)), main, float(main * rng.uniform(0.2, 0.6))],
        "chirp_per_K": float(rng.uniform(-0.002, 0.002)),
        "phases": [float(v) for v in rng.uniform(0, 2 * np.pi, 4)],
    }


def _ripple(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    waves = fringes(s.temp_degC, np.array(p["lengths_m"]), p["chirp_per_K"], np.array(p["phases"]))
    return m + p["strength"] / HOUR * waves


def _ripple_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"period_K": Known(3.0 / p["lengths_m"][1], exact=False)}


def _sine(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    k = p["strength"]
    phase = k * np.radians(m)
    seen = (
        np.degrees(np.sin(phase) / k) if p["sign"] > 0 else np.degrees(np.arcsin(np.clip(phase, -1, 1)) / k)
    )
    return m + (seen - m)


def _sine_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    cubic = -p["sign"] * p["strength"] ** 2 / 6 * np.radians(1.0) ** 2
    return {"c3_per_dps2": Known(cubic)}


def _gradient(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + 1e-6 * p["strength"] * p["sign"] * s.sampled(_wound(s, p).gradient_K) * s.omega_dps


def _signed_winding(rng: np.random.Generator, scene: Scene) -> Parameters:
    return _winding(rng, scene) | {"sign": float(rng.choice([-1, 1]))}


def _sign(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"sign": float(rng.choice([-1, 1]))}


def _ageing_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"knee": float(rng.uniform(4, 12)), "sign": float(rng.choice([-1, 1]))}


def _ageing(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    tau = p["knee"] * s.duration_s
    return m + 1e-6 * p["strength"] * p["sign"] * p["knee"] * np.log1p(s.t_s / tau) * s.omega_dps


def _ageing_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    mean_slope = p["knee"] * np.log1p(1 / p["knee"]) / s.duration_s
    return {"c_ppm_per_s": Known(float(p["strength"] * p["sign"] * mean_slope), exact=False)}


def _warm_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    slow = float(rng.uniform(0.06, 0.2) * scene.duration_s)
    return {
        "slow_s": slow,
        "fast_s": slow * float(rng.uniform(0.1, 0.25)),
        "sign": float(rng.choice([-1, 1])),
    }


def _cooling(s: Scene, p: Parameters) -> np.ndarray:
    """How far two heat capacities in a row, heated from power-on, still are from their end (1 at power-on)."""
    a, b = 1 / p["slow_s"], 1 / p["fast_s"]
    return (b * np.exp(-a * s.t_s) - a * np.exp(-b * s.t_s)) / (b - a)


def _bias_warmup(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] * p["sign"] / HOUR * _cooling(s, p)


def _scale_warmup(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + 1e-6 * p["strength"] * p["sign"] * _cooling(s, p) * s.omega_dps


def _warm_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"tau_s": Known(p["slow_s"], exact=False)}


SCALE_DYNAMIC = ("rate_times_temperature_rate", "rate_times_temperature")
OPTICS = (
    Effect("bias_temperature", ("temperature",), "optics", (*STILL, *TURNING), _law, _bias_temperature, 30.0),
    Effect("shupe", ("temperature_rate",), "optics", STILL, _shupe_draw, _shupe, 1.0),
    Effect("thermal_lag", SCALE_DYNAMIC, "optics", TURNING, _lag_draw, _thermal_lag, 0.1, truth=_lag_truth),
    Effect(
        "bias_hysteresis",
        ("temperature", "temperature_rate"),
        "optics",
        STILL,
        _relay_draw,
        _bias_hysteresis,
        truth=_play_truth("c_dps_per_K", 1 / HOUR),
    ),
    Effect(
        "scale_hysteresis",
        SCALE_DYNAMIC,
        "optics",
        TURNING,
        _relay_draw,
        _scale_hysteresis,
        20.0,
        truth=_play_truth("c_ppm_per_K", 1.0),
    ),
    Effect(
        "polarization_ripple", ("temperature",), "optics", STILL, _ripple_draw, _ripple, truth=_ripple_truth
    ),
    Effect(
        "scale_temperature",
        ("rate_times_temperature",),
        "optics",
        (*TURNING, "averages", "averages"),
        _law,
        _scale_temperature,
        0.1,
    ),
    Effect(
        "scale_nonlinearity",
        ("rate",),
        "electronics",
        ("table/constant", "table/cycle", "averages", "averages"),
        _sign,
        _sine,
        0.05,
        linear=False,
        truth=_sine_truth,
        limit=0.3,
    ),
    Effect("scale_temperature_rate", SCALE_DYNAMIC, "optics", TURNING, _signed_winding, _gradient, 30.0),
    Effect(
        "source_ageing",
        ("rate_times_time", "time"),
        "optics",
        ("table/cycle", "drive/constant"),
        _ageing_draw,
        _ageing,
        100.0,
        truth=_ageing_truth,
    ),
    Effect(
        "bias_warmup",
        ("time_since_power_on", "time"),
        "optics",
        STILL,
        _warm_draw,
        _bias_warmup,
        truth=_warm_truth,
    ),
    Effect(
        "scale_warmup",
        ("time_since_power_on", "rate_times_time"),
        "optics",
        TURNING,
        _warm_draw,
        _scale_warmup,
        300.0,
        truth=_warm_truth,
    ),
)
