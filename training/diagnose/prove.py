"""The proof: what the found physics does to data that had no part in finding it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from training.diagnose.design import domain
from training.diagnose.document import FitResult
from training.diagnose.intake import Intake, full_work
from training.diagnose.naming import Model, build
from training.diagnose.prepare import survey
from training.diagnose.refit import waveform
from training.diagnose.work import FloatArray, Work, block_average

BOOTSTRAP = 400
SECTIONS = 40
FOLDS = 5


@dataclass
class Proof:
    """One recording's misfit before and after, its own offset and scale removed by least squares from both."""

    name: str
    before: FloatArray
    after: FloatArray
    slow_before: FloatArray
    slow_after: FloatArray
    prediction: FloatArray


def cleared(values: FloatArray, rate: FloatArray, valid: np.ndarray) -> FloatArray:
    """Values of the valid rows without their offset and scale factor (least squares, nothing else)."""
    y, w = values[valid], rate[valid]
    design = np.stack([np.ones(len(y)), *([w] if np.ptp(w) > 0.0 else [])], axis=1)
    return y - design @ np.linalg.lstsq(design, y, rcond=None)[0]


def predicted(model: Model, intake: Intake, power_on_known: bool) -> FloatArray:
    """Error [dps] the model's parts predict on every row of a recording, with the timing found for it."""
    total = intake.timing_change if intake.reference is not None else np.zeros(len(intake.rate))
    if not model.parts:
        return total.copy()
    work = full_work(intake, power_on_known)
    work.index = -1
    wave = np.zeros(len(work))
    for part, where in zip(model.parts, model.slices(), strict=True):
        wave += waveform(part, model.fit.beta[where], work)
    if len(wave) == len(total):
        return total + wave
    rows = np.flatnonzero(work.keep)
    return total + np.interp(np.arange(len(total)), _row_of(rows, intake, work), wave)


def _row_of(rows: np.ndarray, intake: Intake, work: Work) -> FloatArray:
    """Row numbers of the working blocks, where rows and blocks are not one to one (uneven time stamps)."""
    del rows
    t = intake.checked.columns["t_s"]
    return np.interp(work.t, t, np.arange(len(t)))


def prove(intake: Intake, prediction: FloatArray, power_on_known: bool) -> Proof:
    """Misfit of one recording with and without the prediction."""
    del power_on_known
    valid, rate = intake.checked.valid, intake.rate
    truth = np.nan_to_num(intake.checked.columns["ref_rate_dps"])
    before = cleared(intake.residual, truth, valid)
    after = cleared(intake.residual - prediction, truth, valid)
    size = max(1, len(before) // 3000) if not intake.work.points else 1
    labels = np.arange(len(before)) // size
    mean = block_average(labels, np.ones(len(before), bool), int(labels[-1]) + 1)
    del rate
    return Proof(intake.recording.name, before, after, mean(before), mean(after), prediction)


def summary(proofs: Sequence[Proof], heldout: bool, seed: int) -> FitResult:
    """Pooled RMS before and after, the improvement with a block-bootstrap interval, and the same for block means."""
    rng = np.random.default_rng(seed)
    before, after = _rms([p.before for p in proofs]), _rms([p.after for p in proofs])
    gain, interval = _improvement([p.before for p in proofs], [p.after for p in proofs], rng)
    slow_gain, slow_interval = _improvement(
        [p.slow_before for p in proofs], [p.slow_after for p in proofs], rng
    )
    slow = {
        "rms_before_dps": _rms([p.slow_before for p in proofs]),
        "rms_after_dps": _rms([p.slow_after for p in proofs]),
        "improvement": slow_gain,
        "ci95_low": slow_interval[0],
        "ci95_high": slow_interval[1],
    }
    rows = [
        {
            "file": p.name,
            "rms_before_dps": _rms([p.before]),
            "rms_after_dps": _rms([p.after]),
            "slow_rms_before_dps": _rms([p.slow_before]),
            "slow_rms_after_dps": _rms([p.slow_after]),
        }
        for p in proofs
    ]
    return FitResult(before, after, gain, interval, heldout, slow, None, rows)


def _rms(parts: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _improvement(
    before: Sequence[FloatArray], after: Sequence[FloatArray], rng: np.random.Generator
) -> tuple[float, tuple[float, float]]:
    pairs = [
        (np.add.reduceat(b**2, s), np.add.reduceat(a**2, s))
        for b, a in zip(before, after, strict=True)
        for s in [np.unique(np.linspace(0, len(b), min(SECTIONS, len(b)), endpoint=False).astype(int))]
    ]
    b, a = np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
    value = 1.0 - float(np.sqrt(a.sum() / max(b.sum(), 1e-300)))
    picks = rng.integers(0, len(b), (BOOTSTRAP, len(b)))
    draws = 1.0 - np.sqrt(a[picks].sum(axis=1) / np.maximum(b[picks].sum(axis=1), 1e-300))
    low, high = np.quantile(draws, [0.025, 0.975])
    return value, (float(min(low, value)), float(max(high, value)))


def folded(model: Model, intakes: Sequence[Intake], power_on_known: bool) -> list[Proof]:
    """Without held-out recordings: every fifth of every recording predicted by coefficients fitted to the rest."""
    wholes = [predicted(model, intake, power_on_known) for intake in intakes]
    if model.parts:
        for fold in range(FOLDS):
            fitted = _without_fold(model, fold)
            if fitted is None:
                continue
            for whole, intake in zip(wholes, intakes, strict=True):
                n = len(whole)
                part = slice(fold * n // FOLDS, (fold + 1) * n // FOLDS)
                whole[part] = predicted(Model(model.parts, model.frame, fitted.fit), intake, power_on_known)[
                    part
                ]
    return [prove(intake, whole, power_on_known) for intake, whole in zip(intakes, wholes, strict=True)]


def _without_fold(model: Model, fold: int) -> Model | None:
    """The same parts fitted to all but one fifth of every recording; None where a part lives only there."""
    pieces = []
    for d in model.frame.domains:
        n = len(d.work)
        rows = np.ones(n, dtype=bool)
        rows[fold * n // FOLDS : (fold + 1) * n // FOLDS] = False
        pieces.append((d, rows))
    domains = [domain(_part_of(d.work, rows)) for d, rows in pieces]
    columns = []
    for d, rows in pieces:
        waves = [
            np.stack([c for point in part.points for c in part.group.columns(d.work, point)], axis=1)
            for part in model.parts
        ]
        columns.append(np.concatenate(waves, axis=1)[rows])
    if any(np.any(np.ptp(np.concatenate(columns), axis=0) <= 0.0) for _ in (0,)):
        return None
    from training.diagnose.design import Frame

    chosen = [d.work.transform(c) for d, c in zip(domains, columns, strict=True)]
    frame = Frame(domains, chosen)
    return Model(model.parts, frame, frame.fit(frame.grams(), model.fit.weights))


def _part_of(work: Work, rows: np.ndarray) -> Work:
    clusters = None if work.clusters is None else np.unique(work.clusters[rows], return_inverse=True)[1]
    return replace(
        work,
        t=work.t[rows],
        y=work.y[rows],
        w=work.w[rows],
        temp=work.temp[rows],
        slow_temp=work.slow_temp[rows],
        spread=work.spread[rows],
        clusters=clusters,
        extra={k: v[rows] for k, v in work.extra.items()},
    )


def placebo(
    model: Model, intakes: Sequence[Intake], proofs: Sequence[Proof], domains: Sequence
) -> float | None:
    """Improvement of block means by the same regressors on a wrong time axis (rolled by half a recording).

    The control of the proof: it must be near nothing, or the improvement is not due to the physics.
    """
    if not model.parts or domains[0].work.points:
        return None
    chosen, fake = [], []
    for d in domains:
        waves = [
            np.stack([c for point in part.points for c in part.group.columns(d.work, point)], axis=1)
            for part in model.parts
        ]
        rolled = np.roll(np.concatenate(waves, axis=1), len(d.work) // 2, axis=0)
        fake.append(rolled)
        chosen.append(d.work.transform(rolled))
    from training.diagnose.design import Frame

    frame = Frame(domains, chosen)
    fit = frame.fit(frame.grams(), model.fit.weights)
    before, after = [], []
    for intake, d, columns in zip(intakes, domains, fake, strict=True):
        del intake
        rows = np.ones(len(d.work), dtype=bool)
        before.append(cleared(d.work.y, d.work.w, rows))
        after.append(cleared(d.work.y - columns @ fit.beta, d.work.w, rows))
    del proofs
    return 1.0 - _rms(after) / max(_rms(before), 1e-300)


__all__ = ["Proof", "build", "folded", "placebo", "predicted", "prove", "summary", "survey"]
