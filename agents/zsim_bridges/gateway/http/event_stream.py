"""Server-sent events: every value on an expression, as long as the client listens."""

import asyncio
from collections.abc import Callable

from aiohttp import web

from zsim.transport.session import Heard
from zsim_bridges.gateway.lines.outbox import Outbox
from zsim_bridges.gateway.subscriptions import SharedSubscriptions

ALIVE_S = 10.0  # wall time after which a comment shows that the connection lives
EventOf = Callable[[Heard], bytes]
"""Makes the event of a value."""


async def stream_events(request: web.Request, feed: SharedSubscriptions, expression: str, shape: EventOf) -> web.StreamResponse:
    """Send every value on an expression until the client leaves.

    Args:
        request: to be answered.
        feed: of the keys of the expression.
        expression: what is wanted.
        shape: see Shape.

    Raises:
        SessionError: it is no key expression.
        TooManyError: there are as many streams as may be.
    """
    cut = request.transport.abort if request.transport is not None else lambda: None
    outbox = Outbox(cut, _lost_comment)
    end = feed.subscribe_stream(expression, lambda heard: outbox.put(shape(heard), may_go=True))
    headers = {"Content-Type": "text/event-stream", "Cache-Control": "no-cache", "Access-Control-Allow-Origin": "*"}
    response = web.StreamResponse(headers=headers)
    try:
        await response.prepare(request)
        while True:
            await response.write(await _next_chunk(outbox))
    except ConnectionError:
        return response
    finally:
        end()


async def _next_chunk(outbox: Outbox) -> bytes:
    try:
        return b"".join(await asyncio.wait_for(outbox.take(), ALIVE_S))
    except TimeoutError:
        return b": still here\n\n"


def _lost_comment(lost: int) -> bytes:
    return b": %d events were lost, they came faster than they were read\n\n" % lost


def event_bytes(kind: str, data: bytes) -> bytes:
    """Return an event."""
    return b"event: %b\ndata: %b\n\n" % (kind.encode(), data)
