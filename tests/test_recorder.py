"""Recording: whole when there is room, counted to the frame when there is not."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from rtcomp.recorder import Recorder
from rtcomp.sources.candump import CandumpWriter
from rtcomp.sources.logs import read_log

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
from rtcomp.cli import main
main(sys.argv[2:])
"""


@pytest.mark.parametrize("name", ["kept.log", "kept.log.gz"])
def test_a_full_disk_ends_the_recording_and_not_the_run(tmp_path, fog_frames, name):
    frames, log, kept = fog_frames(60.0), tmp_path / "drive.log", tmp_path / name
    with CandumpWriter(log) as writer:
        writer.append(frames)
    command = [
        sys.executable,
        "-c",
        LIMITED,
        "60000",
        "run",
        "--log",
        str(log),
        "--record",
        str(kept),
        "--json",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "correction goes on" in done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    record = summary["record"]
    assert summary["frames"] == len(frames) == record["frames"] + record["lost"]
    assert summary["published"] == summary["samples"] > 0
    assert record["error"] == "File too large"
    assert not kept.exists()
    part = tmp_path / f"{name}.part"
    held = list(_frames(part))
    assert sum(map(len, held)) == record["frames"] > 0
    assert np.array_equal(np.concatenate(held), frames[: record["frames"]])


def _frames(path):
    """What can be read of an unfinished log."""
    from rtcomp.errors import RequestError
    from rtcomp.sources.candump import read_candump

    reader = read_candump(path)
    while True:
        try:
            yield next(reader)
        except (StopIteration, RequestError):
            return


def test_a_device_that_takes_nothing_keeps_nothing_and_is_not_replaced(fog_frames, caplog):
    recorder = Recorder("/dev/full")
    for part in np.array_split(fog_frames(30.0), 10):
        recorder.append(part)
    recorder.close()
    assert recorder.counts == {"frames": 0, "lost": 3300, "error": "No space left on device"}
    assert caplog.text.count("stopped") == 1
    assert not os.path.isfile("/dev/full")


def test_what_the_disk_takes_is_kept_whole(tmp_path, fog_frames):
    recorder, frames = Recorder(str(tmp_path / "kept.log.gz")), fog_frames(3.0)
    recorder.append(frames)
    recorder.close()
    assert recorder.counts == {"frames": len(frames), "lost": 0, "error": None}
    assert np.array_equal(np.concatenate(list(read_log(tmp_path / "kept.log.gz"))), frames)
