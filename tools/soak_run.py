"""`rtcomp run` on a socket that it inherits: `python -m tools.soak_run DESCRIPTOR --model … --json`.

Everything is the command's own, but that its bus is a datagram socket carrying struct can_frame. The frames are taken
off it by the code that takes them off SocketCAN, with the kernel's times and drop counts.
"""

import socket
import sys
from typing import Any, Self

from rtcomp.sources import bus
from rtcomp.sources.socketcan import SocketReceiver, configure_socket


class InheritedBus(SocketReceiver):
    """A socket as a `Source`."""

    def __enter__(self) -> Self:
        configure_socket(self.sock)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def main(descriptor: int, arguments: list[str]) -> None:
    """Run the command with the socket in the bus's place."""
    from rtcomp.cli import main as rtcomp

    inherited = socket.socket(fileno=descriptor)

    def open_inherited(text: str, filters: Any = None, clock: Any = None) -> InheritedBus:
        return InheritedBus(inherited, clock)

    bus.open_bus = open_inherited  # pyright: ignore[reportAttributeAccessIssue]
    rtcomp(["run", "--bus", f"inherited:{descriptor}", *arguments])


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
