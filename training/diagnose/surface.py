"""The simulation as a surface over temperature and rate, so that it can be asked about another temperature.

A calibration holds for a soaked gyro.  Where the coil runs behind the temperature sensor the gyro stands on the same
surface, only elsewhere: its error is e(T_coil, ω) − e(T, ω) (PHYSICS.md A3), bend of the surface and all, and how much
of it is bias and how much scale factor is known beforehand.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from training.diagnose.library import PPM, ROOM_DEGC, FloatArray
from training.diagnose.work import Work

TEMP_ORDER, RATE_ORDER = 6, 5
LEAST_SPAN_K = 2.0
MOST_LEFT = 0.02  # of the power that only temperature explains; more, and the simulation is no such surface
LEAST_DPS = 1e-6
ENOUGH_ROWS = 60_000
TERM_ORDER = 3  # of the scale factor over temperature in the term of the live compensator


@dataclass(frozen=True)
class Surface:
    """e(T, ω) [dps] as a polynomial: Chebyshev over `temp_degC` (low, high), powers of ω/`rate_dps`.

    `coefficients` has shape `(TEMP_ORDER + 1, RATE_ORDER + 1)`; `slope_ppm_per_K` is its scale factor's mean slope
    where the recordings were.
    """

    coefficients: FloatArray
    temp_degC: tuple[float, float]
    rate_dps: float
    slope_ppm_per_K: float

    def over_temperature(self, temp_degC: FloatArray) -> FloatArray:
        """The factor of every power of the rate at temperatures `(n,)`, shape `(RATE_ORDER + 1, n)`."""
        low, high = self.temp_degC
        place = np.clip((2.0 * temp_degC - low - high) / (high - low), -1.0, 1.0)
        return np.asarray(chebyshev.chebval(place, self.coefficients), dtype=np.float64)

    def powers(self, rate_dps: FloatArray) -> FloatArray:
        """(ω/`rate_dps`)⁰ … of rates `(n,)`, shape `(RATE_ORDER + 1, n)`."""
        return (rate_dps / self.rate_dps) ** np.arange(RATE_ORDER + 1)[:, None]

    def term(self, share: float, rate_dps: FloatArray) -> dict[str, float]:
        """Coefficients of the live term `thermal_lag`: a cubic scale factor and a straight bias over temperature.

        `share` is what part of the surface acts, `rate_dps` the rates over which odd powers become a scale factor.
        """
        temp = np.linspace(*self.temp_degC, 101)
        factors = share * self.over_temperature(temp)
        x = rate_dps / self.rate_dps
        odd, even = range(1, RATE_ORDER + 1, 2), range(0, RATE_ORDER + 1, 2)
        turning = float(np.mean(x * x)) + 1e-300
        scale = sum((factors[j] * float(np.mean(x ** (j + 1))) / turning for j in odd), np.zeros(len(temp)))
        bias = sum((factors[j] * float(np.mean(x**j)) for j in even), np.zeros(len(temp)))
        rising = (temp - ROOM_DEGC) ** np.arange(TERM_ORDER + 1)[:, None]
        s = np.linalg.lstsq(rising.T, scale / self.rate_dps / PPM, rcond=None)[0]
        b = np.linalg.lstsq(rising[:2].T, bias, rcond=None)[0]
        return {
            "scale_ppm_per_K": float(s[1]),
            "scale2_ppm_per_K2": float(s[2]),
            "scale3_ppm_per_K3": float(s[3]),
            "bias_dps_per_K": float(b[1]),
        }


def fit_surface(rows: Sequence[FloatArray]) -> Surface | None:
    """The simulated error of recordings over their temperature and rate; None where it is no such surface.

    `rows`: temperature [degC], true rate and simulated error [dps] of each recording, shape `(3, n)`.
    """
    most = ENOUGH_ROWS // max(1, len(rows))
    thinned = [row[:, :: 1 + row.shape[1] // most] for row in rows if row.shape[1]]
    if not thinned:
        return None
    temp, rate, error = np.concatenate(thinned, axis=1)
    low, high, top = float(temp.min()), float(temp.max()), float(np.max(np.abs(rate)))
    if high - low < LEAST_SPAN_K or top <= 0.0:
        return None
    powers = (rate / top)[:, None] ** np.arange(RATE_ORDER + 1)
    place = (2.0 * temp - low - high) / (high - low)
    basis = chebyshev.chebvander(place, TEMP_ORDER)
    columns = (basis[:, :, None] * powers[:, None, :]).reshape(len(temp), -1)
    flat = float(np.var(error - powers @ np.linalg.lstsq(powers, error, rcond=None)[0]))
    found = np.linalg.lstsq(columns, error, rcond=1e-9)[0]
    left = float(np.var(error - columns @ found))
    if flat < LEAST_DPS**2 or left > MOST_LEFT * flat:
        return None
    coefficients = found.reshape(TEMP_ORDER + 1, RATE_ORDER + 1)
    slopes = chebyshev.chebval(place, chebyshev.chebder(coefficients)) * 2.0 / (high - low)
    along = np.sum(slopes * powers.T, axis=0)
    slope = float(np.sum(rate * along) / np.sum(rate * rate)) / PPM
    return Surface(coefficients, (low, high), top, slope) if slope else None


def stand_on(surface: Surface | None, work: Work) -> None:
    """Let a recording's regressors ask what the simulation would say of another temperature."""
    if surface is None:
        work.elsewhere = None
        return
    rates = np.stack([work.average(power) for power in surface.powers(work.full["w"])])
    here = surface.over_temperature(work.temp)

    def elsewhere(temp_degC: FloatArray) -> FloatArray:
        return np.sum(rates * (surface.over_temperature(temp_degC) - here), axis=0) / surface.slope_ppm_per_K

    work.elsewhere = elsewhere
