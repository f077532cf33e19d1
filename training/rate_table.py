"""The paper's rate-table experiment on the reference gyro (PHYSICS.md §4.2). Simulated, and always called so.

The surface m(T, ω) is the simulator's; error e = m − ω. One soak shares one scale-factor deviation; a point is the
mean of its samples.
"""

from dataclasses import dataclass, field

import numpy as np

from training.simulator.gyro import surface_output
from training.simulator.scenario import Surface

ARW_DPS_PER_RTHZ = 0.05 / 60.0  # angle random walk of 0.05 °/√h


@dataclass(frozen=True)
class ReferenceGyro:
    """Coefficients of PHYSICS.md §4.2 and §4.4."""

    surface: Surface = field(default_factory=Surface)
    bias_dps: float = 10 / 3600
    bias_dps_per_K: float = 0.1 / 3600
    coil_lag_s: float = 280.0
    soak_scale: float = 280e-6  # 1σ, common to all rates of one soak
    read_noise_dps: float = 0.006  # 1σ of one averaged point
    lsb_dps: float = 0.001

    def measured_dps(self, temp_degC: np.ndarray, rate_dps: np.ndarray) -> np.ndarray:
        """What a noiseless gyro shows at true rate `rate_dps` [°/s] with its coil at `temp_degC`."""
        shown = surface_output(self.surface, rate_dps, temp_degC)
        return shown + self.bias_dps + self.bias_dps_per_K * (temp_degC - self.surface.ref_degC)

    def error_dps(self, temp_degC: np.ndarray, measured_dps: np.ndarray) -> np.ndarray:
        """The true error surface e(T, m) [°/s] over the measured rate: what an oracle would subtract."""
        p = self.surface
        h = temp_degC - p.ref_degC
        K = p.K0_s * (1 + p.alpha_per_K * h)
        G = 1 + p.g0 + p.g1_per_K * h + p.g2_per_K2 * h**2
        optical = np.radians(measured_dps - self.bias_dps - self.bias_dps_per_K * h)
        return measured_dps - np.degrees(np.arcsin(np.clip(optical * p.K0_s / G, -1, 1)) / K)


@dataclass(frozen=True)
class Protocol:
    """The paper's table: 18 soaks of 36 rates = 648 points (PHYSICS.md says which are left out), 448 to train."""

    temps_degC: tuple[float, ...] = tuple(range(-30, 60, 5))
    rates_dps: tuple[float, ...] = tuple(rate for rate in range(-180, 190, 10) if rate)
    soak_s: float = 7200.0
    samples: int = 1000
    period_s: float = 0.6
    training: int = 448


@dataclass(frozen=True)
class RateTable:
    """One simulated experiment; arrays of shape `(points,)` in the order of measurement."""

    temp_degC: np.ndarray
    rate_dps: np.ndarray  # measured, mean of the samples
    true_dps: np.ndarray
    soak: np.ndarray  # index of the soak
    seed: int
    gyro: ReferenceGyro
    protocol: Protocol

    @property
    def error_dps(self) -> np.ndarray:
        """Gyro output error y = measured − true [°/s]."""
        return self.rate_dps - self.true_dps


def simulate(seed: int, gyro: ReferenceGyro | None = None, protocol: Protocol | None = None) -> RateTable:
    """Run the simulated experiment once."""
    gyro, protocol = gyro or ReferenceGyro(), protocol or Protocol()
    return average(simulate_samples(seed, gyro, protocol), seed, gyro, protocol)


def average(readings: np.ndarray, seed: int, gyro: ReferenceGyro, protocol: Protocol) -> RateTable:
    """The table of one experiment from its samples, shape `(points, samples)`."""
    temps, rates = np.array(protocol.temps_degC, float), np.array(protocol.rates_dps, float)
    return RateTable(
        temp_degC=np.repeat(temps, len(rates)),
        rate_dps=readings.mean(axis=1),
        true_dps=np.tile(rates, len(temps)),
        soak=np.repeat(np.arange(len(temps)), len(rates)),
        seed=seed,
        gyro=gyro,
        protocol=protocol,
    )


def simulate_samples(seed: int, gyro: ReferenceGyro, protocol: Protocol) -> np.ndarray:
    """All samples [°/s], shape `(points, samples)`, each rounded to the gyro's LSB."""
    rng = np.random.default_rng(seed)
    temps, rates = np.array(protocol.temps_degC, float), np.array(protocol.rates_dps, float)
    coil = coil_temperatures(temps, gyro, protocol)
    scale = 1 + gyro.soak_scale * rng.standard_normal(len(temps))
    shown = (gyro.measured_dps(coil[:, None], rates) + (scale[:, None] - 1) * rates).ravel()
    shown = shown + gyro.read_noise_dps * rng.standard_normal(shown.size)
    white = rng.standard_normal((shown.size, protocol.samples)) * (
        ARW_DPS_PER_RTHZ / np.sqrt(protocol.period_s)
    )
    white += shown[:, None]
    white /= gyro.lsb_dps
    np.rint(white, out=white)
    white *= gyro.lsb_dps
    return white


def coil_temperatures(temps: np.ndarray, gyro: ReferenceGyro, protocol: Protocol) -> np.ndarray:
    """Coil temperature at the end of each soak [°C]: what is left of the step decays with the coil's lag."""
    before = np.concatenate([[gyro.surface.ref_degC], temps[:-1]])
    return temps + (before - temps) * np.exp(-protocol.soak_s / gyro.coil_lag_s)


def split_points(table: RateTable) -> np.ndarray:
    """The paper's split: a mask of `protocol.training` points drawn at random (seeded by the table)."""
    chosen = np.random.default_rng([table.seed, 1]).permutation(len(table.soak))[: table.protocol.training]
    mask = np.zeros(len(table.soak), bool)
    mask[chosen] = True
    return mask


def split_soaks(table: RateTable) -> np.ndarray:
    """Whole soaks to training, as near to `protocol.training` points as whole soaks come."""
    soaks = np.unique(table.soak)
    count = round(table.protocol.training / len(table.protocol.rates_dps))
    chosen = np.random.default_rng([table.seed, 2]).permutation(soaks)[:count]
    return np.isin(table.soak, chosen)


def split_inside(table: RateTable, temp_degC: tuple[float, float], rate_dps: float) -> np.ndarray:
    """Points within a temperature range and |true rate|: training inside, testing outside shows extrapolation."""
    warm = (table.temp_degC >= temp_degC[0]) & (table.temp_degC <= temp_degC[1])
    return warm & (np.abs(table.true_dps) <= rate_dps)
