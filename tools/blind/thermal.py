"""Heat: networks of thermal resistances and capacities, and conduction through the wound coil.

All states obey x' = A x + B u with u linear between grid points, stepped exactly (matrix exponential).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

NOTHING = 1e-12


def propagate(A: np.ndarray, B: np.ndarray, drive: np.ndarray, dt_s: float, start: np.ndarray) -> np.ndarray:
    """States of x' = A x + B u, shape (n_times, n_states), for a scalar drive u linear between its samples."""
    n = len(A)
    block = np.zeros((n + 2, n + 2))
    block[:n, :n], block[:n, n], block[n, n + 1] = A * dt_s, B * dt_s, 1.0
    full = expm(block)
    F, G0, G1 = full[:n, :n], full[:n, n], full[:n, n + 1]
    states = np.empty((len(drive), n))
    states[0] = start
    pushed = np.outer(drive[:-1], G0) + np.outer(np.diff(drive), G1)
    for k in range(len(drive) - 1):
        states[k + 1] = F @ states[k] + pushed[k]
    return states


def ladder(drive: np.ndarray, dt_s: float, taus_s: tuple[float, ...], coupling: float = 0.4) -> np.ndarray:
    """Last node of a loaded RC ladder, shape of `drive`; `coupling` is how much each stage loads the one before."""
    n = len(taus_s)
    A, B = np.zeros((n, n)), np.zeros(n)
    for i, tau in enumerate(taus_s):
        A[i, i] -= 1.0 / tau
        if i == 0:
            B[0] = 1.0 / tau
        else:
            A[i, i - 1] = 1.0 / tau
        if i + 1 < n:
            A[i, i] -= coupling / tau
            A[i, i + 1] += coupling / tau
    return propagate(A, B, drive, dt_s, np.full(n, drive[0]))[:, -1]


@dataclass(frozen=True)
class Coil:
    """Temperatures of the layers of a potted coil heated from its outer face, hub inside.

    Attributes:
        layers_degC: shape (n_times, n_layers), outermost first.
        hub_degC: shape (n_times,).
        dt_s: grid step [s].
        lag_s: area over the unit-step response of the mean layer temperature [s] (its Elmore delay).
    """

    layers_degC: np.ndarray
    hub_degC: np.ndarray
    dt_s: float
    lag_s: float

    @property
    def mean_degC(self) -> np.ndarray:
        """Mean over the layers, shape (n_times,)."""
        return self.layers_degC.mean(axis=1)

    @property
    def gradient_K(self) -> np.ndarray:
        """Outer minus inner layer, shape (n_times,)."""
        return self.layers_degC[:, 0] - self.layers_degC[:, -1]


def conduct(face_degC: np.ndarray, dt_s: float, thickness_m: float, kappa_m2ps: float, hub: float) -> Coil:
    """Solve the heat equation ∂T/∂t = κ ∂²T/∂r² by finite volumes from the housing face inwards.

    `hub` is the hub's heat capacity in units of the whole winding's; it sits behind the innermost layer.
    """
    n = 16
    g = kappa_m2ps / (thickness_m / n) ** 2
    A, B = np.zeros((n + 1, n + 1)), np.zeros(n + 1)
    A[0, 0], B[0] = -2 * g, 2 * g
    capacity = np.ones(n + 1)
    capacity[n] = max(hub * n, NOTHING)
    for i in range(n):
        flow = g if i + 1 < n else 2 * g
        A[i, i] -= flow
        A[i, i + 1] += flow
        A[i + 1, i] += flow / capacity[i + 1]
        A[i + 1, i + 1] -= flow / capacity[i + 1]
    states = propagate(A, B, face_degC, dt_s, np.full(n + 1, face_degC[0]))
    lag = float(np.linalg.solve(-A, np.ones(n + 1))[:n].mean())
    return Coil(states[:, :n], states[:, n], dt_s, lag)


def mohr(coil: Coil, face_degC: np.ndarray, offset_m: float, lead_m: float, stress: float) -> np.ndarray:
    """Rate error [°/s] of a quadrupolar coil by Mohr's integral (n/DL)(dn/dT + nα) ∫ a(z) Ṫ(z) (L − 2z) dz.

    Args:
        coil: layer temperatures.
        face_degC: temperature of the housing, where the lead lies.
        offset_m: how far the winding's middle is from the fibre's middle.
        lead_m: extra fibre on one end, at the housing's temperature.
        stress: relative change of the elasto-optic factor a(z) from the innermost to the outermost layer.
    """
    length, diameter, sensitivity = 190.0, 0.06, 1.1e-5
    n = coil.layers_degC.shape[1]
    rates = np.gradient(coil.layers_degC, coil.dt_s, axis=0) * (1 + stress * np.linspace(1, 0, n))
    piece = length / n
    half = np.array([0, 1, 1, 0] * (n // 4), dtype=bool)
    integral = np.zeros(len(rates))
    for side, sign in ((half, 1.0), (~half, -1.0)):
        order = np.flatnonzero(side)[::-1]
        distance = (np.arange(len(order)) + 0.5) * piece + sign * offset_m
        integral += sign * rates[:, order] @ (2 * distance * piece)
    integral += np.gradient(face_degC, coil.dt_s) * lead_m * length
    return np.degrees(1.45 / (diameter * length) * sensitivity * integral)
