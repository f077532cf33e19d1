"""`rtcomp train`: models out of recordings, and bad input named."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.cli import cli
from rtcomp.errors import RequestError
from rtcomp.model import ResidualTable, load_model
from training.gk import Settings
from training.inputs import check, check_units, input_columns, stated_unit
from training.rate_table import simulate
from training.table import Recording, write_recording
from training.train import Request, train
from training.ts import TsOptions

OPTIONS = TsOptions("gk-rls", clustering=Settings(starts=1))


def table(rows=slice(None)):
    found = simulate(0)
    columns = {"rate_dps": found.rate_dps, "temp_degC": found.temp_degC, "ref_rate_dps": found.true_dps}
    return Recording("table", {name: values[rows] for name, values in columns.items()})


def invoke(*arguments):
    return CliRunner().invoke(cli, ["train", *map(str, arguments)], catch_exceptions=False)


def test_command_writes_a_sealed_model(tmp_path):
    write_recording(table(), tmp_path / "table.csv")
    out = tmp_path / "model.json"
    told = json.loads(
        invoke(tmp_path / "table.csv", "-o", out, "--method", "gk-rls", "--rules", 4, "--json").stdout
    )
    model = load_model(out)
    assert told["sha256"] == model.sha256
    assert len(model.rules.centers) == 4
    assert isinstance(model.residual_std_dps, ResidualTable)
    assert model.provenance["recordings"][0]["sha256"]


@pytest.mark.parametrize("method", ["gk-rls", "physics-informed"])
def test_methods_that_soaked_points_can_carry(method):
    trained = train([check(table())], Request(method, rules=4, options=OPTIONS, sensor="A17"))
    assert trained.model.sensor == "A17"
    assert trained.model.provenance["method"] == method


def test_number_of_rules_is_chosen_and_told():
    trained = train([check(table())], Request("gk-rls", options=OPTIONS))
    scores = trained.facts["held_out_rms_dps"]
    assert min(scores.values()) <= scores[str(trained.facts["rules"])] <= scores["1"]
    assert "held-out RMS" in trained.sentences[0]


def test_the_rate_of_a_gyro_that_never_turned_is_no_input():
    n = 200
    temp = np.linspace(0, 50, n)
    still = Recording("still", {"t_s": np.arange(n) * 1.0, "rate_dps": 1e-3 * temp**2, "temp_degC": temp})
    item = check(still, static=True)
    assert train([item], Request("gk-rls", rules=2, options=OPTIONS)).model.inputs == ["temp_degC"]
    with pytest.raises(RequestError, match="never turned"):
        train([item], Request("gk-rls", rules=2, inputs=("temp_degC", "rate_dps"), options=OPTIONS))


def test_soaked_points_have_no_history():
    with pytest.raises(RequestError, match="needs t_s"):
        train(
            [check(table())],
            Request("gk-rls", rules=2, inputs=("temp_degC", "lag_temp_degC"), options=OPTIONS),
        )
    with pytest.raises(RequestError, match="over time"):
        train([check(table())], Request("dynamic", options=OPTIONS))
    with pytest.raises(RequestError, match="give one of"):
        train([check(table())], Request("anfis"))


def test_dynamic_inputs_are_what_the_vehicle_computes():
    t = np.arange(0.0, 100.0, 0.5)
    item = Recording("ramp", {"t_s": t, "temp_degC": 0.1 * t, "rate_dps": t})
    slow, slope, on = input_columns(
        item,
        ["lag_temp_degC", "temp_rate_degC_per_s", "time_since_power_on_s"],
        {"temp_rate_degC_per_s": 5.0},
    ).T
    assert slope[-1] == pytest.approx(0.1, rel=1e-6)
    assert (slow[1:] < 0.1 * t[1:]).all()
    np.testing.assert_array_equal(on, t)
    with pytest.raises(RequestError, match="coil_temp_degC"):
        input_columns(item, ["coil_temp_degC"])


def test_too_few_points_are_named():
    with pytest.raises(RequestError, match=r"10 points for 28 parameters"):
        train([check(table(slice(10)))], Request("gk-rls", rules=4, options=OPTIONS))


def test_a_constant_column_is_named():
    with pytest.raises(RequestError, match="temp_degC is constant at -30"):
        train([check(table(slice(36)))], Request("gk-rls", rules=2, options=OPTIONS))


def test_rows_that_are_not_finite_are_refused_or_left_out_aloud(caplog):
    columns = table().columns
    columns["temp_degC"] = columns["temp_degC"].copy()
    columns["temp_degC"][[3, 5]] = np.nan
    with pytest.raises(RequestError, match=r"temp_degC 2 of 648.*--drop-nan"):
        check(Recording("holes", columns))
    assert len(check(Recording("holes", columns), drop_nan=True).recording) == 646
    assert "2 of 648 rows left out" in caplog.text


def test_unsorted_time_is_named():
    columns = {"t_s": np.array([0.0, 2.0, 1.0]), "rate_dps": np.ones(3), "temp_degC": np.ones(3)}
    with pytest.raises(RequestError, match=r"t_s goes from 2 to 1 s at row 2"):
        check(Recording("back", columns), static=True)


def test_mixed_units_in_a_header_are_named():
    columns = {"rate_dps": np.ones(3), "temp_degC": np.ones(3)}
    with pytest.raises(RequestError, match=r"ref_rate_radps in rad/s: the header mixes units"):
        check(Recording("mixed", columns, ignored=("ref_rate_radps",)))
    with pytest.raises(RequestError, match="says rad/s"):
        check_units({"rate_dps": "gyro_z_radps"})
    check_units({"rate_dps": "gyro_z_dps", "temp_degC": "temp_C"})
    assert stated_unit("gyro") is None


def test_no_offset_belongs_to_the_printed_method(tmp_path):
    with pytest.raises(RequestError, match="--method gk-rls"):
        invoke(tmp_path / "x.csv", "-o", tmp_path / "m.json", "--no-offset")
