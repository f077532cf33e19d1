"""diagnosis.json: its parts as strict structs (contract `rtcomp.diagnosis/1`)."""

import json
import math
from typing import Any

import msgspec
from msgspec import Struct, field

SCHEMA = "rtcomp.diagnosis/1"
VERDICTS = ("named", "ambiguous", "unknown", "nothing_missing", "not_excited", "bad_recording")


class Parameter(Struct, forbid_unknown_fields=True):
    """A fitted value with its unit and 95 % interval."""

    value: float
    unit: str
    ci95: tuple[float, float]


class Regime(Struct, forbid_unknown_fields=True):
    """A range of a driver in which the effect is felt."""

    driver: str
    low: float
    high: float


class Where(Struct, forbid_unknown_fields=True):
    """Where an effect is felt: time segments per recording [s], and ranges of drivers."""

    segments: list[list[tuple[float, float]]] = field(default_factory=list)
    regimes: list[Regime] = field(default_factory=list)


class Finding(Struct, forbid_unknown_fields=True):
    """One mismatch; `alternatives` holds what these recordings cannot tell apart from it, itself included."""

    effect: str
    status: str
    alternatives: list[str]
    separate_by: str | None
    driver: str
    where: Where
    parameters: dict[str, Parameter]
    rms_dps: float
    p_value: float
    text: str = ""
    strength: float = 0.0


class Driver(Struct, forbid_unknown_fields=True):
    """A driver the residual depends on, before anything is named."""

    driver: str
    share: float
    p_value: float


class FitResult(Struct, forbid_unknown_fields=True):
    """RMS of the misfit on data not used for the fit; `improvement` = 1 − after/before, with its 95 % interval.

    `slow` repeats it for block means at the working rate, where white noise does not hide a small effect.
    `placebo_improvement` is what an effect of the same kind with a wrong time axis gains there.
    """

    rms_before_dps: float
    rms_after_dps: float
    improvement: float
    ci95: tuple[float, float]
    heldout: bool
    slow: dict[str, float] = field(default_factory=dict)
    placebo_improvement: float | None = None
    recordings: list[dict[str, Any]] = field(default_factory=list)


class Remainder(Struct, forbid_unknown_fields=True):
    """Significant but too small or too shapeless to name."""

    rms_dps: float
    driver: str
    p_value: float


class Estimate(Struct, forbid_unknown_fields=True):
    """A value and its 95 % interval."""

    value: float
    ci95: tuple[float, float]


class Alignment(Struct, forbid_unknown_fields=True):
    """A recording's own offset, scale factor and timing against the simulation."""

    file: str
    offset_dps: Estimate
    scale_ppm: Estimate
    delay_s: Estimate
    clock_ppm: Estimate


class RecordingNote(Struct, forbid_unknown_fields=True):
    """What was read, and what the integrity checks said."""

    file: str
    sha256: str | None
    samples: int
    integrity: list[str]
    heldout: bool = False


class NotExcited(Struct, forbid_unknown_fields=True):
    """An effect these recordings could not test, and what to record instead."""

    effect: str
    record: str


class Diagnosis(Struct, forbid_unknown_fields=True):
    """The whole document."""

    verdict: str
    sentence: str
    findings: list[Finding]
    drivers: list[Driver]
    fit: FitResult
    alignment: list[Alignment]
    remainder: Remainder | None
    noise: dict[str, Any]
    visible_from: dict[str, float]
    not_excited: list[NotExcited]
    recordings: list[RecordingNote]
    seed: int
    schema: str = SCHEMA


def to_json(diagnosis: Diagnosis) -> str:
    """The document on one line; numbers that are not finite become null-free bounds before they get here."""
    return json.dumps(
        _finite(msgspec.to_builtins(diagnosis, enc_hook=float)), allow_nan=False, ensure_ascii=False
    )


def probability(value: float) -> str:
    """A p-value for people; what is too small to mean anything is not printed as if it did."""
    return "< 1e-12" if value <= 1e-12 else f"= {value:.1g}"


def _finite(value: Any) -> Any:
    """Replace what JSON has no number for: ±inf by ±1e308, NaN by 0 with no claim attached to it."""
    if isinstance(value, float) and not math.isfinite(value):
        return 0.0 if math.isnan(value) else math.copysign(1e308, value)
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return value
