"""The bundled DBC files and maps: they load strictly, fit each other, and say what their sources say."""

import functools
import gzip
import re
import struct
import tomllib
from pathlib import Path

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp.signal_map import (
    bundled_maps,
    data_folder,
    dbc_path,
    load_map,
    quantum_dph,
    quantum_warning,
    unavailable_from,
)
from rtcomp.units import rate_unit, temperature_unit

RECORDINGS = Path(__file__).parents[2] / "shared" / "recordings"
MAPS = sorted(bundled_maps())
README = (data_folder() / "README.md").read_text()
INT16 = st.integers(-(2**15), 2**15 - 1)
UINT16 = st.integers(0, 2**16 - 1)
# °/h per bit as found in the makers' documents, independently of these files
ANCHORS = {
    "fog": 0.0036,
    "fog_fd": 0.0036,
    "fog_simulated": 0.0036,
    "bosch_mm5_10": 18,
    "bosch_mm7_10": 18,
    "aceinna_openimu300": 28,
    "sbg_ellipse": 206,
    "xsens_mti": 403,
    "toyota_kinematics": 878,
    "css_canmod_gps": 900,
}


@functools.cache
def database(name):
    return cantools.database.load_file(dbc_path(load_map(name)), strict=True)


def signal(db, reference):
    return db.get_message_by_name(reference.message).get_signal_by_name(reference.signal)


def decode(name, message, payload):
    return database(name).get_message_by_name(message).decode(payload, decode_choices=False)


def real_frames(log, can_id):
    path = RECORDINGS / log
    if not path.exists():
        pytest.skip(f"{log} is not here: real recordings are not shipped with the project")
    with gzip.open(path, "rt") as lines:
        return [bytes.fromhex(line.split("#")[1].strip()) for line in lines if f" {can_id:03X}#" in line]


def test_every_dbc_has_a_map_and_every_map_a_dbc():
    assert sorted(path.stem for path in data_folder().glob("*.dbc")) == MAPS
    assert all(dbc_path(load_map(name)).stem == name for name in MAPS)


@pytest.mark.parametrize("name", MAPS)
def test_every_name_of_a_map_is_in_its_dbc(name):
    signal_map, db = load_map(name), database(name)
    for channel in signal_map.channels:
        rate_unit(signal(db, channel.rate).unit, name)
        for temperature in (channel.temperature, channel.coil_temperature):
            if temperature is not None:
                temperature_unit(signal(db, temperature).unit, name)
        if channel.valid is not None:
            status = signal(db, channel.valid)
            assert all(0 <= raw < 2**status.length for raw in channel.valid.ok)
    for rules in signal_map.messages:
        message = db.get_message_by_name(rules.name)
        if rules.counter is not None:
            counter = message.get_signal_by_name(rules.counter.signal)
            assert 2 ** (counter.length - 1) < rules.counter.modulus <= 2**counter.length
        assert message.is_extended_frame or rules.match == "id"


@pytest.mark.parametrize("name", MAPS)
def test_raw_values_that_mean_not_available_fit_their_signal(name):
    db = database(name)
    for channel in load_map(name).channels:
        for reference in (channel.rate, channel.temperature, channel.coil_temperature):
            if reference is not None and reference.not_available != "j1939":
                found = signal(db, reference)
                lowest = -(2 ** (found.length - 1)) if found.is_signed else 0
                assert all(lowest <= raw < lowest + 2**found.length for raw in reference.not_available)


@pytest.mark.parametrize("name", MAPS)
def test_one_bit_is_what_the_makers_state_and_coarse_ones_are_warned_of(name):
    channel = load_map(name).channels[0]
    found = signal(database(name), channel.rate)
    quantum = quantum_dph(found.conversion.scale, found.unit)
    assert quantum == pytest.approx(ANCHORS[name], rel=5e-3)
    assert (quantum_warning(channel, found.conversion.scale, found.unit) is None) == name.startswith("fog")


def test_the_readme_states_every_map_with_its_signal_and_bit():
    rows = {
        row[0]: row[1:]
        for row in re.findall(r"^\| `(\w+)` \| (\w+) \| .* \| ([\d.]+) \| .* \|$", README, re.M)
    }
    assert sorted(rows) == MAPS
    for name, (rate, quantum) in rows.items():
        channel = load_map(name).channels[0]
        found = signal(database(name), channel.rate)
        assert rate == channel.rate.signal
        assert float(quantum) == pytest.approx(quantum_dph(found.conversion.scale, found.unit), rel=5e-3)
        assert f"**`{name}`**" in README or name.startswith("fog")


def test_the_readme_example_is_a_valid_map(tmp_path):
    example = README.split("```toml")[1].split("```")[0]
    path = tmp_path / "example.toml"
    path.write_text(example)
    loaded = load_map(path)
    assert loaded.channels[0].period_s == tomllib.loads(example)["channel"][0]["period_s"]


@given(st.tuples(INT16, INT16, INT16), INT16)
def test_sbg_layout_is_little_endian_int16_as_documented(gyro, temperature):
    values = decode("sbg_ellipse", "SBG_IMU_GYRO", struct.pack("<hhh", *gyro))
    assert [values[f"Gyro{axis}"] for axis in "XYZ"] == pytest.approx([raw * 1e-3 for raw in gyro])
    info = decode("sbg_ellipse", "SBG_IMU_INFO", struct.pack("<IHh", 1, 0, temperature))
    assert info["Temperature"] == pytest.approx(temperature * 0.01)


@given(st.tuples(INT16, INT16, INT16), INT16)
def test_xsens_layout_is_big_endian_int16_as_documented(gyro, temperature):
    values = decode("xsens_mti", "XCDI_RateOfTurn", struct.pack(">hhh", *gyro))
    assert [values[f"Gyr{axis}"] for axis in "XYZ"] == [raw * 2.0**-9 for raw in gyro]
    heat = decode("xsens_mti", "XCDI_Temperature", struct.pack(">h", temperature))
    assert heat["Temperature"] == temperature * 2.0**-8


@given(st.tuples(UINT16, UINT16, UINT16))
def test_openimu_layout_is_j1939_as_documented(gyro):
    values = decode("aceinna_openimu300", "AngularRate", struct.pack("<HHHBB", *gyro, 0, 0))
    assert [values[f"AngularRate{axis}"] for axis in "XYZ"] == [raw / 128 - 250 for raw in gyro]


def test_openimu_identifier_is_pgn_61482_and_its_errors_start_above_the_range():
    message = database("aceinna_openimu300").get_message_by_name("AngularRate")
    assert (message.frame_id >> 8) & 0x3FFFF == 61482
    (rules,) = load_map("aceinna_openimu300").messages
    assert (rules.match, rules.source_address) == ("pgn", None)
    assert unavailable_from(16) / 128 - 250 == 258.0  # J1939's valid range ends at +252 °/s


@given(UINT16, st.integers(0, 15), st.integers(0, 255), st.integers(0, 15))
def test_bosch_layouts_are_as_documented(rate, status, temperature, counter):
    payload = struct.pack("<HBBHBB", rate, status << 4, temperature, 0, counter, 0)
    values = decode("bosch_mm7_10", "MM7_10_TX1", payload)
    assert values["YawRate"] == pytest.approx(rate * 0.005 - 163.84)
    assert (values["YawRateStatus"], values["Counter1"]) == (status, counter)
    assert values["Temperature"] == temperature - 50
    assert decode("bosch_mm7_10", "MM7_10_TX2", payload)["RollRate"] == values["YawRate"]
    assert decode("bosch_mm7_10", "MM7_10_TX3", payload)["PitchRate"] == values["YawRate"]
    assert decode("bosch_mm5_10", "MM5_10_TX1", payload)["YawRate"] == values["YawRate"]


def test_bosch_status_is_good_when_none_of_its_three_fault_bits_is_set():
    for channel in load_map("bosch_mm7_10").channels:
        assert channel.valid is not None
        assert channel.valid.ok == [raw for raw in range(16) if not raw & 0b111]


@pytest.mark.filterwarnings("default")
def test_canmod_decodes_real_frames_as_the_makers_own_dbc():
    frames = real_frames("css_vw_drive.log.gz", 0x009)
    ours = database("css_canmod_gps").get_message_by_name("gnss_imu")
    theirs = cantools.database.load_file(RECORDINGS / "css_gnss.dbc", strict=False).get_message_by_frame_id(9)
    sample = frames[::1000] + [frame for frame in frames if not frame[0] & 1]
    assert all(
        ours.decode(frame, decode_choices=False) == theirs.decode(frame, decode_choices=False)
        for frame in sample
    )
    assert len(frames) == 526_432
    invalid = [ours.decode(frame) for frame in frames if not frame[0] & 1]
    assert len(invalid) == 5  # as the README says
    assert all(values["AngularRateX"] == 0 for values in invalid)


def test_toyota_decodes_real_frames_as_the_public_dbc():
    frames = real_frames("comma2k19_rav4_bus0.log.gz", 0x024)
    ours = database("toyota_kinematics").get_message_by_name("KINEMATICS")
    theirs = cantools.database.load_file(RECORDINGS / "toyota_2017_subset.dbc").get_message_by_name(
        "KINEMATICS"
    )
    assert len(frames) == 4_974
    assert all(ours.decode(frame) == theirs.decode(frame) for frame in frames)
