"""From what the stages found to findings, a verdict and one sentence for a person."""

from collections.abc import Sequence

import numpy as np

from training.diagnose.align import rivals
from training.diagnose.document import (
    Alignment,
    Diagnosis,
    Driver,
    Estimate,
    Finding,
    FitResult,
    Parameter,
    RecordingNote,
    Regime,
    Remainder,
    Where,
)
from training.diagnose.intake import Intake
from training.diagnose.naming import Model
from training.diagnose.noise import noise_findings, noise_note
from training.diagnose.pipeline import Analysis
from training.diagnose.prove import summary
from training.diagnose.refit import Estimates, estimates, parameters_of, visible_part, waveform, where_of
from training.diagnose.unknown import Unknown, empirical
from training.diagnose.visible import not_excited, visible_from
from training.effects.alias import ALIAS_CLASSES
from training.effects.catalogue import effect

CERTAIN = 1e-12
INTEGRITY = frozenset({"frozen_frames", "dropped_frames", "counter_wrap", "unit_error", "timing_jitter"})
BAD = frozenset({"frozen_frames", "dropped_frames", "counter_wrap", "unit_error"})
TIMING_LEFT = 0.01  # of a timing error's size: what an inexact shift leaves is no unknown physics
EARTH_DPS = 3.0 / 3600.0


def separate_by(name: str, others: Sequence[str]) -> str:
    """The recording that would tell `name` from the others."""
    texts = [c.separate_by for c in ALIAS_CLASSES if name in c.members and set(others) & set(c.members)]
    return "; or ".join(dict.fromkeys(texts)) if texts else effect(name).excitation


def _finding(name: str, others: Sequence[str], **rest: object) -> Finding:
    ordered = [name, *[o for o in others if o != name]]
    status = "named" if len(ordered) == 1 else "ambiguous"
    drivers = effect(name).drivers
    return Finding(
        effect=name, status=status, alternatives=ordered,
        separate_by=None if status == "named" else separate_by(name, ordered[1:]),
        driver=str(rest.pop("driver", drivers[0] if drivers else "time")), **rest,  # type: ignore[arg-type]
    )


def findings_of(analysis: Analysis) -> list[Finding]:
    """All findings, strongest first."""
    found = [*_integrity(analysis), *_timing(analysis), *_fast(analysis), *_coefficients(analysis), *noise_findings(analysis)]
    found += _physics(analysis)
    if analysis.unknown is not None and analysis.unknown.named and analysis.model is not None:
        row = _unknown(analysis, analysis.unknown, analysis.model)
        timing = max((i.timing.change_rms_dps for i in analysis.intakes), default=0.0)
        found += [row] if row.rms_dps > TIMING_LEFT * timing else []
    return sorted(found, key=lambda f: -f.strength)


def _integrity(analysis: Analysis) -> list[Finding]:
    rows: dict[str, Finding] = {}
    for index, intake in enumerate(analysis.intakes):
        noise = max(_white(intake), 1e-12)
        raw = np.asarray(intake.recording.columns["rate_dps"], dtype=np.float64)
        truth = np.asarray(intake.recording.columns.get("ref_rate_dps", np.zeros(len(raw))), dtype=np.float64)
        for fault in intake.checked.faults:
            if fault.effect == "unit_error":
                energy = float(np.nansum((raw - truth) ** 2))
            elif fault.effect == "frozen_frames" and len(raw) == len(intake.residual):
                bad = ~intake.checked.valid & np.isfinite(raw) & np.isfinite(truth)
                energy = float(np.sum((raw[bad] - truth[bad]) ** 2))
            else:
                energy = 0.0
            where = Where([[] for _ in analysis.intakes], [])
            where.segments[index] = fault.segments[:200]
            parameters = {k: Parameter(v, unit, (v, v)) for k, (v, unit) in fault.parameters.items()}
            row = _finding(
                fault.effect, [], where=where, parameters=parameters, rms_dps=float(np.sqrt(energy / max(len(raw), 1))),
                p_value=CERTAIN, text=fault.text, strength=energy / noise**2 + float(fault.samples),
            )
            if fault.effect in rows:
                rows[fault.effect].where.segments[index] = fault.segments[:200]
                rows[fault.effect].strength += row.strength
            else:
                rows[fault.effect] = row
    return list(rows.values())


def _white(intake: Intake) -> float:
    """Deviation of neighbouring residuals, the white noise per sample [dps]."""
    steps = np.diff(intake.residual[intake.checked.valid])
    return float(1.4826 * np.median(np.abs(steps - np.median(steps))) / np.sqrt(2.0)) if len(steps) else 0.0


def _timing(analysis: Analysis) -> list[Finding]:
    rows: dict[str, Finding] = {}
    names = {"timestamp_skew": ("delay_s", "s", "delay_se"), "clock_drift": ("ppm", "ppm", "clock_se")}
    for intake in analysis.intakes:
        timing = intake.timing
        for name in timing.effects:
            if name in names:
                key, unit, error = names[name]
                value = timing.delay_s if name == "timestamp_skew" else timing.clock_ppm
                half = 1.96 * getattr(timing, error)
            else:
                key, unit, value, half = "cutoff_hz", "Hz", float(timing.corner_Hz or 0.0), 0.1 * float(timing.corner_Hz or 0.0)
            gain = timing.gains.get(name, 0.0)
            row = _finding(
                name, list(rivals(timing, name)), where=Where([[] for _ in analysis.intakes], []),
                parameters={key: Parameter(float(value), unit, (float(value - half), float(value + half)))},
                rms_dps=timing.change_rms_dps, p_value=float(max(np.exp(-0.5 * gain) * 100.0, 1e-300)), strength=gain,
                text=f"{effect(name).title} in {intake.recording.name}",
            )
            if name not in rows or rows[name].strength < row.strength:
                rows[name] = row
    return list(rows.values())


def _fast(analysis: Analysis) -> list[Finding]:
    rows: dict[str, Finding] = {}
    for intake in analysis.intakes:
        for fast in intake.fast:
            if fast.effect in analysis.settings.left_out:
                continue
            parameters = {k: Parameter(v, unit, (v - 1.96 * e, v + 1.96 * e)) for k, (v, e, unit) in fast.parameters.items()}
            strength = float(np.clip(-2.0 * np.log(max(fast.p_value, 1e-300)), 0.0, 1400.0))
            row = _finding(
                fast.effect, list(fast.alternatives), where=Where([[] for _ in analysis.intakes], []), parameters=parameters,
                rms_dps=fast.rms_dps, p_value=fast.p_value, text=fast.text, strength=strength,
            )
            if fast.effect not in rows or rows[fast.effect].strength < strength:
                rows[fast.effect] = row
    return list(rows.values())


def _coefficients(analysis: Analysis) -> list[Finding]:
    """Offset and scale factor beyond their tolerances."""
    found = []
    settings = analysis.settings
    for row, intake in zip(alignments(analysis), analysis.intakes, strict=True):
        turning = float(np.sqrt(np.mean((intake.work.w - intake.work.w.mean()) ** 2)))
        pairs = (("bias_error", "dps", row.offset_dps, settings.offset_tol_dps, 1.0),
                 ("scale_error", "ppm", row.scale_ppm, settings.scale_tol_ppm, 1e-6 * turning))
        for name, unit, value, tolerance, size in pairs:
            if abs(value.value) > tolerance and not value.ci95[0] <= 0.0 <= value.ci95[1]:
                found.append(_finding(
                    name, [], where=Where([[] for _ in analysis.intakes], []),
                    parameters={unit: Parameter(value.value, unit, value.ci95)}, rms_dps=abs(value.value) * size,
                    p_value=CERTAIN, text=f"{effect(name).title} of {intake.recording.name}", strength=1.0,
                ))
    return found


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
        found.append(_finding(
            part.effect, others, driver=driver, where=where_of(waves, works, driver),
            parameters=parameters_of(i, model, estimate), rms_dps=float(np.sqrt(np.mean(np.concatenate(waves) ** 2))),
            p_value=float(max(part.p_value, 1e-300)), text=effect(part.effect).equation, strength=part.chi2,
        ))
    return found


def _like_earth(point: dict[str, float], model: Model, where: slice) -> bool:
    """One cycle per turn, small enough for a tilted unit in the Earth's rotation."""
    beta = model.fit.beta[where]
    return point["order"] < 1.5 and float(np.hypot(beta[0], beta[1])) < EARTH_DPS


def _unknown(analysis: Analysis, unknown: Unknown, model: Model) -> Finding:
    joint = empirical(unknown, analysis.domains, model)
    where = joint.slices()[-1]
    works = [d.work for d in analysis.domains]
    waves = [visible_part(waveform(unknown.part, joint.fit.beta[where], w), w) for w in works]
    near = f"; partly like {', '.join(unknown.withdrawn)}" if unknown.withdrawn else ""
    return Finding(
        effect="unknown", status="unknown", alternatives=["unknown"],
        separate_by=f"a recording in which {unknown.driver.replace('_', ' ')} varies on its own, twice",
        driver=unknown.driver, where=where_of(waves, works, unknown.driver), parameters={},
        rms_dps=float(np.sqrt(np.mean(np.concatenate(waves) ** 2))), p_value=float(max(unknown.p_value, 1e-300)),
        text=f"a function of {unknown.driver.replace('_', ' ')} that no catalogue entry carries{near}", strength=unknown.chi2,
    )


def alignments(analysis: Analysis) -> list[Alignment]:
    """Offset, scale factor and timing of every recording, with 95 % intervals."""
    rows = []
    for i, intake in enumerate(analysis.intakes):
        work = intake.work
        design = np.stack([np.ones(len(work)), *([work.w] if np.ptp(work.w) > 0 else [])], axis=1)
        left = work.y.copy()
        if analysis.model is not None:
            for part, where in zip(analysis.model.parts, analysis.model.slices(), strict=True):
                left -= waveform(part, analysis.model.fit.beta[where], work)
        solution = np.linalg.lstsq(design, left, rcond=None)[0]
        errors = _alignment_errors(analysis, i, design)
        scale = (1e6 * solution[1], 1e6 * errors[1]) if len(solution) > 1 else (0.0, 0.0)
        timing = intake.timing
        delay_se = timing.delay_se if np.isfinite(timing.delay_se) else 0.0
        clock_se = timing.clock_se if np.isfinite(timing.clock_se) else 0.0
        rows.append(Alignment(
            intake.recording.name, _estimate(float(solution[0]), errors[0]), _estimate(*scale),
            _estimate(timing.delay_s, delay_se), _estimate(timing.clock_ppm, clock_se),
        ))
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


def conclude(analysis: Analysis) -> Diagnosis:
    """The document of a finished analysis."""
    findings = findings_of(analysis)
    verdict, sentence = _verdict(analysis, findings)
    located = [r for r in analysis.located if r.gain > 0.0]
    top = max((r.gain for r in located), default=1.0)
    fit = summary(analysis.proofs, bool(analysis.heldout), analysis.settings.seed) if analysis.proofs else _no_fit()
    fit.placebo_improvement = analysis.placebo
    ready = analysis.library is not None and analysis.model is not None and analysis.null is not None
    return Diagnosis(
        verdict=verdict, sentence=sentence, findings=findings,
        drivers=[Driver(r.driver, float(r.gain / top), float(max(r.p_value, 1e-300))) for r in located],
        fit=fit, alignment=alignments(analysis), remainder=_remainder(analysis), noise=noise_note(analysis),
        visible_from=visible_from(analysis.library, analysis.domains, analysis.model, analysis.null) if ready else {},  # type: ignore[arg-type]
        not_excited=not_excited(analysis.survey, analysis.library), recordings=_notes(analysis), seed=analysis.settings.seed,
    )


def _no_fit() -> FitResult:
    return FitResult(0.0, 0.0, 0.0, (0.0, 0.0), False)


def _remainder(analysis: Analysis) -> Remainder | None:
    unknown, model = analysis.unknown, analysis.model
    if unknown is None or unknown.named or model is None:
        return None
    row = _unknown(analysis, unknown, model)
    return Remainder(row.rms_dps, row.driver, row.p_value)


def _notes(analysis: Analysis) -> list[RecordingNote]:
    rows = [(i.recording, i.checked, False) for i in analysis.intakes]
    rows += [(r, c, False) for r, c in analysis.unusable]
    rows += [(i.recording, i.checked, True) for i in analysis.heldout]
    notes = []
    for recording, checked, held in rows:
        texts = [f"{f.effect}: {f.text}" for f in checked.faults] + checked.remarks
        texts += [checked.unusable] if checked.unusable else []
        name = recording.path.name if recording.path else recording.name
        notes.append(RecordingNote(name, recording.sha256, len(recording), texts, held))
    return notes


def _verdict(analysis: Analysis, findings: list[Finding]) -> tuple[str, str]:
    if not analysis.intakes or analysis.model is None:
        reasons = "; ".join(f"{r.name}: {c.unusable}" for r, c in analysis.unusable)
        return "bad_recording", f"Nothing can be said: {reasons or 'too few rows for a diagnosis; record at least minutes'}."
    if not findings:
        return _silent(analysis)
    first = findings[0]
    size = f"{first.rms_dps:.3g} °/s rms"
    if first.effect in BAD:
        return "bad_recording", f"The recording is at fault: {first.text}."
    if first.status == "unknown":
        return "unknown", f"Something is missing that no catalogue entry carries: {size}, depending on {first.driver.replace('_', ' ')}."
    title = effect(first.effect).title
    if first.status == "ambiguous":
        rest = ", ".join(effect(a).title.lower() for a in first.alternatives[1:])
        return "ambiguous", f"{title} ({size}), but these recordings cannot tell it from {rest}; to separate: {first.separate_by}."
    others = f", beside {', '.join(f.effect for f in findings[1:])}" if len(findings) > 1 else ""
    return "named", f"{title} is missing from the simulation ({size}, p = {first.p_value:.1g}){others}."


def _silent(analysis: Analysis) -> tuple[str, str]:
    found = analysis.survey
    if found is None or "temperature" not in found.has:
        return "not_excited", (
            "Nothing was found, but the temperature does not change by more than 2 K, so no thermal effect could show; "
            "record a temperature ramp, or soaks at two temperatures or more."
        )
    return "nothing_missing", "The residual is the noise: nothing is missing that these recordings could have shown."


__all__ = ["Regime", "conclude", "findings_of"]
