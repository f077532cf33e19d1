"""`--realtime`: asked for, taken back, and each refusal said; the kernel itself refuses, to a user without rights."""

import gc
import json
import os
import subprocess
import sys

import pytest
from click.testing import CliRunner

from rtcomp.commands.run import command
from rtcomp.doctor import check_realtime
from rtcomp.realtime import PARTS, isolated_cpus, realtime

NAMES = [part.name for part in PARTS]

NOBODY = """
import json, os, resource
from rtcomp.doctor import check_realtime
from rtcomp.realtime import PARTS, realtime
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
if os.geteuid() == 0:
    os.setgroups([])
    os.setuid(65534)
said = []
with realtime(said.append) as granted:
    pass
print(json.dumps({"said": said, "granted": granted, "checks": [check_realtime(part)._asdict() for part in PARTS]}))
"""


@pytest.fixture(scope="module")
def nobody():
    done = subprocess.run([sys.executable, "-c", NOBODY], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_what_is_refused_is_said_in_one_sentence_with_what_mends_it(nobody):
    assert nobody["granted"] == ["frozen collector"]
    assert len(nobody["said"]) == 3
    for sentence, part in zip(nobody["said"], PARTS, strict=False):
        assert sentence.startswith(f"--realtime: no {part.name}: ")
        assert sentence.endswith(part.mend)
        assert "\n" not in sentence
    reasons = ["Operation not permitted", "at most 64 KiB", "only one CPU"]
    assert all(reason in sentence for reason, sentence in zip(reasons, nobody["said"], strict=True))


def test_doctor_says_the_same(nobody):
    checks = {check["name"]: check for check in nobody["checks"]}
    assert list(checks) == NAMES
    assert [check["ok"] for check in checks.values()] == [False, False, False, True]
    assert all(check["mend"] for check in checks.values() if not check["ok"])
    assert "Operation not permitted" in checks["real-time priority"]["found"]


def test_everything_is_taken_back():
    before = os.sched_getscheduler(0), os.sched_getaffinity(0), gc.get_freeze_count()
    said = []
    with realtime(said.append) as granted:
        assert gc.get_freeze_count() > before[2]
        if "real-time priority" in granted:
            assert os.sched_getscheduler(0) == os.SCHED_FIFO
        if "CPU of its own" in granted:
            assert len(os.sched_getaffinity(0)) == 1
    assert len(granted) + len(said) == len(PARTS)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before[:2]
    assert gc.get_freeze_count() == 0


def test_doctor_gives_back_what_it_asked_for():
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    for part in PARTS:
        check_realtime(part)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


def test_isolated_cpus_are_read_as_the_kernel_writes_them(tmp_path, monkeypatch):
    path = tmp_path / "isolated"
    monkeypatch.setattr("rtcomp.realtime.ISOLATED", path)
    assert isolated_cpus() == set()
    for text, cpus in (("\n", set()), ("3\n", {3}), ("2-4,7\n", {2, 3, 4, 7})):
        path.write_text(text)
        assert isolated_cpus() == cpus


@pytest.mark.parametrize("asked", [False, True])
def test_a_run_asks_only_when_told_and_never_needs_it(tmp_path, fog_frames, monkeypatch, asked):
    from rtcomp.sources.candump import write_candump

    log, said = tmp_path / "some.log", []
    write_candump(log, fog_frames(0.1))

    def refuse(*_):
        said.append("asked")
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    result = CliRunner().invoke(command, ["--log", str(log), "--json"] + ["--realtime"] * asked)
    assert result.exit_code == 0, result.output
    assert len(said) == asked
    assert ("--realtime: no real-time priority: Operation not permitted" in result.output) == asked
