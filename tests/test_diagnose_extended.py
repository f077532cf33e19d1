"""Found physics goes back to work: every effect with a term, from the fitted model to the frames on a bus."""

import dataclasses

import numpy as np
import pytest
from click.testing import CliRunner
from diagnose_cases import profile, recording

from rtcomp import fog_format
from rtcomp.commands.model import command as model_command
from rtcomp.model import load_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from rtcomp.terms import TERMS
from training.diagnose.design import domain
from training.diagnose.extended import UNKNOWN_DRIVERS
from training.diagnose.generic import generic_groups
from training.diagnose.groups import GROUPS
from training.diagnose.intake import checked_recording, full_work, take_in
from training.diagnose.naming import Part, build
from training.diagnose.pipeline import Analysis, _prove
from training.diagnose.prepare import survey
from training.diagnose.run import write_all
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation
from training.diagnose.unknown import Unknown
from training.diagnose.verdict import conclude
from training.table import Recording, read_recording

START_NS = 1_767_225_600_000_000_000
BASED_ON_COEFFICIENTS = {"scale_error", "bias_error", "unit_error", "unknown"}
CAUSAL = [g for g in GROUPS if g.effect in TERMS]
SETTINGS = Settings(surrogates=8)
SHARES = {
    "shupe": 0.06,  # the compensator smooths the temperature causally
    "scale_temperature_rate": 0.06,
    "compensation_table": 0.10,  # and sees the sawtooth's jumps as they are
}
SLOPE = {"temperature_rate", "rate_times_temperature_rate"}


def analysis_of(planted: np.ndarray, seed=41) -> tuple[Analysis, Recording]:
    """An analysis up to the search, of a recording with `planted` error, and the recording held out."""
    cases = []
    for k, name in enumerate(("seen", "unseen")):
        case = recording(seed + k)
        columns = {
            **case.columns,
            "rate_dps": case["ref_rate_dps"] + planted + 0.1 * (case["rate_dps"] - case["ref_rate_dps"]),
        }
        cases.append(Recording(name, columns))
    intake = take_in(cases[0], checked_recording(cases[0], False), Simulation("ideal"), SETTINGS)
    found = Analysis(SETTINGS, Simulation("ideal"), [intake], [], survey([intake.work]))
    found.domains = [domain(intake.work)]
    found.base = found.model = build([], found.domains)
    return found, cases[1]


def finished(found: Analysis, unseen: Recording, folder):
    """The rest of a diagnosis: proof, document, files."""
    _prove(found, [unseen])
    diagnosis = conclude(found)
    write_all(found, diagnosis, [unseen], folder)
    return diagnosis


def corrections_on_a_bus(model, case: Recording) -> np.ndarray:
    """What the compensator takes off every rate frame of a recording."""
    t_ns = START_NS + np.rint(case["t_s"] * 1e9).astype(np.int64)
    frames = fog_format.merge(
        fog_format.encode_temperature(t_ns, case["temp_degC"], case["temp_degC"]),
        fog_format.encode_rate(t_ns, case["rate_dps"]),
    )
    pipeline = Pipeline(compile_map(load_map("fog")), {"yaw": [model]}, START_NS)
    return pipeline.process_all(frames).corrected["correction_dps"]


def agree(folder, unseen: Recording, share: float):
    """The table of the proof and the compensator on the bus say the same, but for a constant."""
    shown = CliRunner().invoke(model_command, [str(folder / "extended.json")])
    assert shown.exit_code == 0, shown.output
    table = read_recording(
        folder / "heldout/unseen.csv", {"rate_dps": "correction_dps"}, require=("t_s", "rate_dps")
    )
    np.testing.assert_allclose(table["t_s"], unseen["t_s"], atol=1e-9)
    live = corrections_on_a_bus(load_model(folder / "extended.json"), unseen)
    difference = live - table["rate_dps"]
    assert np.std(table["rate_dps"]) > 1e-4
    assert np.std(difference) < share * np.std(table["rate_dps"])


def points_of(group, found: Analysis):
    """The richest shapes of a group: one grid point per set of coefficients, the middle one."""
    grid = group.grid(found.survey) or [{"period_K": 10.0, "phase_K": 2.0}]
    kinds = {}
    for point in grid:
        key = (*[n for n, _ in group.linear(point)], point.get("shape"))
        kinds.setdefault(key, []).append(point)
    return [points[len(points) // 2] for points in kinds.values()]


@pytest.mark.slow
@pytest.mark.parametrize("group", CAUSAL, ids=lambda g: g.effect)
def test_an_effect_corrects_on_the_bus_what_its_proof_predicts(group, tmp_path):
    blank, _ = analysis_of(np.zeros(len(profile()[0])))
    for index, point in enumerate(points_of(group, blank)):
        columns = np.stack(group.columns(full_work(blank.intakes[0], True), point), axis=1)
        sizes = 0.02 / np.maximum(np.std(columns, axis=0), 1e-30)
        planted = columns @ (sizes * np.where(np.arange(len(sizes)) % 2, -0.5, 1.0))
        found, unseen = analysis_of(planted)
        found.model = build([Part(group, [point], 1e-9, chi2=1e4)], found.domains)
        folder = tmp_path / str(index)
        folder.mkdir()
        diagnosis = finished(found, unseen, folder)
        assert group.effect in {f.effect for f in diagnosis.findings}
        model = load_model(folder / "extended.json")
        assert group.effect in {t.effect for t in model.terms}
        assert group.effect not in model.provenance["not_causal"]
        agree(folder, unseen, SHARES.get(group.effect, 0.02))


# Of the rate: on levels that stand apart a function is known on the levels, and the bus reads the rate with its error.
@pytest.mark.slow
@pytest.mark.parametrize("driver", UNKNOWN_DRIVERS)
def test_the_unnamed_corrects_on_the_bus_what_its_proof_predicts(driver, tmp_path):
    blank, _ = analysis_of(np.zeros(len(profile()[0])))
    [group] = [g for g in generic_groups([blank.intakes[0].work]) if g.effect == driver]
    for index, point in enumerate(points_of(group, blank)):
        columns = np.stack(group.columns(full_work(blank.intakes[0], True), point), axis=1)
        planted = columns @ np.cos(2.0 * np.arange(columns.shape[1]))
        planted *= 0.02 / np.std(planted)
        found, unseen = analysis_of(planted)
        found.unknown = Unknown(driver, Part(group, [point]), 1e-9, 1e4, [], named=True)
        folder = tmp_path / str(index)
        folder.mkdir()
        diagnosis = finished(found, unseen, folder)
        assert diagnosis.verdict == "unknown"
        assert diagnosis.fit.improvement > 0.5
        [term] = load_model(folder / "extended.json").terms
        assert term.effect == "unknown"
        agree(folder, unseen, 0.35 if driver in SLOPE else 0.1 if driver == "rate" else 0.05)


def test_wrong_coefficients_come_along_with_the_rest(tmp_path):
    t, rate, _ = profile()
    found, unseen = analysis_of(0.03 * rate + 0.8)
    diagnosis = finished(found, unseen, tmp_path)
    assert {f.effect for f in diagnosis.findings} == {"scale_error", "bias_error"}
    agree(tmp_path, unseen, 0.03)
    live = corrections_on_a_bus(load_model(tmp_path / "extended.json"), unseen)
    table = np.genfromtxt(tmp_path / "heldout/unseen.csv", delimiter=",", names=True)
    np.testing.assert_allclose(live.mean(), table["correction_dps"].mean(), atol=0.01)
    assert len(t) == len(live)


def test_a_large_static_error_is_corrected_from_the_measured_rate(tmp_path):
    """The reference gyro's size: ten percent of the rate, so that true and measured rate are far apart."""
    _, rate, temp = profile()
    h = temp - 25.0
    planted = rate * (0.04 - 1.3e-3 * h) - 1.6e-6 * rate**3
    found, unseen = analysis_of(planted)
    chosen = {"scale_temperature": {"order": 1.0}, "scale_nonlinearity": {"order": 1.0}}
    parts = [Part(g, [chosen[g.effect]], 1e-9, chi2=1e4) for g in GROUPS if g.effect in chosen]
    found.model = build(parts, found.domains)
    finished(found, unseen, tmp_path)
    live = corrections_on_a_bus(load_model(tmp_path / "extended.json"), unseen)
    left = unseen["rate_dps"] - live - unseen["ref_rate_dps"]
    assert np.std(planted) > 2.0
    assert np.std(left) < 0.01 * np.std(planted)


def test_every_term_of_the_runtime_can_come_from_a_diagnosis():
    assert {g.effect for g in CAUSAL} | BASED_ON_COEFFICIENTS == set(TERMS)


def test_what_the_bus_cannot_know_is_named_in_the_model(tmp_path):
    [group] = [g for g in GROUPS if g.effect == "dead_band"]
    found, unseen = analysis_of(np.zeros(len(profile()[0])))
    found.model = build([Part(group, [{"lock_dps": 0.5, "shape": 1.0}], 1e-9, chi2=1e4)], found.domains)
    finished(found, unseen, tmp_path)
    model = load_model(tmp_path / "extended.json")
    assert not model.terms
    assert model.provenance["not_causal"] == ["dead_band"]


def test_a_recording_out_of_order_gets_its_correction_row_by_row(tmp_path):
    t, rate, _ = profile()
    [group] = [g for g in GROUPS if g.effect == "scale_asymmetry"]
    found, unseen = analysis_of(3e-4 * np.abs(rate))
    found.model = build([Part(group, [{}], 1e-9, chi2=1e4)], found.domains)
    order = np.arange(len(t))
    order[100:400] = order[100:400][::-1]
    order = np.insert(order, 2000, [1999, 1999])
    shuffled = Recording("unseen", {k: v[order] for k, v in unseen.columns.items()})
    shuffled.columns["t_s"][7] = np.nan
    finished(found, dataclasses.replace(shuffled), tmp_path)
    table = np.genfromtxt(tmp_path / "heldout/unseen.csv", delimiter=",", names=True)
    assert len(table) == len(order)
    assert np.isfinite(table["t_s"]).all()
    np.testing.assert_allclose(np.delete(table["t_s"], 7), np.delete(shuffled["t_s"], 7))
    expected = 3e-4 * np.abs(shuffled["ref_rate_dps"])
    assert np.std(table["correction_dps"] - expected) < 0.05 * np.std(expected)
