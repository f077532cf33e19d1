"""End-to-end protection of CAN payloads: checksum and counter as AUTOSAR and Toyota define them, compiled.

Sources: AUTOSAR "Specification of SW-C End-to-End Communication Protection Library", profiles 1 (variant 1A:
both bytes of the DataID enter the CRC) and 5; CRC polynomials from AUTOSAR "Specification of CRC Routines"
(SAE J1850: 0x1D, CCITT-FALSE: 0x1021). Toyota's checksum as in the public opendbc project.

Every function takes `data`, a uint8 array (a row of `FRAME["data"]`) of which the first `length` bytes count.
Registers and indices are uint64: numba makes a float of int64 with uint64, and tests signed indices for wrap.
A payload too short for its header is never valid. What the counter must do is the decoder's business.
"""

import numpy as np

from rtcomp.jit import hot_kernel


def _table(polynomial: int, bits: int) -> np.ndarray:
    """Shape (256,): the register left by each value of a byte."""
    top, mask = 1 << (bits - 1), (1 << bits) - 1
    table = np.zeros(256, np.uint64)
    for value in range(256):
        register = value << (bits - 8)
        for _ in range(8):
            register = ((register << 1) ^ (polynomial if register & top else 0)) & mask
        table[value] = register
    return table


_J1850 = _table(0x1D, 8)
_LATER = [_J1850]  # the register of a byte after 0, 1, … further bytes of 0: the CRC is linear
for _ in range(6):
    _LATER.append(_J1850[_LATER[-1]])
_0, _1, _2, _3, _4, _5, _6 = _LATER
_CCITT = _table(0x1021, 16)
_8 = np.uint64(8)
_BYTE = np.uint64(0xFF)
_WORD = np.uint64(0xFFFF)


@hot_kernel
def crc8_j1850(data, start, stop, register):
    """Advance an SAE J1850 register over `data[start:stop]`, without initial or final inversion."""
    crc = np.uint64(register)
    for k in range(start, stop):
        crc = _J1850[crc ^ np.uint64(data[k])]
    return crc


@hot_kernel
def crc16_ccitt(data, start, stop, register):
    """Advance a CCITT register over `data[start:stop]` (CCITT-FALSE when it starts at 0xFFFF)."""
    crc = np.uint64(register)
    for k in range(start, stop):
        crc = ((crc << _8) & _WORD) ^ _CCITT[(crc >> _8) ^ np.uint64(data[k])]
    return crc


@hot_kernel
def profile1a_crc(data, length, data_id):
    """CRC of AUTOSAR profile 1A: DataID low byte, high byte, then everything behind the CRC byte."""
    sender = np.uint64(data_id)
    crc = _J1850[_J1850[sender & _BYTE] ^ (sender >> _8)]
    if length == 8:  # a classical frame, the common case: seven look-ups that do not wait for each other
        early = _6[crc ^ np.uint64(data[1])] ^ _5[np.uint64(data[2])] ^ _4[np.uint64(data[3])]
        late = _3[np.uint64(data[4])] ^ _2[np.uint64(data[5])] ^ _1[np.uint64(data[6])]
        return early ^ late ^ _0[np.uint64(data[7])]
    return crc8_j1850(data, np.uint64(1), np.uint64(length), crc)


@hot_kernel
def profile1a_ok(data, length, data_id):
    """Whether byte 0 is the profile 1A CRC of the payload."""
    return length >= 2 and np.uint64(data[0]) == profile1a_crc(data, length, data_id)


@hot_kernel
def profile1a_protect(data, length, data_id, counter):
    """Write `counter` (0…14) into the low nibble of byte 1 and then the CRC into byte 0, in place."""
    data[1] = (np.uint64(data[1]) & np.uint64(0xF0)) | np.uint64(counter)
    data[0] = profile1a_crc(data, length, data_id)


@hot_kernel
def profile5_crc(data, length, data_id, offset):
    """CRC of AUTOSAR profile 5: everything but the CRC at `offset`, then DataID low byte and high byte."""
    crc = crc16_ccitt(data, np.uint64(0), np.uint64(offset), _WORD)
    crc = crc16_ccitt(data, np.uint64(offset) + np.uint64(2), np.uint64(length), crc)
    sender = np.uint64(data_id)
    crc = ((crc << _8) & _WORD) ^ _CCITT[(crc >> _8) ^ (sender & _BYTE)]
    return ((crc << _8) & _WORD) ^ _CCITT[(crc >> _8) ^ (sender >> _8)]


@hot_kernel
def profile5_ok(data, length, data_id, offset):
    """Whether the two bytes at `offset` (little-endian) are the profile 5 CRC of the payload."""
    if length < offset + 3:
        return False
    sent = np.uint64(data[offset]) | (np.uint64(data[offset + 1]) << _8)
    return sent == profile5_crc(data, length, data_id, offset)


@hot_kernel
def profile5_protect(data, length, data_id, counter, offset):
    """Write `counter` (0…255) behind the CRC and then the CRC at `offset` (little-endian), in place."""
    data[offset + 2] = counter
    crc = profile5_crc(data, length, data_id, offset)
    data[offset] = crc & _BYTE
    data[offset + 1] = crc >> _8


@hot_kernel
def toyota_checksum(data, length, can_id):
    """Toyota's checksum: bytes of the id, length, all payload bytes but the last, summed modulo 256."""
    total = np.uint64(length)
    sender = np.uint64(can_id)
    for _ in range(4):
        total += sender & _BYTE
        sender >>= _8
    for k in range(length - 1):
        total += np.uint64(data[k])
    return total & _BYTE


@hot_kernel
def toyota_ok(data, length, can_id):
    """Whether the last byte is Toyota's checksum of the payload."""
    return length >= 1 and np.uint64(data[length - 1]) == toyota_checksum(data, length, can_id)
