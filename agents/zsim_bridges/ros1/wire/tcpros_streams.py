"""Headers and frames on asyncio's streams."""

import asyncio
import socket
from asyncio import IncompleteReadError, StreamReader, StreamWriter

from zsim_bridges.ros1.wire import tcpros

HANDSHAKE_S = 10.0  # within which a header must come
FRAME_MAX = 1_000_000  # bytes; what we take in are commands
CONNECTION_ERRORS = (OSError, IncompleteReadError, TimeoutError, ValueError, OverflowError)
"""What a connection ends with: gone, silent, or none that we understand."""


async def read_frame(reader: StreamReader, limit: int = FRAME_MAX) -> bytes:
    """Return the next frame's payload.

    Raises:
        ValueError: it is longer than the limit.
        IncompleteReadError: the connection ended.
    """
    size = tcpros.length(await reader.readexactly(tcpros.LENGTH_SIZE))
    if size > limit:
        raise ValueError(f"a frame has {size} bytes; must have at most {limit}")
    return await reader.readexactly(size)


async def read_header(reader: StreamReader) -> dict[str, str]:
    """Return the header with which a connection begins.

    Raises:
        HeaderError: it is none.
        TimeoutError: it does not come.
    """
    body = await asyncio.wait_for(read_frame(reader, tcpros.HEADER_MAX), HANDSHAKE_S)
    return tcpros.decode_header(body)


async def send_error(writer: StreamWriter, reason: str) -> None:
    """Refuse a connection as ROS does: with a header that has a reason."""
    writer.write(tcpros.encode_header({"error": reason}))
    await writer.drain()


def configure(writer: StreamWriter, nodelay: bool) -> None:
    """Let small messages wait for each other or not, and notice a host that has died."""
    raw: socket.socket = writer.get_extra_info("socket")
    raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, nodelay)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
