"""Connections of this process, as the kernel has them."""

import socket
import struct
import sys

import pytest

from zsim.transport.link_watch import LinkSockets

LINGER = struct.Struct("ii")  # socket(7): whether, and for how many seconds


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows a process its connections")
def test_a_connection_that_was_seen_does_not_linger_when_it_is_closed() -> None:
    """Whoever closes one that lingers, does nothing else for so long while the far end takes nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as near:
        near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(1, 10))
        host, port = near.getpeername()
        assert f"{host}:{port}" in LinkSockets().queued()
        lingers, _ = LINGER.unpack(near.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))
        assert not lingers
