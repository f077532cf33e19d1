"""Errors of loop, converter and supply, and plain wrong coefficients."""

import numpy as np

from tools.blind.effect import Effect, Known, Parameters
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


def _rail_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"limit_dps": Known(p["top_dps"] * (1 - p["strength"] + p["softness"]), exact=False)}


def _adler_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"lock_dps": Known(p["strength"], exact=False)}


def _knee(rng: np.random.Generator, scene: Scene) -> float:
    """So low that one to five samples in a hundred lie above the knee (on a table: its highest levels)."""
    size = np.abs(scene.omega_dps)
    return float(max(1 - np.quantile(size, rng.uniform(0.95, 0.99)) / size.max(), rng.uniform(0.03, 0.2)))


def _code(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return p["strength"] * np.floor(m / p["strength"] + 0.5)


def _coarse(rng: np.random.Generator, scene: Scene) -> float:
    """A step that the noise does not dither away."""
    return float(rng.uniform(4, 10)) * scene.gyro_noise.white_dps


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


def _gross(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m * (1 + 1e-6 * p["strength"] * p["sign"])


def _gross_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"ppm": Known(p["strength"] * p["sign"], exact=False)}


def _offset(m: np.ndarray, s: Scene, p: Parameters) -> np.ndarray:
    return m + p["strength"] * p["sign"]


def _offset_truth(s: Scene, p: Parameters) -> dict[str, Known]:
    return {"dps": Known(p["strength"] * p["sign"], exact=False)}


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
        truth=_adler_truth,
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
        truth=_rail_truth,
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
