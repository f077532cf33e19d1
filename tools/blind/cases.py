"""A case: recordings for the tool, and a truth that it must not see."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from tools.blind.catalogue import ALL, THERMAL_DRIVERS, UNLISTED
from tools.blind.effect import Planted
from tools.blind.frames import Columns
from tools.blind.levels import Wish, quotas, wish
from tools.blind.noise import SoakNoise, dprime_variance
from tools.blind.optics import draw_law
from tools.blind.scenes import Scene, make_scene, white_variance
from tools.blind.signals import Chain, noises, record, waveforms
from tools.blind.strength import catalogue_resemblance, inseparable, solve

LONG = ("cycle", "pulse")
MEDIUM = ("ramp", "warm_up", "cold_start")
TRIES = 10
WAVE = np.float32


@dataclass(frozen=True)
class Made:
    """One recording of a case: its columns, and the sealed waveforms {effect: shape (n,)} and true rate."""

    name: str
    columns: Columns
    truth: dict[str, Any]
    waves: dict[str, np.ndarray]


@dataclass
class Case:
    """A whole case before it is written: its truth, its recordings, and what the user would say on the command line."""

    name: str
    truth: dict[str, Any]
    training: list[Made] = field(default_factory=list)
    heldout: list[Made] = field(default_factory=list)
    arguments: list[str] = field(default_factory=list)


def plan(cases: int, seed: int, levels: tuple[str, ...]) -> list[tuple[str, str, int]]:
    """(name, level, turn within the level) of every case; names do not tell the level."""
    order = quotas(cases, levels)
    turns = [order[:i].count(level) for i, level in enumerate(order)]
    shuffled = np.random.default_rng([seed, 0]).permutation(cases)
    return [(f"case-{k:04d}", order[i], turns[i]) for k, i in enumerate(shuffled)]


def _size(kind: str, rng: np.random.Generator) -> tuple[float, float]:
    """Duration [s] and sampling rate [Hz] fit for a kind of scene."""
    moving, surroundings = [*kind.split("/"), "none"][:2]
    if surroundings in LONG:
        rates = (2.0, 5.0, 10.0) if moving != "zero" else (1.0, 2.0, 5.0)
        return float(rng.uniform(7500, 10800)), float(rng.choice(rates))
    if surroundings in MEDIUM:
        return float(rng.uniform(3600, 7200)), float(rng.choice((5.0, 5.0, 10.0)))
    fs = float(rng.choice((5.0, 10.0, 10.0, 20.0, 50.0, 100.0), p=(0.2, 0.3, 0.2, 0.2, 0.07, 0.03)))
    return float(rng.uniform(1200, 1500 if fs > 20 else 3600)), fs


def _chain(rng: np.random.Generator, wanted: Wish, planted: list[Planted]) -> Chain:
    """Nuisance and reporting of one recording; within one case everything but noise and offset is shared."""
    law, share = None, 0.0
    if wanted.wrong_simulation:
        law, share = dict(planted[0].parameters), 1.0
        law.pop("strength")
    elif _simulated(wanted):
        law, share = draw_law(np.random.default_rng(int(wanted.notes["law_seed"]))), 1.0
    twins = any(p.id in ("thermal_lag", "scale_hysteresis", "scale_temperature_rate") for p in planted)
    return Chain(
        seed=int(rng.integers(1 << 40)),
        offset_dps=float(rng.normal(0, 2e-3)),
        # with a simulated gain law of up to 30 % a scale error of the output is one of the rate only when it is small
        scale_ppm=float(rng.normal(0, 150 if law is None else 2)),
        lsb=float(rng.choice([0.0, 0.3])),
        temp_lsb_K=float(wanted.notes["temp_lsb_K"]),
        temp_noise_K=float(rng.uniform(0.005, 0.02)),
        law=law,
        share=share,
        coil_sensor=twins and wanted.level in ("L1", "L2") and wanted.notes["coil"] > 0.8,
    )


def _simulated(wanted: Wish) -> bool:
    """Whether the recording brings the output of a simulation that knows the gain law."""
    return wanted.wrong_simulation or (
        wanted.kind.endswith("/cycle") and wanted.notes["with_simulation"] > 0.75
    )


def make_case(name: str, level: str, turn: int, seed: int) -> Case:
    """Everything of one case, from (seed, level, turn) alone."""
    rng = np.random.default_rng([seed, 1, int(level[1:]), turn])
    case = _attempt(name, level, turn, rng)
    for _ in range(TRIES):
        if level != "L5" or len(case.truth["effects"][0]["inseparable"]) > 1:
            break
        case = _attempt(name, level, turn, rng)
    return case


def _attempt(name: str, level: str, turn: int, rng: np.random.Generator) -> Case:
    wanted = wish(level, turn, rng)
    wanted.notes.update(
        with_simulation=float(rng.random()),
        law_seed=float(rng.integers(1 << 30)),
        temp_lsb_K=float(rng.choice([0.01, 0.02, 0.05])),
        coil=float(rng.random()),
        reference=float(rng.random()),
    )
    count = 2 if rng.random() < 0.15 and level not in ("L4", "L5", "L7", "L10") else 1
    grade = float(np.exp(rng.uniform(np.log(0.7), np.log(6.0))))
    duration, fs = _size(wanted.kind, rng)
    modelled = _simulated(wanted)
    *scenes, other = (make_scene(wanted.kind, duration, fs, grade, rng, modelled) for _ in range(count + 1))
    planted = _plant(wanted, scenes, rng)
    truth = {"case": name, "level": level, "kind": wanted.kind, "effects": []}
    case = Case(name, truth)
    for i, scene in enumerate(scenes):
        case.training.append(_make(f"recording-{i + 1}", scene, planted, _chain(rng, wanted, planted)))
    lasting = [p for p in planted if p.effect.transferable]
    case.heldout.append(_make("heldout-1", other, lasting, _chain(rng, wanted, planted)))
    truth["effects"] = [_describe(p, scenes, case.training, rng, wanted) for p in planted]
    case.arguments = (
        ["--static"] if wanted.kind.startswith("zero/") and wanted.notes["reference"] < 0.5 else []
    )
    for made in (*case.training, *case.heldout):
        if case.arguments:
            del made.columns["ref_rate_dps"]
    truth["recordings"] = {made.name: made.truth for made in (*case.training, *case.heldout)}
    return case


def _plant(wanted: Wish, scenes: list[Scene], rng: np.random.Generator) -> list[Planted]:
    planted = []
    for name, target in wanted.effects:
        effect = ALL[name]
        parameters = effect.draw(rng, scenes[0])
        if effect.fixed is not None:
            parameters = parameters | {"strength": effect.fixed(rng, scenes[0])}
        elif target is not None:
            parameters = solve(effect, scenes, parameters, target)
        planted.append(Planted(effect, parameters))
    return planted


def _make(name: str, scene: Scene, planted: list[Planted], chain: Chain) -> Made:
    noise = noises(scene, chain)
    columns = record(scene, planted, chain, noise)
    waves = {key: wave.astype(WAVE) for key, wave in waveforms(scene, planted, chain, noise[0]).items()}
    truth = {
        "chain": asdict(chain),
        "noise": _noise(scene),
        "kind": scene.kind,
        "rows": len(columns["rate_dps"]),
    }
    truth["simulated"] = chain.law is not None
    waves["omega_dps"] = scene.omega_dps.astype(WAVE)
    if "t_s" in columns and len(columns["t_s"]) != len(scene.t_s):
        kept = np.searchsorted(np.round(scene.t_s, 6), columns["t_s"])
        waves = {key: wave[kept] for key, wave in waves.items()}
    return Made(name, columns, truth, waves)


def _noise(scene: Scene) -> dict[str, Any]:
    """The gyro's own noise, as the sealed truth keeps it."""
    model = scene.gyro_noise
    if isinstance(model, SoakNoise):
        return {"white_dps": model.white_dps, "soak_ppm": model.soak_ppm, "soak": model.soak.tolist()}
    return asdict(model) | {"reference_dps": scene.reference_dps}


def _reached(plant: Planted, scenes: list[Scene], made: list[Made]) -> float:
    """d′ of the waveform as it came out, in the company of the other effects."""
    total = 0.0
    for scene, recording in zip(scenes, made, strict=True):
        if plant.effect.variance is not None:
            total += (
                dprime_variance(plant.effect.variance(scene, plant.parameters), white_variance(scene)) ** 2
            )
        elif plant.id in recording.waves and len(recording.waves[plant.id]) == len(scene.t_s):
            wave = recording.waves[plant.id].astype(float)
            total += float(np.sum(scene.signature(wave, not plant.effect.delay_is_point) ** 2))
    return float(np.sqrt(total))


def _describe(
    plant: Planted, scenes: list[Scene], made: list[Made], rng: np.random.Generator, wanted: Wish
) -> dict[str, Any]:
    """The sealed entry of one effect."""
    effect = plant.effect
    reached = _reached(plant, scenes, made) or dict(wanted.effects)[plant.id] or 0.0
    waves = [m.waves[plant.id].astype(float) for m in made if plant.id in m.waves]
    measurable = effect.variance is None and effect.fixed is None and effect.stage != "frames"
    unlisted = plant.id in UNLISTED
    twins = [plant.id]
    if measurable and not unlisted and reached > 0:
        twins = inseparable(plant, scenes, reached, rng)
    if "coil_temp_degC" in made[0].columns:
        twins = [plant.id]
    return {
        "effect": plant.id,
        "drivers": list(effect.drivers),
        "thermal": bool(set(effect.drivers) & THERMAL_DRIVERS),
        "unlisted": unlisted,
        "frames": effect.stage == "frames",
        "in_reference": effect.stage == "reference",
        "variance": effect.variance is not None,
        "transferable": effect.transferable,
        "dprime": reached,
        "rms_dps": float(np.sqrt(np.mean(np.concatenate(waves) ** 2))) if waves else 0.0,
        "inseparable": twins,
        "catalogue_r2": catalogue_resemblance(plant, scenes, reached, rng) if unlisted else None,
        "parameters": plant.parameters,
        "known": {k: asdict(v) for k, v in effect.truth(scenes[0], plant.parameters).items()},
    }
