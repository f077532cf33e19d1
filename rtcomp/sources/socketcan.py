"""SocketCAN."""

import socket


def check_interface(channel: str | None) -> None:
    """Refuse an interface that is not there before a socket is made for it. Raises OSError."""
    if not hasattr(socket, "AF_CAN"):
        raise OSError("this system has no SocketCAN")
    socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    if channel:
        socket.if_nametoindex(channel)
