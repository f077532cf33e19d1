"""The scorer against hand-made answers, the oracle against itself, the controls and peers on small cases."""

import json

import numpy as np
import pytest
from scipy.stats import beta

from tools.blind import cases, controls, peers, sealing, summary
from tools.blind.catalogue import KNOWN
from tools.blind.proof import active_segments, compare, overlap
from tools.blind.runner import Outcome
from tools.blind.scenes import make_scene
from tools.blind.score import score
from tools.blind.strength import delta, solve
from training.table import read_recording

SEED = 11


def finding(effect, status="named", alternatives=None, driver="temperature", **more):
    base = {"effect": effect, "status": status, "alternatives": alternatives or [effect], "driver": driver}
    return (
        base | {"separate_by": None, "parameters": {}, "rms_dps": 1e-3, "p_value": 1e-4, "where": {}} | more
    )


def document(*findings, verdict=None):
    said = verdict or (findings[0]["status"] if findings else "nothing_missing")
    return {
        "verdict": said,
        "findings": list(findings),
        "drivers": [{"driver": "temperature"}],
        "recordings": [],
    }


def planted(effect, dprime=30.0, **more):
    base = {
        "effect": effect,
        "drivers": ["temperature"],
        "dprime": dprime,
        "rms_dps": 1e-3,
        "inseparable": [effect],
    }
    rest = {"unlisted": False, "frames": False, "known": {}, "catalogue_r2": None, "transferable": True}
    return base | rest | more


def truth(*effects, level="L1"):
    return {"case": "case-0000", "level": level, "kind": "zero/cycle", "effects": list(effects)}


@pytest.fixture(scope="module")
def cycle():
    return make_scene("zero/cycle", 7500, 0.5, 1.0, np.random.default_rng(SEED))


def test_a_named_truth_scores_and_a_silent_choice_is_one():
    said = score(truth(planted("shupe")), document(finding("shupe")), "done")
    assert said["effects"][0]["first"]
    assert said["effects"][0]["class_size"] == 1
    assert said["extra_names"] == 0
    assert not said["confident_wrong"]
    twins = planted("shupe", inseparable=["shupe", "bias_temperature"])
    alone = score(truth(twins, level="L5"), document(finding("shupe")), "done")
    assert alone["silent"][0]["silent"]
    both = finding(
        "bias_temperature", "ambiguous", ["bias_temperature", "shupe"], separate_by="two ramp speeds"
    )
    fair = score(truth(twins, level="L5"), document(both), "done")
    assert fair["silent"] == [{"effect": "shupe", "silent": False, "in_class": True, "advised": True}]


def test_wrong_extra_and_unknown_findings_are_counted_apart():
    said = score(
        truth(planted("shupe")),
        document(finding("earth_rate"), finding("shupe"), finding("unknown", "unknown")),
        "done",
    )
    assert said["extra_names"] == 1
    assert said["extra_unknown"] == 1
    assert said["confident_wrong"]
    assert said["effects"][0]["in_class"]
    assert not said["effects"][0]["first"]


def test_null_recordings_alarm_on_anything_but_silence():
    quiet = score(truth(level="L0"), document(), "done")
    loud = score(truth(level="L0"), document(finding("unknown", "unknown")), "done")
    faulty = score(truth(level="L0"), document(verdict="bad_recording"), "done")
    assert [s["false_alarm"] for s in (quiet, loud, faulty)] == [False, True, True]
    assert score(truth(level="L0"), None, "crashed")["verdict"] == "crashed"


def test_integrity_faults_count_where_the_recordings_report_them():
    found = document() | {
        "recordings": [{"file": "a", "integrity": [{"effect": "frozen_frames", "samples": 90}]}]
    }
    said = score(truth(planted("frozen_frames", frames=True), level="L10"), found, "done")
    assert said["effects"][0]["in_class"]


def test_parameters_are_compared_and_covered():
    known = {"c_ppm": {"value": -50.0, "exact": True, "magnitude": False}}
    entry = {"c_ppm": {"value": -45.0, "unit": "ppm", "ci95": [-52.0, -38.0]}}
    said = score(
        truth(planted("scale_asymmetry", known=known)),
        document(finding("scale_asymmetry", parameters=entry)),
        "done",
    )
    row = said["effects"][0]["parameters"][0]
    assert row["error"] == pytest.approx(0.1)
    assert row["covered"]


def test_an_unlisted_effect_wants_unknown_and_its_driver():
    stranger = planted("mode_hops", unlisted=True, catalogue_r2=0.2)
    hit = score(truth(stranger, level="L8"), document(finding("unknown", "unknown")), "done")
    miss = score(truth(stranger, level="L8"), document(finding("unknown", "unknown", driver="time")), "done")
    assert hit["unlisted"][0]["flagged"]
    assert hit["unlisted"][0]["driver_right"]
    assert not miss["unlisted"][0]["driver_right"]
    named = score(truth(stranger, level="L8"), document(finding("polarization_ripple")), "done")
    assert not named["unlisted"][0]["flagged"]
    assert named["confident_wrong"]


def test_the_oracle_has_ratio_one_and_doing_nothing_zero(cycle):
    rng = np.random.default_rng(SEED)
    effect = KNOWN["shupe"]
    parameters = solve(effect, [cycle], effect.draw(rng, cycle), 60.0)
    wave = delta(effect, cycle, parameters)
    residual = wave + cycle.noise.sample(len(wave), rng)
    fed = compare(residual, wave, wave, cycle.omega_dps, cycle.noise)
    idle = compare(residual, np.zeros_like(wave), wave, cycle.omega_dps, cycle.noise)
    shifted = compare(residual, wave + 3.0, wave, cycle.omega_dps, cycle.noise)
    assert fed["misfit_ratio"] == pytest.approx(1.0)
    assert fed["rms_ratio"] == pytest.approx(1.0)
    assert idle["misfit_ratio"] == pytest.approx(0.0)
    assert shifted["misfit_ratio"] == pytest.approx(1.0)


def test_segments_and_their_overlap():
    t = np.arange(0, 6000, 1.0)
    wave = np.where((t > 1200) & (t < 1800), np.sin(t / 30), 0.0)
    segments = active_segments(wave, t)
    assert overlap(segments, [(1200.0, 1800.0)]) > 0.85
    assert overlap([(0.0, 100.0)], [(50.0, 150.0)]) == pytest.approx(1 / 3, abs=0.01)
    assert overlap([], []) == 0.0


def test_rates_carry_the_exact_interval():
    told = summary.rate([True] * 3 + [False] * 97)
    assert told["low"] == pytest.approx(beta.ppf(0.025, 3, 98))
    assert told["high"] == pytest.approx(beta.ppf(0.975, 4, 97))
    assert summary.rate([])["rate"] is None


def test_a_summary_of_hand_made_scores_counts_right():
    scores = [
        score(truth(level="L0"), document(), "done"),
        score(truth(level="L0"), document(finding("shupe")), "done"),
        score(truth(planted("shupe")), document(finding("shupe")), "done"),
        score(
            truth(planted("shupe")),
            document(finding("bias_temperature", "ambiguous", ["bias_temperature", "shupe"])),
            "done",
        ),
    ]
    for s in scores:
        s.update(seconds=1.0, heldout=[], overlap=None, message="")
    told = summary.summarise(scores)
    assert told["null"]["false_alarm"]["k"] == 1
    assert told["single"]["strong_first"]["rate"] == 0.5
    assert told["single"]["strong_in_class"]["rate"] == 1.0
    assert told["single"]["strong_class_size"]["mean"] == 1.5
    assert told["confusion"]["shupe"] == {"shupe": 1, "bias_temperature": 1}
    json.dumps(told, allow_nan=False)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("trial")
    seals = {}
    for name, level, turn in (("case-0000", "L0", 0), ("case-0001", "L2", 0), ("case-0002", "L0", 3)):
        seals[name] = sealing.write_case(cases.make_case(name, level, turn, SEED), root / name)
    return root, seals


def scored(root, seals, name, found):
    said = score(sealing.open_case(root / name, seals[name])[0], found, "done")
    return said | {"seconds": 1.0, "heldout": [], "overlap": None, "message": ""}


def test_a_shuffled_label_keeps_everything_but_the_temperature(made, tmp_path):
    root, seals = made
    scores = [scored(root, seals, name, document()) for name in ("case-0000", "case-0002")]
    variants = controls._prepare_shuffle(root, tmp_path, scores, 2, np.random.default_rng(SEED))
    name, case = next(iter(variants.items()))
    before, after = (
        read_recording(p / "seen" / "recording-1.parquet") for p in (root / case, tmp_path / name)
    )
    np.testing.assert_array_equal(before["rate_dps"], after["rate_dps"])
    assert not np.array_equal(before["temp_degC"], after["temp_degC"])
    loud = Outcome("done", "", 1.0, document(finding("shupe", driver="temperature_rate")))
    told = controls._judge_shuffle(variants, dict.fromkeys(variants, loud))
    assert told["thermal_finding"]["rate"] == 1.0


def test_time_run_backwards_twice_is_the_recording_again(made):
    root, _ = made
    columns = read_recording(root / "case-0002" / "seen" / "recording-1.parquet").columns
    twice = controls._backwards(controls._backwards(columns))
    for name in ("t_s", "rate_dps", "temp_degC"):
        np.testing.assert_allclose(twice[name], columns[name], atol=1e-6)
    assert np.all(np.diff(controls._backwards(columns)["t_s"]) > 0)


def test_a_dynamic_effect_that_keeps_its_sign_backwards_fails_the_control(tmp_path):
    scores = {"case-0001": {"truth": ["thermal_lag"]}, "case-0002": {"truth": ["scale_temperature"]}}

    def says(effect, value):
        entry = {"scale_ppm_per_K": {"value": value, "unit": "ppm/K", "ci95": [value, value]}}
        return document(finding(effect, parameters=entry))

    folder = tmp_path / "case-0001" / "found"
    folder.mkdir(parents=True)
    (folder / "diagnosis.json").write_text(json.dumps(says("thermal_lag", -100.0)))
    variants = {"reversed-case-0001": "case-0001", "reversed-case-0002": "case-0002"}
    for value, changed in ((-90.0, 0.0), (90.0, 1.0)):
        outcomes = {
            "reversed-case-0001": Outcome("done", "", 1.0, says("thermal_lag", value)),
            "reversed-case-0002": Outcome("done", "", 1.0, says("scale_temperature", 5.0)),
        }
        told = controls._judge_reversal(variants, outcomes, scores, tmp_path)
        assert told["dynamic_changed"]["rate"] == changed
        assert told["static_kept"]["rate"] == 1.0


def test_what_a_real_axis_shows_already_is_not_counted_as_recovered():
    variants = {"a": ("x", ""), "b": ("x", "bias_step"), "c": ("x", "shupe")}
    outcomes = {
        "a": Outcome("done", "", 1.0, document(finding("shupe"))),
        "b": Outcome("done", "", 1.0, document(finding("shupe"), finding("bias_step"))),
        "c": Outcome("done", "", 1.0, document(finding("shupe"))),
    }
    told = controls._judge_injection(variants, outcomes)
    assert (told["recovered"]["k"], told["recovered"]["n"]) == (1, 1)


def test_injections_have_the_peak_they_promise():
    t = np.arange(0, 4000, 0.5)
    temp = 50 - 60 * np.sin(t / 900)
    for name, wave in controls._injections(temp, t, np.random.default_rng(SEED)).items():
        assert np.max(np.abs(wave)) == pytest.approx(controls.REAL_UNIT_DPS[name])


@pytest.mark.slow
def test_a_peer_finds_a_planted_column_and_predicts_it():
    rng = np.random.default_rng(SEED)
    X = rng.normal(size=(1500, 3))
    y = 2.0 * X[:, 1] + 0.1 * rng.normal(size=1500)
    names = ["shupe", "bias_temperature", "bias_drift"]
    for peer in (peers.lasso, peers.boosting, *([peers.stlsq] if "stlsq" in peers.available() else [])):
        answer = peer(X, y, names)
        assert answer.found
        assert answer.names[:1] in ([], ["bias_temperature"])
        assert np.corrcoef(answer.predict(X), y)[0, 1] > 0.95
