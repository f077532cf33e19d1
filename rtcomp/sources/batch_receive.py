"""Receiving CAN frames in batches: poll, recvmmsg, times, drop counts and conversion in one compiled call.

Everything the operating system reads or writes lies in one array of 64-bit words (`Workspace`): a call
carries two arrays only. Layouts are those of 64-bit Linux: struct can_frame and canfd_frame (linux/can.h),
mmsghdr, cmsghdr, timespec. A FRAME is ten words: time; id | flags << 32 | length << 40; payload.
"""

import ctypes
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtcomp.frames import CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW, CLOCK_STEP_ID, FRAME, FrameFlag
from rtcomp.jit import hot_kernel
from rtcomp.sources.clock import STEP_NS, SteadyClock
from rtcomp.sources.libc import (
    CLOCK_MONOTONIC,
    CLOCK_REALTIME,
    clock_gettime,
    getsockopt,
    last_error,
    poll,
    recvmmsg,
)

EXTENDED, FD, ERROR = int(FrameFlag.EXTENDED), int(FrameFlag.FD), int(FrameFlag.ERROR)
REMOTE, BRS, ESI = int(FrameFlag.REMOTE), int(FrameFlag.BITRATE_SWITCH), int(FrameFlag.ERROR_STATE)
NANO = 1_000_000_000
LOW = 0xFFFFFFFF
FRAME_WORDS = FRAME.itemsize // 8
SOL_SOCKET, SCM_TIMESTAMPNS, SCM_TIMESTAMPING, SO_RXQ_OVFL, SO_MEMINFO = 1, 35, 37, 40, 55
MEMINFO_BYTES = 36  # nine 32-bit words (linux/sock_diag.h), the last of which counts drops
POLLIN, MSG_DONTWAIT = 0x1, 0x40
CLASSIC_SIZE, FD_SIZE = 16, 72
EFF_FLAG, RTR_FLAG, ERR_FLAG, ID_BITS = 0x80000000, 0x40000000, 0x20000000, 0x1FFFFFFF
EVENT_WORD = (ERROR << 32) | (8 << 40)  # an error frame of eight bytes
NEVER = -(1 << 63)
TROUBLE, ERROR_SEEN, ROWS = 1 << 32, 1 << 33, LOW  # what receive_batch returns
HARDWARE_DRIFT = 5_000  # the adapter's clock may be slow by 1 part in this (200 ppm)

# the state at the front of the workspace, one word each
(SOCKET_POLL, WAKE_POLL, CLOCK_SECONDS, CLOCK_NANOS, OFFSET, HOST_OFFSET, LAST_TIME, LAST_BATCH, DROPS,
 LOST, MALFORMED, ERROR_FRAMES, ERRNO, USED, STEP, HARDWARE_KNOWN, HARDWARE_OFFSET, HARDWARE_LAST,
 BATCH, MEMORY_SIZE, MEMORY) = range(21)  # fmt: skip
STATE_WORDS = MEMORY + 5
HEADER_WORDS, VECTOR_WORDS, RAW_WORDS, CONTROL_WORDS = 8, 2, 9, 16


class Workspace:
    """The words that one receiver's system calls and kernel share.

    Attributes:
        words: int64, shape `(n,)`; the state, then headers, vectors, raw frames, control messages per slot.
        frames: FRAME, shape `(2 * batch + 1,)`: a batch, an overflow event before each frame, a clock step.
    """

    def __init__(self, batch: int, descriptor: int, wake_descriptor: int, clock: SteadyClock):
        if sys.byteorder != "little" or ctypes.sizeof(ctypes.c_void_p) != 8:
            raise OSError("batch receive needs a little-endian 64-bit system")
        per_slot = HEADER_WORDS + VECTOR_WORDS + RAW_WORDS + CONTROL_WORDS
        self.words = np.zeros(STATE_WORDS + per_slot * batch, np.int64)
        self.address = self.words.ctypes.data
        self.frames: NDArray[Any] = np.zeros(2 * batch + 1, FRAME)
        self.frame_words = self.frames.view(np.int64).reshape(-1, FRAME_WORDS)
        self.words[BATCH] = batch
        self.words[SOCKET_POLL] = descriptor | POLLIN << 32
        self.words[WAKE_POLL] = wake_descriptor | POLLIN << 32
        self.words[OFFSET] = clock.offset_ns
        self.words[HOST_OFFSET] = clock.host_offset_ns
        self.words[LAST_TIME] = self.words[LAST_BATCH] = NEVER
        self._lay_out(batch)

    def _lay_out(self, batch: int) -> None:
        headers = self.words[STATE_WORDS:][: HEADER_WORDS * batch].reshape(batch, HEADER_WORDS)
        vectors = self.words[STATE_WORDS + HEADER_WORDS * batch :][: VECTOR_WORDS * batch].reshape(batch, -1)
        raw = self.address + 8 * raw_word(batch, 0)
        control = self.address + 8 * control_word(batch, 0)
        slots = np.arange(batch)
        vectors[:, 0] = raw + 8 * RAW_WORDS * slots
        vectors[:, 1] = FD_SIZE
        headers[:, 2] = vectors.ctypes.data + 8 * VECTOR_WORDS * slots
        headers[:, 3] = 1
        headers[:, 4] = control + 8 * CONTROL_WORDS * slots
        headers[:, 5] = 8 * CONTROL_WORDS


@hot_kernel
def raw_word(batch, slot):
    """Where slot's raw frame begins."""
    return STATE_WORDS + (HEADER_WORDS + VECTOR_WORDS) * batch + RAW_WORDS * slot


@hot_kernel
def control_word(batch, slot):
    """Where slot's control messages begin."""
    return STATE_WORDS + (HEADER_WORDS + VECTOR_WORDS + RAW_WORDS) * batch + CONTROL_WORDS * slot


@hot_kernel
def _clock(words, address, which):
    clock_gettime(which, address + 8 * CLOCK_SECONDS)
    return int(words[CLOCK_SECONDS]) * NANO + int(words[CLOCK_NANOS])


@hot_kernel
def monotonic_ns(words, address):
    """The monotonic clock now [ns]."""
    return _clock(words, address, CLOCK_MONOTONIC)


@hot_kernel
def _host_offset(words, address):
    """What to add to the monotonic time to read as the host's clock does; the tightest of five readings."""
    best, offset = 1 << 62, 0
    for _ in range(5):
        before = _clock(words, address, CLOCK_MONOTONIC)
        host = _clock(words, address, CLOCK_REALTIME)
        width = _clock(words, address, CLOCK_MONOTONIC) - before
        if width < best:
            best, offset = width, host - before - width // 2
    return offset


@hot_kernel
def _read_clocks(words, address):
    """The steady time now; words[STEP] becomes what the host's clock has stepped since the last call."""
    host = _clock(words, address, CLOCK_REALTIME)
    now = _clock(words, address, CLOCK_MONOTONIC)
    step = host - now - int(words[HOST_OFFSET])
    if abs(step) >= STEP_NS:  # once more, with care
        step = _host_offset(words, address) - int(words[HOST_OFFSET])
    if abs(step) < STEP_NS:
        step = 0
    words[STEP] = step
    words[HOST_OFFSET] += step
    return now + int(words[OFFSET])


@hot_kernel
def _steady_time(words, stamp, now):
    """A kernel time stamp (host's clock) on the steady clock; in the batch of a step, either side of it."""
    time = stamp - int(words[HOST_OFFSET]) + int(words[OFFSET])
    step = int(words[STEP])
    if step != 0 and not int(words[LAST_BATCH]) <= time <= now + STEP_NS:
        time += step  # stamped before the step
    return time


@hot_kernel
def _hardware_time(words, stamp, arrival):
    """An adapter's time stamp on the steady clock.

    Its clock has an epoch and a drift of its own; the smallest distance to the arrival seen so far, allowed
    to grow with the drift, is the offset (the smallest, since a frame can arrive late but not early).
    """
    distance = arrival - stamp
    elapsed = stamp - int(words[HARDWARE_LAST])
    offset = int(words[HARDWARE_OFFSET]) + max(elapsed, 0) // HARDWARE_DRIFT
    if int(words[HARDWARE_KNOWN]) == 0 or distance < offset or elapsed < -NANO or distance - offset > NANO:
        offset = distance  # also after a reset of the adapter's clock
    words[HARDWARE_KNOWN] = 1
    words[HARDWARE_OFFSET] = offset
    words[HARDWARE_LAST] = stamp
    return stamp + offset


@hot_kernel
def _read_control(words, slot, now):
    """The frame's time on the steady clock, and by how much the socket's drop counter has grown before it."""
    batch = int(words[BATCH])
    p = control_word(batch, slot)
    end = p + int(words[STATE_WORDS + HEADER_WORDS * slot + 5]) // 8
    arrival, hardware, dropped = now, 0, 0
    while p + 2 <= end:
        length = int(words[p])
        if length < 16 or p + (length + 7) // 8 > end:
            break
        level, kind = int(words[p + 1]) & LOW, int(words[p + 1]) >> 32
        if level == SOL_SOCKET and kind == SCM_TIMESTAMPNS:
            arrival = _steady_time(words, int(words[p + 2]) * NANO + int(words[p + 3]), now)
        elif level == SOL_SOCKET and kind == SCM_TIMESTAMPING:
            software = int(words[p + 2]) * NANO + int(words[p + 3])
            if software != 0:
                arrival = _steady_time(words, software, now)
            hardware = int(words[p + 6]) * NANO + int(words[p + 7])
        elif level == SOL_SOCKET and kind == SO_RXQ_OVFL:
            dropped = _new_drops(words, int(words[p + 2]) & LOW)
        p += (length + 7) // 8
    time = min(arrival, now)
    if hardware != 0:
        time = min(_hardware_time(words, hardware, time), now)
    return max(time, int(words[LAST_TIME])), dropped


@hot_kernel
def _new_drops(words, counter):
    """How many frames were dropped since the counter was last seen; it wraps at 32 bits."""
    dropped = (counter - int(words[DROPS])) & LOW
    words[DROPS] = counter
    words[LOST] += dropped
    return dropped


@hot_kernel
def _silent_drops(words, address):
    """What the socket has dropped since a frame last told: the count of a burst's end must not wait for the next."""
    words[MEMORY_SIZE] = MEMINFO_BYTES
    socket = int(words[SOCKET_POLL]) & LOW
    failed = getsockopt(socket, SOL_SOCKET, SO_MEMINFO, address + 8 * MEMORY, address + 8 * MEMORY_SIZE)
    if failed != 0 or int(words[MEMORY_SIZE]) & LOW != MEMINFO_BYTES:
        return 0
    return _new_drops(words, int(words[MEMORY + 4]) & LOW)


@hot_kernel
def _put_event(frames, row, time, can_id, payload):
    frames[row, 0] = time
    frames[row, 1] = can_id | EVENT_WORD
    frames[row, 2] = payload
    for k in range(3, FRAME_WORDS):
        frames[row, k] = 0


@hot_kernel
def _put_overflow(frames, row, time, dropped):
    _put_event(frames, row, time, CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW << 8 | dropped << 16)


@hot_kernel
def _convert(words, slot, frames, row):
    """Write slot's frame, all but its time, to `frames[row]`; False if it is neither classical nor FD."""
    size = int(words[STATE_WORDS + HEADER_WORDS * slot + 7]) & LOW
    p = raw_word(int(words[BATCH]), slot)
    head = int(words[p])
    raw_id, length = head & LOW, (head >> 32) & 0xFF
    if size == FD_SIZE:
        bits = (head >> 40) & 0xFF
        flags = FD | (BRS if bits & 1 else 0) | (ESI if bits & 2 else 0)
        length = min(length, 64)
    elif size == CLASSIC_SIZE:
        flags = 0
        length = min(length, 8)
    else:
        return False
    if raw_id & ERR_FLAG:
        flags = ERROR
        words[ERROR_FRAMES] += 1
    else:
        flags |= (EXTENDED if raw_id & EFF_FLAG else 0) | (REMOTE if raw_id & RTR_FLAG else 0)
    frames[row, 1] = (raw_id & ID_BITS) | flags << 32 | length << 40
    data_bytes = 0 if flags & REMOTE else length
    for k in range(8):
        rest = data_bytes - 8 * k
        word = int(words[p + 1 + k]) if rest > 0 else 0
        frames[row, 2 + k] = word if rest >= 8 or rest <= 0 else word & ((1 << 8 * rest) - 1)
    return True


@hot_kernel
def receive_batch(words, address, frames, timeout_ms):
    """Wait for frames, take what is there, write them and what happened to `frames`.

    `frames` is the FRAME array as int64 words, shape `(2 * batch + 1, 10)`. Returns the rows written, plus
    TROUBLE where an error (in words[ERRNO]) or a wake-up (still readable in its descriptor) is to be dealt
    with, plus ERROR_SEEN where there are error frames among them.
    """
    words[ERRNO] = 0
    words[ERROR_FRAMES] = 0
    words[SOCKET_POLL] &= LOW | POLLIN << 32
    words[WAKE_POLL] &= LOW | POLLIN << 32
    count = 0
    ready = poll(address + 8 * SOCKET_POLL, 2, timeout_ms)
    if ready < 0:
        words[ERRNO] = last_error()
    elif int(words[SOCKET_POLL]) >> 48:
        for slot in range(int(words[USED])):
            words[STATE_WORDS + HEADER_WORDS * slot + 5] = 8 * CONTROL_WORDS
        count = recvmmsg(
            int(words[SOCKET_POLL]) & LOW, address + 8 * STATE_WORDS, int(words[BATCH]), MSG_DONTWAIT, 0
        )
        if count < 0:
            words[ERRNO] = last_error()
            count = 0
        words[USED] = count
    rows = take_batch(words, address, frames, count)
    if rows == 0:
        dropped = _silent_drops(words, address)
        if dropped > 0:
            _put_overflow(frames, 0, int(words[LAST_BATCH]), dropped)
            rows = 1
    if int(words[ERRNO]) != 0 or int(words[WAKE_POLL]) >> 48:
        rows |= TROUBLE
    if int(words[ERROR_FRAMES]) > 0:
        rows |= ERROR_SEEN
    return rows


@hot_kernel
def take_batch(words, address, frames, count):
    """Turn `count` filled slots into rows of `frames`; returns how many."""
    now = _read_clocks(words, address)
    rows = 0
    if int(words[STEP]) != 0:
        rows = 1  # filled when the time of the first frame is known
    for slot in range(count):
        time, dropped = _read_control(words, slot, now)
        if dropped > 0:
            _put_overflow(frames, rows, time, dropped)
            rows += 1
        if _convert(words, slot, frames, rows):
            frames[rows, 0] = time
            rows += 1
        else:
            words[MALFORMED] += 1
        words[LAST_TIME] = time
    if int(words[STEP]) != 0:
        if rows == 1:
            words[LAST_TIME] = now
        _put_event(frames, 0, frames[1, 0] if rows > 1 else now, CLOCK_STEP_ID, int(words[STEP]))
    words[LAST_BATCH] = now
    return rows
