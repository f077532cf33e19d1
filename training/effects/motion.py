"""Errors coupled to motion and attitude, and slow or sudden changes of the bias: PHYSICS.md F2, F3, G1–G7."""

from types import SimpleNamespace

import numpy as np

from training.effects.base import ErrorEffect, amplitude, parameters, shape
from training.effects.truth import STANDARD_GRAVITY_MPS2, Truth
from training.effects.units import DEG_PER_H, EARTH_RATE_DPS, MILLIRADIAN, PPM, RAD_PER_DEG


class BiasError(ErrorEffect):
    """The simulation's zero is simply wrong."""

    id = "bias_error"
    title = "Wrong bias"
    section = "D7"
    equation = "e = b"
    parameters = parameters(dps=amplitude("dps", 0.01, 0.1))
    drivers = ()
    excitation = "standstill"
    source = "definition of the bias, IEEE Std 952"

    def _error(self, truth: Truth, p: SimpleNamespace) -> float:
        return p.dps


class BiasStep(ErrorEffect):
    """A supply, heater or gain range changes, or something breaks, and the bias jumps."""

    id = "bias_step"
    title = "Step of the bias"
    section = "F2"
    equation = "e = A for t ≥ t0"
    parameters = parameters(step_dps=amplitude("dps", 1e-3, 1e-2), t0_s=shape("s", 1800.0, 1800.0))
    drivers = ("time",)
    excitation = "standstill before and after the step, supply and heater state noted"
    source = "PHYSICS.md F2, C6"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return p.step_dps * (truth.t_s >= p.t0_s)


class BiasDrift(ErrorEffect):
    """A steady trend of the bias, which one recording can hardly tell from a random walk."""

    id = "bias_drift"
    title = "Trend of the bias"
    section = "F3"
    equation = "e = c·t"
    parameters = parameters(c_dps_per_s=amplitude("dps/s", DEG_PER_H / 3600.0, 5.0 * DEG_PER_H / 3600.0))
    drivers = ("time",)
    excitation = "several long recordings at standstill, hours apart at the same temperature"
    source = "PHYSICS.md F3; IEEE Std 952 (rate ramp)"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return p.c_dps_per_s * truth.t_s


class Acceleration(ErrorEffect):
    """Acceleration strains coil and mounting."""

    id = "acceleration"
    title = "Acceleration (g and g²) sensitivity"
    section = "G1"
    equation = "e = c1·a + c2·a², a lateral acceleration in g"
    parameters = parameters(
        c1_dps_per_g=amplitude("dps/g", 0.03 * DEG_PER_H, 0.1 * DEG_PER_H, default=0.0),
        c2_dps_per_g2=amplitude("dps/g²", 3e-3 * DEG_PER_H, 1e-2 * DEG_PER_H, default=0.0),
    )
    drivers = ("acceleration",)
    excitation = "the same yaw rate at different speeds, or a tilt test"
    source = "PHYSICS.md G1 [K]; IEEE Std 952"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        g = truth.needs("accel_lat_mps2", self.id) / STANDARD_GRAVITY_MPS2
        return g * (p.c1_dps_per_g + p.c2_dps_per_g2 * g)


class VibrationRectification(ErrorEffect):
    """Vibration modulates phase and intensity together; their product has a mean."""

    id = "vibration_rectification"
    title = "Vibration rectification"
    section = "G2"
    equation = "e = c·a_rms²"
    parameters = parameters(c_dps_per_m2s4=amplitude("dps/(m²/s⁴)", DEG_PER_H / 400.0, DEG_PER_H / 4.0))
    drivers = ("vibration",)
    excitation = "vibration at zero rate (engine running, rough road straight on), several levels"
    source = "PHYSICS.md G2 [S18, S19]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return p.c_dps_per_m2s4 * truth.needs("vibration_rms_mps2", self.id) ** 2


class Misalignment(ErrorEffect):
    """A tilted sensitive axis picks up the roll rate of the suspension and loses the cosine of its own."""

    id = "misalignment"
    title = "Misalignment, cross-axis sensitivity"
    section = "G3"
    equation = "e = sin δ·ω_x + (cos δ − 1)·ω, ω_x = k·d(a_lat)/dt roll rate of the suspension"
    parameters = parameters(
        x_mrad=shape("mrad", 5.0, 20.0), roll_deg_per_mps2=shape("deg/(m/s²)", 0.4, 0.8, default=0.4)
    )
    drivers = ("acceleration", "rate")
    excitation = "quick lane changes (roll without much yaw), or the other axes of the sensor"
    source = "PHYSICS.md G3 [D]; roll gradient of cars 3…6 deg/g [K]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        lateral = truth.needs("accel_lat_mps2", self.id)
        roll_dps = p.roll_deg_per_mps2 * _gradient(lateral, truth.t_s)
        tilt = p.x_mrad * MILLIRADIAN
        return np.sin(tilt) * roll_dps + (np.cos(tilt) - 1.0) * truth.rate_dps


class EarthRate(ErrorEffect):
    """The gyro turns with the Earth and a road reference does not know it."""

    id = "earth_rate"
    title = "Earth rate"
    section = "G5"
    equation = "e = Ω·(sin φ·cos γ + cos φ·sin γ·cos(ψ − ψ0)), Ω = 15.041 °/h, tilt γ towards ψ0"
    parameters = parameters(
        latitude_deg=shape("deg", 48.0, 48.0),
        tilt_deg=shape("deg", 1.0, 5.0, default=0.0),
        azimuth_deg=shape("deg", 0.0, 0.0, default=0.0),
    )
    drivers = ("heading",)
    excitation = "slow full heading circles, upright and with the unit inverted"
    source = "PHYSICS.md G5 [D]; WGS 84"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray | float:
        latitude, tilt = p.latitude_deg * RAD_PER_DEG, p.tilt_deg * RAD_PER_DEG
        upright = np.sin(latitude) * np.cos(tilt)
        if tilt == 0.0:
            return EARTH_RATE_DPS * upright
        psi = (truth.needs("heading_deg", self.id) - p.azimuth_deg) * RAD_PER_DEG
        return EARTH_RATE_DPS * (upright + np.cos(latitude) * np.sin(tilt) * np.cos(psi))


class Magnetic(ErrorEffect):
    """The twist of the fibre with the period of one turn couples the Earth's field by the Faraday effect;
    the vehicle's iron adds a second harmonic of the heading.
    """

    id = "magnetic"
    title = "Faraday magnetic effect"
    section = "G6"
    equation = "e = a1·cos ψ + b1·sin ψ + a2·cos 2ψ + b2·sin 2ψ"
    parameters = parameters(
        cos_dps=amplitude("dps", 0.3 * DEG_PER_H, 3.0 * DEG_PER_H, default=0.0),
        sin_dps=amplitude("dps", 0.0, 0.0, default=0.0),
        cos2_dps=amplitude("dps", 0.0, 0.0, default=0.0),
        sin2_dps=amplitude("dps", 0.0, 0.0, default=0.0),
    )
    drivers = ("heading",)
    excitation = "slow full heading circles, several, in both directions and at two rates"
    source = "PHYSICS.md G6 [S20, S21]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return _harmonics(truth.needs("heading_deg", self.id), p.cos_dps, p.sin_dps, p.cos2_dps, p.sin2_dps)


class TableEccentricity(ErrorEffect):
    """An encoder or gear off its axis makes the reference angle wrong once (or twice) a turn."""

    id = "table_eccentricity"
    title = "Wobble and eccentricity of the rate table"
    section = "G7"
    equation = "e = ω·10⁻⁶·(a1·cos ψ + b1·sin ψ + a2·cos 2ψ + b2·sin 2ψ)"
    parameters = parameters(
        cos_ppm=amplitude("ppm", 50.0, 500.0, default=0.0),
        sin_ppm=amplitude("ppm", 0.0, 0.0, default=0.0),
        cos2_ppm=amplitude("ppm", 0.0, 0.0, default=0.0),
        sin2_ppm=amplitude("ppm", 0.0, 0.0, default=0.0),
    )
    drivers = ("rate_times_heading",)
    excitation = "whole table turns at two rates and in both directions"
    source = "PHYSICS.md G7 [D]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        heading = truth.needs("heading_deg", self.id)
        return truth.rate_dps * PPM * _harmonics(heading, p.cos_ppm, p.sin_ppm, p.cos2_ppm, p.sin2_ppm)


def _harmonics(heading_deg: np.ndarray, a1: float, b1: float, a2: float, b2: float) -> np.ndarray:
    """Return a1·cos ψ + b1·sin ψ + a2·cos 2ψ + b2·sin 2ψ, shape `(n,)`."""
    psi = heading_deg * RAD_PER_DEG
    return a1 * np.cos(psi) + b1 * np.sin(psi) + a2 * np.cos(2.0 * psi) + b2 * np.sin(2.0 * psi)


def _gradient(values: np.ndarray, t_s: np.ndarray) -> np.ndarray:
    """Central differences; zero for fewer than two samples."""
    return np.gradient(values, t_s) if values.size > 1 else np.zeros_like(values)
