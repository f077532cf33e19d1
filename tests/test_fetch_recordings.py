"""The public recordings' converters against what they gave, and the way from a server to the folder."""

import functools
import hashlib
import http.server
import threading

import numpy as np
import pyarrow.csv
import pytest

from rtcomp.errors import WorkError
from rtcomp.sources.messages import to_message
from tools import fetch_recordings
from tools.recordings import convert, sources
from tools.recordings.sources import Original


def table(path):
    read = pyarrow.csv.read_csv(path)
    return {name: np.asarray(read[name].to_numpy(), float) for name in read.column_names}


def same(path, known_path):
    """A table that the tool wrote has the numbers of the known one."""
    ours, known = table(path), table(known_path)
    assert list(ours) == list(known)
    for name, values in known.items():
        np.testing.assert_allclose(
            ours[name], values, rtol=0, atol=1.01e-3 if name == "t_s" else 1e-9, err_msg=name
        )


def pieces_of(frames, log_numbers):
    """The log cut where one MF4 file ended: in the longest pause between the IMU frames on both sides."""
    rows = np.flatnonzero(frames["can_id"] == convert.IMU_ID)
    ends = np.cumsum(np.bincount(log_numbers.astype(int)))
    cuts = []
    for end in ends[:-1]:
        first, last = rows[end - 1], rows[end]
        cuts.append(first + 1 + int(np.argmax(np.diff(frames["t_ns"][first : last + 1]))))
    return np.split(frames, cuts)


def test_the_drive_is_decoded_to_the_known_tables(recordings, tmp_path):
    frames = convert.log_frames(recordings / "css_vw_drive.log.gz")
    fetch_recordings.write_log(frames, tmp_path / "css_vw_drive.log.gz")
    assert np.array_equal(convert.log_frames(tmp_path / "css_vw_drive.log.gz"), frames)
    pieces = pieces_of(frames, table(recordings / "css_vw_imu100hz.csv.gz")["log"])
    assert len(pieces) == len(sources.CSS_LOGS)
    for name, columns in convert.css_tables(pieces, recordings / "css_gnss.dbc").items():
        fetch_recordings.write_table(columns, tmp_path / name)
        same(tmp_path / name, recordings / name)


def test_the_toyota_is_decoded_to_the_known_tables(recordings, tmp_path):
    frames = convert.log_frames(recordings / "comma2k19_rav4_bus0.log.gz")
    fetch_recordings.write_log(frames, tmp_path / "comma2k19_rav4_bus0.log.gz")
    tables = convert.comma_tables(frames, recordings / "toyota_2017_subset.dbc", 46408.584931)
    for name, columns in tables.items():
        fetch_recordings.write_table(columns, tmp_path / name)
        same(tmp_path / name, recordings / name)


def chamber_original(recordings, path):
    """The known table in the units of its original."""
    known = table(recordings / "tofupilot_mems_chamber.csv.gz")
    columns = {"timestamp": 7e6 + 1e6 * known["t_s"], "imu.temperature": known["temp_C"]}
    columns |= {f"imu.gyro.{a}": np.radians(known[f"gyro_{a}_dps"]) for a in "xyz"}
    columns |= {f"imu.acc.{a}": known[f"acc_{a}_mps2"] for a in "xyz"}
    rows = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, rows, fmt="%.12g", delimiter="\t", header="\t".join(columns), comments="")


def test_the_chamber_table_is_known_again_from_its_units(recordings, tmp_path):
    chamber_original(recordings, tmp_path / "original.csv")
    name = "tofupilot_mems_chamber.csv.gz"
    fetch_recordings.chamber(lambda original: tmp_path / "original.csv", tmp_path)
    same(tmp_path / name, recordings / name)


def test_what_is_not_the_known_recording_is_refused(recordings, tmp_path):
    known = table(recordings / "comma2k19_phone_gyro.csv.gz")
    fetch_recordings.write_table(known, tmp_path / "comma2k19_phone_gyro.csv.gz")
    for name, change in (("phone_gyro_x_dps", 1e-4), ("t_s", 1e-3)):
        other = known | {name: known[name] + change}
        with pytest.raises(WorkError, match="not to the recording that is known"):
            fetch_recordings.write_table(other, tmp_path / "comma2k19_phone_gyro.csv.gz")
    frames = convert.log_frames(recordings / "comma2k19_rav4_bus0.log.gz")
    frames["data"][7, 2] ^= 1
    with pytest.raises(WorkError, match="not to the log"):
        fetch_recordings.write_log(frames, tmp_path / "comma2k19_rav4_bus0.log.gz")
    assert not (tmp_path / "comma2k19_rav4_bus0.log.gz").exists()


def test_the_toyota_dbc_is_a_cut_of_the_whole(recordings, tmp_path):
    subset = (recordings / "toyota_2017_subset.dbc").read_text()
    more = subset.replace("BO_ 37", 'BO_ 35 OTHER: 8 XXX\n SG_ A : 0|8@1+ (1,0) [0|0] "" XXX\n\nBO_ 37')
    whole = more + 'CM_ SG_ 36 YAW_RATE "verify";\nVAL_ 37 STEER_FRACTION 0 "none";\n'
    cut = convert.dbc_subset(whole, sources.TOYOTA_IDS)
    assert cut == subset
    fetch_recordings.write_dbc(cut.encode(), tmp_path / "toyota_2017_subset.dbc")
    with pytest.raises(WorkError, match="not the DBC"):
        fetch_recordings.write_dbc(whole.encode(), tmp_path / "toyota_2017_subset.dbc")


def test_mf4_logs_become_the_frames_they_hold(recordings, tmp_path):
    from rtcomp.sources.python_can import mf4_reader

    mf4_reader()  # loads asammdf, which python-can's writer needs too
    from can.io.mf4 import MF4Writer

    parts = convert.log_frames(recordings / "css_vw_drive.log.gz")[:2000]
    path = tmp_path / "piece.MF4"
    with MF4Writer(path) as writer:
        for message in map(to_message, parts):
            writer.on_message_received(message)
    assert np.array_equal(convert.log_frames(path), parts)


def test_payloads_of_a_segment_get_their_zeros_back():
    data = np.array([b"\x01\x02", b"", b"\x00\x00\x00\x00\x00\x00\x00\x09"], "S8")
    frames = convert.comma_frames(
        np.array([1.5, 2.0, 2.5]), np.array([36, 37, 36]), data, np.array([0, 1, 0])
    )
    assert frames["t_ns"].tolist() == [1_500_000_000, 2_500_000_000]
    assert frames["data"][0, :8].tolist() == [1, 2, 0, 0, 0, 0, 0, 0]
    assert frames["data"][1, :8].tolist() == [0, 0, 0, 0, 0, 0, 0, 9]


def test_a_camera_that_turns_right_has_a_positive_z_rate():
    t = np.arange(0.0, 2.0, 0.05)
    half = np.radians(12.0) * t / 2.0
    zero = np.zeros_like(t)
    poses = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
    rates = convert.pose_rates(t, poses, t0_s=0.5)
    np.testing.assert_allclose(rates["pose_wz_dps"], 12.0, atol=1e-9)
    np.testing.assert_allclose(rates["pose_wx_dps"], 0.0, atol=1e-9)
    np.testing.assert_allclose(rates["t_s"][:2], [0.025 - 0.5, 0.075 - 0.5])
    np.testing.assert_allclose(
        convert.phone_gyro(t, np.ones((40, 3)), 0.0)["phone_gyro_y_dps"], np.degrees(1.0)
    )


class Served(Original):
    """An original on a server of our own."""

    server = ""

    @property
    def urls(self):
        return [f"{self.server}/missing", f"{self.server}/{self.paths[0]}"]


@pytest.fixture
def server(tmp_path):
    """A folder served on the loopback interface."""
    (tmp_path / "served").mkdir()
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path / "served")
    handler.log_message = lambda *words: None
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        Served.server = f"http://127.0.0.1:{running.server_address[1]}"
        yield tmp_path / "served"
        running.shutdown()
        thread.join()


def test_originals_are_fetched_once_and_known_from_then_on(server, tmp_path):
    (server / "a.csv").write_bytes(b"as it was\n")
    store = fetch_recordings.Store(tmp_path / "originals")
    original = Served("someone/repo", "0" * 40, ("a.csv",))
    first = store(original)
    assert first.read_bytes() == b"as it was\n"
    sums = (tmp_path / "originals/SHA256SUMS").read_text()
    assert sums == f"{hashlib.sha256(first.read_bytes()).hexdigest()}  {original.name}\n"
    first.unlink()
    (server / "a.csv").write_bytes(b"changed\n")
    with pytest.raises(WorkError, match=r"cannot fetch repo__a\.csv"):
        fetch_recordings.Store(tmp_path / "originals")(original)


def test_every_original_has_an_address_and_a_name_of_its_own():
    everything = [sources.CHAMBER, *sources.CSS_LOGS, sources.CSS_DBC, sources.TOYOTA]
    for group in (sources.COMMA_CAN, sources.COMMA_GYRO, sources.COMMA_POSE):
        everything += group.values()
    assert len({o.name for o in everything}) == len(everything)
    assert all(
        url.startswith("https://github.com/") and o.commit in url for o in everything for url in o.urls
    )
    assert not any("|" in url or " " in url for o in everything for url in o.urls)
