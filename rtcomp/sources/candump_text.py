"""The candump text format, both ways, as kernels over bytes.

One line is `(seconds.fraction) interface id#data`, as `candump -L` and python-can write it. Three id digits
are a standard id, eight an extended one, or an error frame where bit 29 is set; `id##<flags>data` is CAN FD,
`id#R<length>` a remote frame; ` R` or ` T` may follow. (Format: can-utils, `lib.h`.)
"""

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import FrameFlag
from rtcomp.jit import hot_kernel

EXTENDED, FD, ERROR = int(FrameFlag.EXTENDED), int(FrameFlag.FD), int(FrameFlag.ERROR)
REMOTE, BRS, ESI = int(FrameFlag.REMOTE), int(FrameFlag.BITRATE_SWITCH), int(FrameFlag.ERROR_STATE)
ERROR_ID_BIT = 0x20000000
EXTENDED_ID_BIT = 0x80000000
ID_BITS = 0x1FFFFFFF
NANO = 1_000_000_000
MAX_SECONDS = 9_223_372_035  # the last whole second that int64 nanoseconds hold
LONGEST_LINE = 176  # bytes of a written line without its interface name

NEWLINE, SPACE, HASH, POINT, MINUS, OPEN, CLOSE, ZERO = 10, 32, 35, 46, 45, 40, 41, 48
NO_DIGIT = 255

_hex_values = np.full(256, NO_DIGIT, np.uint8)
for _value, _digits in enumerate([*"0123456789", "Aa", "Bb", "Cc", "Dd", "Ee", "Ff"]):
    _hex_values[[ord(digit) for digit in _digits]] = _value
HEX_VALUES: NDArray[np.uint8] = _hex_values
HEX_DIGITS = np.frombuffer(b"0123456789ABCDEF", np.uint8).copy()


@hot_kernel
def _skip(text, p, stop, blanks):
    """The position after the blanks, or after the characters that are none, at `p`."""
    while p < stop and (int(text[p]) == SPACE) == blanks:
        p += 1
    return p


@hot_kernel
def _time_ns(text, p, stop):
    """Read `(seconds.fraction)` at `p`: time [ns], digits beyond the ninth cut off; next position or -1."""
    if p >= stop or int(text[p]) != OPEN:
        return 0, -1
    p += 1
    negative = p < stop and int(text[p]) == MINUS
    if negative:
        p += 1
    seconds = 0
    first = p
    while p < stop and ZERO <= int(text[p]) < ZERO + 10 and p - first < 12:
        seconds = 10 * seconds + int(text[p]) - ZERO
        p += 1
    if p == first or seconds > MAX_SECONDS:
        return 0, -1
    nanos = 0
    if p < stop and int(text[p]) == POINT:
        p += 1
        place = NANO // 10
        while p < stop and ZERO <= int(text[p]) < ZERO + 10:
            nanos += (int(text[p]) - ZERO) * place
            place //= 10
            p += 1
    if p >= stop or int(text[p]) != CLOSE:
        return 0, -1
    time = seconds * NANO + nanos
    return (-time if negative else time), p + 1


@hot_kernel
def _identifier(text, p, stop):
    """Read `id#` at `p`: id without its flag bits, FrameFlag bits, next position or -1."""
    value = 0
    first = p
    while p < stop and p - first < 9 and HEX_VALUES[text[p]] != NO_DIGIT:
        value = 16 * value + int(HEX_VALUES[text[p]])
        p += 1
    digits = p - first
    if p >= stop or int(text[p]) != HASH:
        return 0, 0, -1
    if digits == 3 and value <= 0x7FF:
        return value, 0, p + 1
    if digits == 8 and value & 0x40000000 == 0:
        return value & ID_BITS, (ERROR if value & ERROR_ID_BIT else EXTENDED), p + 1
    return 0, 0, -1


@hot_kernel
def _payload(text, p, stop, longest, data, row):
    """Read hexadecimal bytes at `p` into `data[row]`: how many, next position or -1."""
    length = 0
    while p + 1 < stop and HEX_VALUES[text[p]] != NO_DIGIT:
        low = int(HEX_VALUES[text[p + 1]])
        if low == NO_DIGIT or length == longest:
            return length, -1
        data[row, length] = 16 * int(HEX_VALUES[text[p]]) + low
        length += 1
        p += 2
    return length, p


@hot_kernel
def _tail_is_clean(text, p, stop):
    """Whether only the raw length code (`_9`…`_F`) and the direction (` R`, ` T`) follow."""
    if p + 1 < stop and int(text[p]) == 95 and HEX_VALUES[text[p + 1]] != NO_DIGIT:  # "_"
        p += 2
    if p == stop:
        return True
    if int(text[p]) != SPACE:
        return False
    p = _skip(text, p, stop, True)  # a letter follows: the line has no trailing blanks here
    letter = int(text[p]) | 0x20
    return p + 1 == stop and letter in (114, 116)  # r, t


@hot_kernel
def _parse_line(text, p, stop, frames, row):
    """Read one line, without blanks around it, into `frames[row]` (zeroed before); False if it is none."""
    time, p = _time_ns(text, p, stop)
    if p < 0 or p >= stop or int(text[p]) != SPACE:
        return False
    name = _skip(text, p, stop, True)
    p = _skip(text, name, stop, False)
    if p == name:
        return False
    p = _skip(text, p, stop, True)
    can_id, flags, p = _identifier(text, p, stop)
    if p < 0:
        return False
    longest = 8
    if p + 1 < stop and int(text[p]) == HASH:
        bits = int(HEX_VALUES[text[p + 1]])
        if bits == NO_DIGIT or flags & ERROR:
            return False
        flags |= FD | (BRS if bits & 1 else 0) | (ESI if bits & 2 else 0)
        longest = 64
        p += 2
    if p < stop and int(text[p]) | 0x20 == 114:  # r: a remote frame
        if flags & (FD | ERROR):
            return False
        flags |= REMOTE
        length = 0
        p += 1
        if p < stop and ZERO <= int(text[p]) <= ZERO + 8:
            length = int(text[p]) - ZERO
            p += 1
    else:
        length, p = _payload(text, p, stop, longest, frames["data"], row)
    if p < 0 or not _tail_is_clean(text, p, stop):
        return False
    frames["t_ns"][row] = time
    frames["can_id"][row] = can_id
    frames["flags"][row] = flags
    frames["length"][row] = length
    return True


@hot_kernel
def parse_lines(text, begin, end, frames, lines_before, bad_lines):
    """Read whole lines of `text[begin:end]` into zeroed `frames` until either is used up.

    Returns the position of the first line not read, the number of frames, of lines, and of lines skipped as
    unreadable; the numbers (from 1) of the first of those go to `bad_lines`.
    """
    rows, lines, bad = 0, 0, 0
    while begin < end and rows < len(frames):
        line_end = begin
        while line_end < end and int(text[line_end]) != NEWLINE:
            line_end += 1
        if line_end == end:
            break
        lines += 1
        p, stop = begin, line_end
        begin = line_end + 1
        while p < stop and int(text[p]) <= SPACE:
            p += 1
        while stop > p and int(text[stop - 1]) <= SPACE:
            stop -= 1
        if p == stop:  # an empty line is no loss
            continue
        if _parse_line(text, p, stop, frames, rows):
            rows += 1
            continue
        for k in range(64):  # a line may fail after some of its payload
            frames["data"][rows, k] = 0
        if bad < len(bad_lines):
            bad_lines[bad] = lines_before + lines
        bad += 1
    return begin, rows, lines, bad


@hot_kernel
def _put_decimal(out, p, value, digits):
    """Write `value` with at least `digits` decimal digits at `p`; returns the next position."""
    count = 1
    rest = value // 10
    while rest > 0 or count < digits:
        rest //= 10
        count += 1
    for k in range(count):
        out[p + count - 1 - k] = ZERO + value % 10
        value //= 10
    return p + count


@hot_kernel
def _put_hex(out, p, value, digits):
    """Write `value` with exactly `digits` hexadecimal digits at `p`; returns the next position."""
    for k in range(digits):
        out[p + k] = HEX_DIGITS[(value >> (4 * (digits - 1 - k))) & 15]
    return p + digits


@hot_kernel
def _put_line(frames, i, channel, out, p):
    """Write frame `i` as one line at `p`; returns the next position."""
    time = int(frames["t_ns"][i])
    flags, length = int(frames["flags"][i]), int(frames["length"][i])
    out[p] = OPEN
    p += 1
    if time < 0:
        out[p] = MINUS
        p += 1
        time = -time
    p = _put_decimal(out, p, time // NANO, 1)
    out[p] = POINT
    p = _put_decimal(out, p + 1, time % NANO, 9)
    out[p], out[p + 1] = CLOSE, SPACE
    p += 2
    for k in range(len(channel)):
        out[p + k] = channel[k]
    p += len(channel)
    out[p] = SPACE
    can_id = int(frames["can_id"][i])
    if flags & ERROR:
        p = _put_hex(out, p + 1, can_id | ERROR_ID_BIT, 8)
    else:
        p = _put_hex(out, p + 1, can_id, 8 if flags & EXTENDED else 3)
    out[p] = HASH
    p += 1
    if flags & REMOTE:
        out[p], out[p + 1] = 82, ZERO + min(length, 8)  # R
        p += 2
        length = 0
    elif flags & FD:
        out[p] = HASH
        p = _put_hex(out, p + 1, (1 if flags & BRS else 0) | (2 if flags & ESI else 0), 1)
    for k in range(length):
        p = _put_hex(out, p, int(frames["data"][i, k]), 2)
    out[p] = NEWLINE
    return p + 1


@hot_kernel
def format_lines(frames, first, channel, out):
    """Write `frames[first:]` as lines into `out`; returns the first frame not written and the bytes used."""
    p = 0
    while first < len(frames) and p + LONGEST_LINE + len(channel) <= len(out):
        p = _put_line(frames, first, channel, out, p)
        first += 1
    return first, p
