"""Thermal errors of the bias: PHYSICS.md A1–A5, D10, E1."""

from types import SimpleNamespace

import numpy as np

from training.effects.base import ErrorEffect, amplitude, parameters, shape
from training.effects.truth import Truth
from training.effects.units import DEG_PER_H, PPM

RAMPS = "zero rate, ramps of two speeds in both directions with holds, temperature read to 0.1 K or better"


class BiasTemperature(ErrorEffect):
    """Residual non-reciprocities (polarisation, electronic offset over optical power) drift with temperature,
    so that even a soaked gyro's zero depends on it; Kerr bias (A6) and pick-up (A7) look the same.
    """

    id = "bias_temperature"
    title = "Static thermal bias"
    section = "A1"
    equation = "e = b1·h + b2·h² + b3·h³, h = T − 25 °C"
    parameters = parameters(
        b1_dps_per_K=amplitude("dps/K", 0.1 * DEG_PER_H, 0.3 * DEG_PER_H),
        b2_dps_per_K2=amplitude("dps/K²", 1e-3 * DEG_PER_H, 5e-3 * DEG_PER_H, default=0.0),
        b3_dps_per_K3=amplitude("dps/K³", 0.0, 5e-5 * DEG_PER_H, default=0.0),
    )
    drivers = ("temperature",)
    excitation = "zero or constant rate at four or more soaked temperatures, or ramps in both directions"
    source = "PHYSICS.md A1 [K]; Lefèvre, The Fiber-Optic Gyroscope; IEEE Std 952"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        h = truth.h_K
        return h * (p.b1_dps_per_K + h * (p.b2_dps_per_K2 + h * p.b3_dps_per_K3))


class Shupe(ErrorEffect):
    """Counter-propagating waves pass a fibre element at different times; if its temperature changes meanwhile
    they see different phases. What symmetric winding leaves follows the filtered temperature rate (asymmetry)
    and its change (radial gradient).
    """

    id = "shupe"
    title = "Shupe effect"
    section = "A2"
    equation = "e = c1·LP_τ(dT/dt) + c2·d/dt LP_τ(dT/dt)"
    parameters = parameters(
        tau_s=shape("s", 150.0, 300.0),
        c1_dps_s_per_K=amplitude("dps·s/K", 0.9 * DEG_PER_H * 60.0, 4.0 * DEG_PER_H * 60.0, default=0.0),
        c2_dps_s2_per_K=amplitude("dps·s²/K", 0.8, 18.0, default=0.0),
        smooth_s=shape("s", 0.0, 0.0, default=0.0),
    )
    drivers = ("temperature_rate",)
    excitation = RAMPS
    source = "Shupe, Appl. Opt. 19 (1980) 654; Mohr, J. Lightwave Technol. 14 (1996) 27; PHYSICS.md A2"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        housing = truth.smoothed(p.smooth_s)
        steady = p.c1_dps_s_per_K * housing.lagged_temp_rate(p.tau_s)
        return steady + p.c2_dps_s2_per_K * housing.lagged_temp_rate_change(p.tau_s)


class ThermalLag(ErrorEffect):
    """The sensor sits on the housing and the coil follows by conduction, so that all calibrated against
    temperature is read off at the wrong one while the temperature changes.
    """

    id = "thermal_lag"
    title = "Thermal lag between temperature sensor and coil"
    section = "A3"
    equation = "e = ω·10⁻⁶·(S(LP_τ(T)) − S(T)) + b·(LP_τ(T) − T), S = s·h + s2·h² + s3·h³, h = T − 25 °C"
    parameters = parameters(
        tau_s=shape("s", 280.0, 600.0),
        scale_ppm_per_K=amplitude("ppm/K", -1263.0, -1263.0, default=0.0),
        bias_dps_per_K=amplitude("dps/K", 0.1 * DEG_PER_H, 0.3 * DEG_PER_H, default=0.0),
        tau2_s=shape("s", 0.0, 120.0, default=0.0),
        scale2_ppm_per_K2=amplitude("ppm/K²", 0.0, 0.0, default=0.0),
        scale3_ppm_per_K3=amplitude("ppm/K³", 0.0, 0.0, default=0.0),
    )
    drivers = ("rate_times_temperature_rate", "temperature_rate")
    excitation = "constant 60…100 °/s while the temperature ramps, two speeds, both directions, 30 min holds"
    source = "PHYSICS.md A3 [D]: heat conduction, first order τ·dT_c/dt = T − T_c"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        behind = truth.lagged_temp(p.tau_s, p.tau2_s) - truth.temp_degC
        h = truth.h_K
        coil = h + behind
        bend = p.scale2_ppm_per_K2 * (coil + h) + p.scale3_ppm_per_K3 * (coil * coil + coil * h + h * h)
        return (truth.rate_dps * PPM * (p.scale_ppm_per_K + bend) + p.bias_dps_per_K) * behind


class BiasHysteresis(ErrorEffect):
    """Visco-plastic strain of coating and adhesive and slip of the coil on its spool remember which way the
    temperature came, however slowly.
    """

    id = "bias_hysteresis"
    title = "Thermal hysteresis of the bias"
    section = "A4"
    equation = "e = c·(p − T), p = min(max(p, T − r), T + r)"
    parameters = parameters(
        play_K=shape("K", 4.0, 8.0),
        c_dps_per_K=amplitude("dps/K", 0.5 * DEG_PER_H / 8.0, 5.0 * DEG_PER_H / 16.0),
    )
    drivers = ("temperature", "temperature_rate")
    excitation = "zero rate, a closed temperature loop at two speeds with an inner reversal"
    source = "PHYSICS.md A4; Krasnosel'skii, Pokrovskii, Systems with Hysteresis (play operator)"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return p.c_dps_per_K * truth.play_offset(p.play_K)


class PolarizationRipple(ErrorEffect):
    """Imperfect polariser rejection and cross-coupling at splices form a parasitic interferometer whose phase
    is the birefringence of a fibre length, about −10⁻³ per K.
    """

    id = "polarization_ripple"
    title = "Polarisation non-reciprocity ripple"
    section = "A5"
    equation = "e = a·cos φ + b·sin φ, φ = 2π(h + χh²)/P"
    parameters = parameters(
        period_K=shape("K", 6.0, 6.0),
        cos_dps=amplitude("dps", 0.3 * DEG_PER_H, 5.0 * DEG_PER_H, default=0.0),
        sin_dps=amplitude("dps", 0.0, 0.0, default=0.0),
        chirp_per_K=shape("1/K", 0.0, 0.005, default=0.0),
    )
    drivers = ("temperature",)
    excitation = (
        "a slow continuous ramp over three or more periods; a 5 K grid of soaks aliases periods under 10 K"
    )
    source = "PHYSICS.md A5 [S7]; period = beat length / (length · |birefringence slope|)"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        phase = 2.0 * np.pi * (truth.h_K + p.chirp_per_K * truth.h_K**2) / p.period_K
        return p.cos_dps * np.cos(phase) + p.sin_dps * np.sin(phase)


class CompensationTable(ErrorEffect):
    """A stepwise temperature compensation inside the sensor leaves a sawtooth between its knots."""

    id = "compensation_table"
    title = "Sawtooth of an internal compensation table"
    section = "D10"
    equation = "e = A·(2·frac((h − φ)/P) − 1)"
    parameters = parameters(
        period_K=shape("K", 10.0, 10.0),
        amplitude_dps=amplitude("dps", 1.0 * DEG_PER_H, 10.0 * DEG_PER_H),
        phase_K=shape("K", 0.0, 3.0, default=0.0),
    )
    drivers = ("temperature",)
    excitation = "a slow continuous ramp over three or more knots"
    source = "PHYSICS.md D10 [K]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        cycles = (truth.h_K - p.phase_K) / p.period_K
        return p.amplitude_dps * (2.0 * (cycles - np.floor(cycles)) - 1.0)


class BiasWarmup(ErrorEffect):
    """Electronics and source heat themselves after power-on and the bias settles with them."""

    id = "bias_warmup"
    title = "Bias warm-up"
    section = "E1"
    equation = "e = A·exp(−t/τ), t since power-on"
    parameters = parameters(
        amplitude_dps=amplitude("dps", 3.0 * DEG_PER_H, 10.0 * DEG_PER_H),
        tau_s=shape("s", 420.0, 1700.0),
    )
    drivers = ("time_since_power_on",)
    excitation = "a power-on of three time constants or more, and a second one at another ambient temperature"
    source = "PHYSICS.md E1 [K]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return p.amplitude_dps * np.exp(-truth.t_s / p.tau_s)
