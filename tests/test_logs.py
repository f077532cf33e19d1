"""Logs of every format: the same frames as python-can reads, and what is refused."""

import gzip
import subprocess
import sys
import zlib

import can
import numpy as np
import pytest

from rtcomp.errors import RequestError
from rtcomp.frames import FRAME, FrameFlag
from rtcomp.sources.blf import NO_SIZE
from rtcomp.sources.logs import BATCH, read_log
from rtcomp.sources.messages import to_frames

START = 1_600_000_000.25


def classic_messages(count=BATCH + 100):
    """More than one array of them, so that its border is crossed."""
    rng = np.random.default_rng(3)
    return [
        can.Message(
            timestamp=START + 0.01 * i,
            arbitration_id=int(rng.integers(0x7FF if i % 2 else 0x1FFFFFFF)),
            is_extended_id=i % 2 == 0,
            data=rng.bytes(int(rng.integers(1, 9))),
            channel=0,
        )
        for i in range(count)
    ]


def write_log(path, messages):
    with can.Logger(str(path)) as writer:
        for message in messages:
            writer.on_message_received(message)
    return path


def read_all(path):
    return np.concatenate(list(read_log(path)))


FORMATS = [".log", ".asc", ".blf", ".trc", ".csv", ".db", ".mf4", ".log.gz", ".asc.gz", ".trc.gz", ".csv.gz"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # asammdf's own
@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_gives_python_cans_frames(tmp_path, suffix):
    messages = classic_messages(40 if suffix == ".mf4" else BATCH + 100)
    path = write_log(tmp_path / f"some{suffix}", messages)
    if suffix == ".db":  # its writer may drop the last ones
        messages = list(can.LogReader(path))
    frames, written = read_all(path), to_frames(messages)
    assert frames.dtype == FRAME
    for field in ("can_id", "flags", "length", "reserved", "data"):
        assert frames[field].tolist() == written[field].tolist()
    assert np.max(np.abs(frames["t_ns"] - written["t_ns"])) < 1_000_000  # UNIX; .asc dates end at 1 ms
    steps = np.diff(frames["t_ns"]) - np.diff(written["t_ns"])
    assert np.max(np.abs(steps)) < 101_000  # .trc ends at 0.1 ms


@pytest.mark.parametrize("suffix", [".asc", ".blf"])
def test_can_fd(tmp_path, suffix):
    messages = [
        can.Message(timestamp=START + i, arbitration_id=5, is_extended_id=False, is_fd=True, channel=0,
                    bitrate_switch=i % 2 == 0, data=bytes(range(length)))
        for i, length in enumerate([8, 12, 64])
    ]  # fmt: skip
    frames, written = read_all(write_log(tmp_path / f"fd{suffix}", messages)), to_frames(messages)
    for field in ("can_id", "flags", "length", "data"):
        assert frames[field].tolist() == written[field].tolist()


def test_remote_and_error_frames(tmp_path):
    messages = [
        can.Message(timestamp=START, arbitration_id=5, is_extended_id=False, is_remote_frame=True, dlc=3),
        can.Message(timestamp=START, is_error_frame=True),
    ]
    frames = read_all(write_log(tmp_path / "kinds.csv", messages))
    assert frames["flags"].tolist() == [FrameFlag.REMOTE, FrameFlag.ERROR]
    assert frames["length"].tolist() == [3, 0]


def test_candump_is_known_by_its_content(tmp_path):
    path = write_log(tmp_path / "some.log", classic_messages(10))
    renamed = path.rename(tmp_path / "recorded")
    assert len(read_all(renamed)) == 10


def test_asc_with_a_foreign_date_counts_from_its_start(tmp_path, caplog):
    path = write_log(tmp_path / "foreign.asc", classic_messages(3))
    text = path.read_text()
    for name in ("Sep", "Sun"):
        text = text.replace(name, "Xyz")
    path.write_text(text)
    frames = read_all(path)
    assert len(frames) == 3
    assert frames["t_ns"][0] < 10**9
    assert "times count from the log's start" in caplog.text


def test_missing_file_is_refused_at_once(tmp_path):
    with pytest.raises(RequestError, match="no such log file"):
        read_log(tmp_path / "absent.blf")


def test_folder_is_refused(tmp_path):
    with pytest.raises(RequestError, match="cannot be opened"):
        read_log(tmp_path)


@pytest.mark.parametrize("name", ["some.xyz", "some", "some.txt.gz"])
def test_unknown_format_is_refused(tmp_path, name):
    (tmp_path / name).write_text("what is this\n")
    with pytest.raises(RequestError, match="unknown log format"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("suffix", [".blf", ".db", ".csv", ".mf4", ".csv.gz", ".asc.gz"])
def test_foreign_content_is_refused(tmp_path, suffix):
    path = tmp_path / f"foreign{suffix}"
    path.write_bytes(b"this is no log\nreally, not at all\n" * 20)
    with pytest.raises(RequestError, match=r"wanted a (complete )?\.\w+ log"):
        list(read_log(path))


def cut(path, kept):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    return path


@pytest.mark.parametrize("suffix", [".blf", ".csv", ".db", ".asc.gz", ".csv.gz", ".trc.gz"])
def test_truncated_log_is_refused(tmp_path, suffix):
    path = cut(write_log(tmp_path / f"cut{suffix}", classic_messages(3000)), 0.61)
    with pytest.raises(RequestError, match=r"wanted a complete \.\w+ log"):
        list(read_log(path))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # asammdf's own
def test_truncated_mf4_is_refused(tmp_path):
    path = cut(write_log(tmp_path / "cut.mf4", classic_messages(100)), 0.61)
    code = (  # asammdf cannot finalize a half-made reader, which would warn in whatever test comes next
        "import sys\nfrom rtcomp.errors import RequestError\nfrom rtcomp.sources.logs import read_log\n"
        "try:\n    list(read_log(sys.argv[1]))\nexcept RequestError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, path], check=True, capture_output=True, text=True)
    assert "wanted a complete .mf4 log" in done.stdout


def test_a_payload_that_looks_like_an_object_of_no_length_is_a_payload(tmp_path):
    like = b"LOBJ" + bytes(range(4)) + bytes(52) + b"LOBJ"
    fd = can.Message(
        timestamp=START, arbitration_id=5, is_extended_id=False, is_fd=True, channel=0, data=like
    )
    path = write_log(tmp_path / "like.blf", [fd] * 3)
    assert NO_SIZE.search(zlib.decompress(path.read_bytes()[144 + 32 :]))
    assert [bytes(frame["data"][: frame["length"]]) for frame in read_all(path)] == [like] * 3


def test_frames_before_the_damage_are_passed_on(tmp_path):
    path = cut(write_log(tmp_path / "cut.blf", classic_messages(20_000)), 0.5)
    got = []
    with pytest.raises(RequestError, match=r"\d+ frames"):
        got.extend(read_log(path))
    assert sum(map(len, got)) > 1000


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc", ".csv"])
def test_log_without_frames_is_refused(tmp_path, suffix):
    path = write_log(tmp_path / f"empty{suffix}", [])
    with pytest.raises(RequestError, match="holds no CAN frame"):
        list(read_log(path))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # asammdf's own
def test_mf4_is_read_after_a_bus_was_opened_without_asammdf(tmp_path):
    path = write_log(tmp_path / "some.mf4", classic_messages(5))
    code = (
        "import sys\nfrom rtcomp.sources.bus import open_bus\nfrom rtcomp.sources.logs import read_log\n"
        "open_bus('virtual:x').close()\nassert 'asammdf' not in sys.modules\n"
        "print(sum(map(len, read_log(sys.argv[1]))))"
    )
    done = subprocess.run([sys.executable, "-c", code, path], check=True, capture_output=True, text=True)
    assert done.stdout == "5\n"


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # asammdf's own
def test_mf4_gz_is_read(tmp_path):
    path = write_log(tmp_path / "some.mf4", classic_messages(5))
    packed = tmp_path / "some.mf4.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert read_all(packed)["can_id"].tolist() == read_all(path)["can_id"].tolist()


def test_mf4_without_asammdf_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "asammdf", None)
    path = tmp_path / "some.mf4"
    path.write_bytes(b"MDF     4.10")
    with pytest.raises(RequestError, match=r"pip install 'rtcomp\[mf4\]'"):
        list(read_log(path))
