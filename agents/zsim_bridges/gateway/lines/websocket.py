"""Clients on a WebSocket: what a line is on TCP, a text message is here."""

from aiohttp import WSMsgType, web

from zsim_bridges.gateway.lines.duplex import run_duplex
from zsim_bridges.gateway.lines.outbox import Outbox
from zsim_bridges.gateway.lines.stream_client import Client, lost_line
from zsim_bridges.gateway.lines.tcp_lines import LINE_MAX, ClientFactory

HEARTBEAT_S = 20.0  # wall time after which a browser that is gone is noticed


async def serve(request: web.Request, meet: ClientFactory) -> web.WebSocketResponse:
    """Serve a WebSocket until it ends; the guard has let it in."""
    socket = web.WebSocketResponse(max_msg_size=LINE_MAX, heartbeat=HEARTBEAT_S)
    await socket.prepare(request)
    cut = request.transport.abort if request.transport is not None else lambda: None
    outbox = Outbox(cut, lost_line)
    client = meet(outbox, True)
    await run_duplex(_read(client, socket), _send(outbox, socket), client.close, cut)
    return socket


async def _read(client: Client, socket: web.WebSocketResponse) -> None:
    async for message in socket:
        if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
            data = message.data
            await client.handle_line(data.encode() if isinstance(data, str) else data)


async def _send(outbox: Outbox, socket: web.WebSocketResponse) -> None:
    try:
        while lines := await outbox.take():
            for line in lines:
                await socket.send_str(line[:-1].decode())
    except ConnectionError:
        return
