"""The verdict: the whole document of a finished analysis, and one sentence for a person."""

from training.diagnose.document import (
    Diagnosis,
    Driver,
    Finding,
    FitResult,
    RecordingNote,
    Remainder,
    probability,
)
from training.diagnose.early import early_findings
from training.diagnose.findings import BAD, alignments, findings_of, unknown_finding
from training.diagnose.noise import noise_note
from training.diagnose.pipeline import Analysis
from training.diagnose.prove import summary
from training.diagnose.unknown import Located, ranked
from training.diagnose.visible import not_excited, visible_from
from training.effects.catalogue import catalogue, effect

NAMES = frozenset({"Shupe", "Faraday", "Earth"})  # keep their initials in a sentence


def conclude(analysis: Analysis) -> Diagnosis:
    """The document of a finished analysis."""
    early = early_findings(analysis)
    findings = findings_of(analysis, early)
    verdict, sentence = _verdict(analysis, findings)
    located = _located(analysis, early)
    top = max((r.gain for r in located), default=1.0)
    fit = (
        summary(analysis.proofs, bool(analysis.heldout), analysis.settings.seed)
        if analysis.proofs
        else _no_fit()
    )
    fit.placebo_improvement = analysis.placebo
    if findings and findings[0].effect not in BAD:
        sentence = f"{sentence.rstrip('.')}{proved(fit)}."
    visible = {}
    if analysis.library is not None and analysis.model is not None and analysis.null is not None:
        visible = visible_from(analysis.library, analysis.domains, analysis.model, analysis.null)
    return Diagnosis(
        verdict=verdict,
        sentence=sentence,
        findings=findings,
        drivers=[Driver(r.driver, float(r.gain / top), float(max(r.p_value, 1e-300))) for r in located],
        fit=fit,
        alignment=alignments(analysis),
        remainder=_remainder(analysis),
        noise=noise_note(analysis),
        visible_from=visible,
        not_excited=not_excited(analysis.survey, analysis.library),
        recordings=_notes(analysis),
        seed=analysis.settings.seed,
    )


def proved(fit: FitResult) -> str:
    """What data not used for the fit say of it, to end the sentence with; nothing where the model predicts nothing.

    White noise of single rows hides a small effect, so where they do not decide their means over blocks are asked.
    """
    where = "the held-out recordings" if fit.heldout else "held-out blocks"
    rows = (fit.rms_before_dps, fit.rms_after_dps, *fit.ci95)
    slow = (
        tuple(fit.slow[k] for k in ("rms_before_dps", "rms_after_dps", "ci95_low", "ci95_high"))
        if fit.slow
        else rows
    )
    if fit.rms_before_dps == fit.rms_after_dps and slow[0] == slow[1]:
        return ""
    decides = next((r for r in (rows, slow) if r[2] > 0.0 or r[3] < 0.0), slow)
    before, after, low, high = decides
    of = "the misfit" if decides is rows else "the misfit in means over blocks"
    change = f"{of} of {where} goes from {before:.3g} to {after:.3g} °/s"
    control = fit.placebo_improvement  # of means over blocks
    if low > 0.0 and control is not None and control >= 1.0 - slow[1] / max(slow[0], 1e-300):
        return f"; but that is not proved: {change}, and the same on a wrong time axis does as much"
    if low > 0.0:
        return f"; with it {change}"
    if high < 0.0:
        return f"; but it does not hold: {change}"
    return f"; but that is not proved: {change}, which may be chance"


def _located(analysis: Analysis, early: list[Finding]) -> list[Located]:
    """Drivers of the residual as it came: those of frames, timing and single samples beside the slow ones."""
    told = [Located(f.driver, f.strength, f.strength, f.p_value) for f in early]
    return [row for row in ranked([*told, *analysis.located]) if row.gain > 0.0]


def _no_fit() -> FitResult:
    return FitResult(0.0, 0.0, 0.0, (0.0, 0.0), False)


def _remainder(analysis: Analysis) -> Remainder | None:
    unknown, model = analysis.unknown, analysis.model
    if unknown is None or unknown.named or model is None:
        return None
    row = unknown_finding(analysis, unknown, model)
    return Remainder(row.rms_dps, row.driver, row.p_value)


def _notes(analysis: Analysis) -> list[RecordingNote]:
    rows = [(i.recording, i.checked, False) for i in analysis.intakes]
    rows += [(r, c, False) for r, c in analysis.unusable]
    rows += [(i.recording, i.checked, True) for i in analysis.heldout]
    rows += [(r, c, True) for r, c in analysis.unusable_heldout]
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
        return (
            "bad_recording",
            f"Nothing can be said: {reasons or 'too few rows for a diagnosis; record at least minutes'}.",
        )
    if not findings:
        return _silent(analysis)
    first = findings[0]
    size = f"{first.rms_dps:.3g} °/s rms"
    if first.effect in BAD:
        return "bad_recording", f"The recording is at fault: {first.text}."
    if first.status == "unknown":
        return (
            "unknown",
            f"Something is missing that no catalogue entry carries: {size}, driver {first.driver.replace('_', ' ')}.",
        )
    title = effect(first.effect).title
    if first.status == "ambiguous":
        rest = ", ".join(_title(a) for a in first.alternatives[1:])
        return (
            "ambiguous",
            f"{title} ({size}), but these recordings cannot tell it from {rest}; to separate: {first.separate_by}.",
        )
    others = f", beside {', '.join(_title(f.effect) for f in findings[1:])}" if len(findings) > 1 else ""
    return (
        "named",
        f"{title} is missing from the simulation ({size}, p {probability(first.p_value)}){others}.",
    )


def _title(name: str) -> str:
    """An effect as a person calls it, in the middle of a sentence; initials of names stay."""
    if name not in catalogue():
        return name.replace("_", " ")
    title = effect(name).title
    return title if title.split()[0] in NAMES else title[0].lower() + title[1:]


def _silent(analysis: Analysis) -> tuple[str, str]:
    found = analysis.survey
    if found is None or "temperature" not in found.has:
        return "not_excited", (
            "Nothing was found, but the temperature does not change by more than 2 K, so no thermal effect could show; "
            "record a temperature ramp, or soaks at two temperatures or more."
        )
    return (
        "nothing_missing",
        "The residual is the noise: nothing is missing that these recordings could have shown.",
    )
