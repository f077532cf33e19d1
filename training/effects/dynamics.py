"""The two memories a thermal error can have: a first-order lag and a play (backlash) operator."""

import math

import numpy as np

from rtcomp.jit import kernel


@kernel
def lowpass(t_s: np.ndarray, x: np.ndarray, tau_s: float) -> np.ndarray:
    """Return LP_τ(x), exact where x is linear between samples, settled at the first one; shape `(n,)`.

    Solution of τ dy/dt = x − y over one step with x = x₀ + s·t: y = x₁ − s·τ + (y₀ − x₀ + s·τ)·exp(−Δt/τ).
    """
    y = np.empty_like(x)
    y[0] = x[0]
    for i in range(1, x.size):
        dt = t_s[i] - t_s[i - 1]
        if tau_s <= 0.0 or dt <= 0.0:
            y[i] = x[i] if tau_s <= 0.0 else y[i - 1]
            continue
        lag = (x[i] - x[i - 1]) / dt * tau_s
        y[i] = x[i] - lag + (y[i - 1] - x[i - 1] + lag) * math.exp(-dt / tau_s)
    return y


@kernel
def play(x: np.ndarray, half_width: float) -> np.ndarray:
    """Return the play operator p = min(max(p, x − r), x + r), starting at x₀; shape `(n,)`.

    Krasnosel'skii and Pokrovskii's elementary hysteresis: the output depends on the path, never on its speed.
    """
    p = np.empty_like(x)
    p[0] = x[0]
    for i in range(1, x.size):
        p[i] = min(max(p[i - 1], x[i] - half_width), x[i] + half_width)
    return p


@kernel
def slope(t_s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the slope of the segment that ends at each sample (causal; the first is 0), shape `(n,)`."""
    s = np.zeros_like(x)
    for i in range(1, x.size):
        dt = t_s[i] - t_s[i - 1]
        s[i] = (x[i] - x[i - 1]) / dt if dt > 0.0 else s[i - 1]
    return s
