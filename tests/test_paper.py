"""`rtcomp paper`: the document it promises, and the order of the methods."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.cli import cli
from training.paper import COLUMNS, METHODS, PRINTED, error_left, experiment, ratios, report
from training.paper_figures import draw, surfaces
from training.rate_table import split_points

ROW = {"method", *COLUMNS, "soak_split_std", "ci95", "paper"}


@pytest.fixture(scope="module")
def run():
    return experiment(0)


def left(method, run):
    train = split_points(run.table)
    return error_left(method, run, train)[~train]


def test_filters_pass_the_temperature_error(run):
    raw = left("uncompensated", run).std()
    for method in ("weighted_average", "five_point_cubic", "wavelet"):
        assert left(method, run).std() == pytest.approx(raw, rel=1e-3)


def test_order_of_the_methods_is_the_papers(run):
    order = (
        "ts_refined",
        "lssvm",
        "ts_gk_rls",
        "ts_gk_rls_printed",
        "linear_bilinear",
        "linear_plane",
        "uncompensated",
    )
    stds = [left(method, run).std() for method in order]
    assert stds == sorted(stds)


def test_best_methods_are_at_the_oracle(run):
    oracle = left("oracle", run).std()
    assert left("ts_refined", run).std() < 1.2 * oracle
    assert left("physics_informed", run).std() < 1.1 * oracle


def test_printed_variance_can_be_no_variance():
    largest, spread = PRINTED["ts_refined"][3:5]
    assert largest is not None
    assert spread is not None
    assert spread > largest**2


def test_ratios_of_the_printed_table_are_the_papers_claims():
    rows = [
        {"method": method, "soak_split_std": 1.0, **dict(zip(COLUMNS, figures, strict=True))}
        for method, figures in PRINTED.items()
    ]
    for method in ("physics_informed", "oracle"):
        rows.append(dict(rows[0], method=method))
    claims = ratios(rows)
    for name in ("valid_max_times", "valid_std_times"):
        for claim in claims[name].values():
            assert claim["ts_refined"] == pytest.approx(claim["paper"], rel=0.05)
    for claim in claims["valid_max_down"].values():
        assert claim["ts_refined"] == pytest.approx(claim["paper"], abs=0.08)


def test_figures_are_drawn(tmp_path):
    shown = surfaces(0, method="ts_gk_rls", nodes=9)
    assert shown.before_dps.shape == (9, 9)
    assert shown.left_dps.shape == (18, 36)
    assert np.abs(shown.left_dps).max() < np.abs(shown.before_dps).max()
    files = draw(shown, tmp_path)
    assert {file.name for file in files} == {"figure1.png", "figure1.svg", "figure2.png", "figure2.svg"}
    assert all(file.stat().st_size > 5000 for file in files)


@pytest.mark.slow
def test_command_prints_exactly_the_document():
    result = CliRunner().invoke(cli, ["paper", "--seeds", "2", "--json"], catch_exceptions=False)
    told = json.loads(result.stdout.splitlines()[-1])
    assert set(told) == {"rows", "ratios", "seeds"}
    assert [row["method"] for row in told["rows"]] == list(METHODS)
    assert all(set(row) == ROW for row in told["rows"])
    assert told["seeds"] == 2


@pytest.mark.slow
def test_twenty_seeds_reach_what_is_claimed():
    told = report(20)
    by = {row["method"]: row for row in told["rows"]}
    assert by["ts_refined"]["valid_std"] <= 1.10 * by["oracle"]["valid_std"]
    assert by["ts_refined"]["valid_max"] <= 0.21
    for column in ("valid_std", "soak_split_std"):
        assert by["physics_informed"][column] <= 1.05 * by["oracle"][column]


@pytest.mark.slow
def test_past_the_paper():
    from training.beyond import coverages, extrapolation

    reached = extrapolation(20, lambda doing: None)
    assert reached["physics_informed"]["surface"] <= 0.15
    assert reached["ts_refined"]["surface"] > 5 * reached["physics_informed"]["surface"]
    for share in coverages(20, lambda doing: None).values():
        assert 0.90 <= share <= 0.98
