"""True motion and temperatures of a scenario, and what the temperature sensors make of the latter."""

import numpy as np

from rtcomp.errors import RequestError
from training.effects.dynamics import lowpass
from training.effects.truth import Truth
from training.simulator.draw import Draw
from training.simulator.motion import Replay
from training.simulator.scenario import Environment, Scenario, TemperatureSensor


def housing_temperature(t_s: np.ndarray, environment: Environment) -> np.ndarray:
    """Return the housing temperature [°C]: ambient through two equal lags plus self-heating, shape `(n,)`.

    Self-heating: Σ A·(1 − exp(−t/τ)) from power-on at t = 0 (PHYSICS.md §4.4).
    """
    times, ambient = np.array(environment.ambient_degC).T
    tau = environment.housing_tau_s
    housing = lowpass(t_s, lowpass(t_s, np.interp(t_s, times, ambient), tau), tau)
    for amplitude, heating_tau in zip(
        environment.self_heating_K, environment.self_heating_tau_s, strict=True
    ):
        housing -= amplitude * np.expm1(-t_s / heating_tau)
    return housing


def true_course(scenario: Scenario, draw: Draw) -> Truth:
    """Return what happens in a scenario; shape `(duration·rate,)`.

    Raises RequestError for a replay, whose truth comes from its recording (`on_recording.replayed_course`).
    """
    if isinstance(scenario.motion, Replay):
        raise RequestError("motion 'replay' takes its truth from a recording; use run.simulate")
    t = np.arange(round(scenario.duration_s * scenario.rate_hz)) / scenario.rate_hz
    rate, speed = scenario.motion.path(t, draw.of("motion"))
    housing = housing_temperature(t, scenario.environment)
    return Truth(
        t_s=t,
        rate_dps=rate,
        temp_degC=housing,
        coil_temp_degC=coil_temperature(t, housing, scenario),
        heading_deg=turned(t, rate),
        speed_mps=speed,
        accel_lat_mps2=speed * np.radians(rate),
        vibration_rms_mps2=road_vibration(t, speed, draw),
    )


def coil_temperature(t_s: np.ndarray, housing_degC: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Return the coil temperature [°C], the housing's through one or two lags (A3), shape `(n,)`."""
    coil = lowpass(t_s, housing_degC, scenario.gyro.coil_tau_s)
    return lowpass(t_s, coil, scenario.gyro.coil_tau2_s)


def turned(t_s: np.ndarray, rate_dps: np.ndarray) -> np.ndarray:
    """Return the yaw angle [°] since the start (trapezium rule), anticlockwise positive, shape `(n,)`."""
    steps = 0.5 * (rate_dps[1:] + rate_dps[:-1]) * np.diff(t_s)
    return np.concatenate(([0.0], np.cumsum(steps)))


def road_vibration(t_s: np.ndarray, speed_mps: np.ndarray, draw: Draw) -> np.ndarray:
    """Return the sliding rms of vertical acceleration [m/s²], shape `(n,)`.

    Engine 0.15 m/s² plus a part growing with speed and with the roughness of the road, which changes about
    every minute; ISO 8608 roads give some 0.5…2 m/s² at 20 m/s.
    """
    generator = draw.of("road")
    spell = np.minimum(t_s / 60.0, t_s[-1] / 60.0).astype(np.int64)
    roughness = generator.lognormal(np.log(0.04), 0.5, spell[-1] + 1)
    return 0.15 + lowpass(t_s, roughness[spell], 5.0) * speed_mps


def sensed(
    t_s: np.ndarray, temp_degC: np.ndarray, sensor: TemperatureSensor, generator: np.random.Generator
) -> np.ndarray:
    """Return what a temperature sensor reports [°C]: lag, noise, then its LSB; shape `(n,)`."""
    reading = lowpass(t_s, temp_degC, sensor.lag_s)
    reading += sensor.noise_K * generator.standard_normal(t_s.size)
    return np.round(reading / sensor.lsb_K) * sensor.lsb_K if sensor.lsb_K > 0.0 else reading
