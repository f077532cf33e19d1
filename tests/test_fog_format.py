"""What we write, cantools and the independent E2E package read back."""

from pathlib import Path

import cantools
import e2e.p01
import e2e.p05
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp import fog_format
from rtcomp.errors import RequestError
from rtcomp.fog_format import encode_fd, encode_rate, encode_temperature, merge
from rtcomp.frames import FrameFlag
from rtcomp.signal_map import dbc_path, load_map

CLASSICAL = cantools.database.load_file(dbc_path(load_map("fog")))
FD = cantools.database.load_file(dbc_path(load_map("fog_fd")))
RATES = st.lists(st.floats(-2147.48, 2147.48), min_size=1, max_size=40)
TEMPERATURES = st.floats(-327.0, 327.0)


def decode(database, frame):
    payload = frame["data"][: frame["length"]].tobytes()
    return database.decode_message(int(frame["can_id"]), payload, decode_choices=False)


@given(RATES, st.integers(0, 15), st.integers(0, 10**9))
def test_rate_frames_read_back_by_cantools_and_pass_the_independent_check(rates, status, counter):
    frames = encode_rate(np.arange(len(rates)), rates, status=status, counter=counter)
    for k, (frame, rate) in enumerate(zip(frames, rates, strict=True)):
        values = decode(CLASSICAL, frame)
        assert values["Rate"] == pytest.approx(rate, abs=0.5001e-6)
        assert (values["Status"], values["Counter"]) == (status, (counter + k) % 15)
        assert e2e.p01.e2e_p01_check(bytearray(frame["data"][:8]), fog_format.RATE_DATA_ID)


@given(st.lists(st.tuples(TEMPERATURES, TEMPERATURES), min_size=1, max_size=20))
def test_temperature_frames_read_back(pairs):
    housing, coil = np.array(pairs).T
    frames = encode_temperature(np.arange(len(pairs)), housing, coil)
    for k, frame in enumerate(frames):
        values = decode(CLASSICAL, frame)
        assert values["HousingTemp"] == pytest.approx(housing[k], abs=0.00501)
        assert values["CoilTemp"] == pytest.approx(coil[k], abs=0.00501)
        assert e2e.p01.e2e_p01_check(bytearray(frame["data"][:8]), fog_format.TEMPERATURE_DATA_ID)


@given(RATES, TEMPERATURES, TEMPERATURES, st.integers(0, 15), st.integers(0, 10**9))
def test_fd_frames_read_back(rates, housing, coil, status, counter):
    frames = encode_fd(np.arange(len(rates)), rates, housing, coil, status=status, counter=counter)
    assert np.all(frames["flags"] & FrameFlag.FD)
    for k, (frame, rate) in enumerate(zip(frames, rates, strict=True)):
        values = decode(FD, frame)
        assert values["Rate"] == pytest.approx(rate, abs=0.5001e-6)
        assert values["HousingTemp"] == pytest.approx(housing, abs=0.00501)
        assert values["CoilTemp"] == pytest.approx(coil, abs=0.00501)
        assert (values["Status"], values["Counter"]) == (status, (counter + k) % 256)
        assert e2e.p05.e2e_p05_check(bytes(frame["data"][:12]), fog_format.FD_DATA_ID)


def test_a_stream_written_in_pieces_is_the_stream_written_at_once():
    t_ns = np.arange(100) * 1_000_000
    rates = np.sin(t_ns)
    whole = encode_rate(t_ns, rates, counter=7)
    pieces = [encode_rate(t_ns[k : k + 33], rates[k : k + 33], counter=7 + k) for k in range(0, 100, 33)]
    assert np.array_equal(whole, np.concatenate(pieces))


def test_missing_temperatures_are_sent_as_not_available():
    (channel,) = load_map("fog").channels
    frames = encode_temperature([0, 1], [20.0, np.nan])
    raw = frames["data"][:, 2:6].copy().view("<i2")
    assert raw[0, 0] == 2000
    assert channel.temperature is not None
    assert [int(value) for value in (raw[1, 0],)] == channel.temperature.not_available
    assert np.all(raw[:, 1] == fog_format.NOT_AVAILABLE)


@pytest.mark.parametrize("rate", [2147.4836481, -2147.4836491, np.nan, np.inf])
def test_a_rate_that_does_not_fit_is_refused_by_row(rate):
    with pytest.raises(RequestError, match="of sample 1 does not fit"):
        encode_rate([0, 1, 2], [0.0, rate, 0.0])


def test_the_extreme_rates_fit():
    frames = encode_rate([0, 1], [2147.483647, -2147.483648])
    assert frames["data"][:, 2:6].copy().view("<i4").ravel().tolist() == [2**31 - 1, -(2**31)]


@pytest.mark.parametrize("temperature", [327.68, -327.68, np.inf])
def test_a_temperature_that_does_not_fit_is_refused(temperature):
    with pytest.raises(RequestError, match=r"temperature .* of sample 0"):
        encode_temperature([0], [temperature])


@pytest.mark.parametrize(("status", "unfit"), [(-1, -1), (16, 16), ([3, -1], -1)])
def test_a_status_of_more_than_four_bits_is_refused(status, unfit):
    with pytest.raises(RequestError, match=f"status {unfit} does not fit .* wanted 0…15"):
        encode_rate([0, 1], [0.0, 0.0], status=status)


def test_merge_orders_by_time_and_keeps_the_earlier_argument_first_on_a_tie():
    rates = encode_rate([10, 20, 30], [1.0, 2.0, 3.0])
    temperatures = encode_temperature([5, 20], [25.0, 26.0])
    frames = merge(temperatures, rates)
    assert frames["t_ns"].tolist() == [5, 10, 20, 20, 30]
    assert frames["can_id"].tolist()[2:4] == [fog_format.TEMPERATURE_ID, fog_format.RATE_ID]
    assert len(merge(rates[:0], temperatures[:0])) == 0


@pytest.mark.parametrize(
    ("name", "message", "can_id", "data_id", "length"),
    [
        ("fog", "FOG_RATE", fog_format.RATE_ID, fog_format.RATE_DATA_ID, fog_format.CLASSICAL_LENGTH),
        (
            "fog",
            "FOG_TEMP",
            fog_format.TEMPERATURE_ID,
            fog_format.TEMPERATURE_DATA_ID,
            fog_format.CLASSICAL_LENGTH,
        ),
        ("fog_fd", "FOG_FD", fog_format.FD_ID, fog_format.FD_DATA_ID, fog_format.FD_LENGTH),
    ],
)
def test_writer_map_and_dbc_state_the_same_numbers(name, message, can_id, data_id, length):
    signal_map = load_map(name)
    (rules,) = [rules for rules in signal_map.messages if rules.name == message]
    assert rules.e2e is not None
    assert rules.e2e.data_id == data_id
    definition = cantools.database.load_file(Path(dbc_path(signal_map))).get_message_by_name(message)
    assert (definition.frame_id, definition.length, definition.is_fd) == (can_id, length, length > 8)
    assert all(signal.conversion.scale == 1e-6 for signal in definition.signals if signal.name == "Rate")
