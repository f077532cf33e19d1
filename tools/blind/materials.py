"""How light, power and modulation depend on temperature: laws of matter rather than polynomials."""

import numpy as np
from scipy.special import j1

ROOM_DEGC = 25.0


def wavelength_um(temp_degC: np.ndarray) -> np.ndarray:
    """Emission wavelength [µm] of a GaAs-like source from Varshni's band gap E = E0 − aT²/(T + b)."""
    kelvin = temp_degC + 273.15
    return 1.2398 / (1.519 - 5.405e-4 * kelvin**2 / (kelvin + 204.0))


def power(temp_degC: np.ndarray, characteristic_K: float) -> np.ndarray:
    """Source power relative to room temperature: the threshold law exp(−ΔT/T0)."""
    return np.exp(-(temp_degC - ROOM_DEGC) / characteristic_K)


def modulation(temp_degC: np.ndarray, depth_rad: float, slope_per_K: float) -> np.ndarray:
    """Demodulated fraction J1(φ(T)) relative to room temperature, φ the depth of a piezo modulator."""
    depth = depth_rad * (1 + slope_per_K * (temp_degC - ROOM_DEGC))
    return j1(depth) / j1(depth_rad)


def optical_gain(
    temp_degC: np.ndarray, characteristic_K: float, depth_rad: float, slope: float
) -> np.ndarray:
    """Scale factor relative to room: coil area over wavelength, times power, times modulation."""
    room = np.array(ROOM_DEGC)
    coil = (1 + 2e-5 * (temp_degC - ROOM_DEGC)) * wavelength_um(room) / wavelength_um(temp_degC)
    return coil * power(temp_degC, characteristic_K) * modulation(temp_degC, depth_rad, slope)


def pick_up(temp_degC: np.ndarray, characteristic_K: float, depth_rad: float, slope: float) -> np.ndarray:
    """Bias of a fixed stray voltage divided by gain and power, as its change from room temperature."""
    return 1 / (power(temp_degC, characteristic_K) * modulation(temp_degC, depth_rad, slope)) - 1


def fringes(
    temp_degC: np.ndarray, lengths_m: np.ndarray, chirp_per_K: float, phases: np.ndarray
) -> np.ndarray:
    """Bias of coupled polarisation sections: every pair of coupling points interferes, weighted by coherence.

    lengths_m: lengths of the birefringent sections (beat length 3 mm at room, −1e-3 of it per K).
    """
    heat = temp_degC - ROOM_DEGC
    turn = 1e-3 * (heat + chirp_per_K * heat**2) / 3e-3
    points = np.concatenate([[0.0], np.cumsum(lengths_m)])
    total = np.zeros_like(temp_degC)
    strongest = np.argmax(lengths_m)
    for i in range(len(points)):
        for k in range(i + 1, len(points)):
            span = points[k] - points[i]
            weight = 1.0 if (i, k) == (strongest, strongest + 1) else 0.015 * np.exp(-span)
            total += weight * np.sin(2 * np.pi * span * turn + phases[i] - phases[k])
    return total
