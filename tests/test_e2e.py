"""The compiled checksums against slow twins, the independent autosar-e2e package, and a real car's frames."""

import gzip
from pathlib import Path

import e2e.p01
import e2e.p05
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp import e2e as ours

RECORDINGS = Path(__file__).parents[2] / "shared" / "recordings"
DATA_IDS = st.integers(0, 0xFFFF)


def row(payload: bytes) -> np.ndarray:
    """A row of FRAME["data"]: 64 bytes, garbage behind the payload."""
    data = np.full(64, 0xA5, np.uint8)
    data[: len(payload)] = np.frombuffer(payload, np.uint8)
    return data


def naive_crc(data: bytes, polynomial: int, bits: int, register: int) -> int:
    """Bit by bit, as the polynomial is defined."""
    for byte in data:
        for bit in range(7, -1, -1):
            feedback = (register >> (bits - 1)) ^ ((byte >> bit) & 1)
            register = ((register << 1) & ((1 << bits) - 1)) ^ (polynomial if feedback else 0)
    return register


@given(st.binary(max_size=64), st.integers(0, 0xFF))
def test_crc8_equals_the_bitwise_definition(payload, register):
    assert ours.crc8_j1850(row(payload), 0, len(payload), register) == naive_crc(payload, 0x1D, 8, register)


@given(st.binary(max_size=64), st.integers(0, 0xFFFF))
def test_crc16_equals_the_bitwise_definition(payload, register):
    assert ours.crc16_ccitt(row(payload), 0, len(payload), register) == naive_crc(
        payload, 0x1021, 16, register
    )


def test_crcs_give_the_published_check_values():
    digits = row(b"123456789")
    assert ours.crc8_j1850(digits, 0, 9, 0xFF) ^ 0xFF == 0x4B  # AUTOSAR CRC routines: SAE J1850
    assert ours.crc16_ccitt(digits, 0, 9, 0xFFFF) == 0x29B1  # … and CCITT-FALSE


@given(st.binary(min_size=2, max_size=32), DATA_IDS, st.integers(0, 14))
def test_profile_1a_protects_as_the_independent_package_does(payload, data_id, counter):
    data = row(payload)
    ours.profile1a_protect(data, len(payload), data_id, counter)
    theirs = bytearray(payload)
    theirs[1] = (theirs[1] & 0xF0) | counter
    e2e.p01.e2e_p01_protect(theirs, data_id, increment_counter=False)
    assert data[: len(payload)].tobytes() == bytes(theirs)
    assert ours.profile1a_ok(data, len(payload), data_id)


@given(st.binary(min_size=2, max_size=32), DATA_IDS)
def test_profile_1a_judges_any_payload_as_the_independent_package_does(payload, data_id):
    assert ours.profile1a_ok(row(payload), len(payload), data_id) == e2e.p01.e2e_p01_check(
        bytearray(payload), data_id
    )


@given(st.data(), st.binary(min_size=3, max_size=64), DATA_IDS, st.integers(0, 255))
def test_profile_5_protects_as_the_independent_package_does(draw, payload, data_id, counter):
    offset = draw.draw(st.integers(0, len(payload) - 3))
    data = row(payload)
    ours.profile5_protect(data, len(payload), data_id, counter, offset)
    theirs = bytearray(payload)
    theirs[offset + 2] = counter
    e2e.p05.e2e_p05_protect(theirs, data_id, offset=offset, increment_counter=False)
    assert data[: len(payload)].tobytes() == bytes(theirs)
    assert ours.profile5_ok(data, len(payload), data_id, offset)


@given(st.data(), st.binary(min_size=8, max_size=8), DATA_IDS, st.integers(0, 14))
def test_one_wrong_bit_is_always_noticed(draw, payload, data_id, counter):
    data = row(payload)
    ours.profile1a_protect(data, 8, data_id, counter)
    data[draw.draw(st.integers(0, 7))] ^= 1 << draw.draw(st.integers(0, 7))
    assert not ours.profile1a_ok(data, 8, data_id)
    ours.profile5_protect(data, 8, data_id, counter, 0)
    data[draw.draw(st.integers(0, 7))] ^= 1 << draw.draw(st.integers(0, 7))
    assert not ours.profile5_ok(data, 8, data_id, 0)


@given(st.binary(min_size=8, max_size=8), DATA_IDS, DATA_IDS)
def test_a_frame_of_another_sender_is_refused(payload, data_id, other):
    data = row(payload)
    ours.profile5_protect(data, 8, data_id, 7, 0)
    assert ours.profile5_ok(data, 8, other, 0) == (data_id == other)


@pytest.mark.parametrize("length", [0, 1, 2])
def test_payload_too_short_for_its_header_is_never_valid(length):
    data = np.zeros(64, np.uint8)
    assert not ours.profile5_ok(data, length, 0, 0)
    assert length >= 2 or not ours.profile1a_ok(data, length, 0)
    assert length >= 1 or not ours.toyota_ok(data, length, 0)


def test_toyota_checksum_holds_for_every_speed_frame_of_a_real_car():
    log = RECORDINGS / "comma2k19_rav4_bus0.log.gz"
    if not log.exists():
        pytest.skip(f"{log.name} is not here: real recordings are not shipped with the project")
    with gzip.open(log, "rt") as lines:
        payloads = [bytes.fromhex(line.split("#")[1].strip()) for line in lines if " 0B4#" in line]
    assert len(payloads) > 1000
    assert all(ours.toyota_ok(row(payload), 8, 0x0B4) for payload in payloads)
    assert not any(ours.toyota_ok(row(payload), 8, 0x0B5) for payload in payloads)
