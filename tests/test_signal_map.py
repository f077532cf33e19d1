"""Maps are read strictly, and every refusal says what was got and what was wanted."""

import subprocess
import sys
from pathlib import Path

import pytest

from rtcomp import signal_map
from rtcomp.errors import RequestError
from rtcomp.signal_map import (
    Channel,
    RateSignal,
    dbc_path,
    load_map,
    quantum_dph,
    quantum_warning,
    unavailable_from,
)

SMALLEST = """
schema = "rtcomp.map/1"
title = "smallest"
[[channel]]
name = "yaw"
rate = {message = "M", signal = "R"}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


def test_the_smallest_map_has_sensible_defaults(tmp_path):
    (channel,) = load_map(write(tmp_path, SMALLEST)).channels
    assert (channel.rate.sign, channel.rate.unit, channel.rate.not_available) == (1, None, [])
    assert (channel.temperature, channel.valid, channel.range_dps, channel.period_s) == (
        None,
        None,
        None,
        None,
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("rtcomp.map/1", "rtcomp.map/2"), "schema"),
        (("title", "titel"), "titel"),
        (('signal = "R"', 'signal = "R", factor = 2'), "factor"),
        (('signal = "R"', 'signal = "R", sign = 2'), "sign"),
        (('signal = "R"', "signal = 3"), "signal"),
        (('name = "yaw"', 'name = "yaw/rate"'), "name"),
        (('name = "yaw"', 'name = "yaw"\nrange_dps = 0.0'), "range_dps"),
        (
            ('name = "yaw"', 'name = "yaw"\nvalid = {message = "N", signal = "S", ok = [0]}'),
            "rate's own message M",
        ),
        (('name = "yaw"', 'name = "yaw"\nvalid = {message = "M", signal = "S", ok = []}'), "ok"),
        (("[[channel]]", "[[channel"), "map.toml"),
    ],
)
def test_a_wrong_map_is_refused_with_its_path_and_reason(tmp_path, change, reason):
    path = write(tmp_path, SMALLEST.replace(*change))
    with pytest.raises(RequestError) as error:
        load_map(path)
    assert str(path) in str(error.value)
    assert reason in str(error.value)


@pytest.mark.parametrize(
    ("rules", "reason"),
    [
        ('e2e = {profile = "1A"}', "needs a `data_id`"),
        ('e2e = {profile = "5"}', "needs a `data_id`"),
        ('e2e = {profile = "toyota", data_id = 1}', "takes no `data_id`"),
        ('e2e = {profile = "1A", data_id = 1, offset = 2}', "takes no `offset`"),
        ('e2e = {profile = "1A", data_id = 65536}', "data_id"),
        ('e2e = {profile = "2", data_id = 1}', "profile"),
        ("source_address = 128", 'needs `match = "pgn"`'),
        ('match = "pgn"\nsource_address = 256', "source_address"),
        ('counter = {signal = "C", modulus = 1}', "modulus"),
        ('counter = {signal = "C", modulus = 16, max_step = 0}', "max_step"),
        ('[[message]]\nname = "M"', "two message entries"),
    ],
)
def test_a_wrong_message_rule_is_refused(tmp_path, rules, reason):
    path = write(tmp_path, SMALLEST + f'[[message]]\nname = "M"\n{rules}\n')
    with pytest.raises(RequestError) as error:
        load_map(path)
    assert reason in str(error.value)


def test_two_channels_of_one_name_are_refused(tmp_path):
    channel = SMALLEST[SMALLEST.index("[[channel]]") :]
    with pytest.raises(RequestError, match="two channel entries have one name; got yaw, yaw"):
        load_map(write(tmp_path, SMALLEST + channel))


def test_an_unknown_name_lists_the_bundled_maps():
    with pytest.raises(RequestError, match=r"no signal map 'frog'.*fog, fog_fd"):
        load_map("frog")


def test_a_map_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / "map.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RequestError, match="not valid"):
        load_map(path)


def test_the_dbc_is_relative_to_the_map_and_the_command_line_wins(tmp_path):
    own, other = tmp_path / "own.dbc", tmp_path / "other.dbc"
    own.touch()
    other.touch()
    loaded = load_map(write(tmp_path, SMALLEST.replace("title", 'dbc = "own.dbc"\ntitle')))
    assert dbc_path(loaded) == own.resolve()
    assert dbc_path(loaded, other) == other
    with pytest.raises(RequestError, match="no DBC file"):
        dbc_path(loaded, tmp_path / "absent.dbc")
    with pytest.raises(RequestError, match="names no DBC file; give one with --dbc"):
        dbc_path(load_map(write(tmp_path, SMALLEST)))


def test_reading_a_map_loads_neither_compiler_nor_dbc_parser():
    load = "import sys; from rtcomp.signal_map import load_map; load_map('fog')"
    check = f"{load}; sys.exit(bool({{'numba', 'cantools'}} & {{*sys.modules}}))"
    subprocess.run([sys.executable, "-c", check], cwd=Path(__file__).parents[1], check=True)


def test_an_installed_package_finds_its_own_maps_first(tmp_path, monkeypatch):
    (tmp_path / "rtcomp" / "can_dbc").mkdir(parents=True)
    (tmp_path / "can_dbc").mkdir()
    monkeypatch.setattr(signal_map, "__file__", str(tmp_path / "rtcomp" / "signal_map.py"))
    assert signal_map.data_folder() == tmp_path / "rtcomp" / "can_dbc"
    (tmp_path / "rtcomp" / "can_dbc").rmdir()
    assert signal_map.data_folder() == tmp_path / "can_dbc"


@pytest.mark.parametrize(("bits", "raw"), [(2, 0b10), (4, 0xE), (8, 0xFE), (16, 0xFE00), (32, 0xFE000000)])
def test_j1939_keeps_the_top_of_every_width_for_errors(bits, raw):
    assert unavailable_from(bits) == raw


def test_the_quantum_is_warned_of_only_when_it_hides_the_drift():
    channel = Channel(name="yaw", rate=RateSignal("M", "R"), drift_dph=18.0)
    assert quantum_dph(0.005, "deg/s") == pytest.approx(18.0)
    assert quantum_warning(channel, 0.0049, "deg/s") is None
    assert "one bit of R is 18.4 °/h, coarser than the 18 °/h" in (
        quantum_warning(channel, 0.0051, "deg/s") or ""
    )
    assert quantum_warning(channel, 0.0051, "deg/s", drift_dph=20.0) is None
    assert "403 °/h" in (quantum_warning(channel, -(2**-9), "rad/s") or "")
