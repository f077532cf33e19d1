"""What really happened to the gyro: motion and temperatures, free of any sensor's error."""

from dataclasses import dataclass, field, replace

import numpy as np

from rtcomp.errors import RequestError
from training.effects import dynamics

REFERENCE_TEMP_DEGC = 25.0
STANDARD_GRAVITY_MPS2 = 9.80665


def _nothing() -> np.ndarray:
    return np.empty(0)


@dataclass(frozen=True)
class Truth:
    """True motion and temperatures, every array of shape `(n_samples,)`; optional ones are empty if unknown.

    `t_s` counts from power-on. `temp_degC` is the housing at the temperature sensor's place, `coil_temp_degC`
    the coil. `heading_deg` is the yaw angle, anticlockwise positive from north, not wrapped. `soaked` says
    that the rows are independent settled points: lags have died out and temperature rates are zero.
    """

    t_s: np.ndarray
    rate_dps: np.ndarray
    temp_degC: np.ndarray
    coil_temp_degC: np.ndarray = field(default_factory=_nothing)
    heading_deg: np.ndarray = field(default_factory=_nothing)
    speed_mps: np.ndarray = field(default_factory=_nothing)
    accel_lat_mps2: np.ndarray = field(default_factory=_nothing)
    vibration_rms_mps2: np.ndarray = field(default_factory=_nothing)
    soaked: bool = False

    @property
    def h_K(self) -> np.ndarray:
        """Housing temperature above 25 °C [K]."""
        return self.temp_degC - REFERENCE_TEMP_DEGC

    @property
    def dt_s(self) -> float:
        """The median sampling interval [s]."""
        return float(np.median(np.diff(self.t_s))) if self.t_s.size > 1 else 1.0

    def needs(self, name: str, effect: str) -> np.ndarray:
        """Return an optional driver, or a RequestError that says which effect wanted it."""
        values: np.ndarray = getattr(self, name)
        if values.size != self.t_s.size:
            raise RequestError(f"effect {effect} needs {name}, which is not there; add it or drop the effect")
        return values

    def lagged_temp(self, tau_s: float, tau2_s: float = 0.0) -> np.ndarray:
        """Return LP_τ(T) [°C]: a body that follows the housing, with one time constant or two in a row."""
        if self.soaked:
            return self.temp_degC.copy()
        first = dynamics.lowpass(self.t_s, self.temp_degC, tau_s)
        return dynamics.lowpass(self.t_s, first, tau2_s) if tau2_s > 0.0 else first

    def temp_rate(self) -> np.ndarray:
        """Return dT/dt [K/s] of the segment ending at each sample."""
        return np.zeros_like(self.t_s) if self.soaked else dynamics.slope(self.t_s, self.temp_degC)

    def lagged_temp_rate(self, tau_s: float) -> np.ndarray:
        """Return LP_τ(dT/dt) [K/s] of a gyro that was settled at the first sample.

        By the lag's own equation this is (T − LP_τ(T))/τ, which needs no differences of T.
        """
        if tau_s <= 0.0 or self.soaked:
            return self.temp_rate()
        return (self.temp_degC - self.lagged_temp(tau_s)) / tau_s

    def lagged_temp_rate_change(self, tau_s: float) -> np.ndarray:
        """Return d/dt LP_τ(dT/dt) [K/s²], again from the lag's own equation."""
        if self.soaked:
            return np.zeros_like(self.t_s)
        return (self.temp_rate() - self.lagged_temp_rate(tau_s)) / tau_s

    def smoothed(self, tau_s: float) -> "Truth":
        """Return the same truth with its temperature passed through a first-order lag."""
        return self if tau_s <= 0.0 else replace(self, temp_degC=self.lagged_temp(tau_s))

    def play_offset(self, play_K: float) -> np.ndarray:
        """Return p − T [K] of a play of half width `play_K`."""
        return dynamics.play(self.temp_degC, play_K) - self.temp_degC
