"""How strong an effect must be to reach a wanted d′, and which other effects could pass for it."""

from collections.abc import Sequence

import numpy as np

from tools.blind.catalogue import KNOWN
from tools.blind.effect import Effect, Parameters, Planted
from tools.blind.noise import basis, dprime_variance
from tools.blind.scenes import Scene, white_variance

GROUPS = (
    (
        "scale_temperature",
        "scale_warmup",
        "source_ageing",
        "thermal_lag",
        "scale_hysteresis",
        "scale_temperature_rate",
    ),
    ("bias_temperature", "bias_warmup", "bias_drift", "bias_hysteresis", "shupe"),
    ("polarization_ripple", "compensation_table", "bias_temperature"),
    ("timestamp_skew", "bandwidth", "clock_drift"),
    ("scale_nonlinearity", "saturation"),
    ("earth_rate", "magnetic"),
    ("acceleration", "misalignment"),
    ("bias_step", "auto_zero", "bias_drift"),
    ("scale_step", "source_ageing", "scale_temperature"),
)
"""Families within which one recording may not tell members apart."""
FLEXIBLE = frozenset({"bias_temperature", "scale_temperature", "shupe"})
"""Members with several free coefficients: the span of three draws stands for them."""
NO_DIFFERENCE = 9.0
"""χ² that an oracle would still have between two members: below it nobody can tell."""
CLOSE, ROUNDS = 0.1, 8


def delta(effect: Effect, scene: Scene, parameters: Parameters) -> np.ndarray:
    """Waveform [°/s] of an effect alone on an ideal gyro, as it appears in measured minus reference."""
    if effect.apply is None:
        raise ValueError(f"{effect.id} acts on frames, not on a signal")
    changed = effect.apply(scene.omega_dps, scene, parameters) - scene.omega_dps
    return -changed if effect.stage == "reference" else changed


def strength_dprime(effect: Effect, scenes: Sequence[Scene], parameters: Parameters) -> float:
    """d′ of the effect in all scenes together."""
    total = 0.0
    for scene in scenes:
        if effect.variance is not None:
            total += dprime_variance(effect.variance(scene, parameters), white_variance(scene)) ** 2
        else:
            total += float(
                np.sum(scene.signature(delta(effect, scene, parameters), not effect.delay_is_point) ** 2)
            )
    return float(np.sqrt(total))


def solve(effect: Effect, scenes: Sequence[Scene], parameters: Parameters, wanted: float) -> Parameters:
    """The parameters with the strength that gives the wanted d′ (or the effect's limit, if that comes first)."""
    strength, power = effect.unit, 1.0
    seen: list[tuple[float, float]] = []
    for _ in range(ROUNDS):
        found = strength_dprime(effect, scenes, parameters | {"strength": strength})
        if effect.linear and found > 0:
            return parameters | {"strength": min(strength * wanted / found, effect.limit)}
        if abs(found / wanted - 1) < CLOSE:
            break
        seen.append((strength, found))
        if found == 0:
            strength = min(strength * 3, effect.limit)
            continue
        if len(seen) > 1 and seen[-2][1] > 0 and seen[-2][0] != strength:
            slope = np.log(found / seen[-2][1]) / np.log(strength / seen[-2][0])
            power = float(np.clip(slope, 0.4, 5))
        strength = float(min(strength * np.clip(wanted / found, 1e-3, 1e3) ** (1 / power), effect.limit))
    return parameters | {"strength": strength}


def _signature(effect: Effect, scenes: Sequence[Scene], parameters: Parameters) -> np.ndarray:
    """Whitened waveform beyond the nuisance, all scenes in a row."""
    delay = not effect.delay_is_point
    return np.concatenate([scene.signature(delta(effect, scene, parameters), delay) for scene in scenes])


def resemblance(
    truth: Planted,
    other: Effect,
    scenes: Sequence[Scene],
    wanted: float,
    rng: np.random.Generator,
    draws: int,
) -> float:
    """Share of the truth's whitened energy that the other effect reproduces at its best, 0 to 1."""
    target = _signature(truth.effect, scenes, truth.parameters)
    columns = []
    for _ in range(draws):
        parameters = other.draw(rng, scenes[0])
        unit = parameters | {"strength": other.unit}
        parameters = unit if other.linear else solve(other, scenes, parameters, wanted)
        columns.append(_signature(other, scenes, parameters))
    width = 3 if other.id in FLEXIBLE else 1
    return max(_explained(target, np.column_stack(columns[i : i + width])) for i in range(0, draws, width))


def _explained(target: np.ndarray, columns: np.ndarray) -> float:
    if not np.any(columns):
        return 0.0
    return float(np.sum((basis(columns).T @ target) ** 2) / np.sum(target**2))


def inseparable(
    truth: Planted, scenes: Sequence[Scene], reached: float, rng: np.random.Generator, draws: int = 6
) -> list[str]:
    """The truth and every member of its families that even an oracle could not tell from it in these scenes."""
    same = {other for group in GROUPS if truth.id in group for other in group} - {truth.id}
    twins = [truth.id]
    for name in sorted(same):
        other = KNOWN[name]
        if any(not _can_act(other, scene) for scene in scenes):
            continue
        r2 = resemblance(truth, other, scenes, reached, rng, draws)
        if reached**2 * (1 - r2) < NO_DIFFERENCE:
            twins.append(name)
    return twins


def _can_act(effect: Effect, scene: Scene) -> bool:
    if not scene.timed:
        return effect.id in ("scale_temperature", "scale_nonlinearity", "scale_asymmetry", "saturation")
    road = scene.road()
    if effect.id in ("earth_rate", "magnetic"):
        return scene.heading_deg is not None
    if effect.id in ("acceleration", "misalignment", "auto_zero"):
        return road.speed is not None
    return True


def catalogue_resemblance(
    truth: Planted, scenes: Sequence[Scene], reached: float, rng: np.random.Generator
) -> float:
    """Largest share of an unlisted effect that any single catalogue effect can pass for, 0 to 1."""
    slow = [e for e in KNOWN.values() if e.linear and e.variance is None and e.stage in ("optics", "code")]
    return max(
        (resemblance(truth, e, scenes, reached, rng, 3) for e in slow if all(_can_act(e, s) for s in scenes)),
        default=0.0,
    )
