"""What the levels of concealment ask for: which effects, how strong, how many, in which scenes."""

from dataclasses import dataclass, field

import numpy as np

from tools.blind.catalogue import KNOWN, UNLISTED

WEIGHTS = {
    "L0": 25,
    "L1": 11,
    "L2": 12,
    "L3": 8,
    "L4": 5,
    "L5": 8,
    "L6": 11,
    "L7": 4,
    "L8": 15,
    "L9": 5,
    "L10": 5,
}
"""Shares of a full trial: a quarter null, 41 single, 20 double, 15 not listed, and 8 inseparable by design."""
LEVELS = tuple(WEIGHTS)
NULL_SCENES = (
    ("zero/cycle", 3),
    ("table/cycle", 3),
    ("drive/cold_start", 3),
    ("drive/constant", 2),
    ("circles/constant", 1),
    ("creep/constant", 1),
    ("table/constant", 1),
    ("zero/constant", 1),
    ("averages", 2),
)
PARTLY = (
    ("shupe", "zero/pulse"),
    ("bias_temperature", "zero/pulse"),
    ("thermal_lag", "table/pulse"),
    ("scale_temperature", "table/pulse"),
)
SCALE_TWINS = (
    "scale_temperature",
    "scale_warmup",
    "source_ageing",
    "thermal_lag",
    "scale_hysteresis",
    "scale_temperature_rate",
)
BIAS_TWINS = ("bias_temperature", "bias_warmup", "bias_hysteresis", "shupe", "bias_drift")
TWINS = (
    *((name, f"table/{climate}") for name in SCALE_TWINS for climate in ("ramp", "warm_up")),
    *((name, f"zero/{climate}") for name in BIAS_TWINS for climate in ("ramp", "warm_up")),
    ("timestamp_skew", "gentle/constant"),
    ("bandwidth", "gentle/constant"),
    ("magnetic", "circles/constant"),
    ("earth_rate", "circles/constant"),
)
"""Effects in scenes that hide the difference from their relatives."""
DOUBLES = (
    ("bias_temperature", "bias_hysteresis", "zero/cycle"),
    ("shupe", "polarization_ripple", "zero/cycle"),
    ("bias_temperature", "bias_step", "zero/cycle"),
    ("bias_hysteresis", "bias_warmup", "zero/cycle"),
    ("shupe", "bias_temperature", "zero/cycle"),
    ("thermal_lag", "scale_nonlinearity", "table/cycle"),
    ("scale_temperature", "bias_temperature", "table/cycle"),
    ("scale_temperature", "scale_asymmetry", "table/cycle"),
    ("thermal_lag", "scale_warmup", "table/cycle"),
    ("scale_hysteresis", "scale_nonlinearity", "table/cycle"),
    ("scale_asymmetry", "scale_nonlinearity", "table/constant"),
    ("timestamp_skew", "acceleration", "drive/constant"),
    ("vibration_rectification", "clock_drift", "drive/constant"),
    ("acceleration", "bias_step", "drive/constant"),
    ("magnetic", "table_eccentricity", "circles/constant"),
    ("scale_temperature", "scale_nonlinearity", "averages"),
)
GIANTS = (
    ("scale_temperature", "bias_hysteresis", "low_table/cycle"),
    ("scale_temperature", "shupe", "low_table/cycle"),
    ("scale_nonlinearity", "polarization_ripple", "low_table/cycle"),
    ("scale_temperature", "bias_step", "low_table/cycle"),
    ("scale_nonlinearity", "bias_temperature", "low_table/cycle"),
)
"""A giant scale-factor error and a dwarf of a bias error."""
DECOY_CASES = (
    ("scale_error", None),
    ("bias_error", None),
    ("auto_zero", None),
    ("table_eccentricity", None),
    ("scale_temperature", "table/cycle"),
)
"""What looks like new physics and is not; the last is in the simulation already, with a wrong coefficient."""
FAULTY = (
    ("frozen_frames", "acceleration", "drive/constant"),
    ("dropped_frames", "acceleration", "drive/constant"),
    ("counter_wrap", "vibration_rectification", "drive/constant"),
    ("frozen_frames", "bias_step", "drive/constant"),
    ("dropped_frames", "vibration_rectification", "drive/cold_start"),
    ("unit_error", "acceleration", "drive/constant"),
)
TARGETS = {"L1": (30.0, 100.0), "L2": (12.0, 30.0), "L3": (6.0, 10.0), "L4": (25.0, 70.0), "L5": (12.0, 45.0)}
MANY_D = (25.0, 80.0)


@dataclass(frozen=True)
class Wish:
    """Which effects a case shall have, each with the wanted d′ (None: the effect draws its own strength)."""

    level: str
    kind: str
    effects: tuple[tuple[str, float | None], ...] = ()
    wrong_simulation: bool = False
    notes: dict[str, float] = field(default_factory=dict)


def quotas(cases: int, levels: tuple[str, ...]) -> list[str]:
    """A level for every case: shares by WEIGHTS, largest remainders, in a fixed order."""
    total = sum(WEIGHTS[level] for level in levels)
    exact = [cases * WEIGHTS[level] / total for level in levels]
    counts = [int(value) for value in exact]
    order = sorted(range(len(levels)), key=lambda i: counts[i] - exact[i])
    for i in order[: cases - sum(counts)]:
        counts[i] += 1
    return [level for level, count in zip(levels, counts, strict=True) for _ in range(count)]


def _target(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _pick(rng: np.random.Generator, options):
    return options[int(rng.integers(len(options)))]


def wish(level: str, turn: int, rng: np.random.Generator) -> Wish:
    """What case number `turn` of this level shall be; `turn` walks through the effects so that each has its share."""
    if level == "L0":
        kinds = [kind for kind, weight in NULL_SCENES for _ in range(weight)]
        return Wish(level, kinds[turn % len(kinds)])
    if level in ("L1", "L2", "L3"):
        return _single(level, turn, rng)
    if level == "L4":
        name, kind = PARTLY[turn % len(PARTLY)]
        return Wish(level, kind, ((name, _target(rng, *TARGETS[level])),))
    if level == "L5":
        name, kind = TWINS[(turn * 5) % len(TWINS)]
        return Wish(level, kind, ((name, _target(rng, *TARGETS[level])),))
    if level == "L8":
        effect = list(UNLISTED.values())[turn % len(UNLISTED)]
        return Wish(level, _pick(rng, effect.kinds), ((effect.id, _target(rng, 30, 100)),))
    if level == "L9":
        return _decoy(turn, rng)
    return _several(level, turn, rng)


def _single(level: str, turn: int, rng: np.random.Generator) -> Wish:
    """L1 walks through every effect, L2 and L3 through those whose strength can be chosen, from another start."""
    choices = [e for e in KNOWN.values() if level == "L1" or e.fixed is None]
    start = {"L1": 0, "L2": 11, "L3": 5}[level]
    effect = choices[(start + turn * 7) % len(choices)]
    return Wish(level, _pick(rng, effect.kinds), ((effect.id, _target(rng, *TARGETS[level])),))


def _decoy(turn: int, rng: np.random.Generator) -> Wish:
    from tools.blind.catalogue import ALL

    name, kind = DECOY_CASES[turn % len(DECOY_CASES)]
    kind = kind or _pick(rng, ALL[name].kinds)
    return Wish("L9", kind, ((name, _target(rng, *MANY_D)),), wrong_simulation=name == "scale_temperature")


def _several(level: str, turn: int, rng: np.random.Generator) -> Wish:
    if level == "L7":
        giant, dwarf, kind = GIANTS[turn % len(GIANTS)]
        return Wish(level, kind, ((giant, _target(rng, 8e3, 4e4)), (dwarf, _target(rng, 25, 60))))
    if level == "L10":
        fault, name, kind = FAULTY[turn % len(FAULTY)]
        return Wish(level, kind, ((fault, None), (name, _target(rng, *MANY_D))))
    first, second, kind = DOUBLES[(turn * 3) % len(DOUBLES)]
    strong = _target(rng, 25, 90)
    weak = max(12.0, strong / _target(rng, 1, 10))
    pair = (strong, weak) if rng.random() < 0.5 else (weak, strong)
    return Wish(level, kind, ((first, pair[0]), (second, pair[1])))
