"""Untrusted bytes at every door: done, or refused with a reason, and never anything else."""

import logging
import struct
import zlib

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tools.fuzz_seeds import ASC, seeds
from tools.fuzz_targets import TARGETS, run

EXAMPLES = {
    "dbc": 60,
    "asc": 100,
    "trc": 100,
    "blf": 100,
    "can_csv": 100,
    "signal_map": 100,
}  # their parsers are slow
WILD = (
    b"-1",
    b"1e308",
    b"9" * 40,
    b"0",
    b"null",
    b"NaN",
    b"[]",
    b"{}",
    b'""',
    b"\x00",
    b"\xff",
    b"\n",
    b"true",
    b",",
)


@st.composite
def spoiled(draw, name):
    """A good input with a few pieces cut out, doubled or replaced."""
    data = draw(st.sampled_from(seeds(name)))
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.integers(0, 12)))
        piece = draw(st.sampled_from(WILD) | st.binary(max_size=6) | st.just(data[start:stop] * 2))
        data = data[:start] + piece + data[stop:]
    return data


@pytest.mark.parametrize("name", TARGETS)
def test_good_input_is_taken(name):
    assert all(run(name, seed) for seed in seeds(name))


@pytest.mark.parametrize("name", TARGETS)
def test_any_input_is_taken_or_refused(name, caplog):
    caplog.set_level(logging.CRITICAL)  # a refusal that is said a thousand times helps nobody
    count = EXAMPLES.get(name, 250)

    @settings(max_examples=count, suppress_health_check=list(HealthCheck))
    @given(data=spoiled(name) | st.binary(max_size=200))
    @example(data=b"")
    def anything(data):
        run(name, data)

    anything()


def blf_of(objects):
    """A BLF log whose one container holds these bytes, simulated."""
    packed = zlib.compress(objects)
    head = struct.pack("<4sL8BQQLL8H8H72x", b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1,
                       144 + 32 + len(packed), len(objects), 1, 0, *[0] * 16)  # fmt: skip
    holder = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(packed), 10, 2, len(objects))
    return head + holder + packed


# Found by fuzzing, mended, and never to come back.
FINDINGS = {
    "an object of no length in a .blf log": (
        "blf",
        blf_of(struct.pack("<4sHHLL", b"LOBJ", 16, 1, 0, 999) + bytes(48)),
    ),
    "a table's header that is not UTF-8": ("recording", b"\x80t_s,rate_dps,temp_degC\n0.0,1.0,20.0\n"),
    "an id of more than 32 bits in a log": ("asc", ASC.replace(b"0A0 ", b"B" * 20)),
    "an id of 30 bits in a log": ("asc", ASC.replace(b"0A0 ", b"3FFFFFFFx")),
    "a time after the end of int64 ns in a log": ("asc", ASC.replace(b"0.015991", b"99999999999.0")),
    "a polynomial without a coefficient": (
        "swap",
        b'{"schema": "rtcomp.model/1", "inputs": [], "rules": {"centers": [], "widths": [], "consequents": []}, '
        b'"base": {"kind": "polynomial", "coefficients": []}}',
    ),
    "a time constant beyond 64-bit nanoseconds": (
        "model",
        b'{"schema": "rtcomp.model/1", "inputs": [], "rules": {"centers": [], "widths": [], "consequents": []}, '
        b'"terms": [{"effect": "thermal_lag", "parameters": {"tau_s": 1e300}}]}',
    ),
}
NESTED = (
    '{{"schema": "rtcomp.model/1", "inputs": [], "rules": {{}}, "provenance": {{"a": {opening}1{closing}}}}}'
)


@pytest.mark.parametrize(("opening", "closing"), ["[]", ('{"a":', "}")])
def test_no_depth_of_a_model_can_be_read_and_not_written_again(opening, closing, caplog):
    caplog.set_level(logging.CRITICAL)
    for depth in [
        30,
        100,
        *range(900, 1010),
    ]:  # about the interpreter's limit, reading and writing differ by one
        data = NESTED.format(opening=opening * depth, closing=closing * depth).encode()
        assert run("model", data) == (depth == 30)
        assert run("swap", data)


@pytest.mark.parametrize("what", FINDINGS)
def test_what_fuzzing_found_is_refused(what):
    name, data = FINDINGS[what]
    assert not run(name, data) or name == "swap"  # a swap is refused by being counted
