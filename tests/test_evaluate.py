"""Scores, groups, validity and the evaluation document, on errors whose answer is known."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.cli import cli
from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import Term, new_model, save_model
from training.evaluate import evaluate
from training.groups import blocks, groups_of, soaks
from training.inputs import check
from training.rest import allan, longest_rest
from training.scores import median_interval, ratio_interval, rms_interval, score
from training.table import Recording, write_recording
from training.validity import coverage, held_out_residuals, residual_table

BIAS = new_model(terms=[Term("bias_error", {"dps": 0.5})], residual_std_dps=0.1)


def drive(n=600, seed=0, bias=0.5):
    """Turning, then at rest, with a constant bias."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.1
    true = np.where(t < t[n // 2], 30 * np.sin(t / 3), 0.0)
    columns = {
        "t_s": t,
        "rate_dps": true + bias + 0.1 * rng.standard_normal(n),
        "temp_degC": 20 + 10 * np.sin(t / 20),
        "ref_rate_dps": true,
    }
    return check(Recording(f"drive{seed}", columns))


def soaked(seed=0):
    """Six soaks of ten rates with one error per soak."""
    rng = np.random.default_rng(seed)
    temp, true = np.repeat(np.arange(0.0, 60.0, 10.0), 10), np.tile(np.linspace(-90, 90, 10), 6)
    error = np.repeat(rng.standard_normal(6), 10) * 1e-3 * true
    return check(Recording("table", {"rate_dps": true + error, "temp_degC": temp, "ref_rate_dps": true}))


def test_score_of_a_known_error():
    found = score(np.array([3.0, -4.0, 0.0]))
    assert (found.max_dps, found.min_dps) == (4.0, 0.0)
    assert found.rms_dps == pytest.approx(np.sqrt(25 / 3))
    assert found.rms_ci95 is None


def test_clustered_interval_covers_and_the_independent_one_does_not():
    rng = np.random.default_rng(0)
    hits, naive = 0, 0
    for _ in range(300):
        clusters = np.repeat(np.arange(15), 40)
        error = rng.standard_normal(15)[clusters] + 0.1 * rng.standard_normal(600)
        truth = np.sqrt(1.01)
        low, high = rms_interval(error, clusters)
        hits += low <= truth <= high
        low, high = rms_interval(error, np.arange(600))
        naive += low <= truth <= high
    assert 0.88 <= hits / 300 <= 0.99
    assert naive / 300 < 0.5


def test_ratio_interval_holds_the_ratio():
    rng = np.random.default_rng(0)
    a = rng.standard_normal(2000)
    b = 3 * rng.standard_normal(2000)
    low, high = ratio_interval(a, b, np.arange(2000) // 50)
    assert low < 3 < high
    assert high / low < 1.3
    assert ratio_interval(a, b, np.zeros(2000)) is None


def test_median_interval_holds_the_median():
    values = np.random.default_rng(0).normal(5.0, 1.0, 40)
    low, high = median_interval(values)
    assert low <= np.median(values) <= high


def test_groups():
    assert soaks(np.array([0.0, 0.1, 5.0, 5.1, 0.0])).tolist() == [0, 0, 1, 1, 2]
    groups, what = groups_of([soaked().recording])
    assert (what, len(np.unique(groups))) == ("soak", 6)
    groups, what = groups_of([soaked(1).recording, soaked(2).recording])
    assert (what, len(np.unique(groups))) == ("soak", 12)
    groups, what = groups_of([drive(100).recording, drive(50).recording])
    assert (what, np.bincount(groups).tolist()) == ("recording", [100, 50])
    groups, what = groups_of([drive().recording])
    assert (what, len(np.unique(groups))) == ("block", 20)
    assert np.ptp(np.bincount(groups)) <= 1
    late = drive()
    late.recording.columns["t_s"] = late.recording["t_s"] + np.random.default_rng(1).exponential(
        0.05, len(late.recording)
    )
    assert np.array_equal(groups_of([late.recording])[0], groups), "another jitter, other blocks"
    assert blocks(3).tolist() == [0, 1, 2]


def test_residual_table_covers_new_groups():
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(60):
        groups = np.repeat(np.arange(18), 36)
        temp, rate = np.repeat(np.linspace(-30, 55, 18), 36), np.tile(np.linspace(-180, 180, 36), 18)
        left = 3e-4 * rng.standard_normal(18)[groups] * rate + 0.006 * rng.standard_normal(648)
        train = np.isin(groups, rng.permutation(18)[:12])
        stated = residual_table(temp[train], rate[train], left[train], groups[train])
        given = predict(new_model(residual_std_dps=stated), rate, temp)
        shares.append(coverage(left[~train], given.sigma_dps[~train]))
    assert 0.90 <= np.mean(shares) <= 0.98


def test_held_out_residuals_never_see_their_group():
    groups = np.repeat(np.arange(4), 5)

    def mean_of_the_others(train, test):
        assert not set(groups[train]) & set(groups[test])
        return np.full(test.sum(), groups[train].mean())

    left = held_out_residuals(groups, mean_of_the_others, groups.astype(float))
    assert left[0] == pytest.approx(0 - 2.0)
    with pytest.raises(RequestError, match="one group only"):
        held_out_residuals(np.zeros(5), mean_of_the_others, np.zeros(5))


def test_evaluation_of_a_model_that_is_right():
    told = evaluate({"bias": BIAS}, [drive(seed=1), drive(seed=2)], baselines=False)
    by = {row["method"]: row for row in told["rows"]}
    assert by["bias"]["rms_dps"] == pytest.approx(0.1, rel=0.1)
    assert by["bias"]["improvement"] > 4.5
    assert by["uncompensated"]["improvement"] == 1.0
    assert told["groups"] == {"what": "recording", "count": 2}
    assert told["coverage"]["bias"] == pytest.approx(0.95, abs=0.03)
    assert sum(row["samples"] for row in told["per_temperature"]) == 1200
    json.dumps(told, allow_nan=False)


def test_baselines_are_held_out_and_cannot_learn_what_a_soak_keeps_to_itself():
    told = evaluate({}, [soaked()])
    by = {row["method"]: row for row in told["rows"]}
    assert by["boosted_trees"]["rms_dps"] > 0.7 * by["uncompensated"]["rms_dps"]
    assert "held" in told["baselines"] or "without the soak" in told["baselines"]
    assert "weighted_average" not in by


def test_a_gyro_that_never_turned_does_not_betray_its_error_through_its_rate():
    still = drive(400)
    table = still.recording
    still = check(
        Recording("still", {n: table[n] for n in ("t_s", "temp_degC")} | {"rate_dps": still.error_dps}), True
    )
    told = evaluate({}, [still])
    by = {row["method"]: row for row in told["rows"]}
    for method in ("linear_plane", "lookup_table", "boosted_trees"):
        assert by[method]["rms_dps"] > 0.09  # the noise stays


def test_allan_deviation_of_white_noise_falls_with_the_root_of_tau():
    item = drive(4000, bias=0.0)
    start, stop = longest_rest(item)
    assert stop - start >= 2000
    curve = allan([item], {"raw": item.error_dps})[0]["methods"]["raw"]
    assert curve["adev_dps"][0] == pytest.approx(0.1, rel=0.1)
    assert curve["adev_dps"][4] == pytest.approx(curve["adev_dps"][0] / 4, rel=0.25)


def test_in_sample_is_called_so():
    table = drive().recording
    known = Recording("a", table.columns, sha256="abc")
    model = new_model(terms=BIAS.terms, provenance={"recordings": [{"name": "a", "sha256": "abc"}]})
    told = evaluate({"m": model}, [check(known)], baselines=False)
    assert told["rows"][1]["in_sample"] is True
    assert told["rows"][0]["in_sample"] is None


def test_command(tmp_path):
    write_recording(drive().recording, tmp_path / "drive.csv")
    save_model(BIAS, tmp_path / "bias.json")
    files = [str(tmp_path / "bias.json"), str(tmp_path / "drive.csv")]
    shown = CliRunner().invoke(cli, ["evaluate", *files, "--no-baselines"], catch_exceptions=False)
    assert "bias instability" in shown.stdout
    told = CliRunner().invoke(cli, ["evaluate", *files, "--no-baselines", "--json"], catch_exceptions=False)
    assert json.loads(told.stdout)["schema"] == "rtcomp.evaluation/1"
    with pytest.raises(RequestError, match="no recording"):
        CliRunner().invoke(cli, ["evaluate", files[0]], catch_exceptions=False)
