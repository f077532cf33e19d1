"""Random DBCs and payloads: the compiled decoder agrees with cantools bit for bit."""

import math
import struct

import cantools
import numpy as np
import pytest
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcomp.dbc import SignalTable, find_signal, load_dbc
from rtcomp.decode import frame_words, is_selected, raw_value, scaled_value
from rtcomp.errors import RequestError
from rtcomp.frames import FRAME
from rtcomp.jit import kernel

SCALES = st.sampled_from([1, 2, -3, 0.25, 1e-6, 0.01, 0.244, 1000, 1 / 3])
OFFSETS = st.sampled_from([0, 5, -125, 0.5, -67.67, 4096])


@kernel
def decode_all(words, data, signals, mux, scratch, values, raws, there):
    """Every signal of one payload (data of shape (1, 64))."""
    for k in range(signals.shape[0]):
        there[k] = is_selected(words, data, 0, signals, k, mux)
        raws[k] = raw_value(words, data, 0, signals[k])
        values[k] = scaled_value(raws[k], signals[k], scratch)


def compiled_decode(message, payload):
    table = SignalTable()
    rows = {signal.name: table.add(0, message, signal) for signal in message.signals}
    signals, mux, _ = table.arrays()
    frame = np.zeros(1, FRAME)
    frame["data"][0, : len(payload)] = list(payload)
    values, raws = np.zeros(len(signals)), np.zeros(len(signals), np.uint64)
    there = np.zeros(len(signals), np.bool_)
    decode_all(frame_words(frame), frame["data"], signals, mux, np.zeros(8, np.uint8), values, raws, there)
    return {name: values[k] for name, k in rows.items() if there[k]}


@st.composite
def message_and_payload(draw):
    length = draw(st.sampled_from([1, 2, 5, 8, 12, 24, 64]))
    signals = []
    for index in range(draw(st.integers(1, 4))):
        is_float = draw(st.booleans()) and length >= 8
        bits = draw(st.sampled_from([16, 32, 64])) if is_float else draw(st.integers(1, min(64, 8 * length)))
        start = draw(st.integers(0, 8 * length - bits))
        order = draw(st.sampled_from(["little_endian", "big_endian"]))
        if order == "big_endian":
            start = start // 8 * 8 + 7 - start % 8
        conversion = BaseConversion.factory(draw(SCALES), draw(OFFSETS), None, is_float)
        signed = draw(st.booleans())
        signals.append(Signal(f"S{index}", start, bits, order, signed, conversion=conversion))
    message = Message(0x100, "M", length, signals, strict=False)
    return message, draw(st.binary(min_size=length, max_size=length))


def same(ours, theirs):
    if isinstance(theirs, float) and math.isnan(theirs):
        return math.isnan(ours)
    return struct.pack("<d", ours) == struct.pack("<d", float(theirs)) or ours == float(theirs) == 0


@settings(max_examples=400)
@given(message_and_payload())
def test_agrees_with_cantools_bit_for_bit(case):
    message, payload = case
    ours = compiled_decode(message, payload)
    theirs = {}
    for signal in message.signals:  # one at a time: cantools itself cannot decode signals that overlap
        alone = Message(0x100, "M", message.length, [signal], strict=False)
        theirs |= alone.decode(payload, decode_choices=False)
    for signal in message.signals:
        scale = signal.conversion.scale
        if (
            isinstance(scale, int) and signal.length + scale.bit_length() > 62
        ):  # exact in Python's long integers only
            assert ours[signal.name] == pytest.approx(float(theirs[signal.name]), rel=1e-15)
        else:
            assert same(ours[signal.name], theirs[signal.name]), (signal, payload)


MULTIPLEXED = """VERSION ""
BO_ 256 M: 8 X
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" X
 SG_ Sub m1M : 4|4@1+ (1,0) [0|0] "" X
 SG_ A m0 : 8|16@1- (0.5,1) [0|0] "" X
 SG_ B m1 : 8|16@1+ (1,0) [0|0] "" X
 SG_ C m3 : 24|16@0- (1,0) [0|0] "" X
 SG_ Always : 56|8@1+ (1,0) [0|0] "" X
SG_MUL_VAL_ 256 Sub Page 1-1;
SG_MUL_VAL_ 256 A Page 0-0, 2-4;
SG_MUL_VAL_ 256 B Page 1-1;
SG_MUL_VAL_ 256 C Sub 3-3, 7-9;
"""


@settings(max_examples=100)
@given(st.binary(min_size=8, max_size=8))
def test_multiplexed_signals_appear_when_cantools_says_so(payload):
    message = cantools.database.load_string(MULTIPLEXED, "dbc").messages[0]
    try:
        theirs = message.decode(payload, decode_choices=False)
    except cantools.database.DecodeError:  # cantools refuses a page that selects nothing
        return
    assert compiled_decode(message, payload) == {name: float(value) for name, value in theirs.items()}


def test_a_file_that_is_no_dbc_is_refused(tmp_path):
    path = tmp_path / "bad.dbc"
    path.write_text("this is not a DBC")
    with pytest.raises(RequestError, match="not a DBC"):
        load_dbc(path)
    with pytest.raises(RequestError, match="cannot read"):
        load_dbc(tmp_path / "absent.dbc")


def test_a_missing_signal_names_those_there_are():
    message = cantools.database.load_string(MULTIPLEXED, "dbc").messages[0]
    with pytest.raises(RequestError, match=r"it has .*Always"):
        find_signal(message, "Rate", "map")
