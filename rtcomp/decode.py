"""Bits of a payload to a physical value, compiled; the layout comes from a DBC (`rtcomp.dbc`).

Any signal of 1…64 bits in 64 bytes: its lowest bit lies in byte `byte` at `shift`, the next bytes follow upwards
(Intel, step 1) or downwards (Motorola, step −1).
"""

import numpy as np

from rtcomp.frames import FRAME
from rtcomp.jit import hot_kernel, rare_kernel

UNSIGNED, SIGNED, FLOAT16, FLOAT32, FLOAT64 = range(5)

ALL = np.uint64(2**64 - 1)
PAIRS = np.uint64(0x00FF00FF00FF00FF)
QUADS = np.uint64(0x0000FFFF0000FFFF)
WORD, PAYLOAD = 8, 16  # bytes of a word; where the payload begins in a FRAME

SIGNAL = np.dtype(
    [
        ("message", "<i4"),  # index of its message
        ("byte", "<i4"),
        ("step", "<i4"),
        ("shift", "<i4"),
        ("bits", "<i4"),
        ("word", "<i4"),  # which 8-byte word of the record holds all of it, −1: it crosses two
        ("word_shift", "<i4"),  # where its lowest bit is there (in the reversed word for step −1)
        ("kind", "<i4"),
        ("exact", "<i4"),  # 1: the scale is an integer and no product leaves 63 bits; 2: so is the offset
        ("multiplexer", "<i4"),  # index of the signal that selects this one, −1: always there
        ("mux_start", "<i4"),  # rows of the plan's mux ranges
        ("mux_count", "<i4"),
        ("na_start", "<i4"),  # rows of the plan's raw values that mean "not available"
        ("na_count", "<i4"),
        ("scale", "<f8"),  # of the DBC
        ("offset", "<f8"),
        ("factor", "<f8"),  # from the DBC's unit to ours, and the axis' sign
        ("shift_unit", "<f8"),
    ]
)
"""One signal, ready for `raw_value` and `physical_value`."""


def frame_words(frames: np.ndarray) -> np.ndarray:
    """Frames, shape (n,) of FRAME, as 8-byte words, shape (n, 10), without a copy."""
    return frames.view(np.uint64).reshape(len(frames), FRAME.itemsize // WORD)


@hot_kernel
def reversed_bytes(word):
    """The word with its bytes in the other order."""
    word = ((word >> np.uint64(8)) & PAIRS) | ((word & PAIRS) << np.uint64(8))
    word = ((word >> np.uint64(16)) & QUADS) | ((word & QUADS) << np.uint64(16))
    return (word >> np.uint64(32)) | (word << np.uint64(32))


@hot_kernel
def raw_value(words, data, row, signal):
    """The unsigned raw value of `signal` in frame `row`.

    `words` and `data` are two views of the frames: records as 8-byte words (n, 10), payloads as bytes (n, 64).
    """
    if signal["word"] >= 0:
        word = words[row, np.uint64(signal["word"])]
        if signal["step"] < 0:
            word = reversed_bytes(word)
        word >>= np.uint64(signal["word_shift"])
        return word & (ALL >> np.uint64(64 - signal["bits"]))
    return raw_value_across(data, row, signal)


@hot_kernel
def raw_value_across(data, row, signal):
    """The same byte by byte, for a signal anywhere in the payload `data[row]` (array (n, 64) of uint8)."""
    byte, step, shift, bits = signal["byte"], signal["step"], signal["shift"], signal["bits"]
    raw = np.uint64(data[row, byte]) >> np.uint64(shift)
    got = 8 - shift
    while got < bits:
        byte += step
        raw |= np.uint64(data[row, byte]) << np.uint64(got)
        got += 8
    if bits < 64:
        raw &= (np.uint64(1) << np.uint64(bits)) - np.uint64(1)
    return raw


@hot_kernel
def signed_value(raw, bits):
    """Two's complement of `bits` bits as int64."""
    spare = np.uint64(64 - bits)
    return np.int64(raw << spare) >> np.int64(spare)


@rare_kernel
def float_value(raw, bits, scratch):
    """IEEE 754 of 16, 32 or 64 bits; `scratch` is one row of 8 bytes."""
    for k in range(8):
        scratch[k] = np.uint8((raw >> np.uint64(8 * k)) & np.uint64(0xFF))
    if bits == 64:
        return scratch.view(np.float64)[0]
    if bits == 32:
        return np.float64(scratch.view(np.float32)[0])
    return half_value(raw)


@hot_kernel
def half_value(raw):
    """IEEE 754 half precision, which numba's views lack."""
    sign = -1.0 if raw >> np.uint64(15) else 1.0
    exponent = np.int64((raw >> np.uint64(10)) & np.uint64(31))
    fraction = np.float64(raw & np.uint64(1023))
    if exponent == 31:
        return sign * np.inf if fraction == 0.0 else np.nan
    if exponent == 0:
        return sign * fraction * 2.0**-24
    return sign * (1024.0 + fraction) * 2.0 ** (exponent - 25)


@hot_kernel
def scaled_value(raw, signal, scratch):
    """The value as the DBC gives it, in the DBC's unit; the same arithmetic as cantools."""
    if signal["kind"] > SIGNED:
        return float_value(raw, signal["bits"], scratch) * signal["scale"] + signal["offset"]
    value = signed_value(raw, signal["bits"]) if signal["kind"] == SIGNED else np.int64(raw)
    if signal["exact"] == 2:
        return np.float64(value * np.int64(signal["scale"]) + np.int64(signal["offset"]))
    if signal["exact"] == 1:
        return np.float64(value * np.int64(signal["scale"])) + signal["offset"]
    if signal["kind"] == UNSIGNED:
        return np.float64(raw) * signal["scale"] + signal["offset"]
    return np.float64(value) * signal["scale"] + signal["offset"]


@rare_kernel
def is_selected(words, data, row, signals, index, mux_ranges):
    """Whether signal `index` is there in this payload: every multiplexer above it has a value that selects it."""
    current = np.uint64(index)
    while signals[current]["multiplexer"] >= 0:
        selector = np.uint64(signals[current]["multiplexer"])
        raw = raw_value(words, data, row, signals[selector])
        start = signals[current]["mux_start"]
        hit = False
        for k in range(start, start + signals[current]["mux_count"]):
            if mux_ranges[k, 0] <= raw <= mux_ranges[k, 1]:
                hit = True
        if not hit:
            return False
        current = selector
    return True


@hot_kernel
def is_available(raw, signal, na_ranges):
    """Whether the raw value is a measurement and not a code for "error" or "not available"."""
    for k in range(signal["na_start"], signal["na_start"] + signal["na_count"]):
        if na_ranges[k, 0] <= raw <= na_ranges[k, 1]:
            return False
    return True


@hot_kernel
def physical_value(words, data, row, signals, index, mux_ranges, na_ranges, scratch):
    """The value in our units, NaN when it is not there, not available or not finite."""
    signal = signals[index]
    if signal["multiplexer"] >= 0 and not is_selected(words, data, row, signals, index, mux_ranges):
        return np.nan
    raw = raw_value(words, data, row, signal)
    if signal["na_count"] > 0 and not is_available(raw, signal, na_ranges):
        return np.nan
    value = scaled_value(raw, signal, scratch) * signal["factor"] + signal["shift_unit"]
    return value if np.isfinite(value) else np.nan
