"""What a machine has and lacks for real-time compensation, and the command that mends it."""

import importlib.util
import os
import socket
import time
from pathlib import Path
from typing import NamedTuple

from rtcomp.errors import RequestError, WorkError
from rtcomp.realtime import PARTS, Part

ARPHRD_CAN = "280"


class Check(NamedTuple):
    """One finding: what was looked at, whether it is there, in words, and the way on when it is not."""

    name: str
    ok: bool
    found: str
    mend: str = ""


def check_all(zenoh_config: str | None = None) -> list[Check]:
    """Every check, in the order in which a person would mend things."""
    return [
        check_socketcan(),
        check_interfaces(),
        check_vcan(),
        *(check_realtime(part) for part in PARTS),
        check_kernel(),
        check_kernels_cached(),
        check_zenoh(zenoh_config),
        *(check_package(name, what) for name, what in OPTIONAL.items()),
    ]


OPTIONAL = {
    "rerun": ("rtcomp view", "pip install rerun-sdk"),
    "msgpack": ("udp_multicast buses", "pip install msgpack"),
    "asammdf": ("mf4 logs", "pip install 'rtcomp[mf4]'"),
}


def check_socketcan() -> Check:
    """Whether the kernel opens CAN sockets."""
    family = getattr(socket, "AF_CAN", None)
    try:
        socket.socket(family or -1, socket.SOCK_RAW, getattr(socket, "CAN_RAW", 1)).close()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return Check(
            "SocketCAN",
            False,
            f"no CAN sockets: {reason}",
            "sudo modprobe can_raw   (or another interface: udp_multicast, pcan, …)",
        )
    return Check("SocketCAN", True, "CAN sockets open")


def check_interfaces() -> Check:
    """Which CAN interfaces there are and whether they are up."""
    found = []
    for kind in Path("/sys/class/net").glob("*/type"):
        if kind.read_text().strip() == ARPHRD_CAN:
            found.append(f"{kind.parent.name} ({(kind.parent / 'operstate').read_text().strip()})")
    mend = "sudo ip link set can0 up type can bitrate 500000"
    return Check("CAN interfaces", bool(found), ", ".join(sorted(found)) or "none", "" if found else mend)


def check_vcan() -> Check:
    """Whether virtual CAN is there, or can be loaded."""
    if any(Path("/sys/class/net").glob("vcan*")):
        return Check("vcan", True, "a vcan interface exists")
    release = os.uname().release
    module = any(Path(f"/lib/modules/{release}").glob("kernel/drivers/net/can/vcan.ko*"))
    if module or Path("/sys/module/vcan").exists():
        return Check(
            "vcan",
            False,
            "module there, no interface",
            "sudo modprobe vcan && sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up",
        )
    return Check(
        "vcan",
        False,
        f"kernel {release} has no vcan module",
        "in a source checkout: python -m tools.vcan -- COMMAND runs it in a small guest",
    )


def check_realtime(part: Part) -> Check:
    """Whether one part of `rtcomp run --realtime` is granted: asked for, and given back at once."""
    try:
        part.ask()()
    except OSError as error:
        return Check(part.name, False, f"not for --realtime: {error.strerror or error}", part.mend)
    return Check(part.name, True, part.granted)


def check_kernel() -> Check:
    """Whether the kernel is a real-time one; a help, not a need."""
    realtime = Path("/sys/kernel/realtime")
    if realtime.exists() and realtime.read_text().strip() == "1":
        return Check("kernel", True, f"{os.uname().release}, PREEMPT_RT")
    cores = os.cpu_count() or 1
    return Check(
        "kernel",
        True,
        f"{os.uname().release}, {cores} cores, not a real-time kernel (not needed, lowers the longest delays)",
    )


def check_kernels_cached() -> Check:
    """How long it takes until the first sample can be corrected."""
    from rtcomp.plan import compile_map
    from rtcomp.run import warm_up
    from rtcomp.signal_map import load_map

    start = time.monotonic()
    warm_up(compile_map(load_map("fog")))
    return Check("compiled kernels", True, f"ready after {time.monotonic() - start:.1f} s")


def check_zenoh(config: str | None) -> Check:
    """Whether a session opens, and with a network configuration whether a sample comes back."""
    from rtcomp.zenoh_session import open_session

    name = f"zenoh ({config or 'in-process'})"
    try:
        session = open_session(config)
    except (RequestError, WorkError) as error:
        return Check(
            name, False, str(error), "check the endpoints in the configuration, and that its router runs"
        )
    with session:
        routers, peers = len(session.info.routers_zid()), len(session.info.peers_zid())
    return Check(name, True, f"session opens, {routers} routers and {peers} peers in reach")


def check_package(module: str, use: tuple[str, str]) -> Check:
    """Whether an optional package is there."""
    there = importlib.util.find_spec(module) is not None
    return Check(module, there, f"for {use[0]}", "" if there else use[1])


def show_checks(checks: list[Check]) -> None:
    """Print the checks for a person."""
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=True)
    for check in checks:
        mark = "[green]✓[/]" if check.ok else "[yellow]✗[/]"
        console.print(f"{mark} [bold]{check.name}[/]: {check.found}")
        if check.mend:
            console.print(f"    mend: {check.mend}", markup=False)
