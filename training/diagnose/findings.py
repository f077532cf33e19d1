"""What the stages found, put as findings: effect, alternatives, driver, place, parameters, strength."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from training.diagnose.design import Domain
from training.diagnose.document import (
    Alignment,
    Estimate,
    Finding,
    Parameter,
    Where,
)
from training.diagnose.early import CERTAIN
from training.diagnose.intervals import WIDER, Estimates, estimates
from training.diagnose.likelihood import inverse
from training.diagnose.named import named
from training.diagnose.naming import Model
from training.diagnose.noise import noise_findings
from training.diagnose.pipeline import WAKE, Analysis
from training.diagnose.refit import parameters_of, visible_part, waveform, where_of
from training.diagnose.unknown import RATE_DRIVERS, Unknown, empirical
from training.effects.catalogue import effect

BAD = frozenset({"frozen_frames", "dropped_frames", "counter_wrap", "unit_error"})
TIMING = frozenset({"timestamp_skew", "clock_drift", "bandwidth"})
SHAPELESS = frozenset({"multiplicative_noise", "quantization", "scale_error"})
FAINT = 300.0  # χ²
TIMING_LEFT = 0.01  # of a timing error's size: what an inexact shift leaves is no unknown physics
EARTH_SURE = 3.0  # standard errors above that, from which it is too large
SECOND_SURE = 4.0  # standard errors of a second harmonic that is one
EARTH_DPS = 15.041 / 3600.0  # the most that the Earth's rotation can show, on a unit that lies flat


def findings_of(analysis: Analysis, early: Sequence[Finding]) -> list[Finding]:
    """All findings, those of the early stages among them, strongest first."""
    found = [
        *early,
        *_coefficients(analysis),
        *noise_findings(analysis),
    ]
    found += _physics(analysis)
    if analysis.unknown is not None and analysis.unknown.named and analysis.model is not None:
        row = unknown_finding(analysis, analysis.unknown, analysis.model)
        timing = max((i.timing.change_rms_dps for i in analysis.intakes), default=0.0)
        found += [row] if row.rms_dps > TIMING_LEFT * timing else []
    return sorted((f for f in found if not _is_wake(f, found)), key=lambda f: -f.strength)


def _is_wake(found: Finding, beside: Sequence[Finding]) -> bool:
    """Whether a faint timing error is no more than what a giant leaves that goes with the rate.

    Its shape is inexact, and the rate times what changes slowly has a share of the rate's slope.
    """
    giant = max(
        (f.rms_dps for f in beside if f.driver in RATE_DRIVERS and f.effect not in SHAPELESS), default=0.0
    )
    return found.effect in TIMING and found.strength < FAINT and found.rms_dps < WAKE * giant


def _coefficients(analysis: Analysis) -> list[Finding]:
    """Offset and scale factor beyond their tolerances, each told by the recording that shows it most."""
    found: dict[str, Finding] = {}
    settings = analysis.settings
    for row, intake in zip(alignments(analysis), analysis.intakes, strict=True):
        turning = float(np.sqrt(np.mean((intake.work.w - intake.work.w.mean()) ** 2)))
        pairs = (
            ("bias_error", "dps", row.offset_dps, settings.offset_tol_dps, 1.0),
            ("scale_error", "ppm", row.scale_ppm, settings.scale_tol_ppm, 1e-6 * turning),
        )
        for name, unit, value, tolerance, size in pairs:
            if abs(value.value) <= tolerance or value.ci95[0] <= 0.0 <= value.ci95[1]:
                continue
            if name in found and abs(found[name].parameters[unit].value) >= abs(value.value):
                continue
            found[name] = named(
                name,
                [],
                where=Where([[] for _ in analysis.intakes], []),
                parameters={unit: Parameter(value.value, unit, value.ci95)},
                rms_dps=abs(value.value) * size,
                p_value=CERTAIN,
                text=f"{effect(name).title} of {intake.recording.name}",
                strength=1.0,
            )
    return list(found.values())


def _physics(analysis: Analysis) -> list[Finding]:
    model = analysis.model
    if model is None or not model.parts:
        return []
    works = [d.work for d in analysis.domains]
    estimate: Estimates = estimates(model, analysis.domains)
    found = []
    for i, (part, where) in enumerate(zip(model.parts, model.slices(), strict=True)):
        waves = [visible_part(waveform(part, model.fit.beta[where], w), w) for w in works]
        others = sorted(part.alternatives, key=part.alternatives.__getitem__)
        if part.effect == "magnetic" and _like_earth(part.points[0], model, where):
            others.append("earth_rate")
        driver = effect(part.effect).drivers[0]
        found.append(
            named(
                part.effect,
                others,
                driver=driver,
                where=where_of(waves, works, driver),
                parameters=parameters_of(i, model, estimate),
                rms_dps=float(np.sqrt(np.mean(np.concatenate(waves) ** 2))),
                p_value=float(max(part.p_value, 1e-300)),
                text=effect(part.effect).equation,
                strength=part.chi2,
            )
        )
    return found


def _like_earth(point: dict[str, float], model: Model, where: slice) -> bool:
    """One cycle per turn and, within its error, small enough for a tilted unit in the Earth's rotation.

    A second harmonic, which the Earth has not, must be beyond the noise's before it rules the Earth out.
    """
    beta, error = model.fit.beta[where], np.sqrt(np.diag(inverse(model.fit.information))[where])
    if point["order"] > 1.5 and np.hypot(*beta[2:]) > SECOND_SURE * np.max(error[2:]):
        return False
    return float(np.hypot(*beta[:2])) - EARTH_SURE * float(np.max(error[:2])) < EARTH_DPS


def unknown_finding(analysis: Analysis, unknown: Unknown, model: Model) -> Finding:
    """The finding of something that no catalogue entry carries."""
    joint = empirical(unknown, analysis.domains, model)
    where = joint.slices()[-1]
    works = [d.work for d in analysis.domains]
    waves = [visible_part(waveform(unknown.part, joint.fit.beta[where], w), w) for w in works]
    near = f"; partly like {', '.join(unknown.withdrawn)}" if unknown.withdrawn else ""
    return Finding(
        effect="unknown",
        status="unknown",
        alternatives=["unknown"],
        separate_by=f"a recording in which {unknown.driver.replace('_', ' ')} varies on its own, twice",
        driver=unknown.driver,
        where=where_of(waves, works, unknown.driver),
        parameters=_of_the_function(unknown, joint, analysis.domains),
        rms_dps=float(np.sqrt(np.mean(np.concatenate(waves) ** 2))),
        p_value=float(max(unknown.p_value, 1e-300)),
        text=f"a function of {unknown.driver.replace('_', ' ')} that no catalogue entry carries{near}",
        strength=unknown.chi2,
    )


def _of_the_function(unknown: Unknown, joint: Model, domains: Sequence[Domain]) -> dict[str, Parameter]:
    """How far the empirical function rises from its lowest to its highest value, and its shape if it has one."""
    point, group = unknown.part.points[0], unknown.part.group
    shape = {
        key: Parameter(float(point[key]), "", (float(point[key]), float(point[key])))
        for key in ("centre", "bump", "width", "cycle", "order")
        if point.get(key)
    }
    estimate = estimates(joint, domains)
    mine = [k for k, (i, _, _) in enumerate(estimate.names) if i == len(joint.parts) - 1]
    columns = np.concatenate([np.stack(group.columns(d.work, point), axis=1) for d in domains])
    wave = columns @ estimate.values[mine]
    rise = columns[int(np.argmax(wave))] - columns[int(np.argmin(wave))]
    error = float(np.sqrt(max(rise @ estimate.covariance[np.ix_(mine, mine)] @ rise, 0.0)))
    half = WIDER * float(stats.t.ppf(0.975, float(np.min(estimate.dof[mine])))) * error
    size = float(np.ptp(wave))
    return {"peak_to_peak_dps": Parameter(size, "dps", (size - half, size + half)), **shape}


def alignments(analysis: Analysis) -> list[Alignment]:
    """Offset, scale factor and timing of every recording, with 95 % intervals."""
    rows = []
    for i, intake in enumerate(analysis.intakes):
        work = intake.work
        design = np.stack([np.ones(len(work)), *([work.w] if np.ptp(work.w) > 0 else [])], axis=1)
        left = work.y.copy()
        told = analysis.everything()
        if told is not None:
            for part, where in zip(told.parts, told.slices(), strict=True):
                left -= waveform(part, told.fit.beta[where], work)
        solution = np.linalg.lstsq(design, left, rcond=None)[0]
        errors = _alignment_errors(analysis, i, design)
        scale = (1e6 * solution[1], 1e6 * errors[1]) if len(solution) > 1 else (0.0, 0.0)
        timing = intake.timing
        delay_se = timing.delay_se if np.isfinite(timing.delay_se) else 0.0
        clock_se = timing.clock_se if np.isfinite(timing.clock_se) else 0.0
        rows.append(
            Alignment(
                intake.recording.name,
                _estimate(float(solution[0]), errors[0]),
                _estimate(*scale),
                _estimate(timing.delay_s, delay_se),
                _estimate(timing.clock_ppm, clock_se),
            )
        )
    return rows


def _alignment_errors(analysis: Analysis, i: int, design: np.ndarray) -> list[float]:
    base = analysis.model or analysis.base
    if base is None:
        return [0.0] * design.shape[1]
    domain = analysis.domains[i]
    cuts = np.cumsum([len(d.edges) - 1 for d in analysis.domains])[:-1]
    spectrum = np.repeat(np.split(base.fit.spectrum, cuts)[i], np.diff(domain.edges))
    rows = domain.work.transform(design)
    inverse = np.linalg.pinv(rows.T @ rows)
    return [float(np.sqrt(v)) for v in np.diag(inverse @ (rows.T @ (rows * spectrum[:, None])) @ inverse)]


def _estimate(value: float, error: float) -> Estimate:
    return Estimate(float(value), (float(value - 1.96 * error), float(value + 1.96 * error)))
