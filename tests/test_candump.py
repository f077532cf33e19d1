"""Candump logs: round trip to the bit, equality with python-can's reader, bad input."""

import gzip
import logging
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcomp.errors import RequestError
from rtcomp.frames import (
    CAN_ERR_CRTL,
    CAN_ERR_CRTL_RX_OVERFLOW,
    CLOCK_STEP_ID,
    FRAME,
    FrameFlag,
)
from rtcomp.sources.candump import CandumpWriter, read_candump, write_candump

DRIVE = Path(__file__).parent.parent / "../shared/recordings/css_vw_drive.log.gz"
TOYOTA = DRIVE.with_name("comma2k19_rav4_bus0.log.gz")
GOOD = b"(1.000000001) can0 123#11AABB\n"


def read_all(path, **options):
    return np.concatenate(list(read_candump(path, **options)))


def write_text(path, text):
    path.write_bytes(text)
    return path


@st.composite
def frame_rows(draw):
    kind = draw(st.sampled_from(["classic", "fd", "remote", "error"]))
    extended = kind != "error" and draw(st.booleans())
    flags = FrameFlag.EXTENDED if extended else FrameFlag(0)
    highest = 0x7FF if not extended and kind != "error" else 0x1FFFFFFF
    data = draw(st.binary(max_size=64 if kind == "fd" else 8))
    length = len(data)
    if kind == "fd":
        flags |= FrameFlag.FD
        flags |= draw(st.sampled_from([0, FrameFlag.BITRATE_SWITCH, FrameFlag.ERROR_STATE]))
        flags |= draw(st.sampled_from([0, FrameFlag.ERROR_STATE]))
    if kind == "remote":
        flags |= FrameFlag.REMOTE
        data, length = b"", draw(st.integers(0, 8))
    if kind == "error":
        flags |= FrameFlag.ERROR
    time = draw(st.integers(-(2**62), 2**63 - 10**9))
    payload = np.frombuffer(data.ljust(64, b"\0"), np.uint8)
    return time, draw(st.integers(0, highest)), int(flags), length, 0, payload


@given(st.lists(frame_rows(), min_size=1, max_size=30), st.sampled_from([".log", ".log.gz"]))
@settings(max_examples=60)
def test_round_trip_to_the_bit(tmp_path_factory, rows, suffix):
    path = tmp_path_factory.mktemp("round") / f"trip{suffix}"
    frames = np.array(rows, FRAME)
    write_candump(path, frames)
    assert read_all(path, chunk=256).tobytes() == frames.tobytes()


def test_receiver_events_survive(tmp_path):
    frames = np.zeros(2, FRAME)
    frames["flags"] = FrameFlag.ERROR
    frames["length"] = 8
    frames["can_id"] = CAN_ERR_CRTL, CLOCK_STEP_ID
    frames["data"][0, 1:6] = [CAN_ERR_CRTL_RX_OVERFLOW, 0x34, 0x12, 0, 0]
    frames["data"][1, :8] = np.frombuffer(np.int64(-5_000_000_000).tobytes(), np.uint8)
    write_candump(tmp_path / "events.log", frames)
    assert read_all(tmp_path / "events.log").tobytes() == frames.tobytes()


@pytest.mark.parametrize(
    ("line", "t_ns", "can_id", "flags", "data"),
    [
        (b"(1436509052.249713) vcan0 044#2A366C2BBA", 1436509052249713000, 0x44, 0, "2A366C2BBA"),
        (b"(1.5) can0 1F334455#", 1500000000, 0x1F334455, FrameFlag.EXTENDED, ""),
        (b"(0.1234567899) can0 001#00 R", 123456789, 1, 0, "00"),
        (b"  (12) 7 7FF#ff  T \r", 12 * 10**9, 0x7FF, 0, "FF"),
        (b"(1.0) can0 00000001##5112233", 10**9, 1, FrameFlag.EXTENDED | FrameFlag.FD | FrameFlag.BITRATE_SWITCH,
         "112233"),
        (b"(1.0) can0 001##2", 10**9, 1, FrameFlag.FD | FrameFlag.ERROR_STATE, ""),
        (b"(1.0) can0 20000040#0000000000000000", 10**9, 0x40, FrameFlag.ERROR, "0000000000000000"),
        (b"(1.0) can0 123#1122334455667788_E", 10**9, 0x123, 0, "1122334455667788"),
    ],
)  # fmt: skip
def test_line(tmp_path, line, t_ns, can_id, flags, data):
    [frame] = read_all(write_text(tmp_path / "one.log", line + b"\n"))
    payload = bytes.fromhex(data)
    assert (frame["t_ns"], frame["can_id"], frame["flags"]) == (t_ns, can_id, flags)
    assert frame["data"].tobytes() == payload.ljust(64, b"\0")
    assert frame["length"] == len(payload)


@pytest.mark.parametrize(("text", "length"), [(b"R", 0), (b"R8", 8), (b"r3", 3)])
def test_remote_frame(tmp_path, text, length):
    [frame] = read_all(write_text(tmp_path / "one.log", b"(1.0) can0 123#" + text + b"\n"))
    assert (frame["flags"], frame["length"]) == (FrameFlag.REMOTE, length)


@pytest.mark.parametrize(
    "line",
    [
        b"garbage", b"(1.0) can0", b"(1.0) can0 123", b"(1.0) 123#11", b"1.0 can0 123#11", b"(1.x) can0 123#11",
        b"(1.0) can0 12#11", b"(1.0) can0 FFF#11", b"(1.0) can0 12345#11", b"(1.0) can0 123#1", b"(1.0) can0 123#1G",
        b"(1.0) can0 123#112233445566778899", b"(1.0) can0 123##", b"(1.0) can0 123##1" + b"00" * 65,
        b"(1.0) can0 123#R9", b"(1.0) can0 123#11 X", b"(1.0) can0 123#11 R R", b"(99999999999.0) can0 123#11",
        b"(.5) can0 123#11", b"\xff\x00\x81", b"(1.0) can0 123##1R", b"(1.0)can0 123#11",
    ],
)  # fmt: skip
def test_garbage_is_skipped_counted_and_reported(tmp_path, line, caplog):
    reader = read_candump(write_text(tmp_path / "bad.log", GOOD + line + b"\n" + GOOD))
    with caplog.at_level(logging.WARNING):
        frames = np.concatenate(list(reader))
    assert len(frames) == 2
    assert frames[0].tobytes() == frames[1].tobytes()  # nothing of the bad line stays in the next frame
    assert (reader.skipped, reader.first_skipped, reader.lines_read) == (1, [2], 3)
    assert "skipped 1 unreadable line (line 2)" in caplog.text


def test_line_longer_than_a_block_is_one_bad_line(tmp_path):
    text = GOOD + b"x" * 5000 + b"\n" + GOOD
    reader = read_candump(write_text(tmp_path / "long.log", text), chunk=256)
    assert sum(map(len, reader)) == 2
    assert (reader.skipped, reader.first_skipped) == (1, [2])


def test_truncated_last_line_is_skipped(tmp_path):
    reader = read_candump(write_text(tmp_path / "cut.log", GOOD + b"(2.0) can0 12"))
    assert sum(map(len, reader)) == 1
    assert reader.first_skipped == [2]


def test_last_line_needs_no_newline(tmp_path):
    assert len(read_all(write_text(tmp_path / "end.log", GOOD + GOOD.strip()))) == 2


@pytest.mark.parametrize("text", [b"", b"\n\n", b"no frame here\n"])
def test_nothing_readable_is_refused(tmp_path, text):
    with pytest.raises(RequestError, match="is a CAN frame"):
        list(read_candump(write_text(tmp_path / "none.log", text)))


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(RequestError, match="no such log file"):
        read_candump(tmp_path / "absent.log")


def random_log(count):
    rng = np.random.default_rng(7)
    return b"".join(b"(%d.%06d) can0 123#%s\n" % (i, rng.integers(10**6), rng.bytes(8).hex().encode())
                    for i in range(count))  # fmt: skip


@pytest.mark.parametrize("kept", [0.5, 0.999])
def test_truncated_gzip_gives_what_is_good_then_says_so(tmp_path, kept):
    text = random_log(5000)
    packed = gzip.compress(text)
    path = write_text(tmp_path / "cut.log.gz", packed[: int(kept * len(packed))])
    got = []
    reader = read_candump(path, chunk=4096)
    with pytest.raises(RequestError, match=r"ends early, after \d+ frames") as refusal:
        got.extend(reader)
    frames = np.concatenate(got)
    assert f"after {len(frames)} frames" in str(refusal.value)
    assert 0.4 * 5000 < len(frames) < 5000
    whole = read_all(write_text(tmp_path / "whole.log", text))
    assert frames[:-1].tobytes() == whole[: len(frames) - 1].tobytes()


def test_damaged_gzip_is_refused(tmp_path):
    packed = bytearray(gzip.compress(random_log(2000)))
    packed[len(packed) // 2] ^= 0xFF
    with pytest.raises(RequestError, match="damaged"):
        list(read_candump(write_text(tmp_path / "bad.log.gz", bytes(packed))))


def test_blocks_do_not_change_the_frames(tmp_path):
    path = write_text(tmp_path / "some.log", random_log(300))
    assert read_all(path, chunk=256).tobytes() == read_all(path).tobytes()


def test_writer_names_its_file_at_the_end(tmp_path):
    path = tmp_path / "kept.log"
    writer = CandumpWriter(path)
    writer.append(np.zeros(3, FRAME))
    assert not path.exists()
    writer.close()
    writer.close()
    assert len(read_all(path)) == 3
    assert [file.name for file in tmp_path.iterdir()] == ["kept.log"]


def test_writer_leaves_nothing_where_nothing_was_written(tmp_path):
    with pytest.raises(KeyError), CandumpWriter(tmp_path / "none.log"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_python_can_reads_what_we_write(tmp_path):
    frames = read_all(write_text(tmp_path / "in.log", random_log(50)))
    write_candump(tmp_path / "out.log", frames)
    messages = list(can.CanutilsLogReader(tmp_path / "out.log"))
    assert [message.arbitration_id for message in messages] == frames["can_id"].tolist()
    assert [bytes(message.data) for message in messages] == [
        bytes(row[:length]) for row, length in zip(frames["data"], frames["length"], strict=True)
    ]


def assert_same_as_python_can(path):
    count = 0
    for frames in read_candump(path):
        messages = READERS[path]
        for row in frames:
            message = next(messages)
            length = int(row["length"])
            assert row["can_id"] == message.arbitration_id
            assert bool(row["flags"] & FrameFlag.EXTENDED) == message.is_extended_id
            assert length == message.dlc
            assert row["data"][:length].tobytes() == message.data
            assert abs(row["t_ns"] / 1e9 - message.timestamp) < 1e-6
        count += len(frames)
    assert next(READERS[path], None) is None
    return count


READERS = {}


@pytest.mark.parametrize(
    ("path", "count"),
    [(TOYOTA, 53_800), pytest.param(DRIVE, 640_067, marks=pytest.mark.slow)],
)
def test_real_log_equals_python_can(path, count):
    if not path.exists():
        pytest.skip(f"{path.name}: the folder of recordings is missing")
    READERS[path] = iter(can.LogReader(path))
    assert assert_same_as_python_can(path) == count
