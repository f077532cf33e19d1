"""Whatever repeats per turn (poles, gear teeth, encoder marks), taken out before noise and lines are looked for.

At a constant rate it looks like a line of the supply, and as it comes faster at higher rates, like noise that follows
the rate.
"""

import numpy as np

from training.diagnose.work import FloatArray

MOST_ORDERS = 48
SEEN = 60.0
MOST_AT_ONCE = 4


def heading(columns: dict[str, FloatArray], rate: FloatArray) -> FloatArray:
    """Heading [rad] on the rows: as recorded, else the integral of the rate [dps]."""
    if "heading_deg" in columns and np.all(np.isfinite(columns["heading_deg"])):
        return np.deg2rad(columns["heading_deg"])
    steps = np.diff(columns["t_s"]) * 0.5 * (rate[1:] + rate[:-1])
    return np.deg2rad(np.concatenate([[0.0], np.cumsum(steps)]))


def without_orders(
    residual: FloatArray, rate: FloatArray, columns: dict[str, FloatArray], valid: np.ndarray
) -> FloatArray:
    """The residual `(n,)` without clear harmonics of the heading, in the bias or times the rate `(n,)` [dps]."""
    if np.ptp(rate) == 0.0:
        return residual
    psi = heading(columns, rate)
    if np.ptp(np.unwrap(psi)) < 2.0 * np.pi:
        return residual
    left = np.where(valid, residual, 0.0)
    size = rate / np.sqrt(np.mean(rate**2))
    for _ in range(MOST_AT_ONCE):
        noise = max(float(np.mean(np.diff(left) ** 2)) / 2.0, 1e-300)
        gains = [_gain(left * scale, psi, float(np.mean(scale**2))) for scale in (np.ones(len(rate)), size)]
        kind, order = np.unravel_index(int(np.argmax(gains)), (2, MOST_ORDERS))
        if gains[kind][order] < SEEN * noise:
            break
        scale = size if kind else 1.0
        wave = np.stack([np.cos((order + 1) * psi) * scale, np.sin((order + 1) * psi) * scale], axis=1)
        left = left - wave @ np.linalg.lstsq(wave.T @ wave, wave.T @ left, rcond=None)[0]
    return residual + left - np.where(valid, residual, 0.0)


def _gain(values: FloatArray, psi: FloatArray, power: float) -> FloatArray:
    """Energy that each order 1…`MOST_ORDERS` explains of `values`, shape `(MOST_ORDERS,)`."""
    turn, phase = np.exp(1j * psi), np.ones(len(psi), dtype=complex)
    found = np.empty(MOST_ORDERS)
    for k in range(MOST_ORDERS):
        phase *= turn
        found[k] = 2.0 * np.abs(np.vdot(phase, values)) ** 2 / (len(values) * power)
    return found
