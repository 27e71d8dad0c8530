"""The console: shows one run after the other on a viser server that only its own HTTP proxy can reach.

Order of this file: the viser server, which messages of a page may reach it, the console.
"""

import asyncio
import contextlib
import http
import io
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any, Literal

import msgspec
import viser
import viser.infra._infra
import websockets.asyncio.server
from msgspec import Meta, Struct
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from zsim.contract import flight_messages
from zsim.contract.messages import Info
from zsim.schema import message
from zsim.transport.session import Session
from zsim_bridges.console.action_socket import ActionSockets
from zsim_bridges.console.camera_socket import CameraSockets
from zsim_bridges.console.http_proxy import (
    BACKEND_HOST,
    MESSAGE_MAX,
    SECRET_HEADER,
    HttpProxy,
    ListenAddress,
    ViserBackend,
)
from zsim_bridges.console.monitoring.page_head import no_run_head
from zsim_bridges.console.page.camera_follow import CameraFollow
from zsim_bridges.console.page.camera_frustums import CameraFrustums
from zsim_bridges.console.page_tokens import OPERATOR, VIEWER
from zsim_bridges.console.record_player import RecordPlayer
from zsim_bridges.console.run_page import RunPage
from zsim_bridges.observer_process import ObserverProcess

NAME_MAX = 64  # characters of what is no text of a user's
VALUE_MAX = 2_000  # characters of a control's text: expressions of twelve variables, a line each
EXACT_MAX = 2**53  # a page's numbers are exact up to it; a larger one fits no message

Value = bool | message.Number | Annotated[str, Meta(max_length=VALUE_MAX)]


class AnyThreadEvent(asyncio.Event):
    """An event that other threads may set; the loop's own `set` wakes the tasks that wait.

    An asyncio.Event iterates over its waiters, and fails when the loop changes them meanwhile.
    """

    def set(self) -> None:
        """Set it; on the loop, wake the waiters even if another thread has set it before."""
        if asyncio._get_running_loop() is None:
            self._value = True
        else:
            self._value = False
            super().set()


class _Buffer(AsyncMessageBuffer):
    """A buffer of viser's, which sets its event from every thread, and once more on the loop."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.message_event = AnyThreadEvent()


viser.infra._infra.AsyncMessageBuffer = _Buffer  # type: ignore[misc]


class PrivateViser:
    """A viser server on a port of loopback that refuses connections without the secret.

    Attributes:
        server: viser's.
        secret: to be sent in SECRET_HEADER.
    """

    def __init__(self) -> None:
        self.secret = secrets.token_urlsafe(24)
        with _silent(), _requiring_secret(self.secret):
            self.server = viser.ViserServer(host=BACKEND_HOST, port=0, verbose=False)

    @property
    def port(self) -> int:
        return self.server.get_port()

    def close(self) -> None:
        """Stop it."""
        with _silent():
            self.server.stop()


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep viser from printing an address that is of no use to a person."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _requiring_secret(secret: str) -> Iterator[None]:
    """Let servers that are started meanwhile refuse connections without the secret: viser has no setting for it."""
    serve = websockets.asyncio.server.serve

    def serve_checked(*args: Any, process_request: Callable[..., Any] | None = None, **more: Any) -> Any:
        def check(connection: Any, request: Request) -> Response | None:
            if not secrets.compare_digest(request.headers.get(SECRET_HEADER, ""), secret):
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), b"")
            return None

        return serve(*args, process_request=check, **more)

    websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


class ViewerCamera(Struct, tag_field="type", tag="ViewerCameraMessage"):
    """Every page sends where its camera is."""

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
    """A page sends this when somebody uses a control."""

    class Updates(Struct, forbid_unknown_fields=True):
        """Only the value of a control."""

        value: Value

    uuid: str
    updates: Updates


class SceneClick(Struct, tag_field="type", tag="ScenePointerMessage"):
    """A page sends this when somebody clicks into the scene; nothing but the ray is looked at."""

    event_type: Literal["click"]
    ray_origin: message.Vector3
    ray_direction: message.Vector3
    screen_pos: tuple[tuple[message.Number, message.Number]]
    modifier: Annotated[str, Meta(max_length=NAME_MAX)] | None = None


_DECODER = msgspec.msgpack.Decoder(ViewerCamera | ControlUpdate | SceneClick)
"""All other messages are refused, such as to show the page on the Internet, or to upload files."""


class PageControls:
    """The controls that viser knows, and those that each page has for itself.

    Args:
        gui: of all pages.
        pages: returns the GUI of each open page.
    """

    def __init__(self, gui: viser.GuiApi, pages: Callable[[], Sequence[viser.GuiApi]] = tuple) -> None:
        self._gui = gui
        self._pages = pages

    def _own(self, uuid: str) -> Any:
        handles = (page._gui_input_handle_from_uuid.get(uuid) for page in self._pages())
        return next((handle for handle in handles if handle is not None), None)

    def accepts(self, uuid: str, value: Value) -> bool:
        """Return whether a control takes such a value: viser converts it to its type, and fails where it cannot."""
        handle: Any = self._gui._gui_input_handle_from_uuid.get(uuid)  # viser has no public way to a control by its id
        handle = handle or self._own(uuid)
        return handle is not None and not getattr(handle, "disabled", False) and _accepts(handle, value)


def _accepts(handle: Any, value: Value) -> bool:
    options = getattr(handle, "options", None)
    if options is not None:
        return value in options
    current = handle.value
    if isinstance(current, bool) or isinstance(value, bool):
        return isinstance(current, bool) and isinstance(value, bool)
    if isinstance(current, str) or isinstance(value, str):
        return isinstance(current, str) and isinstance(value, str)
    return abs(value) <= EXACT_MAX


def is_permitted(data: bytes, role: str, controls: PageControls) -> bool:
    """Return whether a message of a page may reach the console.

    Args:
        data: one message of viser's: a msgpack map with its type.
        role: of the page.
        controls: of all pages.
    """
    if len(data) > MESSAGE_MAX:
        return False
    try:
        message = _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if not isinstance(message, ControlUpdate):
        return True
    return role == OPERATOR and controls.accepts(message.uuid, message.updates.value)


class Console:
    """One console.

    Args:
        address: where pages are served.
        name: process name.
        token: of operators; None on this machine alone.
        rate_hz: pictures a second; None: as many as suit the number of drones.
        say: prints a line.
        world: where a run is looked for, in words.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(
        self,
        address: ListenAddress,
        name: str,
        token: str | None,
        rate_hz: float | None,
        say: Callable[[str], None],
        world: str = "",
    ) -> None:
        self._name = name
        self._world = world
        self._rate_hz = rate_hz
        self._say = say
        self._run_page: RunPage | None = None
        self._viser = PrivateViser()
        self._camera_follow = CameraFollow(self._viser.server)
        self._frustums = CameraFrustums(self._viser.server)
        _show_text(self._viser.server.gui, f"Waiting for a world: {world}" if world else "Waiting for a world")
        controls = PageControls(self._viser.server.gui, self._pages)
        permits = partial(is_permitted, controls=controls)
        sockets = CameraSockets(lambda: self._run_page and self._run_page.cameras, self._frustums)
        actions = ActionSockets(self._frustums.client_id, self._camera_follow, self._record)
        answers = permits, sockets.respond, actions.respond, self._head, self._command
        backend = ViserBackend(self._viser.port, self._viser.secret, self._state, *answers)
        self._proxy = HttpProxy(address, token, backend)

    @contextmanager
    def open(self) -> Iterator[None]:
        """Serve pages.

        Raises:
            RunError: the port is taken.
        """
        try:
            with self._proxy.open():
                urls = self._proxy.urls()
                self._say(f"{self._name}: steer at {urls[OPERATOR]}")
                self._say(f"{self._name}: look, without steering, at {urls[VIEWER]}")
                yield
        finally:
            self._viser.close()

    def serve(
        self,
        link: Session,
        info: Info,
        observer: ObserverProcess,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """Show a run until it is over or `stopped` returns true."""
        self._run_page = page = RunPage(
            self._viser.server, link, info, observer, self._camera_follow, self._frustums, self._rate_hz
        )
        try:
            page.run(stopped)
        finally:
            page.close()

    def _record(self) -> RecordPlayer | None:
        return self._run_page.record if self._run_page else None

    def _pages(self) -> list[viser.GuiApi]:
        return [page.gui for page in self._viser.server.get_clients().values()]

    def _state(self) -> dict[str, Any]:
        return self._run_page.state() if self._run_page else {"run_id": None}

    def _head(self) -> dict[str, Any]:
        return self._run_page.head() if self._run_page else no_run_head(self._world)

    def _command(self, op: str) -> str:
        return self._run_page.command(op) if self._run_page else "there is no run yet"


def _show_text(gui: viser.GuiApi, text: str) -> None:
    """Show a line on pages without a run."""
    gui.configure_theme(show_logo=False, show_share_button=False)
    gui.set_panel_label("zsim")
    gui.add_markdown(text)
