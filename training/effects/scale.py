"""Errors of the scale factor, all multiplied by the rate: PHYSICS.md B1–B6, E2, F2, D7."""

from types import SimpleNamespace

import numpy as np

from training.effects.base import ErrorEffect, amplitude, parameters, shape
from training.effects.truth import Truth
from training.effects.units import PPM

DAY_S = 86400.0


class ScaleTemperature(ErrorEffect):
    """The source's mean wavelength, the coil's size and an open loop's gain move with temperature."""

    id = "scale_temperature"
    title = "Scale factor versus temperature"
    section = "B1"
    equation = "e = ω·10⁻⁶·(s1·h + s2·h² + s3·h³)"
    parameters = parameters(
        s1_ppm_per_K=amplitude("ppm/K", -1263.0, -3000.0),
        s2_ppm_per_K2=amplitude("ppm/K²", 1.8, 5.0, default=0.0),
        s3_ppm_per_K3=amplitude("ppm/K³", 0.0, 0.01, default=0.0),
    )
    drivers = ("rate_times_temperature",)
    excitation = "|rate| of 20 °/s or more at four or more temperatures, one of them met again later"
    source = "PHYSICS.md B1, §4.2 [D]; S10"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        h = truth.h_K
        return truth.rate_dps * PPM * h * (p.s1_ppm_per_K + h * (p.s2_ppm_per_K2 + h * p.s3_ppm_per_K3))


class ScaleNonlinearity(ErrorEffect):
    """An open loop measures the sine of the Sagnac phase, a closed loop is limited by its 2π reset."""

    id = "scale_nonlinearity"
    title = "Scale-factor nonlinearity with rate"
    section = "B2"
    equation = "e = c3·ω³ + c5·ω⁵ + c3h·h·ω³; open loop c3 = −K²/6, c5 = +K⁴/120 with K·ω in radians"
    parameters = parameters(
        c3_per_dps2=amplitude("1/dps²", 2.5e-8, -1.674e-6),
        c5_per_dps4=amplitude("1/dps⁴", 0.0, 8.08e-13, default=0.0),
        c3h_per_dps2_per_K=amplitude("1/(dps²·K)", 0.0, 3.27e-9, default=0.0),
    )
    drivers = ("rate", "rate_times_temperature")
    excitation = "five or more levels of |rate|, up to half the range or beyond"
    source = "PHYSICS.md B2 [D], S2, S11; series of sin(K·ω)/K"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        w = truth.rate_dps
        return w**3 * (p.c3_per_dps2 + p.c5_per_dps4 * w**2 + p.c3h_per_dps2_per_K * truth.h_K)


class ScaleHysteresis(ErrorEffect):
    """Parts heated unevenly strain the coil, and the strain remembers which way the temperature came."""

    id = "scale_hysteresis"
    title = "Thermal hysteresis of the scale factor"
    section = "B3"
    equation = "e = ω·10⁻⁶·c·(p − T), p = min(max(p, T − r), T + r)"
    parameters = parameters(
        play_K=shape("K", 4.0, 4.0), c_ppm_per_K=amplitude("ppm/K", 150.0 / 8.0, 800.0 / 8.0)
    )
    drivers = ("rate_times_temperature", "rate_times_temperature_rate")
    excitation = (
        "constant 60…100 °/s over a closed temperature loop at two speeds, with holds and an inner reversal"
    )
    source = "PHYSICS.md B3 [S6]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return truth.rate_dps * PPM * p.c_ppm_per_K * truth.play_offset(p.play_K)


class ScaleTemperatureRate(ErrorEffect):
    """The radial gradient of a changing temperature strains the coil and heats source and coil unequally."""

    id = "scale_temperature_rate"
    title = "Scale factor versus temperature rate"
    section = "B4"
    equation = "e = ω·10⁻⁶·c·LP_τ(dT/dt)"
    parameters = parameters(
        tau_s=shape("s", 150.0, 300.0), c_ppm_s_per_K=amplitude("ppm·s/K", 100.0 * 60.0, 300.0 * 60.0)
    )
    drivers = ("rate_times_temperature_rate",)
    excitation = (
        "constant 60…100 °/s, temperature pulses faster than the coil's time constant, or a coil sensor"
    )
    source = "PHYSICS.md B4 [E]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return truth.rate_dps * PPM * p.c_ppm_s_per_K * truth.lagged_temp_rate(p.tau_s)


class ScaleAsymmetry(ErrorEffect):
    """Demodulator offset times nonlinearity, or unequal converter halves, give + and − different gains."""

    id = "scale_asymmetry"
    title = "Scale-factor asymmetry"
    section = "B5"
    equation = "e = 10⁻⁶·c·|ω|"
    parameters = parameters(c_ppm=amplitude("ppm", 50.0, 500.0))
    drivers = ("rate",)
    excitation = "both signs of rate at the same speed, alternating"
    source = "PHYSICS.md B5 [K]; IEEE Std 952"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return PPM * p.c_ppm * np.abs(truth.rate_dps)


class SourceAgeing(ErrorEffect):
    """The source's wavelength and power age, and the scale factor follows."""

    id = "source_ageing"
    title = "Source ageing, slow drift of the scale factor"
    section = "B6"
    equation = "e = ω·10⁻⁶·(c·t + r·√t + l·ln(1 + t/τ))"
    parameters = parameters(
        c_ppm_per_s=amplitude("ppm/s", 32.0 / (12.0 * DAY_S), 1e5 / (365.25 * DAY_S), default=0.0),
        c_ppm_per_sqrt_s=amplitude("ppm/√s", 0.0, 0.0, default=0.0),
        c_ppm_per_ln=amplitude("ppm", 0.0, 0.0, default=0.0),
        ln_tau_s=shape("s", 600.0, 600.0, default=600.0),
    )
    drivers = ("rate_times_time",)
    excitation = "recordings weeks apart at the same temperature and rates"
    source = "PHYSICS.md B6 [S13]: 32 ppm in 12 days; hard: 10 % of power in a year, not normalised"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        late = np.maximum(truth.t_s, 0.0)
        aged = p.c_ppm_per_s * late + p.c_ppm_per_sqrt_s * np.sqrt(late)
        return truth.rate_dps * PPM * (aged + p.c_ppm_per_ln * np.log1p(late / p.ln_tau_s))


class ScaleWarmup(ErrorEffect):
    """Electronics and source heat themselves 5…15 K above ambient and the gain settles with them."""

    id = "scale_warmup"
    title = "Scale-factor warm-up"
    section = "E2"
    equation = "e = ω·10⁻⁶·A·exp(−t/τ), t since power-on"
    parameters = parameters(amplitude_ppm=amplitude("ppm", 2000.0, 15000.0), tau_s=shape("s", 420.0, 1700.0))
    drivers = ("rate_times_time", "time_since_power_on")
    excitation = "turning during a power-on, and during a second one at another ambient temperature"
    source = "PHYSICS.md E2 [K]"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return truth.rate_dps * PPM * p.amplitude_ppm * np.exp(-truth.t_s / p.tau_s)


class ScaleStep(ErrorEffect):
    """A supply, heater or gain range changes and the scale factor with it."""

    id = "scale_step"
    title = "Step of the scale factor"
    section = "F2"
    equation = "e = ω·10⁻⁶·A for t ≥ t0"
    parameters = parameters(step_ppm=amplitude("ppm", 500.0, 5000.0), t0_s=shape("s", 1800.0, 1800.0))
    drivers = ("rate_times_time",)
    excitation = "turning before and after the step, supply and heater state noted"
    source = "PHYSICS.md F2, C6"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return truth.rate_dps * PPM * p.step_ppm * (truth.t_s >= p.t0_s)


class ScaleError(ErrorEffect):
    """The simulation's scale factor is simply wrong."""

    id = "scale_error"
    title = "Wrong scale factor"
    section = "D7"
    equation = "e = ω·10⁻⁶·c"
    parameters = parameters(ppm=amplitude("ppm", 1000.0, 10000.0))
    drivers = ("rate",)
    excitation = "rates of 20 °/s or more against a second reference"
    source = "definition of the scale factor, IEEE Std 952"

    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray:
        return truth.rate_dps * PPM * p.ppm
