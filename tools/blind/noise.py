"""Gyro noise that is not 1/f: relaxation processes and telegraph traps over white noise and a random walk.

The spectrum of every part is known exactly, so the noise can be whitened without estimating anything:
the orthonormal cosine transform diagonalises it (λ = spectral density at the bin; the mean has weight zero).
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct
from scipy.signal import lfilter

EMPTY = 1e-6
"""Norm of a whitened constant is round-off, 1e-9; that of anything real is far above 1."""


@dataclass(frozen=True)
class NoiseModel:
    """White std per sample [°/s], random walk per √s [°/s], and relaxations (variance [(°/s)²], time [s], trap)."""

    dt_s: float
    white_dps: float
    walk_dps_per_rs: float
    relaxations: tuple[tuple[float, float, bool], ...]

    def spectrum(self, n: int) -> np.ndarray:
        """Variances of the n cosine-transform coefficients, shape (n,); the first (the mean) is infinite."""
        cosine = np.cos(np.pi * np.arange(n) / n)
        total = np.full(n, self.white_dps**2)
        for variance, tau, _ in self.relaxations:
            phi = np.exp(-self.dt_s / tau)
            total += variance * (1 - phi**2) / (1 - 2 * phi * cosine + phi**2)
        total[1:] += self.walk_dps_per_rs**2 * self.dt_s / (2 - 2 * cosine[1:])
        total[0] = np.inf
        return total

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Columns, shape (n, k) or (n,), in the basis where the noise is white with unit variance."""
        spread = np.sqrt(self.spectrum(len(columns)))
        transformed = np.asarray(dct(columns, axis=0, norm="ortho"))
        return transformed / (spread if columns.ndim == 1 else spread[:, None])

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """One realisation [°/s], shape (n,)."""
        out = rng.normal(0, self.white_dps, n)
        out += np.cumsum(rng.normal(0, self.walk_dps_per_rs * np.sqrt(self.dt_s), n))
        for variance, tau, trap in self.relaxations:
            out += (
                _telegraph(n, self.dt_s, variance, tau, rng)
                if trap
                else _relax(n, self.dt_s, variance, tau, rng)
            )
        return out


def _relax(n: int, dt_s: float, variance: float, tau_s: float, rng: np.random.Generator) -> np.ndarray:
    phi = np.exp(-dt_s / tau_s)
    drive = rng.normal(0, np.sqrt(variance * (1 - phi**2)), n)
    drive[0] = rng.normal(0, np.sqrt(variance))
    return np.asarray(lfilter([1.0], [1.0, -phi], drive))


def _telegraph(n: int, dt_s: float, variance: float, tau_s: float, rng: np.random.Generator) -> np.ndarray:
    flips = rng.random(n) < (1 - np.exp(-dt_s / tau_s)) / 2
    return np.sqrt(variance) * rng.choice([-1.0, 1.0]) * np.where(np.cumsum(flips) % 2, -1.0, 1.0)


@dataclass(frozen=True)
class SoakNoise:
    """Noise of averaged rate-table points: white readings and a scale factor that scatters from soak to soak."""

    white_dps: float
    soak_ppm: float
    rate_dps: np.ndarray
    soak: np.ndarray

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Columns, shape (n, k) or (n,), whitened by the Cholesky factor of the block covariance."""
        same = self.soak[:, None] == self.soak[None, :]
        rate = 1e-6 * self.soak_ppm * self.rate_dps
        covariance = np.diag(np.full(len(rate), self.white_dps**2)) + same * np.outer(rate, rate)
        return np.linalg.solve(np.linalg.cholesky(covariance), columns)

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """One realisation [°/s], shape (n,)."""
        scatter = rng.normal(0, self.soak_ppm * 1e-6, int(self.soak.max()) + 1)
        return rng.normal(0, self.white_dps, n) + scatter[self.soak] * self.rate_dps


Noise = NoiseModel | SoakNoise


def draw_noise(rng: np.random.Generator, dt_s: float, grade: float) -> NoiseModel:
    """A gyro of `grade` (1: N 0.05 °/√h, B 0.5 °/h, R 1 °/h/√h), each figure off by up to ±30 %."""
    n, b, r = (nominal * grade * rng.uniform(0.7, 1.3) for nominal in (0.05, 0.5, 1.0))
    taus = np.exp(np.arange(np.log(0.5), np.log(6000), 1.0) + rng.uniform(-0.4, 0.4))
    shares = rng.lognormal(0, 0.4, len(taus)) * (b / 3600) ** 2 / np.pi
    traps = rng.random(len(taus)) < 0.3
    white = float(n / 60 / np.sqrt(dt_s))
    relaxations = tuple((float(v), float(t), bool(k)) for v, t, k in zip(shares, taus, traps, strict=True))
    return NoiseModel(dt_s, white, r / 216000, relaxations)


def basis(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the span of columns, shape (n, m); columns that whitening has emptied are left out."""
    scale = np.linalg.norm(columns, axis=0)
    return np.linalg.qr(columns[:, scale > EMPTY] / scale[scale > EMPTY])[0]


def dprime(noise: Noise, waveform: np.ndarray, nuisance: np.ndarray) -> float:
    """Matched-filter SNR √(x'Σ⁻¹x) of a waveform after the nuisance columns, shape (n, m), are projected out."""
    q, whitened = basis(noise.whiten(nuisance)), noise.whiten(waveform)
    return float(np.linalg.norm(whitened - q @ (q.T @ whitened)))


def dprime_variance(extra: np.ndarray, base_variance: float) -> float:
    """√(2 KL) of added variance `extra`, shape (n,): for a shift of the mean the same formula is the usual d′."""
    ratio = 1 + extra / base_variance
    return float(np.sqrt(np.sum(ratio - 1 - np.log(ratio))))
