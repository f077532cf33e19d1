"""Found physics at work: logs in, what a soaked model leaves out named, and the held-out drive corrected on a bus."""

import json

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.commands.diagnose import command as diagnose
from rtcomp.commands.run import command as run
from rtcomp.commands.simulate import command as simulate
from rtcomp.model import OpenLoopSine, load_model, new_model, save_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from rtcomp.sources.logs import read_log
from tools.chamber_on_bus import over_a_bus
from training.simulator.scenario import BUNDLED, Surface


def ok(command, *words):
    result = CliRunner().invoke(command, [str(w) for w in words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """A soaked gyro's surface as a model, and two simulated cold-start drives as CAN logs, one to learn from."""
    folder = tmp_path_factory.mktemp("story")
    surface = {k: v for k, v in msgspec.structs.asdict(Surface()).items() if k not in ("kind", "at")}
    save_model(new_model(base=OpenLoopSine(**surface)), folder / "base.json")
    text = (BUNDLED / "paper_omission.toml").read_text().replace("rate_hz = 20.0", "rate_hz = 4.0")
    (folder / "drive.toml").write_text(text.replace('simulation = "soaked_gyro"', "simulation = ''"))
    for name, seed in (("seen", 1), ("unseen", 3)):
        ok(simulate, folder / "drive.toml", "-o", folder / f"{name}.log.gz", "--seed", seed)
    logs = [
        "--map",
        "fog_simulated",
        "--simulation",
        folder / "base.json",
        "--out",
        folder / "found",
        "--json",
    ]
    told = ok(diagnose, folder / "seen.log.gz", "--heldout", folder / "unseen.log.gz", *logs)
    return folder, json.loads(told)


def test_the_omission_is_named_from_can_logs(story):
    _, document = story
    assert document["findings"][0]["effect"] == "thermal_lag"
    assert document["fit"]["heldout"]
    assert document["fit"]["improvement"] > 0.5


def error_on_a_bus(frames, models):
    """RMS [°/s] of corrected less reference of the drive's frames that came over a CAN bus, in their own time."""
    pipeline = Pipeline(compile_map(load_map("fog_simulated")), {"yaw": models}, int(frames["t_ns"][0]))
    samples = pipeline.process_all(frames).corrected
    known = np.isfinite(samples["ref_rate_dps"])
    assert known.sum() > 20_000
    return float(np.sqrt(np.mean((samples["rate_dps"] - samples["ref_rate_dps"])[known] ** 2)))


def test_the_held_out_drive_over_a_bus_before_and_after(story):
    folder, document = story
    frames = over_a_bus(np.concatenate(list(read_log(folder / "unseen.log.gz"))))
    before = error_on_a_bus(frames, [load_model(folder / "base.json")])
    after = error_on_a_bus(frames, [load_model(folder / "found/extended.json")])
    assert after < 0.4 * before
    assert before == pytest.approx(document["fit"]["rms_before_dps"], rel=0.25)
    told = json.loads(
        ok(
            run,
            "--log",
            folder / "unseen.log.gz",
            "--map",
            "fog_simulated",
            "--model",
            folder / "found/extended.json",
            "--json",
        ).splitlines()[-1]
    )
    assert told["rms_corrected_dps"] == pytest.approx(after, rel=1e-3)
