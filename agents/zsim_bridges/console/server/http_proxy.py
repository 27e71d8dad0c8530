"""The console's HTTP server: serves the page to who may open it, and relays what viser and the page send each other."""

import asyncio
import secrets
import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import msgspec
from aiohttp import ClientError, ClientSession, WSMsgType, web

from zsim.errors import RunError
from zsim_bridges.console.frame import page_html
from zsim_bridges.console.orders import OrderRequest
from zsim_bridges.console.server.page_tokens import OPERATOR, VIEW_PATH, VIEWER, PageRequest, PageTokens
from zsim_bridges.console.server.run_files import RunFiles
from zsim_bridges.web.web_server import ANY_PORT, ServedSite, open_on_thread, start_site, url_host

MESSAGE_MAX = 100_000  # bytes of one message of a page
BACKEND_HOST = "127.0.0.1"  # where viser listens
PAGE_HEADER = "X-Zsim-Page"  # a page's name: no page of another site can send it without asking first
CLIENT_HEADER = "X-Zsim-Client"  # the key that the page was given, by which viser's number of it is known
COPIED_HEADER = "X-Zsim-Copied"  # sent once a page has what it keeps of a console that leaves
SECRET_HEADER = "X-Zsim-Console"  # which viser's server asks for
ALL_ADDRESSES = ("0.0.0.0", "::")
PAGES_MAX = 50  # open at once, of operators and of viewers: viewers keep no operator out
HEARTBEAT_S = 20.0  # after which a page on a machine that is gone is noticed
CLOSE_S = 0.3  # wall; twice at the end, for what is under way, and for pages to close their sockets: slow ones do not
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; form-action 'none'"
HEADERS = {
    "Content-Security-Policy": POLICY,  # the page is one file, and nothing it shows comes from elsewhere
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class ListenAddress(NamedTuple):
    """Where pages are served.

    Attributes:
        or_any: whether another port will do where this one is taken.
    """

    host: str
    port: int
    or_any: bool = False

    def url(self, path: str = "/", token: str | None = None) -> str:
        """Return the URL of a page; by the name of this machine where it listens on all addresses."""
        host = socket.gethostname() if self.host in ALL_ADDRESSES else self.host
        query = f"?token={quote(token, safe='')}" if token else ""
        return f"http://{url_host(host)}:{self.port}{path}{query}"


class ViserBackend(NamedTuple):
    """The viser server behind the proxy.

    Attributes:
        port: on BACKEND_HOST.
        secret: that it asks for in SECRET_HEADER.
        state: returns what the console shows, as plain data.
        permits: returns whether a message of a page may reach viser, by the page's role.
        serve_cameras: answers a page's request for a socket of pictures, until it closes.
        serve_actions: answers one for a socket of what is done in the scene, by the page's role, until it closes.
        head: returns what the head of the page shows, as plain data.
        command: takes an order; returns what has become of it so far, as plain data with its `state` and `reason`.
        files: what the run leaves behind.
        looked: called with the key of a page that lives, its role, and the address that it is at.
    """

    port: int
    secret: str
    state: Callable[[], dict[str, Any]]
    permits: Callable[[bytes, str], bool]
    serve_cameras: Callable[[web.Request], Awaitable[web.StreamResponse]]
    serve_actions: Callable[[web.Request, str], Awaitable[web.StreamResponse]]
    head: Callable[[], dict[str, Any]]
    command: Callable[[OrderRequest], dict[str, Any]]
    files: RunFiles
    looked: Callable[[str, str, str], None] = lambda *_: None


class HttpProxy:
    """One server of pages.

    Args:
        address: where pages are served.
        token: of operators; None where only this machine can connect.
        backend: see ViserBackend.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(self, address: ListenAddress, token: str | None, backend: ViserBackend) -> None:
        self._address = address
        self._token = token
        self._view_token = secrets.token_urlsafe(12)
        self._tokens = self._tokens_at(address)
        self._backend = backend
        self._pages = {OPERATOR: page_html.operator_page(), VIEWER: page_html.viewer_page()}
        self._open_pages: Counter[str] = Counter()  # sockets, by what they are for
        self._loop = asyncio.new_event_loop()
        self._client: ClientSession | None = None

    def _tokens_at(self, address: ListenAddress) -> PageTokens:
        return PageTokens(address.host, address.port, self._token, self._view_token)

    def urls(self) -> dict[str, str]:
        """Return the URLs to be opened, by role."""
        view_token = self._view_token if self._token is not None else None
        return {OPERATOR: self._address.url("/", self._token), VIEWER: self._address.url(VIEW_PATH, view_token)}

    @contextmanager
    def open(self) -> Iterator[None]:
        """Serve pages, on a thread of its own.

        Raises:
            RunError: the port is taken, or the address is none of this machine.
        """
        with open_on_thread(self._loop, "console server", self._open, self._close):
            yield

    async def _open(self) -> ServedSite:
        app = web.Application(client_max_size=MESSAGE_MAX)
        app.add_routes([web.get(path, self._page) for path in ("/", VIEW_PATH)])
        shared = {"/state": self._state, "/head": self._head, "/cameras": self._cameras, "/actions": self._actions}
        for path, handler in shared.items():
            app.add_routes([web.get(path, handler), web.get(f"{VIEW_PATH}{path}", handler)])
        app.add_routes([web.post("/command", self._command)])
        for name, path in self._backend.files.paths.items():
            shown = partial(self._file, path)
            app.add_routes([web.get(f"/{name}", shown), web.get(f"{VIEW_PATH}/{name}", shown)])
        try:
            host, port, or_any = self._address
            site = await start_site(app, host, (port, ANY_PORT) if or_any else (port,), shutdown_s=CLOSE_S)
        except OSError as error:
            address = f"{self._address.host}, port {self._address.port}"
            raise RunError(f"console: cannot listen on {address} ({error.strerror}); say --port") from error
        self._address = self._address._replace(port=site.port)
        self._tokens = self._tokens_at(self._address)
        self._client = ClientSession()
        return site

    async def _close(self, site: ServedSite) -> None:
        assert self._client is not None
        await self._client.close()
        await site.cleanup()

    # Requests

    async def _page(self, request: web.Request) -> web.StreamResponse:
        """Serve the page, or its WebSocket."""
        page_request = _page_request(request)
        role = self._tokens.role_of(page_request)
        if role is None:
            return _missing_token()
        if page_request.token:
            return self._set_cookie(page_request)
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._stream(role, lambda: self._relay(request, role))
        headers = {**HEADERS, "Content-Encoding": "gzip"}
        return web.Response(body=self._pages[role], content_type="text/html", charset="utf-8", headers=headers)

    def _set_cookie(self, page_request: PageRequest) -> web.Response:
        """Put the token into a cookie, and out of the address; a proxy may show the page below a path of its own."""
        response = web.Response(status=303, headers={**HEADERS, "Location": f".{page_request.path}"})
        role = self._tokens.role_of_address(page_request)
        if role is not None:
            name = self._tokens.cookie(role)
            response.set_cookie(name, page_request.token, httponly=True, samesite="Strict", path="/")
        return response

    async def _state(self, request: web.Request) -> web.Response:
        return self._answer(request, self._backend.state)

    async def _head(self, request: web.Request) -> web.Response:
        look = request.headers.get(PAGE_HEADER, ""), COPIED_HEADER in request.headers
        key, role = request.headers.get(CLIENT_HEADER, ""), self._tokens.role_of(_page_request(request))
        if key and role:
            self._backend.looked(key, role, request.remote or "")
        return self._answer(request, lambda: {**self._backend.head(), **self._backend.files.shown(*look)})

    def _answer(self, request: web.Request, shown: Callable[[], dict[str, Any]]) -> web.Response:
        if self._tokens.role_of(_page_request(request)) is None:
            return _missing_token()
        return _json_response(shown())

    async def _file(self, path: Path, request: web.Request) -> web.StreamResponse:
        """Serve what a run left behind: a page to be read, or a file to be kept."""
        if self._tokens.role_of(_page_request(request)) is None:
            return _missing_token()
        if self._backend.files.size_bytes(path) is None:
            return web.Response(status=404, text=f"{path} is not there yet\n", headers=HEADERS)
        kept = {} if path.suffix == ".html" else {"Content-Disposition": f'attachment; filename="{path.name}"'}
        return web.FileResponse(path, headers={**HEADERS, **kept})

    async def _command(self, request: web.Request) -> web.Response:
        """Take an order of an operator; viewers have no such path."""
        if self._tokens.role_of(_page_request(request)) != OPERATOR:
            return _missing_token()
        try:
            order = _ORDERS.decode(await request.read())
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            return _json_response({"refusal": f"body: {error}"}, 400)
        became = self._backend.command(order)
        refusal = became["reason"] if became["state"] == "refused" else ""
        return _json_response({"refusal": refusal, "order": became}, 409 if refusal else 200)

    async def _cameras(self, request: web.Request) -> web.StreamResponse:
        """Serve a page's socket for pictures of cameras: viewers see them, too."""
        return await self._socket(request, "cameras", lambda _: self._backend.serve_cameras(request))

    async def _actions(self, request: web.Request) -> web.StreamResponse:
        """Serve a page's socket for what is done in the scene: viewers move their cameras."""
        return await self._socket(request, "actions", partial(self._backend.serve_actions, request))

    async def _socket(
        self, request: web.Request, what: str, serve: Callable[[str], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        role = self._tokens.role_of(_page_request(request))
        return _missing_token() if role is None else await self._stream(f"{what} of {role}", lambda: serve(role))

    async def _stream(self, what: str, serve: Callable[[], Awaitable[web.StreamResponse]]) -> web.StreamResponse:
        """Serve a socket, unless too many of its kind are open."""
        if self._open_pages[what] >= PAGES_MAX:
            return web.Response(status=503, text=f"{PAGES_MAX} pages are open already; close one\n", headers=HEADERS)
        self._open_pages[what] += 1
        try:
            return await serve()
        finally:
            self._open_pages[what] -= 1

    async def _relay(self, request: web.Request, role: str) -> web.WebSocketResponse:
        """Relay messages both ways, until one side closes."""
        header = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = [part.strip() for part in header.split(",") if part.strip()]
        page = web.WebSocketResponse(
            protocols=protocols, compress=False, max_msg_size=MESSAGE_MAX, heartbeat=HEARTBEAT_S
        )
        await page.prepare(request)
        assert self._client is not None
        url = f"ws://{BACKEND_HOST}:{self._backend.port}/"
        headers = {SECRET_HEADER: self._backend.secret}
        try:
            connecting = self._client.ws_connect(url, protocols=protocols, headers=headers, compress=0, max_msg_size=0)
            async with connecting as viser:
                ways = [
                    asyncio.ensure_future(way) for way in (_to_page(viser, page), self._to_viser(page, viser, role))
                ]
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        except ClientError:
            pass  # viser ends, or has ended
        await page.close()
        return page

    async def _to_viser(self, page: web.WebSocketResponse, viser: Any, role: str) -> None:
        async for message in page:
            if message.type is WSMsgType.BINARY and self._backend.permits(message.data, role):
                await viser.send_bytes(message.data)


_ORDERS = msgspec.json.Decoder(OrderRequest)


def _json_response(shown: dict[str, Any], status: int = 200) -> web.Response:
    body = msgspec.json.encode(shown)
    return web.Response(body=body, status=status, content_type="application/json", headers=HEADERS)


async def _to_page(viser: Any, page: web.WebSocketResponse) -> None:
    async for message in viser:
        if message.type is WSMsgType.BINARY:
            await page.send_bytes(message.data)


def _page_request(request: web.Request) -> PageRequest:
    headers = request.headers
    token = request.query.get("token", "")
    return PageRequest(request.path, headers.get("Host", ""), headers.get("Origin"), token, dict(request.cookies))


def _missing_token() -> web.Response:
    text = "This page needs the token of the console: open the link that it printed when it started.\n"
    return web.Response(status=401, text=text, headers=HEADERS)
