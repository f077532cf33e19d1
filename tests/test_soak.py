"""The soak's measures on planted leaks of real processes, and a short soak."""

import json
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from tools import audit
from tools.soak import main
from tools.soak_judge import RUNTIMES, WARM_UP, Reading, Watched, growth, judge, slope_per_h
from tools.soak_load import CYCLE_S, PARTS, cycle

KEPT = """
import os, sys, threading
from pathlib import Path
kept, ended = [], threading.Event()

def waiting(name):
    thread = threading.Thread(target=ended.wait, daemon=True)
    thread.start()
    if name:
        Path(f"/proc/self/task/{thread.native_id}/comm").write_text(name)
    return thread

def come_and_go(k):
    if k % 2:
        kept.extend([b"x" * (1 << 20), os.open("/dev/null", os.O_RDONLY)])
    elif kept:
        os.close(kept.pop())
        kept.clear()

LEAKS = {
    "memory": lambda k: kept.append(b"x" * (1 << 18)),
    "descriptors": lambda k: kept.append(os.open("/dev/null", os.O_RDONLY)),
    "threads": lambda k: kept.append(waiting(None)),
    "runtime": lambda k: kept.append(waiting(f"rx-{k}")),
    "a few runtime": lambda k: k % 8 or kept.append(waiting(f"rx-{k}")),
    "nothing": come_and_go,
}
for k, line in enumerate(sys.stdin):
    LEAKS[sys.argv[1]](k)
    print(k, flush=True)
"""


def watched(what, p99_us=lambda k: 100.0, steps=40):
    """Verdicts that are negative of a process that keeps something in every step; a step is told to last a minute."""
    pytest.importorskip("psutil")
    command = [sys.executable, "-c", KEPT, what]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        process_rows = Watched(process.pid)
        for k in range(steps):
            process.stdin.write("\n")
            process.stdin.flush()
            process.stdout.readline()
            process_rows.read(p99_us(k))
        process.stdin.close()
    rows = [row._replace(t_s=60.0 * k) for k, row in enumerate(process_rows.rows)]
    return {verdict for verdict, is_good in judge(rows)[1].items() if not is_good}


@pytest.mark.parametrize(
    ("what", "verdicts"),
    [
        ("nothing", set()),
        ("memory", {"memory is flat"}),
        ("descriptors", {"descriptors do not grow"}),
        ("threads", {"threads do not grow"}),
        ("runtime", {"threads do not grow"}),
        ("a few runtime", set()),
    ],
)
def test_a_planted_leak_is_found_and_what_comes_and_goes_is_none(what, verdicts):
    assert watched(what) - {"memory is flat"} == verdicts - {"memory is flat"}
    if what in ("nothing", "memory"):  # threads and descriptors take memory too
        assert watched(what) == verdicts


def test_a_latency_that_rises_is_not_steady_and_one_that_is_rough_is():
    rough = np.random.default_rng(1).lognormal(4.0, 0.7, 40)
    assert watched("nothing", lambda k: rough[k]) == set()
    assert watched("nothing", lambda k: rough[k] + 50.0 * k) == {"p99 is steady"}


def test_growth_is_the_least_late_over_the_most_early():
    assert growth(np.array([24, 26] * 30)) == 0
    assert growth(np.repeat([10, 11, 12], 20)) == 2
    assert growth(np.repeat([12, 10, 9], 20)) == 0
    assert growth(np.arange(60)) == 40 - 19
    assert growth(np.arange(60) // 3) > RUNTIMES


def test_a_slope_is_found_with_its_size_and_none_where_there_is_none():
    random = np.random.default_rng(0)
    seconds = np.arange(60) * 60.0
    for leak in (0.0, 36.0):
        memory = 200.0 + leak * seconds / 3600.0 + random.normal(0.0, 0.3, 60)
        memory[[5, 40]] += 30.0  # what an allocator may do
        slope = slope_per_h(seconds, memory)
        assert slope["value"] == pytest.approx(leak, abs=1.5)
        assert slope["ci95"][0] <= leak <= slope["ci95"][1]
    assert slope["ci95"][0] > 30.0


def memory_is_flat(span_s, mb_per_h, step_mb=0.0):
    """The verdict on 45 readings over a span, with a slope and one step of an allocator half way."""
    t_s = np.linspace(0.0, span_s, 45)
    rss_mb = 240.0 + mb_per_h * t_s / 3600.0 + step_mb * (t_s > span_s / 2)
    rows = [Reading(t, mb, mb, 20, 10, 8, 100.0) for t, mb in zip(t_s, rss_mb, strict=True)]
    return judge(rows[:1] * (len(rows) // (WARM_UP - 1)) + rows)[1]["memory is flat"]


def test_a_step_of_the_allocator_is_no_leak_in_minutes_and_a_small_slope_is_one_in_an_hour():
    assert memory_is_flat(225.0, 5.0, step_mb=1.7)
    assert not memory_is_flat(225.0, 60.0)
    assert memory_is_flat(2700.0, 1.0)
    assert not memory_is_flat(2700.0, 6.0)


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
    report = json.loads(done.stdout.splitlines()[-1])
    verdicts = report["verdicts"]
    del verdicts["memory is flat"], verdicts["p99 is steady"]  # half a minute says nothing of these
    assert all(verdicts.values()), {key: value for key, value in report.items() if key != "rows"}
    assert report["samples"] > 0
    assert report["visitors"] > 0
    assert report["swaps"]["accepted"] == report["swaps"]["refused"] > 0


@pytest.mark.slow
def test_a_load_without_a_part_lacks_it():
    without = [word for part in PARTS for word in ("--without", part)]
    done = CliRunner().invoke(main, ["--minutes", "0.05", "--json", *without])
    report = json.loads(done.stdout.splitlines()[-1])
    assert (report["visitors"], report["swaps"]) == (0, {"accepted": 0, "refused": 0})
    assert report["sent"] == report["frames"] <= 100  # but those that end it


@pytest.mark.slow
def test_the_bill_of_materials_lists_what_is_installed(tmp_path):
    pytest.importorskip("cyclonedx_py")
    assert audit.write_sbom(tmp_path / "sbom.json") > 10
    names = {part["name"] for part in json.loads((tmp_path / "sbom.json").read_text())["components"]}
    assert {"numpy", "eclipse-zenoh", "cryptography"} <= names
