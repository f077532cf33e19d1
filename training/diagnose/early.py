"""What the stages before the slow physics found: frames, timing, single samples."""

import numpy as np
from msgspec.structs import replace

from training.diagnose.align import rivals
from training.diagnose.document import Finding, Parameter, Where
from training.diagnose.intake import Intake
from training.diagnose.named import named
from training.diagnose.pipeline import Analysis
from training.effects.catalogue import effect

CERTAIN = 1e-12  # what a check of the frames themselves shows


def early_findings(analysis: Analysis) -> list[Finding]:
    """What the stages before the slow physics found: frames, timing, single samples."""
    found = [*_integrity(analysis), *_timing(analysis), *_fast(analysis)]
    return [_unnamed(f, analysis.settings.left_out) for f in found]


def _unnamed(found: Finding, left_out: frozenset[str]) -> Finding:
    """The finding without the names that are left out: what was seen stays, as something without a name."""
    names = [name for name in found.alternatives if name not in left_out]
    if len(names) == len(found.alternatives):
        return found
    if found.effect not in left_out:
        single = len(names) == 1
        return replace(
            found,
            alternatives=names,
            status="named" if single else found.status,
            separate_by=None if single else found.separate_by,
        )
    return replace(
        found,
        effect="unknown",
        status="unknown",
        alternatives=["unknown"],
        separate_by=None,
        text=f"{found.text}, which no catalogue entry carries",
    )


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
            row = named(
                fault.effect,
                [],
                where=where,
                parameters=parameters,
                rms_dps=float(np.sqrt(energy / max(len(raw), 1))),
                p_value=CERTAIN,
                text=fault.text,
                strength=energy / noise**2 + float(fault.samples),
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
                key, unit, value, half = (
                    "cutoff_hz",
                    "Hz",
                    float(timing.corner_Hz or 0.0),
                    0.1 * float(timing.corner_Hz or 0.0),
                )
            gain = timing.gains.get(name, 0.0)
            row = named(
                name,
                list(rivals(timing, name)),
                where=Where([[] for _ in analysis.intakes], []),
                parameters={key: Parameter(float(value), unit, (float(value - half), float(value + half)))},
                rms_dps=timing.change_rms_dps,
                p_value=float(max(np.exp(-0.5 * gain) * 100.0, 1e-300)),
                strength=gain,
                text=f"{effect(name).title} in {intake.recording.name}",
            )
            if name not in rows or rows[name].strength < row.strength:
                rows[name] = row
    return list(rows.values())


def _fast(analysis: Analysis) -> list[Finding]:
    rows: dict[str, Finding] = {}
    for intake in analysis.intakes:
        for fast in intake.fast:
            parameters = {
                k: Parameter(v, unit, (v - 1.96 * e, v + 1.96 * e))
                for k, (v, e, unit) in fast.parameters.items()
            }
            strength = float(np.clip(-2.0 * np.log(max(fast.p_value, 1e-300)), 0.0, 1400.0))
            row = named(
                fast.effect,
                list(fast.alternatives),
                where=Where([[] for _ in analysis.intakes], []),
                parameters=parameters,
                rms_dps=fast.rms_dps,
                p_value=fast.p_value,
                text=fast.text,
                strength=strength,
            )
            if fast.effect not in rows or rows[fast.effect].strength < strength:
                rows[fast.effect] = row
    return list(rows.values())
