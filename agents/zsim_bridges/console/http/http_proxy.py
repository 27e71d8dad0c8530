"""The console's door: serves the page, and passes on what viser and the page say to each other, as far as it may."""

import asyncio
import gzip
import importlib.resources
import logging
import secrets
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from urllib.parse import quote

import msgspec
from aiohttp import ClientError, ClientSession, WSMsgType, web

from zsim.errors import RunError
from zsim_bridges.console.http.page_rights import (
    OPERATOR,
    MESSAGE_MAX,
    VIEW_PATH,
    VIEWER,
    PageRequest,
    ControlRights,
    PageTokens,
    is_permitted,
)
from zsim_bridges.console.http.private_viser import HOST, SECRET_HEADER
from zsim_bridges.loop_thread import opened_on

EVERYWHERE = ("0.0.0.0", "::")  # on all addresses of this machine: no address of its own
PAGES_MAX = 50  # open at once, of operators and of viewers: who only looks keeps no operator out
HEARTBEAT_S = 20.0  # a page on a machine that has gone is missed after it
CLOSE_S = 1.0
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; form-action 'none'"
HEADERS = {
    "Content-Security-Policy": POLICY,  # the page is one file, and nothing it shows comes from elsewhere
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
VIEW_STYLE = (
    "<style>body::before{content:'view only';position:fixed;top:8px;left:50%;transform:translateX(-50%);z-index:9999;"
    "background:#1971c2;color:#fff;font:600 13px sans-serif;padding:3px 14px;border-radius:10px}"
    ".mantine-Button-root,.mantine-Slider-root,.mantine-Input-input{pointer-events:none;opacity:.4}</style>"
)
_QUIET = logging.Logger("quiet", logging.CRITICAL + 1)  # what is no HTTP is answered, and nobody's business


class ListenAddress(NamedTuple):
    """Where pages are served."""

    host: str
    port: int

    def url(self, path: str = "/", token: str | None = None) -> str:
        """Return the address of a page, as others reach it where all of them may."""
        host = socket.gethostname() if self.host in EVERYWHERE else self.host
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{self.port}{path}" + (f"?token={quote(token, safe='')}" if token else "")


class ViserBackend(NamedTuple):
    """What stands behind the door.

    Attributes:
        port: of viser on this machine.
        secret: that viser asks for.
        state: returns what is shown, as plain data.
        controls: of all pages.
    """

    port: int
    secret: str
    state: Callable[[], dict[str, Any]]
    controls: ControlRights


class HttpProxy:
    """One door.

    Args:
        place: where pages are served.
        token: of operators; None where only this machine can connect.
        inside: what stands behind it.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(self, place: ListenAddress, token: str | None, inside: ViserBackend) -> None:
        self._place = place
        self._token = token
        self._view_token = secrets.token_urlsafe(12)
        self._tokens = PageTokens(place.host, place.port, token, self._view_token)
        self._backend = inside
        self._pages = _pages()
        self._open_pages: Counter[str] = Counter()  # by role
        self._loop = asyncio.new_event_loop()
        self._client: ClientSession | None = None

    def urls(self) -> dict[str, str]:
        """Return the addresses to be opened, by role."""
        shown = self._view_token if self._token is not None else None
        return {OPERATOR: self._place.url("/", self._token), VIEWER: self._place.url(VIEW_PATH, shown)}

    @contextmanager
    def open(self) -> Iterator[None]:
        """Let pages in, on a thread of its own.

        Raises:
            RunError: the port is taken.
        """
        with opened_on(self._loop, "door", self._open, self._close):
            yield

    async def _open(self) -> web.AppRunner:
        app = web.Application()
        app.add_routes([web.get(path, self._page) for path in ("/", VIEW_PATH)])
        app.add_routes([web.get(path, self._state) for path in ("/state", f"{VIEW_PATH}/state")])
        runner = web.AppRunner(app, access_log=None, logger=_QUIET, shutdown_timeout=CLOSE_S)
        await runner.setup()
        try:
            await web.TCPSite(runner, *self._place).start()
        except OSError as error:
            await runner.cleanup()
            where = f"{self._place.host}, port {self._place.port}"
            raise RunError(f"console: cannot listen on {where} ({error.strerror}); say --port") from error
        self._client = ClientSession()
        return runner

    async def _close(self, runner: web.AppRunner) -> None:
        assert self._client is not None
        await self._client.close()
        await runner.cleanup()

    # What is asked

    async def _page(self, request: web.Request) -> web.StreamResponse:
        """Serve the page, or the stream of what it shows."""
        asked = _page_request(request)
        role = self._tokens.role_of(asked)
        if role is None:
            return _missing_token()
        if asked.token:
            return self._set_cookie(asked)
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._stream(request, role)
        body = self._pages[role]
        headers = {**HEADERS, "Content-Encoding": "gzip"}
        return web.Response(body=body, content_type="text/html", charset="utf-8", headers=headers)

    def _set_cookie(self, asked: PageRequest) -> web.Response:
        """Put the token into a cookie, and out of the address."""
        response = web.Response(status=303, headers={**HEADERS, "Location": asked.path})
        role = self._tokens.role_of_address(asked)
        if role is not None:
            response.set_cookie(self._tokens.cookie(role), asked.token, httponly=True, samesite="Strict", path="/")
        return response

    async def _state(self, request: web.Request) -> web.Response:
        if self._tokens.role_of(_page_request(request)) is None:
            return _missing_token()
        body = msgspec.json.encode(self._backend.state())
        return web.Response(body=body, content_type="application/json", headers=HEADERS)

    async def _stream(self, request: web.Request, role: str) -> web.StreamResponse:
        if self._open_pages[role] >= PAGES_MAX:
            return web.Response(status=503, text=f"{PAGES_MAX} pages are open already; close one\n", headers=HEADERS)
        self._open_pages[role] += 1
        try:
            return await self._relay(request, role)
        finally:
            self._open_pages[role] -= 1

    async def _relay(self, request: web.Request, role: str) -> web.WebSocketResponse:
        """Pass on what both sides say, until one hangs up."""
        spoken = [part.strip() for part in request.headers.get("Sec-WebSocket-Protocol", "").split(",") if part.strip()]
        page = web.WebSocketResponse(protocols=spoken, compress=False, max_msg_size=MESSAGE_MAX, heartbeat=HEARTBEAT_S)
        await page.prepare(request)
        assert self._client is not None
        address = f"ws://{HOST}:{self._backend.port}/"
        headers = {SECRET_HEADER: self._backend.secret}
        try:
            dialled = self._client.ws_connect(address, protocols=spoken, headers=headers, compress=0, max_msg_size=0)
            async with dialled as viser:
                ways = [
                    asyncio.ensure_future(way) for way in (_to_page(viser, page), self._to_viser(page, viser, role))
                ]
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        except ClientError:
            pass  # viser ends, or ends just now
        await page.close()
        return page

    async def _to_viser(self, page: web.WebSocketResponse, viser: Any, role: str) -> None:
        async for said in page:
            if said.type is WSMsgType.BINARY and is_permitted(said.data, role, self._backend.controls):
                await viser.send_bytes(said.data)


async def _to_page(viser: Any, page: web.WebSocketResponse) -> None:
    async for shown in viser:
        if shown.type is WSMsgType.BINARY:
            await page.send_bytes(shown.data)


def _page_request(request: web.Request) -> PageRequest:
    headers = request.headers
    token = request.query.get("token", "")
    return PageRequest(request.path, headers.get("Host", ""), headers.get("Origin"), token, dict(request.cookies))


def _missing_token() -> web.Response:
    text = "This page needs the token of the console: open the link that it printed when it started.\n"
    return web.Response(status=401, text=text, headers=HEADERS)


def _pages() -> dict[str, bytes]:
    """Return viser's page for operators, and the one for viewers, whose controls look as inert as they are."""
    plain = importlib.resources.files("viser").joinpath("client/build/index.html").read_text()
    made = {OPERATOR: "", VIEWER: VIEW_STYLE}
    return {
        role: gzip.compress(plain.replace("</head>", f"{style}</head>", 1).encode()) for role, style in made.items()
    }
