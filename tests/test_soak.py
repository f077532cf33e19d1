"""The soak's own measures, and a short soak."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from tools import audit
from tools.soak import CYCLE_S, cycle, main, memory_slope


def test_a_planted_leak_is_found_with_its_size_and_none_where_there_is_none():
    random = np.random.default_rng(0)
    seconds = np.arange(60) * 60.0
    for leak in (0.0, 36.0):
        memory = 200.0 + leak * seconds / 3600.0 + random.normal(0.0, 0.3, 60)
        memory[[5, 40]] += 30.0  # what an allocator may do
        slope = memory_slope(np.column_stack([seconds, memory]))
        assert slope["value"] == pytest.approx(leak, abs=1.5)
        assert slope["ci95"][0] <= leak <= slope["ci95"][1]
    assert slope["ci95"][0] > 30.0


def test_the_cycle_can_be_repeated_without_a_jump(fog_map):
    from rtcomp.pipeline import Pipeline

    frames = cycle(200)
    again = frames.copy()
    again["t_ns"] += CYCLE_S * 1_000_000_000
    pipeline = Pipeline(fog_map)
    pipeline.process_all(np.concatenate([frames, again]))
    assert pipeline.rejected == {}
    assert pipeline.counts["samples"] == 2 * 200 * CYCLE_S


@pytest.mark.slow
def test_half_a_minute_loses_nothing_uncounted_and_grows_nothing_but_memory():
    done = CliRunner().invoke(main, ["--minutes", "0.5", "--rate-hz", "200", "--json"])
    verdicts = json.loads(done.stdout.splitlines()[-1])["verdicts"]
    del verdicts["memory is flat"], verdicts["p99 is steady"]  # half a minute says nothing of these
    assert all(verdicts.values()), verdicts


@pytest.mark.slow
def test_the_bill_of_materials_lists_what_is_installed(tmp_path):
    pytest.importorskip("cyclonedx_py")
    assert audit.write_sbom(tmp_path / "sbom.json") > 10
    names = {part["name"] for part in json.loads((tmp_path / "sbom.json").read_text())["components"]}
    assert {"numpy", "eclipse-zenoh", "cryptography"} <= names
