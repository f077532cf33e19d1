"""The command line: help with an example everywhere; a wrong request is one sentence, status 2, nothing written."""

import json
import subprocess
import sys

import pytest
from click.testing import CliRunner

import rtcomp.cli
from rtcomp.cli import cli, main
from rtcomp.model import model_document, save_model
from rtcomp.sources.candump import CandumpWriter

COMMANDS = cli.list_commands(None)
CONTRACT = {
    "demo",
    "run",
    "replay",
    "train",
    "evaluate",
    "paper",
    "model",
    "simulate",
    "diagnose",
    "view",
    "doctor",
}


def call(*arguments, capsys):
    """Exit status, standard output and standard error of one command."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return ended.value.code or 0, captured.out, captured.err


@pytest.fixture
def drive(tmp_path, fog_frames):
    with CandumpWriter(tmp_path / "drive.log") as writer:
        writer.append(fog_frames(3.0))
    return tmp_path / "drive.log"


def test_every_command_of_the_contract_exists():
    assert set(COMMANDS) >= CONTRACT


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name):
    result = CliRunner().invoke(cli, [name, "--help"])
    assert result.exit_code == 0
    assert f"rtcomp {name}" in result.output
    assert "Example" in result.output


def test_a_log_run_prints_one_json_document_last(drive, capsys):
    status, out, _ = call("run", "--log", drive, "--json", capsys=capsys)
    assert status == 0
    document = json.loads(out.splitlines()[-1])
    keys = {
        "frames",
        "samples",
        "lost",
        "rejected",
        "flags",
        "rms_raw_dps",
        "rms_corrected_dps",
        "latency_us",
        "seconds",
    }
    assert keys <= set(document)
    assert document["samples"] == 300
    assert document["flags"] == {"no_model": 300}
    assert document["latency_us"] == {"p50": None, "p99": None}


def test_garbage_in_the_middle_is_skipped_counted_and_said(drive, caplog, capsys):
    lines = drive.read_bytes().splitlines(keepends=True)
    drive.write_bytes(b"".join(lines[:100]) + b"\x00garbage \xff\n(oops) can0 zz\n" + b"".join(lines[100:]))
    status, out, _ = call("run", "--log", drive, "--json", capsys=capsys)
    assert status == 0
    document = json.loads(out.splitlines()[-1])
    assert (document["samples"], document["rejected"]["unreadable_line"]) == (300, 2)
    assert "skipped 2 unreadable lines" in caplog.text


def wrong_unit(folder):
    from rtcomp.signal_map import data_folder

    text = (data_folder() / "fog.toml").read_text().replace("fog.dbc", str(data_folder() / "fog.dbc"))
    path = folder / "map.toml"
    path.write_text(text.replace('signal = "Rate"', 'signal = "Rate", unit = "furlong"', 1))
    return path


def other_dbc(folder):
    path = folder / "other.dbc"
    path.write_text('VERSION ""\nBO_ 5 OTHER: 8 X\n SG_ A : 0|8@1+ (1,0) [0|0] "" X\n')
    return path


def changed_model(folder, model, **changes):
    path = folder / "model.json"
    document = {k: v for k, v in model_document(model).items() if k != "sha256"}
    path.write_text(json.dumps(document | changes))
    return path


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (lambda f, d, m: ["run", "--log", f / "absent.log"], "no such log file"),
        (lambda f, d, m: ["run"], "either --bus"),
        (lambda f, d, m: ["run", "--bus", "nothing:can0"], "see `rtcomp doctor`"),
        (lambda f, d, m: ["run", "--bus", "socketcan:absent0"], "see `rtcomp doctor`"),
        (lambda f, d, m: ["run", "--log", d, "--map", "absent"], "there is no signal map 'absent'"),
        (lambda f, d, m: ["run", "--log", d, "--map", wrong_unit(f)], "its unit is 'furlong'"),
        (lambda f, d, m: ["run", "--log", d, "--dbc", other_dbc(f)], "no message 'FOG_RATE'"),
        (lambda f, d, m: ["run", "--log", d, "--dbc", f / "absent.dbc"], "no DBC file"),
        (lambda f, d, m: ["run", "--log", d, "--model", f / "absent.json"], "cannot read model"),
        (
            lambda f, d, m: [
                "run",
                "--log",
                d,
                "--model",
                changed_model(f, m, residual_std_dps=float("nan")),
            ],
            "NaN",
        ),
        (
            lambda f, d, m: ["run", "--log", d, "--model", changed_model(f, m, schema="rtcomp.model/9")],
            "schema is",
        ),
        (lambda f, d, m: ["run", "--log", d, "--model", "pitch=x.json"], "no channel 'pitch'"),
        (lambda f, d, m: ["run", "--log", d, "--zenoh", f / "absent.json5"], "no zenoh configuration"),
        (lambda f, d, m: ["run", "--log", d, "--record", f / "absent" / "x.log"], "cannot be written"),
        (lambda f, d, m: ["run", "--log", d, "--power-on", "yesterday"], "power_on"),
        (lambda f, d, m: ["run", "--config", f / "absent.toml"], "cannot read configuration"),
        (lambda f, d, m: ["model", f / "absent.json"], "cannot read model"),
        (lambda f, d, m: ["demo", "--model", f / "absent.json"], "cannot read model"),
    ],
)
def test_bad_requests_are_one_clear_sentence_and_status_2(
    tmp_path, drive, ts_model, capsys, arguments, reason
):
    before = set(tmp_path.iterdir())
    command = [str(a) for a in arguments(tmp_path, drive, ts_model)]
    made = set(tmp_path.iterdir()) - before
    status, out, err = call(*command, capsys=capsys)
    assert status == 2, err
    assert reason in err
    assert out == ""
    assert "Traceback" not in err
    assert set(tmp_path.iterdir()) - before == made


def test_a_truncated_packed_log_says_how_far_it_got(tmp_path, fog_frames, capsys):
    path = tmp_path / "drive.log.gz"
    with CandumpWriter(path) as writer:
        writer.append(fog_frames(30.0))
    path.write_bytes(path.read_bytes()[:-2000])
    status, _, err = call("run", "--log", path, capsys=capsys)
    assert status == 2
    assert "ends early" in err


def test_model_checks_shows_and_seals(tmp_path, lag_model, capsys):
    path = changed_model(tmp_path, lag_model)
    assert call("model", path, capsys=capsys)[0] == 0
    status, out, _ = call("model", path, "--seal", "--json", capsys=capsys)
    assert status == 0
    assert json.loads(out)["sha256"] == json.loads(path.read_text())["sha256"]
    save_model(lag_model, path)
    assert "thermal_lag" in call("model", path, capsys=capsys)[1]


def test_doctor_tells_and_mends(capsys):
    status, out, _ = call("doctor", "--json", capsys=capsys)
    assert status == 0
    checks = json.loads(out)["checks"]
    assert {"SocketCAN", "vcan", "real-time priority"} <= {check["name"] for check in checks}
    assert all(check["ok"] or check["mend"] for check in checks)


def test_demo_corrects_what_it_replays(capsys):
    status, out, err = call("demo", "--seconds", "4", "--json", capsys=capsys)
    assert status == 0, err
    document = json.loads(out.splitlines()[-1])
    assert document["samples"] > 200
    assert document["lost"] == 0
    assert document["received"] == document["samples"]
    assert document["rms_raw_dps"] > 5 * document["rms_corrected_dps"]


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import rtcomp", ["can", "zenoh", "rerun", "numba", "scipy"]),
        (
            "import rtcomp.pipeline, rtcomp.plan, rtcomp.run",
            ["can", "zenoh", "rerun", "scipy.linalg", "sklearn", "training"],
        ),
        (
            "import rtcomp.cli; rtcomp.cli.cli.list_commands(None)",
            ["can", "zenoh", "rerun", "numba", "training"],
        ),
    ],
)
# (numba itself imports the empty shell of scipy to see its version)
def test_nothing_heavy_is_loaded_before_it_is_needed(statement, absent):
    code = f"import sys; {statement}; print([name for name in {absent!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_module_runs_like_the_command():
    result = subprocess.run(
        [sys.executable, "-m", "rtcomp", "--version"], capture_output=True, text=True, check=True
    )
    assert rtcomp.__version__ in result.stdout
