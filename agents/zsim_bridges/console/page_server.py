"""The console's HTTP server: serves pages to permitted clients, and relays messages between pages and a private viser.

The page is viser's, extended by the parts in `frame/`: a head, tools over the scene, and camera windows. Viewers see
its controls disabled. The page can also show the files that the run has written, and copy them before the console
exits. viser's own server cannot be reached in any other way, and messages from pages to it are filtered.

This is the only file that uses internals of viser 1.1 and websockets, which have no public interface to
- refuse connections without a secret (`_requiring_secret`),
- refuse one page the use of a control that all pages share (`_guard_controls`),
- find a control by its id, or the id of a control (`control_ids`, `control_id`, `PageControls`),
- show a JPEG on a camera's frustum without decoding it (`show_jpeg`),
- let viser's message buffer set its event safely from other threads (`AnyThreadEvent`),
- write to a page that closes meanwhile without a warning (`Buffer`).
"""

import asyncio
import contextlib
import gzip
import http
import importlib.resources
import io
import secrets
import socket
import stat
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from urllib.parse import quote, urlsplit

import msgspec
import viser
import viser.infra._infra
import websockets.asyncio.server
from aiohttp import ClientError, ClientSession, WSMsgType, web
from msgspec import Meta, Struct
from viser._messages import GuiUpdateMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from zsim.contract import flight_messages
from zsim.errors import RunError
from zsim.output_folder import RECORD
from zsim.schema import message
from zsim_bridges.console.control_desk import OPERATOR, VIEWER
from zsim_bridges.console.orders import OrderRequest
from zsim_bridges.web import is_loopback_authority
from zsim_bridges.web.web_server import (
    ANY_PORT,
    Handler,
    ServedSite,
    check_token,
    open_on_thread,
    start_site,
    tokens_match,
    url_host,
)

VIEW_PATH = "/view"
MESSAGE_MAX = 100_000  # maximum size of a message from a page [bytes]
BACKEND_HOST = "127.0.0.1"  # where viser listens
PAGE_HEADER = "X-Zsim-Page"  # name of a page; pages of other sites cannot send it without permission
CLIENT_HEADER = "X-Zsim-Client"  # key of a page, which maps to viser's number
COPIED_HEADER = "X-Zsim-Copied"  # sent once a page has its copies from a console that is exiting
SECRET_HEADER = "X-Zsim-Console"  # its value, a secret, is required by viser's server
ALL_ADDRESSES = ("0.0.0.0", "::")
PAGES_MAX = 50  # maximum number of open pages, separately for each role: viewers must not exclude operators
HEARTBEAT_S = 20.0  # period of pings, which detect a page whose machine has disappeared
CLOSE_S = 0.3  # wall; timeout used twice on exit: for requests in progress, and for pages to close their sockets
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'; form-action 'none'"
HEADERS = {
    "Content-Security-Policy": POLICY,  # the page is one file and loads nothing from elsewhere
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
PARTS = (  # files added to viser's page; each may use what those before it define
    "layout.html",
    "orders.html",
    "head_bar.html",
    "fleet_table.html",
    "camera_windows.html",
    "scene_tools.html",
    "flight_bar.html",
    "map_drawing.html",
    "map_view.html",
    "touch.html",
)
# wall; a page silent for this long is considered closed; above GONE_MS of head_bar.html + LOOK_MS of orders.html
POLL_TIMEOUT_S = 5.0
MTIME_ERROR_S = 2.0  # maximum amount by which a file's modification time may be too early: the resolution of FAT
POLL_S = 0.1  # wall; period of checking whether all pages have their copies
POLLING_PAGES_MAX = 200  # maximum number of pages remembered; at most 50 of operators and 50 of viewers are open
_ORDERS = msgspec.json.Decoder(OrderRequest)
NAME_MAX = 64  # maximum number of characters in the name of a key that modifies a click
VALUE_MAX = 2_000  # maximum number of characters of a control's text: expressions of twelve variables, a line each
INTEGER_EXACT_MAX = 2**53  # a page's numbers are exact up to this; larger ones do not fit any message
Value = bool | message.Number | Annotated[str, Meta(max_length=VALUE_MAX)]
Permits = Callable[[int, str], bool]
"""Returns whether a page, by viser's number, may use a shared control, by its id."""


class ListenAddress(NamedTuple):
    """The address where pages are served; `or_any`: use another port if this one is taken."""

    host: str
    port: int
    or_any: bool = False

    def url(self, path: str = "/", token: str | None = None) -> str:
        """Return the URL of a page, with the name of this machine if it listens on all addresses."""
        host = socket.gethostname() if self.host in ALL_ADDRESSES else self.host
        query = f"?token={quote(token, safe='')}" if token else ""
        return f"http://{url_host(host)}:{self.port}{path}{query}"


class RunFiles:
    """The report and the record of one run; files older than this object belong to another run.

    Args:
        folder: folder of the run; None if unknown.

    Attributes:
        paths: paths of the files by their names on pages; the files may not exist yet.
    """

    def __init__(self, folder: Path | None) -> None:
        root = folder and folder.absolute()
        self.paths = {"report": root / "report.html", "record": root / RECORD} if root else {}
        self._since_s = time.time()
        self._polled_s: dict[str, float] = {}  # when pages without copies last polled [s; monotonic], by their names
        self._is_exiting = False

    def state(self, page: str, has_copies: bool) -> dict[str, Any]:
        """Return the state of the files for a page (empty: unnamed); `has_copies`: the page needs no more copies."""
        self._polled_s.pop(page, None)
        if page and not has_copies:
            while len(self._polled_s) >= POLLING_PAGES_MAX:
                del self._polled_s[min(self._polled_s, key=self._polled_s.__getitem__)]
            self._polled_s[page] = time.monotonic()
        files = {name: {"path": str(path), "size_bytes": self.size_bytes(path)} for name, path in self.paths.items()}
        return {"files": files, "leaves": self._is_exiting}

    def offer(self, within_s: float, is_abandoned: Callable[[], bool]) -> None:
        """Tell pages to copy the files before the console exits; wait at most `within_s`, or until `is_abandoned`."""
        self._is_exiting = True
        deadline_s = time.monotonic() + within_s
        while (now_s := time.monotonic()) < deadline_s and not is_abandoned():
            if not any(now_s - polled_s < POLL_TIMEOUT_S for polled_s in list(self._polled_s.values())):
                return
            time.sleep(POLL_S)

    def size_bytes(self, path: Path) -> int | None:
        """Return the size of one of the files, None if this run has not written it."""
        try:
            status = path.stat()
        except OSError:
            return None
        is_own = stat.S_ISREG(status.st_mode) and status.st_mtime >= self._since_s - MTIME_ERROR_S
        return status.st_size if is_own else None


class ViserBackend(NamedTuple):
    """The services behind the HTTP server; sockets are served until they close."""

    port: int  # viser's port on BACKEND_HOST
    secret: str  # required by viser in SECRET_HEADER
    state: Callable[[], dict[str, Any]]  # returns what the console shows
    permits: Callable[[bytes, str], bool]  # returns whether a page's message, in a role, may reach viser
    serve_cameras: Callable[[web.Request], Awaitable[web.StreamResponse]]  # a socket of pictures
    serve_actions: Callable[[web.Request, str], Awaitable[web.StreamResponse]]  # a socket of actions, in a role
    head: Callable[[], dict[str, Any]]  # returns what the head of the page shows
    command: Callable[[OrderRequest], dict[str, Any]]  # takes an order; returns its progress
    files: RunFiles
    on_poll: Callable[[str, str, str], None]  # called with key, role and address of a page whenever it polls


class HttpProxy:
    """The server of the pages; `token` is the operators' token, None if only this machine can connect.

    Raises:
        RunError: other machines could reach the server, and there is no token.
    """

    def __init__(self, address: ListenAddress, token: str | None, backend: ViserBackend) -> None:
        self._address = address
        self._token = token
        self._view_token = secrets.token_urlsafe(12)
        self._tokens = self._tokens_at(address)
        self._backend = backend
        self._pages = {OPERATOR: _page(), VIEWER: _page("viewer.html")}
        self._open_pages: Counter[str] = Counter()  # number of open sockets, by purpose
        self._loop = asyncio.new_event_loop()
        self._client: ClientSession | None = None

    def _tokens_at(self, address: ListenAddress) -> "PageTokens":
        return PageTokens(address.host, address.port, self._token, self._view_token)

    def urls(self) -> dict[str, str]:
        view_token = self._view_token if self._token is not None else None
        return {OPERATOR: self._address.url("/", self._token), VIEWER: self._address.url(VIEW_PATH, view_token)}

    @contextmanager
    def open(self) -> Iterator[None]:
        """Serve pages in a thread; raise RunError if the port is taken or the address is not this machine's."""
        with open_on_thread(self._loop, "console server", self._open, self._close):
            yield

    async def _open(self) -> ServedSite:
        app = web.Application(client_max_size=MESSAGE_MAX)
        app.add_routes([web.get(path, self._page) for path in ("/", VIEW_PATH)])
        handlers = {"/state": self._state, "/head": self._head, "/cameras": self._cameras, "/actions": self._actions}
        handlers |= {f"/{name}": partial(self._file, path) for name, path in self._backend.files.paths.items()}
        for path, handler in handlers.items():
            app.add_routes([web.get(each, self._permitted(handler)) for each in (path, f"{VIEW_PATH}{path}")])
        app.add_routes([web.post("/command", self._permitted(self._command))])  # viewers have no such path
        host, port, or_any = self._address
        try:
            site = await start_site(app, host, (port, ANY_PORT) if or_any else (port,), shutdown_s=CLOSE_S)
        except OSError as error:
            reason = f"cannot listen on {host}, port {port} ({error.strerror})"
            raise RunError(f"console: {reason}; give --port") from error
        self._address = self._address._replace(port=site.port)
        self._tokens = self._tokens_at(self._address)
        self._client = ClientSession()
        return site

    async def _close(self, site: ServedSite) -> None:
        assert self._client is not None
        await self._client.close()
        await site.cleanup()

    def _permitted(self, serve: Callable[[web.Request, str], Awaitable[web.StreamResponse]]) -> Handler:
        """Return a handler that passes a request with its role to `serve`, and refuses requests without a role."""

        async def respond(request: web.Request) -> web.StreamResponse:
            role = self._tokens.role_of(_page_request(request))
            return _missing_token() if role is None else await serve(request, role)

        return respond

    async def _page(self, request: web.Request) -> web.StreamResponse:
        page_request = _page_request(request)
        role = self._tokens.role_of(page_request)
        if role is None:
            return _missing_token()
        if page_request.token:
            # The token moves to a cookie. The path is relative, since a reverse proxy may add a prefix to it.
            response = web.Response(status=303, headers={**HEADERS, "Location": f".{page_request.path}"})
            token_role = self._tokens.role_of_address(page_request)
            if token_role is not None:
                name = self._tokens.cookie(token_role)
                response.set_cookie(name, page_request.token, httponly=True, samesite="Strict", path="/")
            return response
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._stream(role, lambda: self._relay(request, role))
        headers = {**HEADERS, "Content-Encoding": "gzip"}
        return web.Response(body=self._pages[role], content_type="text/html", charset="utf-8", headers=headers)

    async def _state(self, _: web.Request, role: str) -> web.Response:
        return _json_response(self._backend.state())

    async def _head(self, request: web.Request, role: str) -> web.Response:
        key = request.headers.get(CLIENT_HEADER, "")
        if key:
            self._backend.on_poll(key, role, request.remote or "")
        files = self._backend.files.state(request.headers.get(PAGE_HEADER, ""), COPIED_HEADER in request.headers)
        return _json_response({**self._backend.head(), **files})

    async def _file(self, path: Path, _: web.Request, role: str) -> web.StreamResponse:
        """Serve a file of the run: a page to display, or a file to download."""
        if self._backend.files.size_bytes(path) is None:
            return web.Response(status=404, text=f"{path} does not exist yet\n", headers=HEADERS)
        disposition = {} if path.suffix == ".html" else {"Content-Disposition": f'attachment; filename="{path.name}"'}
        return web.FileResponse(path, headers={**HEADERS, **disposition})

    async def _command(self, request: web.Request, role: str) -> web.Response:
        try:
            order = _ORDERS.decode(await request.read())
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            return _json_response({"refusal": f"body: {error}"}, 400)
        progress = self._backend.command(order)
        refusal = progress["reason"] if progress["state"] == "refused" else ""
        return _json_response({"refusal": refusal, "order": progress}, 409 if refusal else 200)

    async def _cameras(self, request: web.Request, role: str) -> web.StreamResponse:
        return await self._stream(f"cameras of {role}", lambda: self._backend.serve_cameras(request))

    async def _actions(self, request: web.Request, role: str) -> web.StreamResponse:
        return await self._stream(f"actions of {role}", lambda: self._backend.serve_actions(request, role))

    async def _stream(self, purpose: str, serve: Callable[[], Awaitable[web.StreamResponse]]) -> web.StreamResponse:
        if self._open_pages[purpose] >= PAGES_MAX:
            return web.Response(status=503, text=f"{PAGES_MAX} pages are open already; close one\n", headers=HEADERS)
        self._open_pages[purpose] += 1
        try:
            return await serve()
        finally:
            self._open_pages[purpose] -= 1

    async def _relay(self, request: web.Request, role: str) -> web.WebSocketResponse:
        header = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = [part.strip() for part in header.split(",") if part.strip()]
        page = web.WebSocketResponse(
            protocols=protocols, compress=False, max_msg_size=MESSAGE_MAX, heartbeat=HEARTBEAT_S
        )
        await page.prepare(request)
        assert self._client is not None
        url = f"ws://{BACKEND_HOST}:{self._backend.port}/"
        headers = {SECRET_HEADER: self._backend.secret}
        permits = self._backend.permits

        async def forward(source: Any, sink: Any, permits: Callable[[bytes], bool]) -> None:
            async for each in source:
                if each.type is WSMsgType.BINARY and permits(each.data):
                    await sink.send_bytes(each.data)

        try:
            connecting = self._client.ws_connect(url, protocols=protocols, headers=headers, compress=0, max_msg_size=0)
            async with connecting as viser_socket:
                directions = (
                    forward(viser_socket, page, lambda _: True),
                    forward(page, viser_socket, lambda data: permits(data, role)),
                )
                tasks = [asyncio.ensure_future(each) for each in directions]
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        except ClientError:
            pass  # viser is stopping or has stopped
        await page.close()
        return page


def _json_response(data: dict[str, Any], status: int = 200) -> web.Response:
    body = msgspec.json.encode(data)
    return web.Response(body=body, status=status, content_type="application/json", headers=HEADERS)


def _missing_token() -> web.Response:
    text = "This page needs the token of the console: open the link that it printed when it started.\n"
    return web.Response(status=401, text=text, headers=HEADERS)


def _page(style: str = "") -> bytes:
    html = importlib.resources.files("viser").joinpath("client/build/index.html").read_text()
    folder = importlib.resources.files("zsim_bridges.console.frame")
    parts = "".join(folder.joinpath(name).read_text("utf-8") for name in PARTS)
    head, end, tail = html.rpartition("</body>")
    document = f"{head}{parts}{end}{tail}" if end else f"{html}{parts}"
    style_html = folder.joinpath(style).read_text("utf-8") if style else ""
    return gzip.compress(document.replace("</head>", f"{style_html}</head>", 1).encode())


# Who may open a page


class PageRequest(NamedTuple):
    """The fields of an HTTP request that identify its sender."""

    path: str
    host: str  # value of its Host header
    origin: str | None
    token: str  # token in its URL; empty for none
    cookies: dict[str, str]


def _page_request(request: web.Request) -> PageRequest:
    headers = request.headers
    token = request.query.get("token", "")
    return PageRequest(request.path, headers.get("Host", ""), headers.get("Origin"), token, dict(request.cookies))


class PageTokens:
    """Decides who may open pages in which role: by tokens, or, if only this machine can connect, by the Host header.

    Requests from pages of other servers are refused.

    Args:
        listen, port: the address at which pages are served.
        operator, viewer: the tokens of the two roles; the operators' is None if only this machine can connect.

    Raises:
        RunError: other machines could reach the pages, and there is no token.
    """

    def __init__(self, listen: str, port: int, operator: str | None, viewer: str) -> None:
        check_token("console", listen, operator)
        self._tokens = {OPERATOR: operator, VIEWER: viewer}
        self._port = port

    def cookie(self, role: str) -> str:
        """Return the name of a role's cookie; it includes the port, since a host's ports share cookies in browsers."""
        return f"zsim_{role}_{self._port}"

    def role_of(self, request: PageRequest) -> str | None:
        """Return the role in which the request's path may be opened, None if it may not."""
        role = VIEWER if request.path.startswith(VIEW_PATH) else OPERATOR
        try:
            if request.origin is not None and urlsplit(request.origin).netloc != request.host:
                return None  # the request comes from a page of another server
            if self._tokens[OPERATOR] is None:
                return role if is_loopback_authority(request.host) else None
        except ValueError:
            return None
        for each in (OPERATOR,) if role == OPERATOR else (VIEWER, OPERATOR):
            if any(
                self._is_token(token, each) for token in (request.token, request.cookies.get(self.cookie(each), ""))
            ):
                return role
        return None

    def role_of_address(self, request: PageRequest) -> str | None:
        """Return the role whose token is in the URL, for the cookie to be set; None without a valid token."""
        roles = (role for role in (OPERATOR, VIEWER) if self._is_token(request.token, role))
        return next(roles, None) if request.token else None

    def _is_token(self, received: str, role: str) -> bool:
        token = self._tokens[role]
        return token is not None and tokens_match(received, token)


class AnyThreadEvent(asyncio.Event):
    """An event that any thread may set; waiting tasks wake once the loop's own thread sets it.

    Setting an asyncio.Event iterates over its waiters, which fails if the loop changes them at the same time.
    """

    def set(self) -> None:
        """Set the event; on the loop, wake the waiters even if another thread has already set it."""
        if asyncio._get_running_loop() is None:
            self._value = True
        else:
            self._value = False
            super().set()


class Buffer(AsyncMessageBuffer):
    """viser's message buffer, with an event that any thread may set; silently drops writes to closed pages."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.message_event = AnyThreadEvent()
        self._warned_push_after_done = True  # a page may close while a picture is being drawn for it


viser.infra._infra.AsyncMessageBuffer = Buffer  # type: ignore[misc]


class PrivateViser:
    """A viser server on a loopback port that refuses connections without a secret in SECRET_HEADER.

    A control used without permission changes nothing, and its page shows the previous value again.
    """

    def __init__(self, permits: Permits = lambda *_: True) -> None:
        self.secret = secrets.token_urlsafe(24)
        with contextlib.redirect_stdout(io.StringIO()), _requiring_secret(self.secret):
            self.server = viser.ViserServer(host=BACKEND_HOST, port=0, verbose=False)
        _guard_controls(self.server, permits)

    @property
    def port(self) -> int:
        return self.server.get_port()

    def close(self) -> None:
        """Stop the server, suppressing the text that viser prints."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()


def _guard_controls(server: viser.ViserServer, permits: Permits) -> None:
    handle_update, pages = server.gui._handle_gui_updates, server.gui._websock_interface

    async def handle_guarded(client_id: Any, message: GuiUpdateMessage) -> None:
        if permits(client_id, message.uuid):
            await handle_update(client_id, message)
            return
        control: Any = server.gui._gui_input_handle_from_uuid.get(message.uuid)
        page = server.get_clients().get(client_id)
        if control is not None and page is not None and not control._impl.is_button:
            previous = GuiUpdateMessage(message.uuid, {"value": control.value})
            page.gui._websock_interface.queue_message(previous)

    pages.unregister_handler(GuiUpdateMessage, handle_update)
    pages.register_handler(GuiUpdateMessage, handle_guarded)


@contextlib.contextmanager
def _requiring_secret(secret: str) -> Iterator[None]:
    """Make servers started in this context refuse connections without the secret."""
    serve = websockets.asyncio.server.serve

    def serve_checked(*args: Any, process_request: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        def check(connection: Any, request: Request) -> Response | None:
            if not secrets.compare_digest(request.headers.get(SECRET_HEADER, ""), secret):
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), b"")
            return None

        return serve(*args, process_request=check, **kwargs)

    websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def control_ids(gui: viser.GuiApi) -> frozenset[str]:
    return frozenset(getattr(gui, "_gui_input_handle_from_uuid", ()))


def control_id(control: Any) -> str:
    """Return the id of a control of viser; empty for other controls."""
    return control._impl.uuid if hasattr(control, "_impl") else ""


def show_jpeg(frustum: Any, data: bytes) -> None:
    """Show a JPEG on a camera's frustum unchanged; viser would decode and re-encode it."""
    if getattr(frustum, "_format", "") != "jpeg":
        frustum._format = "jpeg"
    frustum._image_data = data


# Messages of pages


class ViewerCamera(Struct, tag_field="type", tag="ViewerCameraMessage"):
    """The pose of a page's camera, sent by every page."""

    wxyz: flight_messages.Quaternion
    position: message.Vector3
    fov: message.Number
    near: message.Number
    far: message.Number
    image_height: message.Number
    image_width: message.Number
    look_at: message.Vector3
    up_direction: message.Vector3


class ControlUpdate(Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """The use of a control."""

    class Updates(Struct, forbid_unknown_fields=True):
        """The value of a control."""

        value: Value

    uuid: str
    updates: Updates


class SceneClick(Struct, tag_field="type", tag="ScenePointerMessage"):
    """A click in the scene; only the ray is used."""

    event_type: Literal["click"]
    ray_origin: message.Vector3
    ray_direction: message.Vector3
    screen_pos: tuple[tuple[message.Number, message.Number]]
    modifier: Annotated[str, Meta(max_length=NAME_MAX)] | None = None


_DECODER = msgspec.msgpack.Decoder(ViewerCamera | ControlUpdate | SceneClick)
"""Other messages are refused, such as those that upload files or share the page on the Internet."""


class PageControls:
    """The controls known to viser: those that all pages share, and those of each of the open `pages`."""

    def __init__(self, gui: viser.GuiApi, pages: Callable[[], Sequence[viser.GuiApi]] = tuple) -> None:
        self._gui = gui
        self._pages = pages

    def accepts(self, uuid: str, value: Value) -> bool:
        """Return whether a control accepts a value; viser would fail to convert an invalid one."""
        handles = (gui._gui_input_handle_from_uuid.get(uuid) for gui in (self._gui, *self._pages()))
        handle: Any = next((each for each in handles if each is not None), None)
        if handle is None or getattr(handle, "disabled", False):
            return False
        options = getattr(handle, "options", None)
        if options is not None:
            return value in options
        for kind in (bool, str):
            if isinstance(handle.value, kind) or isinstance(value, kind):
                return isinstance(handle.value, kind) and isinstance(value, kind)
        return abs(value) <= INTEGER_EXACT_MAX  # type: ignore[arg-type]


def is_permitted(data: bytes, role: str, controls: PageControls) -> bool:
    """Return whether a message (a msgpack map with its type) from a page in this role may reach viser."""
    if len(data) > MESSAGE_MAX:
        return False
    try:
        message = _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if not isinstance(message, ControlUpdate):
        return True
    return role == OPERATOR and controls.accepts(message.uuid, message.updates.value)
