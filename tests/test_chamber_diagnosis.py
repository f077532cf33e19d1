"""The diagnosis of the real chamber recording holds on a branch that it has not seen."""

import pytest

from tools.chamber_diagnosis import scored
from training.table import read_recording


@pytest.mark.slow
def test_what_is_found_on_z_beats_a_cubic_on_the_second_cooling(recordings):
    columns = {"rate_dps": "gyro_z_dps", "temp_degC": "temp_C"}
    told = scored(read_recording(recordings / "tofupilot_mems_chamber.csv.gz", columns), 2)
    assert told["findings"]
    assert told["rms_dps"]["diagnosis"] < 0.5 * told["rms_dps"]["polynomial 3"]
    assert told["rms_dps"]["diagnosis"] < 0.5 * told["rms_dps"]["raw"]
