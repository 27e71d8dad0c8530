"""A connection's two halves: what comes is read while what waits is sent, until one of them ends."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

FLUSH_S = 2.0  # how long what is left may take to be sent to a client that hangs up

Half = Coroutine[Any, Any, None]


async def run_duplex(reading: Half, sending: Half, finish: Callable[[], None], cut: Callable[[], None]) -> None:
    """Read and send until one of the two ends; then send what is left.

    Args:
        reading: ends with the client's last request.
        sending: ends when nothing is to be sent any more.
        finish: ends the client, so that sending ends.
        cut: ends the connection at once, for a client that does not take what is left.
    """
    reader, sender = asyncio.create_task(reading), asyncio.create_task(sending)
    try:
        await asyncio.wait({reader, sender}, return_when=asyncio.FIRST_COMPLETED)
        finish()
        await asyncio.wait({sender}, timeout=FLUSH_S)
    finally:
        finish()
        if not sender.done():
            cut()
        for half in (reader, sender):
            half.cancel()
        await asyncio.gather(reader, sender, return_exceptions=True)
