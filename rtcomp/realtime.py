"""`rtcomp run --realtime`: what the system can do so that nothing else delays a frame; never required.

Each part is asked for by itself. What this machine does not grant is said in one sentence, with what mends it, and
the run goes on without.
"""

import contextlib
import ctypes
import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

PRIORITY = 50  # of 1…99; above the kernel's threaded interrupts would keep frames from coming in
MCL_CURRENT, MCL_FUTURE = 1, 2  # sys/mman.h
CAP_IPC_LOCK = 14  # linux/capability.h
ISOLATED = Path("/sys/devices/system/cpu/isolated")
STATUS = Path("/proc/self/status")

Undo = Callable[[], object]


class Part(NamedTuple):
    """One thing to ask for; `ask` returns what takes it back, or raises OSError."""

    name: str
    ask: Callable[[], Undo]
    granted: str
    mend: str


def ask_priority() -> Undo:
    """SCHED_FIFO for the calling thread."""
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this system has no SCHED_FIFO")
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    return lambda: os.sched_setscheduler(0, *before)


def ask_memory() -> Undo:
    """All memory of the process stays in RAM, that which is asked for later too.

    Under a limit that is not above all we will ever ask for, a later allocation would fail instead of being paged
    out; so a limit is a refusal.
    """
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and not has_capability(CAP_IPC_LOCK):
        raise OSError(f"at most {limit >> 10} KiB may be locked")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return libc.munlockall


def has_capability(number: int) -> bool:
    """Whether this process has one of Linux's capabilities."""
    try:
        words = STATUS.read_text().split()
        return bool(int(words[words.index("CapEff:") + 1], 16) >> number & 1)
    except (OSError, ValueError):
        return False


def ask_cpu() -> Undo:
    """The calling thread on one CPU: an isolated one where there is, else the last it may use."""
    if not hasattr(os, "sched_setaffinity"):
        raise OSError("this system pins no threads")
    before = os.sched_getaffinity(0)
    if len(before) < 2:
        raise OSError("there is only one CPU to use")
    os.sched_setaffinity(0, {max(isolated_cpus() & before or before)})
    return lambda: os.sched_setaffinity(0, before)


def isolated_cpus() -> set[int]:
    """CPUs that the kernel keeps free of other work (`isolcpus=`), as in `2-3,6`."""
    try:
        ranges = [part.partition("-") for part in ISOLATED.read_text().strip().split(",") if part]
    except OSError:
        return set()
    return {cpu for first, _, last in ranges for cpu in range(int(first), int(last or first) + 1)}


def ask_collector() -> Undo:
    """Nothing that exists now is looked at by the garbage collector again."""
    gc.collect()
    gc.freeze()
    return gc.unfreeze


PARTS = (
    Part(
        "real-time priority",
        ask_priority,
        "SCHED_FIFO granted",
        "sudo setcap cap_sys_nice+ep $(readlink -f $(which python3))   (or rtprio in /etc/security/limits.conf)",
    ),
    Part(
        "memory lock",
        ask_memory,
        "all memory may be locked",
        "echo '* - memlock unlimited' | sudo tee /etc/security/limits.d/rtcomp.conf   (then log in again)",
    ),
    Part(
        "CPU of its own",
        ask_cpu,
        "the receiving thread can be pinned",
        "taskset -c 0-1 rtcomp run …   (two CPUs or more; isolcpus= on the kernel's command line keeps one free)",
    ),
    Part("frozen collector", ask_collector, "nothing to ask for", ""),
)


@contextlib.contextmanager
def realtime(say: Callable[[str], None]) -> Iterator[list[str]]:
    """Ask for every part, for the calling thread and its process; yields the names of those granted.

    Call it in the thread that receives. Everything is taken back at the end.
    """
    granted = []
    with contextlib.ExitStack() as undo:
        for part in PARTS:
            try:
                undo.callback(part.ask())
                granted.append(part.name)
            except OSError as error:
                say(f"--realtime: no {part.name}: {error.strerror or error}; to have it: {part.mend}")
        yield granted
