"""Which effects one recording cannot tell apart, and the recording that would (PHYSICS.md §1.H)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class AliasClass:
    """Effects with (nearly) the same fingerprint, and the experiment that separates them."""

    id: str
    title: str
    members: tuple[str, ...]
    separate_by: str


ALIAS_CLASSES = (
    AliasClass(
        "H1",
        "thermal dynamics of the scale factor",
        ("thermal_lag", "scale_hysteresis", "scale_temperature_rate", "scale_temperature"),
        "constant 60…100 °/s while the temperature ramps at 1 and at 3 K/min, both ways, with 30 min holds "
        "and an inner reversal; or a temperature sensor at the coil",
    ),
    AliasClass(
        "H2",
        "thermal dynamics of the bias",
        ("shupe", "bias_hysteresis", "thermal_lag", "bias_temperature"),
        "zero rate over a temperature profile with ramps of two speeds, both ways, with holds",
    ),
    AliasClass(
        "H3",
        "time against temperature",
        (
            "bias_temperature",
            "scale_temperature",
            "bias_warmup",
            "scale_warmup",
            "source_ageing",
            "bias_drift",
        ),
        "two power-ons at different ambient temperatures, and the same temperature met again hours later",
    ),
    AliasClass(
        "H4",
        "timing",
        ("timestamp_skew", "bandwidth", "clock_drift"),
        "a chirp of rate from 0.1 to 0.5 of the sampling rate, again after more than 30 min; or a loop-back "
        "frame of known time",
    ),
    AliasClass(
        "H5",
        "shape at high rate",
        ("scale_nonlinearity", "saturation"),
        "several rate levels on both sides of the knee",
    ),
    AliasClass(
        "H6",
        "heading",
        ("earth_rate", "magnetic", "table_eccentricity"),
        "the same circle at two rates and in both directions; the unit tilted; a magnet",
    ),
    AliasClass(
        "H7",
        "even in rate",
        ("scale_asymmetry", "vibration_rectification", "supply_ripple"),
        "both signs of rate at the same speed, and vibration at zero rate",
    ),
    AliasClass(
        "H8",
        "optical power (Kerr and pick-up are members of bias_temperature)",
        ("bias_temperature", "bias_step"),
        "a step of source power or supply at constant temperature",
    ),
    AliasClass(
        "H9",
        "near zero rate",
        ("dead_band", "quantization", "frozen_frames", "dropped_frames", "auto_zero"),
        "a slow sweep through zero with the frame counter recorded",
    ),
    AliasClass(
        "H10",
        "scale factor against the reference's",
        ("scale_error", "misalignment", "unit_error", "acceleration"),
        "a second reference, and the same yaw rate at different speeds",
    ),
    AliasClass(
        "A5",
        "periodic in temperature",
        ("polarization_ripple", "compensation_table"),
        "a slow continuous ramp over three or more periods: a sawtooth has harmonics falling as 1/k",
    ),
    AliasClass(
        "B7",
        "noise that grows with motion",
        ("multiplicative_noise", "timing_jitter"),
        "constant high rate (no angular acceleration) for minutes",
    ),
    AliasClass(
        "F1",
        "slow wandering",
        ("noise_level", "bias_drift"),
        "several long recordings at standstill and constant temperature",
    ),
    AliasClass(
        "F2",
        "steps",
        ("bias_step", "auto_zero", "bias_warmup"),
        "standstill through the step with supply, heater and stops noted",
    ),
)
"""H1…H10 of PHYSICS.md, then pairs that its single entries name."""


def alias_classes_of(effect: str) -> tuple[AliasClass, ...]:
    """Return every class the effect is a member of."""
    return tuple(alias for alias in ALIAS_CLASSES if effect in alias.members)
