"""Sending CAN frames at absolute times from compiled code: clock_nanosleep, then sendmmsg of what is due."""

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import FrameFlag
from rtcomp.jit import hot_kernel
from rtcomp.sources.libc import (
    CLOCK_MONOTONIC,
    TIMER_ABSTIME,
    clock_gettime,
    clock_nanosleep,
    last_error,
    sendmmsg,
)

EXTENDED, FD, ERROR = int(FrameFlag.EXTENDED), int(FrameFlag.FD), int(FrameFlag.ERROR)
REMOTE, BRS, ESI = int(FrameFlag.REMOTE), int(FrameFlag.BITRATE_SWITCH), int(FrameFlag.ERROR_STATE)
NANO = 1_000_000_000
MSG_DONTWAIT = 0x40
EAGAIN, EINTR, ENETDOWN, ENOBUFS = 11, 4, 100, 105
CLASSIC_SIZE, FD_SIZE = 16, 72
FD_FRAME = 4  # CANFD_FDF
EFF_FLAG, RTR_FLAG, ERR_FLAG = 0x80000000, 0x40000000, 0x20000000
RETRY_NS = 100_000  # pause when the interface's queue is full
PATIENCE_NS = NANO  # a queue full for this long belongs to a bus that is off or alone

# the state at the front of the words
SECONDS, NANOS, BATCH, FAILED, STUCK_SINCE, LAST_ERRNO = range(6)
STATE_WORDS = 6
HEADER_WORDS, VECTOR_WORDS, RAW_WORDS = 8, 2, 9


def send_words(batch: int) -> NDArray[np.int64]:
    """The words that sendmmsg and the kernel share: state, then headers, vectors and raw frames per slot."""
    words = np.zeros(STATE_WORDS + (HEADER_WORDS + VECTOR_WORDS + RAW_WORDS) * batch, np.int64)
    headers = words[STATE_WORDS:][: HEADER_WORDS * batch].reshape(batch, -1)
    vectors = words[STATE_WORDS + HEADER_WORDS * batch :][: VECTOR_WORDS * batch].reshape(batch, -1)
    raw = words[STATE_WORDS + (HEADER_WORDS + VECTOR_WORDS) * batch :]
    slots = np.arange(batch)
    vectors[:, 0] = raw.ctypes.data + 8 * RAW_WORDS * slots
    headers[:, 2] = vectors.ctypes.data + 8 * VECTOR_WORDS * slots
    headers[:, 3] = 1
    words[BATCH] = batch
    return words


@hot_kernel
def _now(words, address):
    clock_gettime(CLOCK_MONOTONIC, address + 8 * SECONDS)
    return int(words[SECONDS]) * NANO + int(words[NANOS])


@hot_kernel
def _sleep_until(words, address, deadline):
    words[SECONDS] = deadline // NANO
    words[NANOS] = deadline % NANO
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, address + 8 * SECONDS, 0)


@hot_kernel
def _put_frame(words, slot, frames, row):
    """Lay `frames[row]` (a FRAME as ten words) out as struct can_frame or canfd_frame in a slot."""
    batch = int(words[BATCH])
    p = STATE_WORDS + (HEADER_WORDS + VECTOR_WORDS) * batch + RAW_WORDS * slot
    head = int(frames[row, 1])
    flags, length = (head >> 32) & 0xFF, (head >> 40) & 0xFF
    raw_id = head & 0x1FFFFFFF
    if flags & ERROR:
        raw_id |= ERR_FLAG
    else:
        raw_id |= (EFF_FLAG if flags & EXTENDED else 0) | (RTR_FLAG if flags & REMOTE else 0)
    bits = 0
    if flags & FD:
        bits = FD_FRAME | (1 if flags & BRS else 0) | (2 if flags & ESI else 0)
    words[p] = raw_id | length << 32 | bits << 40
    for k in range(8):
        words[p + 1 + k] = frames[row, 2 + k]
    words[STATE_WORDS + HEADER_WORDS * batch + VECTOR_WORDS * slot + 1] = (
        FD_SIZE if flags & FD else CLASSIC_SIZE
    )


@hot_kernel
def _send_once(words, address, descriptor, count, now):
    """Send `count` slots: how many frames are done with (sent, or the first given up), or 0 to try again."""
    sent = sendmmsg(descriptor, address + 8 * STATE_WORDS, count, MSG_DONTWAIT)
    if sent < 0 and last_error() == ENETDOWN:  # told once for an interface that is perhaps up again
        sent = sendmmsg(descriptor, address + 8 * STATE_WORDS, count, MSG_DONTWAIT)
    if sent > 0:
        words[STUCK_SINCE] = 0
        return sent
    code = last_error()
    words[LAST_ERRNO] = code
    if code == EINTR:
        return 0
    if code in (EAGAIN, ENOBUFS):
        if int(words[STUCK_SINCE]) == 0:
            words[STUCK_SINCE] = now
        if now - int(words[STUCK_SINCE]) < PATIENCE_NS:
            return 0
    words[FAILED] += 1
    return -1


@hot_kernel
def send_paced(words, address, descriptor, frames, deadlines, sent_at, first, end):
    """Send `frames[first:]` at their deadlines until monotonic time `end` [ns]; returns the first not sent.

    All that is due goes in one call. `sent_at` gets each frame's time of sending, -1 for one that failed.
    """
    i = first
    while i < len(deadlines):
        now = _now(words, address)
        if now >= end:
            break
        if int(deadlines[i]) > now:
            _sleep_until(words, address, min(int(deadlines[i]), end))
            continue
        count = 0
        while count < int(words[BATCH]) and i + count < len(deadlines) and int(deadlines[i + count]) <= now:
            _put_frame(words, count, frames, i + count)
            count += 1
        done = _send_once(words, address, descriptor, count, now)
        for k in range(i, i + abs(done)):
            sent_at[k] = now if done > 0 else -1
        i += abs(done)
        if done == 0:
            _sleep_until(words, address, now + RETRY_NS)
    return i
