"""What a stranger gets wrong: every bad request is refused, or every bad recording named, in one sentence."""

import gzip
import io
import json
from contextlib import redirect_stderr, redirect_stdout
from types import SimpleNamespace

import numpy as np
import pytest
from diagnose_cases import lag_effect, recording

from rtcomp.cli import main
from rtcomp.errors import RequestError
from training.diagnose.folder import staged
from training.diagnose.request import differences, one_sensor
from training.diagnose.settings import Settings
from training.table import Recording, write_recording


def write(case: Recording, path, **changes):
    columns = {**case.columns, **changes}
    write_recording(Recording("x", {k: v for k, v in columns.items() if v is not None}), path)
    return path


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A short sound recording with a lag, as a file."""
    return write(recording(61, lag_effect, seconds=1500.0), tmp_path_factory.mktemp("sound") / "sound.csv")


def call(*words, out):
    """`rtcomp diagnose` as a person calls it: exit status, standard output and standard error."""
    said, told = io.StringIO(), io.StringIO()
    with redirect_stdout(said), redirect_stderr(told), pytest.raises(SystemExit) as ended:
        main(["diagnose", *map(str, words), "--out", str(out), "--json"])
    output = said.getvalue() + told.getvalue()
    return SimpleNamespace(
        exit_code=ended.value.code or 0, stdout=said.getvalue(), stderr=told.getvalue(), output=output
    )


def refused(result, out, *words):
    """One sentence on standard error, exit status 2, nothing written."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert not out.exists()
    assert not list(out.parent.glob(".*"))
    said = result.stderr.strip()
    assert "Traceback" not in said
    for word in words:
        assert word in said, said
    return said


def told(result, out, verdict, *words):
    """A whole document with this verdict, on standard output as in the folder, and the words in its sentence."""
    assert result.exit_code == 0, result.output
    assert result.stdout.count("\n") == 1
    document = json.loads(result.stdout)
    assert document == json.loads((out / "diagnosis.json").read_text())
    assert document["verdict"] == verdict, document["sentence"]
    said = document["sentence"] + " ".join(note for r in document["recordings"] for note in r["integrity"])
    for word in words:
        assert word in said, said
    for name in ("report.html", "extended.json", "diagnosis.rrd"):
        assert (out / name).stat().st_size > 0
    return document


CASE = recording(62, lag_effect, seconds=1500.0)
N = len(CASE)


def test_no_truth(tmp_path):
    path = write(CASE, tmp_path / "a.csv", ref_rate_dps=None)
    refused(call(path, out=tmp_path / "o"), tmp_path / "o", "ref_rate_dps", "--static")


def test_no_truth_in_what_is_held_out(tmp_path, sound):
    path = write(CASE, tmp_path / "a.csv", ref_rate_dps=None)
    refused(call(sound, "--heldout", path, out=tmp_path / "o"), tmp_path / "o", "a: no ref_rate_dps")


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"rate_dps": None}, ("rate_dps", "--columns")),
        ({"rate_dps": None, "ref_rate_dps": None}, ("rate_dps",)),
    ],
)
def test_missing_columns(tmp_path, columns, words):
    refused(call(write(CASE, tmp_path / "a.csv", **columns), out=tmp_path / "o"), tmp_path / "o", *words)


def test_a_renamed_column_of_another_unit(tmp_path, sound):
    text = sound.read_text().replace("rate_dps", "gyro_radps", 1)
    (tmp_path / "a.csv").write_text(text)
    result = call(tmp_path / "a.csv", "--columns", "rate_dps=gyro_radps", out=tmp_path / "o")
    refused(result, tmp_path / "o", "rad/s", "convert")


def test_text_where_numbers_belong(tmp_path):
    (tmp_path / "a.csv").write_text("t_s,rate_dps,temp_degC,ref_rate_dps\n0,1,x,3\n")
    refused(call(tmp_path / "a.csv", out=tmp_path / "o"), tmp_path / "o", "temp_degC", "not a number")


def damaged(kind, tmp_path):
    """A file that is no table."""
    whole = write(CASE, tmp_path / "whole.csv.gz").read_bytes()
    parquet = write(CASE, tmp_path / "whole.parquet").read_bytes()
    name, content = {
        "empty": ("a.csv", b""),
        "only a header": ("a.csv", b"t_s,rate_dps,temp_degC,ref_rate_dps\n"),
        "truncated gz": ("a.csv.gz", whole[: len(whole) // 2]),
        "no gz": ("a.csv.gz", b"t_s,rate_dps\n0,1\n"),
        "truncated parquet": ("a.parquet", parquet[: len(parquet) // 2]),
        "empty parquet": ("a.parquet", b""),
        "binary": ("a.csv", gzip.compress(b"x" * 1000)),
    }[kind]
    (tmp_path / name).write_bytes(content)
    return tmp_path / name


@pytest.mark.parametrize(
    "kind",
    ["empty", "only a header", "truncated gz", "no gz", "truncated parquet", "empty parquet", "binary"],
)
def test_damaged_files(tmp_path, kind):
    path = damaged(kind, tmp_path)
    refused(call(path, out=tmp_path / "o"), tmp_path / "o", path.name)


def test_a_missing_file_and_a_folder(tmp_path):
    refused(call(tmp_path / "none.csv", out=tmp_path / "o"), tmp_path / "o", "none.csv")
    refused(call(tmp_path, out=tmp_path / "o"), tmp_path / "o")


def test_held_out_is_fitted_too(tmp_path, sound):
    refused(call(sound, "--heldout", sound, out=tmp_path / "o"), tmp_path / "o", "twice")


@pytest.mark.parametrize("shift_s", [0.0, -500.0])
def test_held_out_is_a_piece_of_what_is_fitted(tmp_path, sound, shift_s):
    whole = recording(61, lag_effect, seconds=1500.0)
    rows = np.arange(N) >= 1000
    piece = whole.take(rows)
    path = write(piece, tmp_path / "piece.csv", t_s=piece["t_s"] + shift_s)
    refused(call(sound, "--heldout", path, out=tmp_path / "o"), tmp_path / "o", "piece", "shares rows")


def test_held_out_points_are_among_those_fitted(tmp_path):
    points = {"t_s": None, "rate_dps": CASE["rate_dps"][::20], "temp_degC": CASE["temp_degC"][::20]}
    points["ref_rate_dps"] = CASE["ref_rate_dps"][::20]
    a = write(CASE, tmp_path / "a.csv", **points)
    half = {k: None if v is None else v[::-2] for k, v in points.items()}
    b = write(CASE, tmp_path / "b.csv", **half)
    refused(call(a, "--heldout", b, out=tmp_path / "o"), tmp_path / "o", "b shares rows with a")


def test_two_held_out_of_one_name(tmp_path, sound):
    paths = []
    for k, name in enumerate("ab"):
        (tmp_path / name).mkdir()
        paths.append(write(recording(70 + k, seconds=1500.0), tmp_path / name / "drive.csv"))
    result = call(sound, "--heldout", paths[0], "--heldout", paths[1], out=tmp_path / "o")
    refused(result, tmp_path / "o", "drive", "rename")


def test_points_and_time_series_together(tmp_path, sound):
    path = write(CASE, tmp_path / "a.csv", t_s=None)
    refused(call(sound, path, out=tmp_path / "o"), tmp_path / "o", "a has no t_s")


def test_a_bent_scale_factor_over_other_rates_is_no_other_sensor():
    def bent(seed, top):
        rng = np.random.default_rng(seed)
        rate = top * np.sin(np.arange(4000) / 90.0)
        shown = rate - 2e-6 * rate**3 + 3e-3 * rng.standard_normal(len(rate))
        temp = np.full(len(rate), 25.0)
        return Recording(
            f"bent{seed}",
            {"t_s": np.arange(4000) * 0.1, "rate_dps": shown, "ref_rate_dps": rate, "temp_degC": temp},
        )

    one_sensor([bent(1, 180.0), bent(2, 60.0)], Settings())
    other = bent(2, 60.0)
    other.columns["rate_dps"] = 1.04 * other["rate_dps"]
    with pytest.raises(RequestError, match="different sensors"):
        one_sensor([bent(1, 180.0), other], Settings())


@pytest.mark.parametrize(("scale", "offset"), [(1.04, 0.0), (1.0, 1.6)])
def test_recordings_of_different_sensors(tmp_path, sound, scale, offset):
    path = write(CASE, tmp_path / "other.csv", rate_dps=scale * CASE["rate_dps"] + offset)
    refused(call(sound, path, out=tmp_path / "o"), tmp_path / "o", "different sensors", "sound", "other")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("s.json", '{"schema": "rtcomp.model/9"}', ("schema", "rtcomp.model/1")),
        ("s.json", '{"schema": "rtcomp.diagnosis/1"}', ("schema",)),
        ("s.json", "no json", ("not a model file",)),
        ("s.toml", 'titel = "x"', ("not a scenario",)),
        ("s.toml", "= = =", ("not a scenario",)),
        ("s.csv", "t_s,rate_dps\n0,1\n", ("not a model file",)),
    ],
)
def test_a_simulation_of_the_wrong_kind(tmp_path, sound, name, content, words):
    (tmp_path / name).write_text(content)
    refused(call(sound, "--simulation", tmp_path / name, out=tmp_path / "o"), tmp_path / "o", name, *words)


def test_a_simulation_that_is_not_there(tmp_path, sound):
    refused(call(sound, "--simulation", "nowhere.toml", out=tmp_path / "o"), tmp_path / "o", "nowhere.toml")


def test_out_is_a_file_or_below_one(tmp_path, sound):
    (tmp_path / "taken").write_text("mine")
    for out in (tmp_path / "taken", tmp_path / "taken/below"):
        result = call(sound, out=out)
        assert result.exit_code == 2
        assert "taken" in result.stderr
        assert "Traceback" not in result.stderr
    assert (tmp_path / "taken").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_out_that_no_one_can_write_to(sound):
    result = call(sound, out="/proc/nowhere/found")
    assert result.exit_code == 2
    assert "cannot write to folder" in result.stderr


def test_results_in_a_folder_replace_their_namesakes_and_nothing_else(tmp_path):
    out = tmp_path / "found"
    (out / "heldout").mkdir(parents=True)
    (out / "heldout/old.csv").write_text("stale")
    (out / "diagnosis.json").write_text("stale")
    (out / "mine.txt").write_text("kept")
    with staged(out) as folder:
        (folder / "heldout").mkdir()
        (folder / "heldout/new.csv").write_text("fresh")
        (folder / "diagnosis.json").write_text("fresh")
    assert (out / "mine.txt").read_text() == "kept"
    assert (out / "diagnosis.json").read_text() == "fresh"
    assert [p.name for p in (out / "heldout").iterdir()] == ["new.csv"]
    with pytest.raises(FileNotFoundError), staged(out) as folder:
        (folder / "diagnosis.json").write_text("half") and (folder / "none.csv").unlink()
    assert (out / "diagnosis.json").read_text() == "fresh"
    assert sorted(p.name for p in out.iterdir()) == ["diagnosis.json", "heldout", "mine.txt"]


def test_ten_rows(tmp_path):
    path = write(CASE.take(np.arange(10)), tmp_path / "a.csv")
    document = told(call(path, out=tmp_path / "o"), tmp_path / "o", "bad_recording", "10 rows")
    assert document["findings"] == []


def test_ten_points(tmp_path):
    path = write(CASE.take(np.arange(0, 1000, 100)), tmp_path / "a.csv", t_s=None)
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "bad_recording", "too few")


def test_one_temperature(tmp_path):
    quiet = recording(63, seconds=1500.0)
    path = write(quiet, tmp_path / "a.csv", temp_degC=np.full(N, 25.0))
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "not_excited", "temperature")


def test_no_temperature(tmp_path):
    path = write(recording(63, seconds=1500.0), tmp_path / "a.csv", temp_degC=None)
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "not_excited", "no temperature (temp_degC)")


def test_points_at_one_temperature(tmp_path):
    rates = np.tile(np.linspace(-100.0, 100.0, 21), 3)
    rate = rates + 0.005 * np.random.default_rng(5).standard_normal(63)
    points = Recording("p", {"rate_dps": rate, "temp_degC": np.full(63, 25.0), "ref_rate_dps": rates})
    told(
        call(write(points, tmp_path / "a.csv"), out=tmp_path / "o"),
        tmp_path / "o",
        "not_excited",
        "temperature",
    )


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_time_in_another_unit(tmp_path, factor):
    path = write(CASE, tmp_path / "a.csv", t_s=factor * CASE["t_s"])
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "bad_recording", "not in seconds")


def test_temperature_in_kelvin(tmp_path):
    path = write(CASE, tmp_path / "a.csv", temp_degC=CASE["temp_degC"] + 273.15)
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "bad_recording", "kelvin")


def test_rate_in_rad_per_s(tmp_path):
    path = write(CASE, tmp_path / "a.csv", rate_dps=np.radians(CASE["rate_dps"]))
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "bad_recording", "rad/s")


def test_a_shuffled_clock(tmp_path):
    t = np.random.default_rng(2).permutation(CASE["t_s"])
    told(
        call(write(CASE, tmp_path / "a.csv", t_s=t), out=tmp_path / "o"),
        tmp_path / "o",
        "bad_recording",
        "clock",
    )


def test_nothing_but_missing_values(tmp_path):
    path = write(CASE, tmp_path / "a.csv", rate_dps=np.full(N, np.nan))
    told(call(path, out=tmp_path / "o"), tmp_path / "o", "bad_recording", "values")


def test_gaps_missing_values_disorder_and_repeats_do_not_hide_the_physics(tmp_path, sound):
    whole = recording(64, lag_effect)
    rows = np.arange(len(whole))
    rows = rows[(rows < 3000) | (rows > 3400)]
    rows[500:510] = rows[500:510][::-1]
    rows = np.insert(rows, 900, [899, 899])
    spoilt = whole.take(rows)
    for name, at in (("rate_dps", 50), ("temp_degC", 60), ("ref_rate_dps", 70), ("t_s", 80)):
        spoilt.columns[name][at] = np.nan
    paths = (
        write(spoilt, tmp_path / "a.csv"),
        write(recording(65, lag_effect).take(rows), tmp_path / "b.parquet"),
    )
    result = call(paths[0], "--heldout", paths[1], out=tmp_path / "o")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["findings"][0]["effect"] == "thermal_lag"
    notes = " ".join(document["recordings"][0]["integrity"])
    for word in ("missing", "bridged", "sorted", "repeated", "pause"):
        assert word in notes, notes
    table = np.genfromtxt(tmp_path / "o/heldout/b.csv", delimiter=",", names=True)
    assert table.dtype.names == ("t_s", "correction_dps")
    assert len(table) == len(rows)
    assert np.isfinite(table["correction_dps"]).all()


def test_what_is_held_out_of_a_bad_recording_gets_a_table_all_the_same(tmp_path, sound):
    path = write(CASE.take(np.arange(10)), tmp_path / "a.csv")
    told(call(path, "--heldout", sound, out=tmp_path / "o"), tmp_path / "o", "bad_recording")
    table = np.genfromtxt(tmp_path / "o/heldout/sound.csv", delimiter=",", names=True)
    assert len(table) == N
    assert not table["correction_dps"].any()


def test_drivers_with_gaps_or_in_some_recordings_only(tmp_path):
    speed = np.full(N, 3.0)
    speed[10:20] = np.nan
    a = write(
        recording(66, seconds=1500.0), tmp_path / "a.csv", speed_mps=speed, vibration_rms_mps2=np.abs(speed)
    )
    b = write(recording(67, seconds=1500.0), tmp_path / "b.csv", speed_mps=speed)
    result = call(a, "--heldout", b, out=tmp_path / "o")
    assert result.exit_code == 0, result.output
    assert "vibration_rectification" not in json.loads(result.stdout)["visible_from"]


def test_scale_factors_are_not_compared_where_one_turned_this_way_only_and_the_other_that():
    random = np.random.default_rng(5)

    def turned(top_dps, error_ppm):
        rate = np.where(np.arange(2000) % 40 < 20, 0.0, top_dps) + random.normal(0.0, 0.02, 2000)
        temp = np.linspace(20.0, 30.0, 2000)
        return error_ppm * 1e-6 * rate + random.normal(0.0, 0.01, 2000), rate, temp

    offset, scale = differences(turned(100.0, 0.0), turned(-100.0, 0.0))
    assert abs(offset) < 0.01
    assert scale == 0.0
    _, scale = differences(turned(100.0, 0.0), turned(100.0, 3000.0))
    assert scale == pytest.approx(3000.0, rel=0.1)
