"""The blind proof's own honesty: same seed same cases, truths that cannot be changed, d′ and scores that are right."""

import ast
from pathlib import Path

import numpy as np
import pytest

from rtcomp.errors import RequestError, WorkError
from tools.blind import cases, sealing
from tools.blind.catalogue import ALL, KNOWN, UNLISTED
from tools.blind.effect import Planted
from tools.blind.levels import LEVELS, quotas
from tools.blind.noise import NoiseModel, SoakNoise, dprime, dprime_variance, draw_noise
from tools.blind.relays import preisach
from tools.blind.scenes import make_scene
from tools.blind.strength import delta, inseparable, solve, strength_dprime
from tools.blind.thermal import conduct, ladder, mohr

SEED = 11


@pytest.fixture(scope="module")
def cycle():
    return make_scene("zero/cycle", 7500, 0.5, 1.0, np.random.default_rng(SEED))


def test_generator_and_tool_share_no_code():
    folder = Path(cases.__file__).parent
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                assert not name.startswith("training.") or name == "training.table", (path.name, name)


def test_same_seed_gives_the_same_sealed_case_and_another_seed_another(tmp_path):
    seals = []
    for i, seed in enumerate((SEED, SEED, SEED + 1)):
        case = cases.make_case("case-0000", "L1", 3, seed)
        seals.append(sealing.write_case(case, tmp_path / str(i)))
    assert seals[0] == seals[1] != seals[2]
    first, second = ((tmp_path / f"{i}/seen/recording-1.parquet").read_bytes() for i in range(2))
    assert first == second


def test_an_edited_truth_is_refused_and_an_untouched_one_opens(tmp_path):
    case = cases.make_case("case-0001", "L1", 3, SEED)
    seal = sealing.write_case(case, tmp_path)
    opened, arrays = sealing.open_case(tmp_path, seal)
    assert opened["effects"][0]["effect"] == case.truth["effects"][0]["effect"]
    assert any(name.startswith("heldout-1/") for name in arrays)
    path = tmp_path / "sealed" / "truth.json"
    path.write_text(path.read_text().replace('"level":"L1"', '"level":"L2"'))
    with pytest.raises(WorkError, match="sealed was"):
        sealing.open_case(tmp_path, seal)


def test_what_the_tool_sees_tells_nothing_of_the_truth(tmp_path):
    case = cases.make_case("case-0002", "L1", 1, SEED)
    sealing.write_case(case, tmp_path)
    words = " ".join(str(p.name) for p in (tmp_path / "seen").iterdir())
    words += (tmp_path / "seen" / "arguments.json").read_text()
    assert not any(name in words for name in ALL)


def test_levels_share_the_cases_and_turns_count_up_within_a_level():
    planned = cases.plan(109, SEED, LEVELS)
    levels = [level for _, level, _ in planned]
    assert levels.count("L0") == 25
    assert levels.count("L8") == 15
    for level in LEVELS:
        turns = sorted(turn for _, other, turn in planned if other == level)
        assert turns == list(range(len(turns)))
    assert [name for name, _, _ in planned] == sorted(name for name, _, _ in planned)
    assert quotas(7, ("L0",)) == ["L0"] * 7


def test_dprime_of_a_waveform_in_white_noise_is_its_norm_over_sigma_beyond_the_nuisance():
    n, sigma = 400, 0.3
    noise = NoiseModel(0.1, sigma, 0.0, ())
    ones = np.ones((n, 1))
    wave = np.sin(np.linspace(0, 20, n)) + 5.0
    assert dprime(noise, wave, ones) == pytest.approx(np.linalg.norm(wave - wave.mean()) / sigma, rel=1e-9)
    assert dprime(noise, 7 * np.ones(n), ones) == pytest.approx(0, abs=1e-6)


def test_dprime_with_a_full_covariance_agrees_with_solving_it():
    rng = np.random.default_rng(SEED)
    soak = np.repeat(np.arange(6), 8)
    rate = np.tile(np.linspace(-90, 90, 8), 6)
    noise = SoakNoise(0.01, 80.0, rate, soak)
    covariance = 0.01**2 * np.eye(48) + (soak[:, None] == soak) * np.outer(rate, rate) * 80e-6**2
    wave, nuisance = rng.normal(size=48), np.column_stack([np.ones(48), rate])
    inverse = np.linalg.inv(covariance)
    inner = wave @ inverse @ wave
    cross = nuisance.T @ inverse @ wave
    expected = inner - cross @ np.linalg.solve(nuisance.T @ inverse @ nuisance, cross)
    assert dprime(noise, wave, nuisance) == pytest.approx(np.sqrt(expected), rel=1e-6)


def test_sampled_noise_is_white_with_unit_variance_after_whitening():
    noise = draw_noise(np.random.default_rng(SEED), 1.0, 1.0)
    whitened = [noise.whiten(noise.sample(4096, np.random.default_rng(i)))[1:] for i in range(30)]
    power = np.mean(np.square(whitened), axis=0)
    for band in (power[:40], power[40:400], power[400:]):
        assert band.mean() == pytest.approx(1.0, abs=0.12)


def test_variance_dprime_is_zero_without_extra_variance_and_quadratic_at_first():
    assert dprime_variance(np.zeros(100), 1.0) == 0.0
    small = dprime_variance(np.full(10_000, 1e-3), 1.0)
    assert small == pytest.approx(np.sqrt(10_000 / 2) * 1e-3, rel=1e-2)


@pytest.mark.parametrize("name", ["shupe", "bias_hysteresis", "compensation_table", "thermostat"])
def test_strengths_are_found_for_a_wanted_dprime(name, cycle):
    effect = ALL[name]
    parameters = effect.draw(np.random.default_rng(SEED), cycle)
    solved = solve(effect, [cycle], parameters, 25.0)
    assert strength_dprime(effect, [cycle], solved) == pytest.approx(25.0, rel=0.15)


def test_strength_of_a_nonlinear_effect_is_found_too():
    scene = make_scene("creep/constant", 1200, 5.0, 1.0, np.random.default_rng(SEED))
    effect = KNOWN["dead_band"]
    assert strength_dprime(effect, [scene], solve(effect, [scene], {}, 20.0)) == pytest.approx(20.0, rel=0.15)


def test_every_effect_does_something_in_every_scene_it_names():
    for effect in (*KNOWN.values(), *UNLISTED.values()):
        for kind in dict.fromkeys(effect.kinds):
            rng = np.random.default_rng(SEED)
            scene = make_scene(kind, 1500, 4.0, 1.0, rng)
            size = effect.unit if effect.fixed is None else effect.fixed(rng, scene)
            change = delta(effect, scene, effect.draw(rng, scene) | {"strength": size})
            assert np.all(np.isfinite(change)), (effect.id, kind)
            assert np.std(change) > 0, (effect.id, kind)


def test_lag_and_gradient_cannot_be_told_apart_when_faint(cycle):
    scene = make_scene("table/ramp", 3600, 1.0, 1.0, np.random.default_rng(SEED))
    rng = np.random.default_rng(SEED)
    effect = KNOWN["thermal_lag"]
    plant = Planted(effect, solve(effect, [scene], effect.draw(rng, scene), 12.0))
    assert "scale_temperature_rate" in inseparable(plant, [scene], 12.0, rng)


def test_a_ladder_settles_and_a_coil_forgets_its_start():
    drive = np.concatenate([np.zeros(5), np.full(2000, 10.0)])
    assert ladder(drive, 2.0, (60.0, 90.0))[-1] == pytest.approx(10.0, abs=1e-3)
    coil = conduct(drive, 2.0, 0.008, 1.5e-7, 0.2)
    assert coil.mean_degC[-1] == pytest.approx(10.0, abs=0.02)
    area = np.sum(drive[5:] - coil.mean_degC[5:]) * 2.0 / 10.0
    assert area == pytest.approx(coil.lag_s, rel=0.02)


def test_a_symmetric_winding_feels_less_than_an_asymmetric_one():
    face = np.interp(np.arange(0, 6000, 2.0), [0, 1000, 4000, 6000], [20, 20, 60, 60])
    coil = conduct(face, 2.0, 0.008, 1.5e-7, 0.2)
    plateau = slice(1600, 1900)
    perfect = mohr(coil, face, 0.0, 0.0, 0.0)[plateau]
    trimmed = mohr(coil, face, 0.8, 2.0, 0.0)[plateau]
    assert np.abs(perfect).mean() < 0.2 * np.abs(trimmed).mean()


def test_relays_remember_direction_but_not_speed():
    slow, fast = (np.concatenate([np.linspace(0, 40, n), np.linspace(40, 0, n)]) for n in (4000, 500))
    loops = [preisach(drive, 4.0, 0.2, 1) for drive in (slow, fast)]
    heights = [loop[3 * len(loop) // 4] - loop[len(loop) // 4] for loop in loops]
    assert heights[0] == pytest.approx(8.0, rel=0.1)
    assert heights[1] == pytest.approx(heights[0], rel=0.05)


def test_a_kept_trial_is_not_continued_with_another_request(tmp_path):
    from tools.blind.trial import seal_cases

    sealing.write_seals({}, {"seed": 1, "count": 4, "levels": ["L0"]}, tmp_path)
    with pytest.raises(RequestError, match="another trial"):
        seal_cases(tmp_path, 5, 1, ("L0",), 1, lambda *_: None)
