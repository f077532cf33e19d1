"""Errors of loop, converter, firmware and supply, and sudden changes."""

import numpy as np

from tools.blind.effect import Effect, Known, Parameters
from tools.blind.materials import pick_up
from tools.blind.scenes import Scene

HOUR = 3600.0


def _sign(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"sign": float(rng.choice([-1, 1]))}


def _asymmetry(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    half = 0.5e-6 * p["strength"] * p["sign"]
    up, down = 1 + half, 1 - half
    share = 1 / (1 + np.exp(-np.clip(m / 0.05, -60, 60)))
    return m * (up * share + down * (1 - share)) + half * np.abs(m)


def _asymmetry_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"c_ppm": Known(p["strength"] * p["sign"])}


def _adler(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return np.sign(m) * np.sqrt(np.maximum(0.0, m**2 - p["strength"] ** 2))


def _rail(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """An amplifier that bends towards its rail: linear to the knee, then an exponential approach."""
    top = p["top_dps"]
    knee, room = top * (1 - p["strength"]), top * p["softness"]
    over = np.maximum(np.abs(m) - knee, 0.0)
    return np.sign(m) * (np.minimum(np.abs(m), knee) + room * (1 - np.exp(-over / room)))


def _rail_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"top_dps": float(np.max(np.abs(scene.omega_dps))), "softness": float(rng.uniform(0.005, 0.05))}


def _knee(rng: np.random.Generator, scene: Scene) -> float:
    """So low that one to five samples in a hundred lie above the knee (on a table: its highest levels)."""
    size = np.abs(scene.omega_dps)
    return float(max(1 - np.quantile(size, rng.uniform(0.95, 0.99)) / size.max(), rng.uniform(0.03, 0.2)))


def _code(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return p["strength"] * np.floor(m / p["strength"] + 0.5)


def _coarse(rng: np.random.Generator, scene: Scene) -> float:
    """A step that the noise does not dither away."""
    return float(rng.uniform(4, 10)) * scene.noise.white_dps


def _code_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"lsb_dps": Known(p["strength"])}


def _tone_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    fs = 1 / scene.dt_s
    folded = float(rng.uniform(0.08, 0.42)) * fs
    return {"frequency_hz": float(rng.integers(1, 40)) * fs + folded, "phase": float(rng.uniform(0, 1))}


def _tone(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """A rectified supply tone far above the sampling rate, seen where the sampler folds it."""
    turn = p["frequency_hz"] * s.t_s + p["phase"]
    return m + p["strength"] / HOUR * np.sin(2 * np.pi * turn)


def _noise_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"seed": int(rng.integers(1 << 30))}


def _intensity(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    """Gain noise of a thermal source: gamma-distributed intensity in every sample."""
    shape = 1 / (1e-6 * p["strength"]) ** 2
    gain = np.random.default_rng(p["seed"]).standard_gamma(shape, len(m)) / shape
    return m * gain


def _intensity_variance(s: Scene, p: Parameters) -> np.ndarray:
    return (1e-6 * p["strength"] * s.omega_dps) ** 2


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


def _gross(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m * (1 + 1e-6 * p["strength"] * p["sign"])


def _gross_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"ppm": Known(p["strength"] * p["sign"], exact=False)}


def _offset(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] * p["sign"]


def _offset_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"dps": Known(p["strength"] * p["sign"], exact=False)}


ROADS = ("drive/constant", "drive/cold_start")
ELECTRONICS = (
    Effect(
        "scale_asymmetry",
        ("rate",),
        "electronics",
        ("table/constant", "table/cycle", "averages"),
        _sign,
        _asymmetry,
        100.0,
        truth=_asymmetry_truth,
    ),
    Effect(
        "dead_band",
        ("rate",),
        "electronics",
        ("creep/constant",),
        apply=_adler,
        unit=0.02,
        linear=False,
        limit=0.4,
    ),
    Effect(
        "saturation",
        ("rate",),
        "electronics",
        ("table/constant", "drive/constant"),
        _rail_draw,
        _rail,
        0.02,
        linear=False,
        limit=0.5,
        fixed=_knee,
    ),
    Effect(
        "quantization",
        ("rate",),
        "code",
        ("creep/constant", "drive/constant"),
        apply=_code,
        transferable=False,
        truth=_code_truth,
        fixed=_coarse,
    ),
    Effect(
        "supply_ripple",
        ("time",),
        "electronics",
        ("zero/constant", "drive/constant"),
        _tone_draw,
        _tone,
        transferable=False,
    ),
    Effect(
        "multiplicative_noise",
        ("rate",),
        "electronics",
        ("table/constant", "drive/constant"),
        _noise_draw,
        _intensity,
        300.0,
        linear=False,
        transferable=False,
        variance=_intensity_variance,
    ),
    Effect(
        "bias_step",
        ("time",),
        "electronics",
        ("zero/cycle", "drive/constant", "zero/constant"),
        _step_draw,
        _bias_step,
        transferable=False,
        truth=_step_truth("amplitude_dps", 1 / HOUR),
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
        truth=_step_truth("amplitude_ppm", 1.0),
    ),
    Effect("bias_drift", ("time",), "electronics", ("zero/cycle",), _seep_draw, _seep),
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
        _noise_draw,
        _auto_zero,
        transferable=False,
    ),
)
GROSS = (
    Effect(
        "scale_error",
        ("rate",),
        "electronics",
        ("table/constant", "drive/constant"),
        _sign,
        _gross,
        truth=_gross_truth,
        fixed=lambda rng, scene: float(rng.uniform(4e4, 1.2e5)),
    ),
    Effect(
        "bias_error",
        ("time",),
        "electronics",
        ("zero/constant", "drive/constant"),
        _sign,
        _offset,
        truth=_offset_truth,
        fixed=lambda rng, scene: float(rng.uniform(3, 9)),
    ),
)
