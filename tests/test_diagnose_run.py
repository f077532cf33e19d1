import json

import numpy as np
import pytest
from click.testing import CliRunner
from diagnose_cases import lag_effect, recording

from rtcomp.commands.diagnose import command
from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import load_model
from training.diagnose.run import run_diagnose
from training.diagnose.settings import Settings
from training.table import write_recording

KEYS = {
    "schema",
    "verdict",
    "sentence",
    "findings",
    "drivers",
    "fit",
    "alignment",
    "remainder",
    "noise",
    "visible_from",
    "not_excited",
    "recordings",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("diagnosis")
    for name, seed in (("drive", 31), ("unseen", 32)):
        write_recording(recording(seed, lag_effect), out / f"{name}.csv.gz")
    run_diagnose(
        [out / "drive.csv.gz"], out / "found", [out / "unseen.csv.gz"], settings=Settings(surrogates=16)
    )
    return out


def test_every_file_is_written(folder):
    found = folder / "found"
    names = {p.name for p in found.iterdir()}
    assert names == {"diagnosis.json", "report.html", "extended.json", "diagnosis.rrd", "heldout"}
    document = json.loads((found / "diagnosis.json").read_text())
    assert set(document) >= KEYS
    assert document["schema"] == "rtcomp.diagnosis/1"
    assert document["findings"][0]["effect"] == "thermal_lag"


def test_the_heldout_table_has_the_recordings_rows_and_mends_them(folder):
    table = np.genfromtxt(folder / "found/heldout/unseen.csv", delimiter=",", names=True)
    unseen = recording(32, lag_effect)
    np.testing.assert_allclose(table["t_s"], unseen["t_s"], atol=1e-5)
    planted = lag_effect(unseen["t_s"], unseen["ref_rate_dps"], unseen["temp_degC"])
    assert np.std(planted - table["correction_dps"]) < 0.2 * np.std(planted)


def test_the_extended_model_carries_the_effect_to_the_compensator(folder):
    unseen = recording(32, lag_effect)
    model = load_model(folder / "found/extended.json")
    corrected = (
        unseen["rate_dps"] - predict(model, unseen["rate_dps"], unseen["temp_degC"], unseen["t_s"]).error_dps
    )
    before = np.std(unseen["rate_dps"] - unseen["ref_rate_dps"])
    assert np.std(corrected - unseen["ref_rate_dps"]) < 0.8 * before


def test_the_report_stands_alone(folder):
    html = (folder / "found/report.html").read_text()
    assert "thermal_lag" in html
    assert "data:image/png;base64," in html
    assert "http://" not in html
    assert "<script" not in html


def test_names_in_the_report_are_escaped(folder, tmp_path):
    case = recording(33)
    write_recording(case, tmp_path / "a<b>.csv")
    run_diagnose([tmp_path / "a<b>.csv"], tmp_path / "found", settings=Settings(surrogates=8))
    assert "a<b>" not in (tmp_path / "found/report.html").read_text()


def test_the_same_file_twice_is_refused(folder):
    with pytest.raises(RequestError, match="twice"):
        run_diagnose([folder / "drive.csv.gz"], folder / "no", [folder / "drive.csv.gz"])


def test_the_command_prints_one_document(folder):
    out = folder / "again"
    result = CliRunner().invoke(command, [str(folder / "drive.csv.gz"), "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout.splitlines()[-1])
    assert printed == json.loads((out / "diagnosis.json").read_text())
