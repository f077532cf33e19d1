"""From a scene and planted effects to the recording that the tool sees, and the waveform of every effect in it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tools.blind.effect import STAGES, Parameters, Planted
from tools.blind.frames import COUNTER, FAULTS, Columns
from tools.blind.optics import gain_error
from tools.blind.scenes import Scene


@dataclass(frozen=True)
class Chain:
    """What one recording has besides the effects.

    Attributes:
        seed: of all noises.
        offset_dps, scale_ppm: the recording's own nuisance.
        lsb: rate resolution in units of the white noise (0: none).
        temp_lsb_K, temp_noise_K: of the reported temperature.
        law: optical gain law that the simulation has as well (then the recording gets sim_rate_dps), or None.
        share: how much of that law the gyro has.
        coil_sensor: whether a second sensor reports the coil.
    """

    seed: int
    offset_dps: float
    scale_ppm: float
    lsb: float
    temp_lsb_K: float
    temp_noise_K: float
    law: Parameters | None = None
    share: float = 0.0
    coil_sensor: bool = False


def _modelled(scene: Scene, chain: Chain) -> np.ndarray:
    """What the simulation predicts [°/s]: an ideal gyro, or one with the known gain law."""
    gain = 0.0 if chain.law is None else chain.share * gain_error(scene.temp_degC, chain.law)
    return scene.omega_dps * (1 + gain)


def measure(
    scene: Scene, planted: Sequence[Planted], chain: Chain, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Measured rate and the gyro's part of the reference error [°/s], both shape (n,)."""
    rate = _modelled(scene, chain)
    reference = scene.omega_dps
    by_stage = {stage: [p for p in planted if p.effect.stage == stage] for stage in STAGES}
    for stage in ("motion", "optics", "electronics"):
        for plant in by_stage[stage]:
            rate = _apply(plant, rate, scene)
    rate = rate * (1 + 1e-6 * chain.scale_ppm) + chain.offset_dps + noise
    for plant in by_stage["code"]:
        rate = _apply(plant, rate, scene)
    for plant in by_stage["reference"]:
        reference = _apply(plant, reference, scene)
    return rate, reference


def _apply(plant: Planted, signal: np.ndarray, scene: Scene) -> np.ndarray:
    if plant.effect.apply is None:
        raise ValueError(f"{plant.id} acts on frames, not on a signal")
    return plant.effect.apply(signal, scene, plant.parameters)


def waveforms(
    scene: Scene, planted: Sequence[Planted], chain: Chain, noise: np.ndarray
) -> dict[str, np.ndarray]:
    """Error of the gyro against its reference with each effect minus the error without it, {id: shape (n,)}."""
    whole = np.subtract(*measure(scene, planted, chain, noise))
    found = {}
    for plant in planted:
        if plant.effect.stage != "frames":
            rest = [p for p in planted if p is not plant]
            found[plant.id] = whole - np.subtract(*measure(scene, rest, chain, noise))
    return found


def noises(scene: Scene, chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Noise of the gyro and of its reference [°/s], independent of each other, both shape (n,)."""
    n = len(scene.t_s)
    own = scene.gyro_noise.sample(n, np.random.default_rng([chain.seed, 1]))
    return own, np.random.default_rng([chain.seed, 2]).normal(0, scene.reference_dps, n)


def record(
    scene: Scene, planted: Sequence[Planted], chain: Chain, noise: tuple[np.ndarray, np.ndarray]
) -> Columns:
    """The finished columns of one recording, by the names of a table."""
    rate, reference = measure(scene, planted, chain, noise[0])
    rng = np.random.default_rng([chain.seed, 3])
    columns = {} if not scene.timed else {"t_s": np.round(scene.t_s, 6)}
    if chain.lsb:
        step = chain.lsb * scene.gyro_noise.white_dps
        rate = np.round(rate / step) * step
    temp = scene.temp_degC + rng.normal(0, chain.temp_noise_K, len(rate))
    columns |= {
        "rate_dps": np.round(rate, 8),
        "temp_degC": np.round(np.round(temp / chain.temp_lsb_K) * chain.temp_lsb_K, 4),
        "ref_rate_dps": np.round(reference + noise[1], 8),
    }
    if chain.law is not None:
        columns["sim_rate_dps"] = np.round(_modelled(scene, chain), 8)
    if scene.timed:
        columns |= _vehicle(scene, rng)
        columns["counter"] = np.mod(np.arange(len(rate)), COUNTER)
    if chain.coil_sensor:
        columns["coil_temp_degC"] = np.round(_coil(scene, planted) + rng.normal(0, 0.02, len(rate)), 3)
    for plant in planted:
        if plant.effect.stage == "frames":
            columns = FAULTS[plant.id](columns, plant.parameters)
    return columns


def _coil(scene: Scene, planted: Sequence[Planted]) -> np.ndarray:
    winding = next((p.parameters for p in planted if "thickness_m" in p.parameters), None)
    key = (
        (0.008, 1.5e-7, 0.2)
        if winding is None
        else tuple(winding[k] for k in ("thickness_m", "kappa_m2ps", "hub"))
    )
    return scene.sampled(scene.coil(*key).mean_degC)


def _vehicle(scene: Scene, rng: np.random.Generator) -> Columns:
    """Heading, speed, lateral acceleration and vibration as a vehicle or table reports them."""
    n, columns = len(scene.t_s), {}
    if scene.heading_deg is not None:
        columns["heading_deg"] = np.round(np.mod(scene.heading_deg + rng.normal(0, 0.05, n), 360), 3)
    road = scene.road()
    if road.speed is not None and road.accel_lat is not None:
        speed = np.interp(scene.t_s, road.grid_s, road.speed)
        columns["speed_mps"] = np.round(np.maximum(speed * (1 + rng.normal(0, 0.003, n)), 0), 3)
        accel = np.interp(scene.t_s, road.grid_s, road.accel_lat)
        columns["accel_lat_mps2"] = np.round(accel + rng.normal(0, 0.05, n), 4)
    if scene.vibration is not None:
        columns["vibration_rms_mps2"] = np.round(scene.vibration * (1 + rng.normal(0, 0.03, n)), 4)
    return columns
