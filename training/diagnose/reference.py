"""The true rate as regressors need it: the reference with its own noise taken out, movable in time.

A reference's white noise ν is in the residual as −ν.  A regressor made of the raw reference would find itself there
and name a bandwidth or a dead band that does not exist.  Where the motion is smooth from sample to sample, what the
residual shares with the reference (covariance −σ²) measures ν; a Wiener filter removes what it can of it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, ndimage

from training.diagnose.spectrum import band_edges
from training.diagnose.work import FloatArray, dct, inverse_dct

DIFFERENCES = 4
DIFFERENCE_NORM = np.sqrt(70.0)  # 1² + 4² + 6² + 4² + 1²
WINDOW = 32
QUIET_SHARE = 0.25
QUIET_LIMIT, MOVING = 4.0, 25.0  # times the quiet windows' power
ROUNDS = 5
BARE = 1.3  # power of the reference at a frequency, times its noise, up to which it is taken for noise alone
LARGEST = 4.0
KNOTS, CHUNK = 9, 100_000
STIFF = 20.0
HALF_WIDTHS = (4, 16, 64, 256)  # samples, to average a rate that stands still
STANDING = 8  # of them on either side, by which a standstill is told


@dataclass(frozen=True)
class Reference:
    """The true rate [dps] on the recording's rows, a spline through it, and its white noise [dps].

    `noise_dps` is the deviation per sample as recorded, `left_dps` what the smoothing leaves of it, `gain` the
    smoothing per DCT coefficient; `still` says where it stands still.
    """

    t: FloatArray
    rate: FloatArray
    noise_dps: float
    left_dps: float
    gain: FloatArray
    still: NDArray[np.bool_]
    spline: interpolate.CubicSpline

    def moved(self, t: FloatArray, delay_s: FloatArray | float) -> FloatArray:
        """The rate as a channel that is late by `delay_s` shows it, ω(t − τ)."""
        return self.spline(np.clip(t - delay_s, t[0], t[-1]))

    def slope_to_noise(self) -> float:
        """How steep the rate is beside what the smoothing leaves of its noise's slope; rms over rms."""
        count, step_s = len(self.t), float(np.median(np.diff(self.t)))
        frequency = np.pi * np.arange(count) / (count * step_s)
        noise = self.noise_dps * float(np.sqrt(np.mean((self.gain * frequency) ** 2)))
        slope = float(np.sqrt(np.mean(self.spline(self.t, 1) ** 2)))
        return slope / noise if noise > 0.0 else np.inf


def reference(t: FloatArray, ref: FloatArray, residual: FloatArray) -> Reference:
    """Smooth a reference `(n,)` on times `(n,)` by what the residual `(n,)` says of its noise."""
    noise = _shared_noise(ref, residual)
    rate, gain = _wiener(ref, noise) if noise > 0.0 else (ref, np.ones(len(ref)))
    left = float(np.sqrt(noise * np.mean(gain**2)))
    still = standstills(ref, float(np.sqrt(noise)))
    return Reference(t, rate, float(np.sqrt(noise)), left, gain, still, interpolate.CubicSpline(t, rate))


def unbiased(
    ref: Reference, residual: FloatArray, gain: FloatArray, spread: FloatArray | None = None
) -> Reference:
    """A smoothed reference with the noise that is left in it estimated from the residual `(n,)` and taken out.

    The residual, cleared of what it has of known shapes (`cleared`), is n − ν: gyro noise less reference noise.
    Wiener's estimate of ν from it, filtered by S_ν/S_residual at every frequency, leaves a rate whose error is
    uncorrelated with the residual: regressors made of it, its derivatives too, cannot find the reference's noise in
    the residual.  `gain` `(n,)` is the local gain error s of what was cleared: an error η of the rate comes back in the
    residual as −s·η, so a share k of it must be k·(1 + s·(1 − k)).  `spread` `(n,)` is the residual's relative
    deviation where that follows the motion.  The estimate is bounded, so that a large effect stays.
    """
    if ref.noise_dps <= 0.0:
        return ref
    level = np.ones(len(residual)) if spread is None else spread
    spectrum = dct(residual / level)
    edges = band_edges(len(residual))
    power = np.repeat(np.add.reduceat(spectrum**2, edges[:-1]) / np.diff(edges), np.diff(edges))
    share = np.minimum(ref.noise_dps**2 / np.maximum(power, 1e-300), 1.2)
    bound = LARGEST * ref.noise_dps
    usual = float(np.median(share * ref.gain))
    estimate = inverse_dct(spectrum * share * ref.gain) / level * (1.0 + gain * (1.0 - usual))
    rate = settled(ref.rate + np.clip(estimate, -bound, bound))
    rate = np.where(ref.still, 0.0, rate)
    return replace(ref, rate=rate, spline=interpolate.CubicSpline(ref.t, rate))


def settled(rate: FloatArray) -> FloatArray:
    """The rate `(n,)` averaged wherever it stands still to within its own noise, over as long as it does.

    On a level apart from others any function of the rate may have any slope, and would find there what the rate still
    has of the residual's noise.
    """
    noise = _quiet_power(rate)
    if noise <= 0.0:
        return rate
    level = rate.mean()
    sums = np.concatenate([[0.0], np.cumsum(rate - level)])
    squares = np.concatenate([[0.0], np.cumsum((rate - level) ** 2)])
    index, out = np.arange(len(rate)), rate.copy()
    for half in HALF_WIDTHS:
        low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(rate))
        reach = np.minimum(index - low, high - 1 - index)  # the same on both sides, or a slope would pull
        low, high = index - reach, index + reach + 1
        count = high - low
        mean = (sums[high] - sums[low]) / count
        variance = (squares[high] - squares[low]) / count - mean**2
        still = (reach >= half // 2) & (variance < noise * (1.1 + 4.0 * np.sqrt(2.0 / count)))
        out[still] = mean[still] + level
    return out


def standstills(ref: FloatArray, noise_dps: float) -> NDArray[np.bool_]:
    """Whether a reference `(n,)` is nothing but a level within its error of zero and noise, `(n,)`.

    The smoothed rate keeps the slowest of the noise, which is in the residual with slope one: at a standstill like a
    dead band.  Only of zero is the level known without that noise.
    """
    found = np.zeros(len(ref), bool)
    if noise_dps <= 0.0:
        return found
    size = 2 * STANDING + 1
    mean, square = (ndimage.uniform_filter1d(v, size, mode="nearest") for v in (ref, (ref - ref.mean()) ** 2))
    still = square - (mean - ref.mean()) ** 2 < noise_dps**2 * _spread_of(size)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        level = ref[first:end].mean()
        error = noise_dps / np.sqrt(end - first)
        if (
            end - first < 2 * size
            or abs(level) > 4.0 * error
            or ref[first:end].var() > noise_dps**2 * _spread_of(end - first)
        ):
            continue
        near = np.abs(ref - level)[max(first - STANDING, 0) : end + STANDING] < 3.0 * noise_dps
        part = slice(max(first - STANDING, 0), max(first - STANDING, 0) + len(near))
        kept = np.flatnonzero(~near)
        low = max([int(k) + 1 for k in kept if part.start + k < first], default=0)
        high = min([int(k) for k in kept if part.start + k >= end], default=len(near))
        found[part.start + low : part.start + high] = True
    return found


def _spread_of(count: int) -> float:
    """How much a variance from `count` samples of noise may exceed the noise's."""
    return 1.05 + 3.0 * float(np.sqrt(2.0 / count))


def cleared(
    residual: FloatArray, t: FloatArray, rate: FloatArray, temp: FloatArray | None, valid: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """(residual without what is neither timing nor noise, gain error of what was taken), both `(n,)`.

    By least squares, before anything is named: any function of the rate, a scale factor that changes slowly with time
    or with temperature, and a static bias.  A scale factor drifting by s' per second looks like a delay of
    s'·∫ω²/(2∫ω̇²); a large error over temperature or rate looks like noise where the rate steps.  A delay and its
    drift are fitted along and left in.  The function of the rate may not bend so sharply that, on a level apart from
    others, it follows the reference's noise: its second differences are penalised by that noise.
    """
    if np.ptp(rate) < 0.5:
        return residual, np.zeros(len(residual))
    slope, middle = np.gradient(rate, t), 0.5 * (t[0] + t[-1])
    knots = np.linspace(
        rate.min(), rate.max(), KNOTS
    )  # by rank they would crowd on a level and take its noise away
    times = np.linspace(t[0], t[-1], KNOTS)
    if temp is not None:
        temp = np.where(np.isfinite(temp), temp, np.nanmedian(temp))
    low, span = (0.0, 0.0) if temp is None else (float(np.min(temp)), float(np.ptp(temp)))

    def design(part: slice, more: float = 0.0) -> FloatArray:
        w = (rate[part] + more) / np.max(np.abs(rate))
        columns = [*_hats(rate[part] + more, knots), *(w * hat for hat in _hats(t[part], times))]
        if temp is not None and span > 0.0:
            h = 2.0 * (temp[part] - low) / span - 1.0
            columns += [h, h**2, h**3, *(w * h**k for k in range(1, 6)), w**3 * h]
        kept = [slope[part], slope[part] * (t[part] - middle) / (t[-1] - t[0])]
        return np.stack([*columns, *kept], axis=1)

    parts = [slice(i, i + CHUNK) for i in range(0, len(t), CHUNK)]
    pieces = [(x := design(p)[valid[p]], x.T @ x, x.T @ residual[p][valid[p]])[1:] for p in parts]
    gram, right = (np.sum([piece[i] for piece in pieces], axis=0) for i in (0, 1))
    bend = np.diff(np.eye(KNOTS), 2, axis=0) / (knots[1] - knots[0])
    gram[:KNOTS, :KNOTS] += STIFF * len(t) * _quiet_power(rate) * bend.T @ bend
    weights = np.linalg.lstsq(gram, right, rcond=1e-10)[0]
    weights[-2:] = 0.0
    step = 0.25 * float(knots[1] - knots[0])
    taken, above, below = (
        np.concatenate([design(p, more) @ weights for p in parts]) for more in (0.0, step, -step)
    )
    return residual - taken, (above - below) / (2.0 * step)


def _hats(values: FloatArray, knots: FloatArray) -> list[FloatArray]:
    return [np.interp(values, knots, row) for row in np.eye(len(knots))]


def _quiet_power(rate: FloatArray) -> float:
    """Power of the reference's fourth differences where it is quietest [dps²]: at least its noise."""
    d = np.diff(rate, DIFFERENCES) / DIFFERENCE_NORM
    count = len(d) // WINDOW
    if count < 1:
        return 0.0
    return float(np.quantile(np.mean(d[: count * WINDOW].reshape(count, WINDOW) ** 2, axis=1), QUIET_SHARE))


def _shared_noise(ref: FloatArray, residual: FloatArray) -> float:
    """Variance of white noise per sample that the reference has and the residual mirrors [dps²]; 0 where none shows.

    Fourth differences leave of a smooth motion next to nothing and of white noise everything, in the reference d and
    in the residual e alike: E[d·e] = −σ² + s·(E[d²] − σ²), with s what the residual has of the motion (a scale error, a
    bandwidth).  Windows in which the rate steps or shakes stand out by E[d²]; they give s, the others σ².  The weight
    of a window is taken from its neighbours, because its own power is large where its noise is.
    """
    if np.ptp(ref) == 0.0 or len(ref) < 10 * WINDOW:
        return 0.0
    d, e = (np.diff(values, DIFFERENCES) / DIFFERENCE_NORM for values in (ref, residual))
    count = len(d) // WINDOW
    d, e = (values[: count * WINDOW].reshape(count, WINDOW) for values in (d, e))
    power, shared = np.mean(d * d, axis=1), np.mean(d * e, axis=1)
    floor = float(np.quantile(power, QUIET_SHARE))
    if floor <= 0.0:
        return 0.0
    quiet = power < QUIET_LIMIT * floor
    moving = power > MOVING * floor
    around = np.maximum(np.roll(power, 1), np.roll(power, -1))
    weight = quiet / np.maximum(around, floor)
    power_still, shared_still = (float(np.average(v, weights=weight)) for v in (power, shared))
    variance = max(-shared_still, 0.0)
    for _ in range(ROUNDS if moving.any() else 0):
        slope = float(np.sum(shared[moving] + variance) / np.sum(power[moving] - variance))
        variance = min(max(slope * max(power_still - variance, 0.0) - shared_still, 0.0), power_still)
    return _sharpened(ref, residual, quiet, min(variance, power_still))


def _sharpened(ref: FloatArray, residual: FloatArray, quiet: NDArray[np.bool_], variance: float) -> float:
    """The shared variance from every frequency within the quiet windows at which the reference is noise alone.

    Fourth differences use little more than a third of what the samples say.
    """
    size = len(quiet) * WINDOW
    a, b = (
        dct(values[:size].reshape(-1, WINDOW).T[:, quiet]) for values in (ref, residual - residual.mean())
    )
    bare = np.mean(a * a, axis=1) < BARE * variance
    bare[0] = False
    return max(-float(np.mean((a * b)[bare])), 0.0) if bare.sum() >= 4 else variance


def _wiener(ref: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """(smoothed reference, gain of the filter per DCT coefficient)."""
    line = np.linspace(ref[0], ref[-1], len(ref))
    spectrum = dct(ref - line)
    width = max(5, len(ref) // 2000)
    power = ndimage.uniform_filter1d(spectrum**2, width, mode="nearest")
    gain = np.clip(1.0 - 1.5 * noise / np.maximum(power, 1e-300), 0.0, 1.0)
    return line + inverse_dct(spectrum * gain), gain
