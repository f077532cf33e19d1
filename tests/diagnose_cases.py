"""Small simulated recordings for the diagnosis tests: a chamber cycle with rate steps, white and 1/f² noise, seeded."""

import numpy as np

from training.table import Recording

STEP_S = 0.5


def profile(seconds: float = 5400.0, static: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(t [s], true rate [dps], temperature [degC]): ramps of two speeds both ways with holds, steps of rate."""
    t = np.arange(0.0, seconds, STEP_S)
    knots = np.asarray([0, 0.05, 0.3, 0.4, 0.52, 0.6, 0.8, 0.9, 1.0]) * seconds
    temp = np.interp(t, knots, [25, 25, -5, -5, 40, 40, 12, 12, 25])
    temp = np.convolve(np.pad(temp, 200, mode="edge"), np.ones(401) / 401, mode="valid")
    levels = np.asarray([0, 60, -60, 20, -20, 100, -100, 5, -5])
    rate = np.zeros_like(t) if static else levels[(t // 50).astype(int) * 7 % len(levels)].astype(float)
    return t, rate, temp


def noise(seed: int, n: int) -> np.ndarray:
    """White noise of 0.004 dps per sample and a random walk of 0.0004 dps per root hour."""
    rng = np.random.default_rng(seed)
    return 4e-3 * rng.standard_normal(n) + 4e-4 * np.sqrt(STEP_S / 3600.0) * np.cumsum(rng.standard_normal(n))


def recording(
    seed: int, effect=None, static: bool = False, seconds: float = 5400.0, **extra: np.ndarray
) -> Recording:
    """A recording with `effect(t, rate, temp)` [dps] added to noise; `extra` columns replace or join the others."""
    t, rate, temp = profile(seconds, static)
    error = noise(seed, len(t)) if effect is None else noise(seed, len(t)) + effect(t, rate, temp)
    columns = {"t_s": t, "rate_dps": rate + error, "temp_degC": temp, "ref_rate_dps": rate}
    return Recording(f"case{seed}", {**columns, **extra})


def lagged(temp: np.ndarray, tau_s: float) -> np.ndarray:
    """First-order lag by Euler steps of a tenth of a sample: slow and obvious."""
    out, state = np.empty_like(temp), temp[0]
    for i in range(len(temp)):
        start = temp[max(i - 1, 0)]
        for k in range(10):
            state += (start + (temp[i] - start) * (k + 0.5) / 10 - state) * (STEP_S / 10) / tau_s
        out[i] = state
    return out


def lag_effect(t: np.ndarray, rate: np.ndarray, temp: np.ndarray) -> np.ndarray:
    """A thermal lag of 200 s on a scale factor of 40 ppm/K."""
    return rate * 40e-6 * (lagged(temp, 200.0) - temp)
