"""Time alignment at full rate: delay, clock drift and bandwidth of the measured rate against the true one.

The delay is fitted by moving a cubic spline through the true rate (Gauss-Newton), not by finite differences, which
turn a delay into a bandwidth.  A second-order Butterworth filter is a delay up to s², so both are tried and the
likelihood says which, or that it cannot say.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import optimize, signal

from training.diagnose.design import Domain, Frame, domain
from training.diagnose.library import ROOM_DEGC
from training.diagnose.likelihood import inverse
from training.diagnose.prepare import prepare
from training.diagnose.reference import Reference
from training.diagnose.work import FloatArray, Work

SIGNIFICANT = 30.0
SECOND = 45.0
STEEP = (
    10.0  # the rate's slope beside that of the reference's noise, below which the noise may look like a delay
)
SHAPE = 0.1  # of what one effect gains: its shape is not known better
CLASS_COST = 10.0
SIMPLER = 2.0
ABOVE_NYQUIST = 0.55  # samples: a shorter delay may be a filter whose corner no sample shows
MAX_STEPS = 6
CORNERS = 12
MAX_ROWS = 1_500_000


@dataclass
class Timing:
    """What the time alignment found; `moved` is the true rate as the measuring channel saw it, `(n,)`."""

    delay_s: float = 0.0
    delay_se: float = float("nan")
    clock_ppm: float = 0.0
    clock_se: float = float("nan")
    corner_Hz: float | None = None
    poles: int = 2
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    gains: dict[str, float] = field(default_factory=dict)
    moved: FloatArray = field(default_factory=lambda: np.empty(0))
    change_rms_dps: float = 0.0
    sample_s: float = 0.0

    def applied(self, ref: Reference) -> "Timing":
        """The same timing on another recording's reference: nothing of it is fitted there."""
        t = ref.t
        if self.corner_Hz is not None:
            moved = filtered(ref.rate, 1.0 / float(np.median(np.diff(t))), self.corner_Hz, self.poles)
        else:
            moved = (
                ref.moved(t, self.delay_s + 1e-6 * self.clock_ppm * (t - t[0])) if self.effects else ref.rate
            )
        return replace(self, moved=moved, change_rms_dps=float(np.std(moved - ref.rate)))


def common(timings: Sequence[Timing]) -> Timing:
    """The timing that recordings share: that of those that show one, averaged, where at least half of them do."""
    shown = [timing for timing in timings if timing.effects]
    if not shown or 2 * len(shown) < len(timings):
        return Timing()
    kind = max(shown, key=lambda timing: max(timing.gains.values()))
    alike = [timing for timing in shown if set(timing.effects) == set(kind.effects)]
    corners = [timing.corner_Hz for timing in alike if timing.corner_Hz is not None]
    return replace(
        kind,
        delay_s=float(np.mean([timing.delay_s for timing in alike])),
        clock_ppm=float(np.mean([timing.clock_ppm for timing in alike])),
        corner_Hz=float(np.exp(np.mean(np.log(corners)))) if corners else None,
    )


def align(
    columns: dict[str, FloatArray],
    whole: FloatArray,
    ref: Reference,
    valid: np.ndarray,
    clear: Callable[[FloatArray], FloatArray],
    spread: FloatArray | None = None,
    left_out: frozenset[str] = frozenset(),
) -> Timing:
    """Fit the timing of one recording.

    `whole` (n,) is measured − simulated [dps]; `clear` takes out of a residual what is neither timing nor noise;
    `spread` (n,) is the residual's relative noise. What is `left_out` of the catalogue is not fitted.
    """
    t = columns["t_s"]
    residual = clear(whole)
    if np.ptp(ref.rate) < 0.5 or ref.slope_to_noise() < STEEP:
        return Timing(moved=ref.rate)
    work = prepare("timing", columns, residual, np.zeros(len(t)), ref.rate, valid, max_blocks=MAX_ROWS)
    if spread is not None:
        work.spread = np.sqrt(work.average(spread**2))
    span = t - 0.5 * (t[0] + t[-1])
    slope = ref.spline(t, 1)
    base, rolling, only_rolling = _base(work, [slope, span * slope])
    if only_rolling:
        return Timing(moved=ref.rate)
    first = base.gain([slope, span * slope])
    timing = _moved_fit(base, work, t, span, residual, ref)
    if (
        max(first[0], timing.gains.get("both", 0.0)) < SIGNIFICANT
        and base.gain([slope, ref.spline(t, 2)])[0] < SIGNIFICANT
    ):
        timing.moved = ref.rate
        return timing
    _decide(timing, base, t, span, residual, ref, lambda moved: clear(whole - (moved - ref.rate)), left_out)
    timing.gains["misalignment"] = rolling
    timing.sample_s = float(np.median(np.diff(t)))
    timing.change_rms_dps = float(np.std((timing.moved - ref.rate)[valid]))
    return timing


def _base(work: Work, timing: list[FloatArray]) -> tuple["_Base", float, bool]:
    """(what timing is added to, what rolling alone gains, whether it is no timing but the roll of a tilted unit).

    Rolling goes with the change of the lateral acceleration, and so nearly with that of the rate: each alone is taken
    for the other, and what the one leaves of the other by its inexact shape is neither.
    """
    plain = _Base(work, _static_nuisance(work))
    if "roll_rate" not in work.extra:
        return plain, 0.0, False
    rolled = _Base(work, [*_static_nuisance(work), work.extra["roll_rate"]])
    rolling = 2.0 * (rolled.null.loglik - plain.null.loglik)
    late = plain.gain(timing)[0]
    if late < SIGNIFICANT:
        return plain, 0.0, False
    both = rolling + rolled.gain(timing)[0]
    if both - late < max(SIGNIFICANT, SHAPE * late):
        return plain, rolling, False
    return rolled, 0.0, both - rolling < max(SIGNIFICANT, SHAPE * rolling)


def _static_nuisance(work: Work) -> list[FloatArray]:
    """What must not be taken for timing: scale factor over temperature and the shape at high rates."""
    h = work.temp - ROOM_DEGC
    top = work.full["w_max"][0]
    return [work.w * h, work.per_block(lambda w: (w / top) ** 3), work.per_block(np.abs)]


class _Base:
    """The null model of one recording at full rate, to which timing columns are added."""

    def __init__(self, work: Work, nuisance: list[FloatArray]) -> None:
        self.work = work
        columns = [c for c in nuisance if np.ptp(c) > 0.0]
        self.domain: Domain = domain(work, columns)
        self.frame = Frame([self.domain])
        self.null = self.frame.fit(self.frame.grams())

    def gain(
        self, columns: list[FloatArray], target: FloatArray | None = None
    ) -> tuple[float, FloatArray, FloatArray]:
        """(2 Δ log-likelihood, coefficients, standard errors) of full-rate columns added to the null."""
        shared = (
            np.stack([self.work.average(c) for c in columns], axis=1)
            if columns
            else np.empty((len(self.work), 0))
        )
        extra = [self.work.transform(shared)] if columns else None
        frame = self.frame
        if target is not None:
            rows = self.work.transform(self.work.average(target)[:, None])
            frame = Frame([self.domain], targets=[rows])
        fit = frame.best_fit(frame.grams(extra=extra), self.null.weights)
        errors = np.sqrt(np.diag(inverse(fit.information))) if columns else np.empty(0)
        return 2.0 * (fit.loglik - self.null.loglik), fit.beta, errors


def _moved_fit(
    base: _Base, work: Work, t: FloatArray, span: FloatArray, residual: FloatArray, ref: Reference
) -> Timing:
    """Gauss-Newton on delay and clock drift with the exactly moved true rate."""
    delay, clock = 0.0, 0.0
    gain, errors = 0.0, np.full(2, np.nan)
    moved = ref.rate
    for _ in range(MAX_STEPS):
        shift = delay + clock * span
        moved = ref.moved(t, shift)
        slope = -ref.spline(np.clip(t - shift, t[0], t[-1]), 1)
        gain, step, errors = base.gain([slope, span * slope], residual - (moved - ref.rate))
        delay += float(np.clip(step[0], -0.5, 0.5))
        clock += float(np.clip(step[1], -2e-4, 2e-4))
        if np.all(np.abs(step) < 0.05 * errors):
            break
    timing = Timing(delay, float(errors[0]), 1e6 * clock, 1e6 * float(errors[1]), moved=moved)
    timing.gains["both"] = gain
    return timing


def _decide(
    timing: Timing,
    base: _Base,
    t: FloatArray,
    span: FloatArray,
    residual: FloatArray,
    ref: Reference,
    without: Callable[[FloatArray], FloatArray],
    left_out: frozenset[str],
) -> None:
    """Name what the timing is: delay, clock drift, bandwidth, or a class of them.

    `without(moved)` is the cleared residual with that motion taken for the true one: cleared before, a large delay
    would have lost what of it looks like a function of the rate.
    """
    late = t - t[0]
    delay, delay_se = _one_shift(base, t, without, ref, np.ones(len(t)), timing.delay_s)
    clock, clock_se = _one_shift(base, t, without, ref, late, 0.0)
    _, corner, poles = _bandwidth(base, residual, t, ref)
    sampling = 1.0 / float(np.median(np.diff(t)))
    slid = timing.delay_s + 1e-6 * timing.clock_ppm * span
    motions = [ref.moved(t, delay), ref.moved(t, clock * late), filtered(ref.rate, sampling, corner, poles)]
    only, drift, bandwidth, both = (
        base.gain([], without(moved))[0] for moved in (*motions, ref.moved(t, slid))
    )
    only, bandwidth = (
        -np.inf if name in left_out else gain
        for name, gain in (("timestamp_skew", only), ("bandwidth", bandwidth))
    )
    if "clock_drift" in left_out:
        drift = both = -np.inf
    timing.gains |= {"timestamp_skew": only, "bandwidth": bandwidth, "clock_drift": max(both, drift)}
    timing.gains["drift_alone"] = drift
    if drift > max(only, bandwidth) + SIMPLER and both - drift < SECOND and drift > SIGNIFICANT:
        timing.delay_s, timing.delay_se = 0.0, 0.0
        timing.clock_ppm, timing.clock_se = 1e6 * clock, 1e6 * clock_se
        timing.effects["clock_drift"] = {"clock_ppm": timing.clock_ppm}
        timing.moved = ref.moved(t, clock * late)
        return
    if both - only > SECOND and abs(timing.clock_ppm) > 6.0 * timing.clock_se:
        timing.effects["clock_drift"] = {"clock_ppm": timing.clock_ppm}
        timing.moved = ref.moved(t, timing.delay_s + 1e-6 * timing.clock_ppm * span)
        timing.delay_s += (
            1e-6 * timing.clock_ppm * float(span[0])
        )  # at the start, from where the drift counts
        timing.delay_se = float(np.hypot(timing.delay_se, 1e-6 * timing.clock_se * span[0]))
        if abs(timing.delay_s) > 6.0 * timing.delay_se and abs(timing.delay_s) * sampling > 0.02:
            timing.effects["timestamp_skew"] = {"delay_s": timing.delay_s}
        return
    timing.delay_se = delay_se
    timing.delay_s, timing.clock_ppm = delay, 0.0
    if max(only, bandwidth) < SIGNIFICANT:
        timing.delay_s = 0.0
        timing.moved = ref.rate
        return
    if bandwidth > only + SIMPLER:
        timing.corner_Hz, timing.poles = corner, poles
        timing.effects["bandwidth"] = {"corner_Hz": corner}
        timing.moved = filtered(ref.rate, sampling, corner, poles)
    else:
        timing.effects["timestamp_skew"] = {"delay_s": delay}
        timing.moved = ref.moved(t, delay)


def rivals(timing: Timing, effect: str) -> dict[str, float]:
    """Effects that explain as much as the timing effect `effect` does, with what they cost."""
    mine = timing.gains["drift_alone" if effect == "clock_drift" else effect]
    gains = {"misalignment": timing.gains.get("misalignment", 0.0)}
    if effect == "timestamp_skew" and 0.0 < timing.delay_s < ABOVE_NYQUIST * timing.sample_s:
        gains["bandwidth"] = mine
    elif len(timing.effects) < 2 and (effect != "clock_drift" or timing.delay_s == 0.0):
        gains |= {
            "timestamp_skew": timing.gains["timestamp_skew"],
            "bandwidth": timing.gains["bandwidth"],
            "clock_drift": timing.gains["drift_alone"],
        }
    return {name: mine - gain for name, gain in gains.items() if name != effect and gain > mine - CLASS_COST}


def _one_shift(
    base: _Base,
    t: FloatArray,
    without: Callable[[FloatArray], FloatArray],
    ref: Reference,
    shape: FloatArray,
    start: float,
) -> tuple[float, float]:
    """(size, its standard error) of one delay that goes as `shape` `(n,)`: constant, or growing with time."""
    size, error = start, np.inf
    most = 0.5 / float(np.max(shape))
    for _ in range(MAX_STEPS):
        slope = -ref.spline(np.clip(t - size * shape, t[0], t[-1]), 1) * shape
        _, step, errors = base.gain([slope], without(ref.moved(t, size * shape)))
        size, error = size + float(np.clip(step[0], -most, most)), float(errors[0])
        if abs(step[0]) < 0.05 * error:
            break
    return size, error


def _bandwidth(base: _Base, residual: FloatArray, t: FloatArray, ref: Reference) -> tuple[float, float, int]:
    """Best low-pass (one or two poles): (gain, corner [Hz], poles)."""
    sampling = 1.0 / float(np.median(np.diff(t)))
    best = (-np.inf, 0.0, 2)
    for poles in (1, 2):

        def loss(log_corner: float, poles: int = poles) -> float:
            change = filtered(ref.rate, sampling, float(np.exp(log_corner)), poles) - ref.rate
            return -base.gain([], residual - change)[0]

        grid = np.log(np.geomspace(0.004 * sampling, 0.44 * sampling, CORNERS))
        losses = [loss(x) for x in grid]
        at = int(np.argmin(losses))
        bounds = (grid[max(at - 1, 0)], grid[min(at + 1, CORNERS - 1)])
        found: Any = optimize.minimize_scalar(
            loss, bounds=bounds, method="bounded", options={"xatol": 2e-3, "maxiter": 18}
        )
        best = max(best, (-float(found["fun"]), float(np.exp(found["x"])), poles))
    return best


def filtered(rate: FloatArray, sampling: float, corner: float, poles: int) -> FloatArray:
    """The rate after a Butterworth low-pass of one or two poles, settled at the start."""
    b, a = np.asarray(signal.butter(poles, corner, fs=sampling))
    return signal.lfilter(b, a, rate, zi=signal.lfilter_zi(b, a) * rate[0])[0]
