"""The clock of received frames: UNIX time that never steps.

It is the monotonic clock plus an offset taken once at the start. Where the host's clock is set while we run,
the frames' time goes on undisturbed, and the step is told to whoever asks `host_step`.
"""

import time

STEP_NS = 2_000_000  # both clocks are slewed alike, so anything beyond reading noise is a step


def _host_ahead_ns() -> int:
    """How far the host's clock is ahead of the monotonic one, read with as little in between as possible."""
    best, ahead = 1 << 62, 0
    for _ in range(5):
        before = time.monotonic_ns()
        host = time.time_ns()
        width = time.monotonic_ns() - before
        if width < best:
            best, ahead = width, host - before - width // 2
        if width < 5_000:  # not interrupted
            break
    return ahead


class SteadyClock:
    """UNIX nanoseconds on the monotonic clock.

    `offset_ns` is what is added to the monotonic time; `host_offset_ns` what would have to be added to it now
    to read as the host's clock does. They differ after a step of the host's clock.
    """

    def __init__(self) -> None:
        self.offset_ns = self.host_offset_ns = _host_ahead_ns()

    def now_ns(self) -> int:
        """The time now, UNIX ns."""
        return time.monotonic_ns() + self.offset_ns

    def host_step(self) -> int:
        """By how many ns the host's clock has stepped since the last call; 0 almost always."""
        step = time.time_ns() - time.monotonic_ns() - self.host_offset_ns
        if abs(step) < STEP_NS:
            return 0
        step = _host_ahead_ns() - self.host_offset_ns  # once more, with care
        if abs(step) < STEP_NS:
            return 0
        self.host_offset_ns += step
        return step
