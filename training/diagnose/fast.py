"""What only full-rate samples show: variance that follows the motion, spectral lines, least significant bits.

None of these needs to know the slow physics: they look at differences of neighbouring residuals, at the periodogram
against its own neighbourhood, and at the codes themselves.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage, optimize, stats

from training.diagnose.work import FloatArray

BLOCKS = 1500
MIN_IN_BLOCK = 8
VARIANCE_Z = 6.0
VARIANCE_SHARE = 0.01
TOP_SHARES = (0.02, 0.1)
RANK_P = 1e-3  # that a few wild blocks are not all there is to it
LINE_LOG_P = -16.0
WEIGHT_GAIN = 20.0
LSB_TO_NOISE = 2.5
BESIDE = 0.06  # of a step
KNOWN_TO = 6.0  # standard errors of a variance, between the reference's noise and what the residual has of it


@dataclass
class FastFinding:
    """One effect seen at full rate."""

    effect: str
    parameters: dict[str, tuple[float, float, str]]
    rms_dps: float
    p_value: float
    alternatives: dict[str, float]
    text: str


@dataclass
class VarianceModel:
    """How the white noise's variance follows the motion: v ∝ 1 + rate·ω² + slope·(dω/dt)²; and what that is called."""

    rate: float = 0.0
    slope: float = 0.0
    finding: FastFinding | None = None

    def spread(self, rate: FloatArray, t: FloatArray) -> FloatArray:
        """Relative standard deviation of the noise per sample, mean square one."""
        variance = 1.0 + self.rate * rate**2 + self.slope * np.gradient(rate, t) ** 2
        return np.sqrt(variance / np.mean(variance))


def variance_model(residual: FloatArray, rate: FloatArray, t: FloatArray, valid: np.ndarray) -> VarianceModel:
    """Multiplicative noise (variance ∝ ω²) and timing jitter (∝ (dω/dt)²) from second differences of the residual."""
    if np.ptp(rate) < 1.0 or len(rate) < 500:
        return VarianceModel()
    second = np.zeros(len(residual) - 2)
    second[:] = (residual[2:] - 2.0 * residual[1:-1] + residual[:-2]) / np.sqrt(6.0)
    good = valid[2:] & valid[1:-1] & valid[:-2]
    size = max(MIN_IN_BLOCK, len(second) // BLOCKS)
    slope = np.gradient(rate, t)
    labels = np.arange(len(second)) // size
    count = np.bincount(labels, weights=good)
    keep = count >= 0.7 * size

    def mean(values: FloatArray) -> FloatArray:
        return (np.bincount(labels, weights=np.where(good, values, 0.0)) / np.maximum(count, 1.0))[keep]

    power = mean(second**2)
    drivers = {"multiplicative_noise": mean(rate[1:-1] ** 2), "timing_jitter": mean(slope[1:-1] ** 2)}
    if keep.sum() < 60 or not np.any(power > 0.0):
        return VarianceModel()
    return _variance_fit(power, drivers, 0.35 * size)


def _variance_fit(power: FloatArray, drivers: dict[str, FloatArray], dof: float) -> VarianceModel:
    none = _gamma_fit(power, [], dof)
    fits = {name: _gamma_fit(power, [column], dof) for name, column in drivers.items()}
    both = _gamma_fit(power, list(drivers.values()), dof)
    best = min(drivers, key=lambda name: fits[name][1])
    gain = (none[1] - fits[best][1]) / max(1.0, fits[best][2])
    share = fits[best][0][1] * float(np.mean(drivers[best])) / max(float(np.mean(power)), 1e-300)
    rank = _rank_p(power, drivers[best])
    if gain < WEIGHT_GAIN or share < VARIANCE_SHARE or rank > 0.5 or both[0][0] <= 0.0:
        return VarianceModel()
    model = VarianceModel(float(both[0][1] / both[0][0]), float(both[0][2] / both[0][0]))
    if gain < VARIANCE_Z**2 or rank > RANK_P:
        return model
    other = next(name for name in drivers if name != best)
    cost = (fits[other][1] - fits[best][1]) / max(1.0, fits[best][2])
    value = float(np.sqrt(max(fits[best][0][1], 0.0)))
    unit, scale, key = ("ppm", 1e6, "sigma_ppm") if best == "multiplicative_noise" else ("s", 1.0, "sigma_s")
    error = 0.5 * value / np.sqrt(max(gain, 1.0))
    model.finding = FastFinding(
        best,
        {key: (value * scale, float(error) * scale, unit)},
        float(np.sqrt(share * np.mean(power))),
        rank,
        {other: cost} if cost < 10.0 else {},
        "the variance of the residual follows the motion",
    )
    return model


def _rank_p(power: FloatArray, driver: FloatArray) -> float:
    """How often ranks alone would rise so with the driver: over all blocks, or in those where it is largest."""
    overall: Any = stats.spearmanr(power, driver, alternative="greater")
    found = [float(overall.pvalue)]
    for share in TOP_SHARES:
        top = driver >= np.quantile(driver, 1.0 - share)
        if 8 <= top.sum() < len(driver):
            test: Any = stats.mannwhitneyu(power[top], power[~top], alternative="greater")
            found.append(float(test.pvalue))
    return min(1.0, len(found) * min(found))


def _gamma_fit(power: FloatArray, columns: list[FloatArray], dof: float) -> tuple[FloatArray, float, float]:
    """Non-negative fit of mean powers under the gamma law: (weights, deviance, dispersion)."""
    design = np.stack([np.ones(len(power)), *columns], axis=1)
    size = design.mean(axis=0)
    scaled, level = design / size, float(np.mean(power))
    expected = np.full(len(power), level)
    weights = np.zeros(design.shape[1])
    for _ in range(12):
        weights = optimize.nnls(scaled / expected[:, None], power / expected)[0]
        expected = np.maximum(scaled @ weights, 1e-3 * level)
    ratio = np.maximum(power / expected, 1e-12)
    deviance = 2.0 * dof * float(np.sum(ratio - 1.0 - np.log(ratio)))
    return weights / size, deviance, deviance / max(len(power) - len(weights), 1)


def line_finding(
    residual: FloatArray, rate: FloatArray, t: FloatArray, valid: np.ndarray
) -> FastFinding | None:
    """The strongest spectral line of the residual that the motion does not have (supply ripple, aliased or not)."""
    if len(residual) < 2000:
        return None
    step = float(np.median(np.diff(t)))
    flat = np.where(valid, residual - ndimage.uniform_filter1d(residual, min(201, len(residual) // 4)), 0.0)
    window = np.hanning(len(flat))
    power = np.abs(np.fft.rfft(flat * window)) ** 2
    frequency = np.fft.rfftfreq(len(flat), step)
    background = _background(power)
    low = np.searchsorted(frequency, 0.02 / step)
    ratio = power / background
    ratio[:low] = 0.0
    top = int(np.argmax(ratio))
    log_p = float(np.log(len(ratio)) - 0.5 * ratio[top] / 0.7)
    motion = np.abs(np.fft.rfft((rate - rate.mean()) * window)) ** 2
    shared = (
        motion[top] / max(float(np.median(motion[max(0, top - 200) : top + 200])), 1e-300)
        if np.ptp(rate) > 0
        else 0.0
    )
    if log_p > LINE_LOG_P or shared > 30.0:
        return None
    band = slice(max(low, top - 3), top + 4)
    excess = float(np.sum(power[band] - background[band]))
    amplitude = float(np.sqrt(max(excess, 0.0) * 2.0 / (0.375 * len(flat) ** 2)) * np.sqrt(2.0))
    error = amplitude / np.sqrt(max(ratio[top], 1.0))
    resolution = 0.5 / (len(flat) * step)
    return FastFinding(
        "supply_ripple",
        {
            "frequency_Hz": (float(frequency[top]), resolution, "Hz"),
            "amplitude_dps": (amplitude, error, "dps"),
        },
        amplitude / np.sqrt(2.0),
        float(np.exp(max(log_p, -600.0))),
        {},
        f"a line at {frequency[top]:.4g} Hz",
    )


def _background(power: FloatArray) -> FloatArray:
    """Local mean level from medians over neighbourhoods, robust against lines."""
    size = max(31, len(power) // 200)
    blocks = len(power) // size
    level = np.median(power[: blocks * size].reshape(blocks, size), axis=1) / np.log(2.0)
    return np.interp(np.arange(len(power)), (np.arange(blocks) + 0.5) * size, np.maximum(level, 1e-300))


def _staircase(codes: FloatArray) -> float | None:
    """The step of rising codes [dps] that are multiples of one; None if they are not.

    Stored with fewer digits, or on a finer grid of its own, a code lies a little beside its multiple.
    """
    steps = np.diff(codes)
    least = float(np.min(steps[steps > 1e-9 * max(np.max(np.abs(codes)), 1.0)], initial=np.inf))
    if not np.isfinite(least):
        return None
    step = float(np.mean(steps[steps < 1.5 * least]))
    for reach in (
        20.0,
        400.0,
    ):  # wider gaps tell the step more exactly, once it is known well enough to count them
        near = steps[steps < reach * step]
        step = float(np.sum(near) / np.sum(np.rint(near / step)))
    multiples = np.concatenate([[0.0], np.cumsum(np.rint(steps / step))])
    lsb, _ = np.polyfit(multiples, codes, 1)
    beside = (codes - codes[0]) / lsb - multiples
    beside -= np.median(beside)
    return float(lsb) if np.mean(np.abs(beside) < BESIDE) > 0.98 else None


def quantization_finding(
    rate: FloatArray, residual: FloatArray, valid: np.ndarray, reference_dps: float = 0.0
) -> FastFinding | None:
    """A least significant bit so coarse that the error is a staircase of the rate instead of noise.

    `reference_dps` is the reference's own noise, which the residual has beside the gyro's.
    """
    codes = np.unique(rate[valid])
    if len(codes) < 3 or len(codes) > 0.2 * valid.sum():
        return None
    lsb = _staircase(codes)
    if lsb is None:
        return None
    differences = np.diff(residual[valid])
    spread = 1.4826 * float(np.median(np.abs(differences - np.median(differences)))) / np.sqrt(2.0)
    total = float(np.std(differences)) / np.sqrt(2.0)
    surely = reference_dps**2 * (1.0 - KNOWN_TO / np.sqrt(len(differences)))  # a noise is known from samples
    spread, total = (float(np.sqrt(max(v * v - surely, 0.0))) for v in (spread, total))
    expected = lsb / np.sqrt(12.0)
    other = float(np.sqrt(max(total**2 - expected**2, 0.0)))
    if expected < 0.8 * min(total, max(spread, expected)) or other > lsb / LSB_TO_NOISE:
        return None
    return FastFinding(
        "quantization",
        {"lsb_dps": (lsb, 1e-3 * lsb, "dps")},
        expected,
        1e-12,
        {},
        f"the rate moves in steps of {lsb:.6g} °/s, coarser than its noise",
    )
