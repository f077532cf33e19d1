"""The fault campaign: every scenario of sensor and bus; those around a run take minutes and are a step of `.ci/run`."""

import json

import pytest
from click.testing import CliRunner

from tools.fault_campaign import main, run_scenario, scenarios
from tools.faults import streams


@pytest.mark.parametrize("scenario", streams.scenarios(), ids=lambda scenario: scenario.name)
def test_a_fault_of_sensor_or_bus_has_its_flags_and_counts(scenario):
    result = run_scenario(scenario, quick=True)
    assert result["got"] == result["expected"]


def test_there_are_enough_of_them_each_with_a_name_of_its_own():
    names = [scenario.name for scenario in scenarios()]
    assert len(set(names)) == len(names) >= 25


def test_the_command_prints_one_document():
    done = CliRunner().invoke(main, ["--json", "--only", "rate s"])
    assert done.exit_code == 0
    document = json.loads(done.stdout.splitlines()[-1])
    assert [s["name"] for s in document["scenarios"]] == ["rate stuck", "rate spiking", "rate saturated"]
    assert all(s["passed"] for s in document["scenarios"])
