"""HTTP connections that send no complete request make room or are closed, while others are served."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from functools import wraps
from typing import Any

from aiohttp import ClientSession, web
from jumping_time import run_jumping

from zsim_bridges.web.web_server import BODY_BYTES_MAX, SMALL_BYTES, HttpConnection, HttpConnections

HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\n"  # an incomplete head
WHOLE = HALF + b"\r\n"
LONG_S = 600.0  # wall time, longer than any test
STRANGERS, CONNECTIONS = 5, 8

Stream = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def answer(request: web.Request) -> web.Response:
    """Answer at once, except on /wait, where the test releases the answer."""
    if request.path == "/wait":
        request.app[STARTED].release()
        await request.app[RELEASE].wait()
    return web.Response(status=401 if request.path == "/refused" else 200)


RELEASE = web.AppKey("release", asyncio.Event)
STARTED = web.AppKey("started", asyncio.Semaphore)


@asynccontextmanager
async def server(
    request_s: float = LONG_S, body_bytes_max: int = BODY_BYTES_MAX
) -> AsyncIterator[tuple[Callable[[], Coroutine[Any, Any, Stream]], str, Any]]:
    """Yield a function that connects, the URL, and the application."""
    connections = HttpConnections(STRANGERS, CONNECTIONS, request_s, body_bytes_max)
    app = web.Application(middlewares=[connections.observe])
    app[RELEASE], app[STARTED] = asyncio.Event(), asyncio.Semaphore(0)
    app.router.add_get("/{path:.*}", answer)
    app.router.add_post("/{path:.*}", answer)
    runner = web.AppRunner(app)
    await runner.setup()
    http = runner.server
    assert http is not None
    async with AsyncExitStack() as stack:
        stack.push_async_callback(runner.cleanup)
        listener = await asyncio.get_running_loop().create_server(
            lambda: HttpConnection(http(), connections), "127.0.0.1", 0
        )
        stack.callback(listener.close)
        port = listener.sockets[0].getsockname()[1]

        async def connect() -> Stream:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            stack.callback(writer.close)
            return reader, writer

        yield connect, f"http://127.0.0.1:{port}", app


def in_loop(test: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    @wraps(test)
    def run() -> None:
        run_jumping(test())

    return run


async def status(stream: Stream, request: bytes) -> int:
    """Send a request and return the status of its answer, which has an empty body."""
    reader, writer = stream
    writer.write(request)
    head = await reader.readuntil(b"\r\n\r\n")
    return int(head.split()[1])


async def is_cut(stream: Stream) -> bool:
    try:
        return await stream[0].read() == b""
    except ConnectionResetError:
        return True


@in_loop
async def test_the_oldest_incomplete_head_makes_room_for_the_next_connection() -> None:
    async with server() as (connect, url, _):
        halves = []
        for _ in range(STRANGERS + 1):
            halves.append(await connect())
            halves[-1][1].write(HALF)
        assert await is_cut(halves[0])
        async with ClientSession() as session, session.get(url) as response:
            assert response.status == 200
        assert await is_cut(halves[1])
        assert await status(halves[-1], b"\r\n") == 200


@in_loop
async def test_a_head_that_is_incomplete_in_time_ends_its_connection() -> None:
    async with server(request_s=0.05) as (connect, _, _):
        half = await connect()
        half[1].write(HALF)
        assert await is_cut(half)


@in_loop
async def test_an_answered_connection_makes_no_room_for_strangers() -> None:
    async with server() as (connect, _, _):
        known, refused = await connect(), await connect()
        assert await status(known, WHOLE) == 200
        assert await status(refused, WHOLE.replace(b"/ ", b"/refused ")) == 401
        for _ in range(STRANGERS + CONNECTIONS):
            (await connect())[1].write(HALF)
        assert await is_cut(refused)
        assert await status(known, WHOLE) == 200


@in_loop
async def test_a_pending_request_is_answered_whatever_the_number_of_connections() -> None:
    async with server() as (connect, _, app):
        busy = []
        for _ in range(CONNECTIONS):
            busy.append(await connect())
            busy[-1][1].write(WHOLE.replace(b"/ ", b"/wait "))
            await app[STARTED].acquire()
        late = await connect()
        late[1].write(HALF)
        assert await is_cut(late)
        app[RELEASE].set()
        assert [await status(stream, b"") for stream in busy] == [200] * CONNECTIONS


# Bodies

SHORT_S = 0.2  # wall time


def head_of(size: int, path: str = "/") -> bytes:
    return b"POST %s HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % (path.encode(), size)


@in_loop
async def test_a_request_with_an_incomplete_body_times_out() -> None:
    async with server(request_s=SHORT_S) as (connect, _, _):
        slow, known = await connect(), await connect()
        assert await status(known, WHOLE) == 200
        for stream in (slow, known):  # an answered connection gets no longer
            assert await status(stream, head_of(100) + b"half") == 408
        for reader, _ in (slow, known):
            await reader.read()  # until the connection is closed


@in_loop
async def test_an_incomplete_request_ends_even_a_known_connection() -> None:
    async with server(request_s=SHORT_S) as (connect, _, _):
        reader, writer = known = await connect()
        assert await status(known, WHOLE) == 200
        writer.write(HALF)
        assert await reader.read() == b""


@in_loop
async def test_large_bodies_wait_for_room_but_small_ones_do_not() -> None:
    size = 2 * SMALL_BYTES
    async with server(body_bytes_max=size) as (connect, _, app):
        first, second, small = await connect(), await connect(), await connect()
        first[1].write(head_of(size, "/wait") + bytes(size))
        await app[STARTED].acquire()
        waiting = asyncio.create_task(status(second, head_of(size) + bytes(size)))
        for _ in range(3):
            assert await status(small, head_of(SMALL_BYTES) + bytes(SMALL_BYTES)) == 200
        assert not waiting.done()
        app[RELEASE].set()
        assert await waiting == 200


@in_loop
async def test_large_bodies_are_refused_without_room_in_time() -> None:
    size = 2 * SMALL_BYTES
    async with server(request_s=SHORT_S, body_bytes_max=size) as (connect, _, app):
        first, second = await connect(), await connect()
        first[1].write(head_of(size, "/wait") + bytes(size))
        await app[STARTED].acquire()
        assert await status(second, head_of(size) + bytes(size)) == 408
        app[RELEASE].set()
