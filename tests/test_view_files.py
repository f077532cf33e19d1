"""Models, recordings, diagnoses and paper runs, logged and read back."""

import numpy as np
import pytest

from rtcomp.compensator import predict
from rtcomp.demo import MODEL
from rtcomp.errors import RequestError
from rtcomp.model import load_model
from rtcomp.view import files
from rtcomp.view.scene import HEIGHT, SIDE
from rtcomp.view.surface import NODES
from tests.view_rrd import Rrd
from training.paper_figures import Surfaces
from training.table import Recording

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def model():
    return load_model(MODEL)


def drive(n=3000):
    t = np.arange(n) * 0.01
    truth, temp = 40.0 * np.sin(0.3 * t), -10.0 + 0.3 * t
    return t, truth, temp


def test_a_models_surface_is_what_the_compiled_step_predicts(model, tmp_path):
    files.save_model(model, tmp_path / "m.rrd")
    rrd = Rrd(tmp_path / "m.rrd")
    mesh = rrd.static("/model/surface/before/model/mesh", "Mesh3D:vertex_positions")
    assert len(mesh) == NODES**2
    box = files.fitting_box([model], files.NOTHING, files.NOTHING, files.NOTHING)
    (t0, t1), (w0, w1) = box.temp_degC, box.rate_dps
    temp, rate = (mesh[:, 0] / SIDE + 0.5) * (t1 - t0) + t0, (mesh[:, 1] / SIDE + 0.5) * (w1 - w0) + w0
    expected = predict(model, rate, temp).error_dps
    assert mesh[:, 2] / HEIGHT * 2 * box.limit_dps == pytest.approx(expected, abs=2e-3 * box.limit_dps)
    centers = rrd.static("/model/surface/before/rules/centers", "Points3D:positions")
    assert len(centers) == len(model.rules.centers)
    assert {"/model/surface/before/validity", "/model/surface/after/sigma/unmeasured/mesh"} <= rrd.entities
    labels = rrd.static("/model/surface/before/axes/labels", "Points3D:labels")
    assert {"temperature [°C]", "rate [°/s]", "error [°/s]"} <= set(labels)
    assert rrd.blueprints == 1


def test_a_recordings_streams_hold_every_row_with_the_models_correction(model, tmp_path):
    t, truth, temp = drive()
    rate = truth + 1.5
    columns = {"t_s": t, "rate_dps": rate, "temp_degC": temp, "ref_rate_dps": truth}
    files.save_recording(Recording("drive", columns), tmp_path / "d.rrd", [model])
    rrd = Rrd(tmp_path / "d.rrd")
    t_ns, rates = rrd.scalars("/drive/rate")
    expected = rate - predict(model, rate, temp, t).error_dps
    assert t_ns.tolist() == np.rint(t * 1e9).astype(int).tolist()
    assert rates == pytest.approx(np.stack([rate, expected, truth], axis=-1))
    _, errors = rrd.scalars("/drive/error")
    assert errors == pytest.approx(np.stack([rate - truth, expected - truth], axis=-1))
    assert "/drive/surface/after/measured" in rrd.entities
    assert rrd.rows("/drive/surface/before/operating_point") > 50
    _, slopes = rrd.scalars("/drive/temperature_rate")
    assert slopes[-1, 0] == pytest.approx(0.3 * 60.0, rel=0.06)  # three time constants after the start


def test_a_rate_table_becomes_points_at_their_errors(model, tmp_path):
    rng = np.random.default_rng(5)
    truth, temp = rng.uniform(-150, 150, 60), rng.uniform(-30, 60, 60)
    rate = truth + predict(model, truth, temp).error_dps
    columns = {"rate_dps": rate, "temp_degC": temp, "ref_rate_dps": truth}
    files.save_recording(Recording("table", columns), tmp_path / "t.rrd", [model])
    rrd = Rrd(tmp_path / "t.rrd")
    before = rrd.static("/table/surface/before/points", "Points3D:positions")
    after = rrd.static("/table/surface/after/points", "Points3D:positions")
    assert before.shape == after.shape == (60, 3)
    assert before[:, :2] == pytest.approx(after[:, :2])
    assert np.abs(after[:, 2]).max() < np.abs(before[:, 2]).max()


def test_a_recording_without_temperature_is_refused(tmp_path):
    with pytest.raises(RequestError, match="temp_degC"):
        files.save_recording(Recording("r", {"rate_dps": np.zeros(3)}), tmp_path / "r.rrd")
    assert not list(tmp_path.iterdir())


def test_a_diagnosis_shows_its_curves_and_verdict(tmp_path):
    t, rate, temp = drive(500)
    before, after = 0.1 * np.sin(t), 0.01 * np.cos(t)
    curves = {
        "drive/error_before_dps": (t, before),
        "drive/error_after_dps": (t, after),
        "drive/temperature_degC": (t, temp),
        "drive/true_rate_dps": (t, rate),
    }
    files.save_diagnosis(tmp_path / "d.rrd", curves, "A thermal lag is missing.", ["thermal lag, 0.07 °/s"])
    rrd = Rrd(tmp_path / "d.rrd")
    _, logged = rrd.scalars("/drive/error/before")
    assert logged[:, 0] == pytest.approx(before)
    assert "thermal lag is missing" in str(rrd.static("/verdict", "TextDocument:text"))
    assert {"/drive/surface/before/measured", "/drive/surface/after/measured"} <= rrd.entities


def test_a_diagnosis_of_nothing_is_still_a_file(tmp_path):
    files.save_diagnosis(tmp_path / "d.rrd", {}, "The frames are at fault.")
    assert "at fault" in str(Rrd(tmp_path / "d.rrd").static("/verdict", "TextDocument:text"))


def test_a_paper_run_shows_both_figures_on_one_scale(tmp_path):
    temp, rate = np.linspace(-40, 60, 7), np.linspace(-200, 200, 9)
    error = np.outer(temp, rate) / 1000.0
    shown = Surfaces(temp, rate, error, temp, rate, error / 50.0, "ts_refined", 0)
    files.save_paper(shown, tmp_path / "p.rrd")
    rrd = Rrd(tmp_path / "p.rrd")
    heights = {
        side: np.ptp(rrd.static(f"/paper/surface/{side}/error/mesh", "Mesh3D:vertex_positions")[:, 2])
        for side in ("before", "after", "magnified")
    }
    assert heights["before"] == pytest.approx(50.0 * heights["after"], rel=1e-4)
    assert heights["magnified"] > 0.5 * heights["before"]
