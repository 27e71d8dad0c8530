"""A UDP socket to one port of an aircraft."""

import asyncio
import errno
import time
from collections.abc import Callable
from typing import Any

from zsim.errors import RunError
from zsim_bridges.vehicle_links.vehicle_session import UdpChannel

FORMER_S = 2.0  # s, wall, chosen: a driver that this one replaces has its port for some 10 ms more
AGAIN_S = 0.02  # s, wall, chosen: between two tries to have it


class AircraftSocket(asyncio.DatagramProtocol):
    """Hands on what one port of the aircraft sends.

    Args:
        receive: called with each datagram.

    Attributes:
        fault: why the newest datagram could not be delivered, as where nobody listens; empty for none.
    """

    def __init__(self, receive: Callable[[bytes], None]) -> None:
        self._receive = receive
        self._transport: asyncio.DatagramTransport | None = None
        self.fault = ""

    async def open(self, channel: UdpChannel) -> None:
        """Open it.

        Raises:
            RunError: the port here is taken, or the aircraft's address is no use.
        """
        local = ("0.0.0.0", channel.local_port) if channel.local_port else None
        until_s = time.monotonic() + FORMER_S
        loop = asyncio.get_running_loop()
        while self._transport is None:
            try:
                to = channel.host, channel.port
                self._transport, _ = await loop.create_datagram_endpoint(lambda: self, remote_addr=to, local_addr=local)
            except OSError as error:
                if error.errno != errno.EADDRINUSE or time.monotonic() > until_s:
                    raise RunError(_not_opened(channel, error)) from error
                await asyncio.sleep(AGAIN_S)

    def send(self, datagram: bytes) -> None:
        """Send a datagram."""
        if self._transport is not None:
            self._transport.sendto(datagram)

    def close(self) -> None:
        """Close it."""
        if self._transport is not None:
            self._transport.close()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Hand a datagram on."""
        self._receive(data)

    def error_received(self, exc: Exception) -> None:
        """Note that nobody listens there yet; what is due is sent again."""
        self.fault = getattr(exc, "strerror", None) or str(exc)


def _not_opened(channel: UdpChannel, error: OSError) -> str:
    """Return why there is no socket for a channel, and what to do."""
    why = error.strerror or str(error)
    if error.errno in (errno.EADDRINUSE, errno.EACCES):
        return f"UDP port {channel.local_port} here cannot be had: {why}; give another --local-port, or end who has it"
    return f"{channel.host}:{channel.port} cannot be reached: {why}; give the address of the aircraft"
