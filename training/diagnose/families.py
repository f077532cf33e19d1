"""Which effects mistake each other's shape errors for a second effect, and what is too weak beside a strong one."""

from collections.abc import Sequence

KINDS = {
    ("bias", "static"): ("bias_temperature", "polarization_ripple", "compensation_table"),
    ("bias", "dynamic"): ("shupe", "bias_hysteresis"),
    ("bias", "time"): ("bias_drift", "bias_warmup", "bias_step", "auto_zero"),
    ("scale", "static"): ("scale_temperature",),
    ("scale", "dynamic"): ("thermal_lag", "scale_hysteresis", "scale_temperature_rate"),
    ("scale", "time"): ("source_ageing", "scale_warmup", "scale_step"),
    ("scale", "rate"): ("scale_nonlinearity", "saturation", "scale_asymmetry", "dead_band"),
    ("bias", "turn"): ("magnetic",),
    ("scale", "turn"): ("table_eccentricity",),
}
FAMILY = {effect: family for family, effects in KINDS.items() for effect in effects}
LEAST_SHARE = (0.001, 0.009, 0.05)
"""Of a stronger effect's χ², below which a weak one is taken for its shape error: acting on something else; on the same
(bias, scale factor); and going alike too."""
MOST_CHI2 = (100.0, 400.0, float("inf"))
"""But not what is as strong as this by itself."""
GIANT_SHARE = 0.003
"""Unless it acts on the same as a giant: what that is on another day, or how it turns with temperature, is a twentieth
of it and goes in no catalogue."""


def family(effect: str) -> tuple[str, str]:
    """(what it acts on, how it goes): effects alike in both mistake each other's shape errors for a second effect."""
    return FAMILY.get(effect, (effect, effect))


def too_weak(effects: Sequence[str], strengths: Sequence[float], i: int, trained: bool = False) -> bool:
    """Whether the i-th effect, by its χ², is no more than the shape error of a stronger one.

    A `trained` simulation is itself only good to a share of its surface, so what acts as the strong one does is then
    what the training left, however clearly it shows.
    """
    mine = family(effects[i])
    for j, other in enumerate(effects):
        theirs = family(other)
        alike = sum(a == b for a, b in zip(mine, theirs, strict=True)) if theirs[0] == mine[0] else 0
        most = float("inf") if trained and alike else MOST_CHI2[alike]
        if alike:
            most = max(most, GIANT_SHARE * strengths[j])
        if j != i and strengths[i] < min(LEAST_SHARE[alike] * strengths[j], most):
            return True
    return False
