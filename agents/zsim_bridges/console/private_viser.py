"""viser's server, on a port of loopback that refuses connections without a secret."""

import asyncio
import contextlib
import http
import io
import secrets
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal

import msgspec
import viser
import viser.infra._infra
import websockets.asyncio.server
from msgspec import Meta, Struct
from viser._messages import GuiUpdateMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from zsim.contract import flight_messages
from zsim.schema import message
from zsim_bridges.console.page_server import BACKEND_HOST, MESSAGE_MAX, OPERATOR, SECRET_HEADER


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


Permits = Callable[[int, str], bool]
"""Returns whether a page, by viser's number of it, may use a control of all pages, by its id."""


class PrivateViser:
    """A viser server on a port of loopback that refuses connections without the secret.

    Args:
        permits: a use that it does not permit changes nothing, and the page shows the value of before again.

    Attributes:
        server: viser's.
        secret: to be sent in SECRET_HEADER.
    """

    def __init__(self, permits: Permits = lambda *_: True) -> None:
        self.secret = secrets.token_urlsafe(24)
        with _silent(), _requiring_secret(self.secret):
            self.server = viser.ViserServer(host=BACKEND_HOST, port=0, verbose=False)
        _guard_controls(self.server, permits)

    @property
    def port(self) -> int:
        return self.server.get_port()

    def close(self) -> None:
        """Stop it."""
        with _silent():
            self.server.stop()


def _guard_controls(server: viser.ViserServer, permits: Permits) -> None:
    """Look at each use of a control before viser does: it shares controls, and cannot refuse one to a page."""
    handle_update, pages = server.gui._handle_gui_updates, server.gui._websock_interface

    async def guarded(client_id: Any, message: GuiUpdateMessage) -> None:
        if permits(client_id, message.uuid):
            await handle_update(client_id, message)
            return
        control: Any = server.gui._gui_input_handle_from_uuid.get(message.uuid)
        page = server.get_clients().get(client_id)
        if control is not None and page is not None and not control._impl.is_button:
            before = GuiUpdateMessage(message.uuid, {"value": control.value})
            page.gui._websock_interface.queue_message(before)

    pages.unregister_handler(GuiUpdateMessage, handle_update)
    pages.register_handler(GuiUpdateMessage, guarded)


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


NAME_MAX = 64  # characters of what is no text of a user's
VALUE_MAX = 2_000  # characters of a control's text: expressions of twelve variables, a line each
EXACT_MAX = 2**53  # a page's numbers are exact up to it; a larger one fits no message

Value = bool | message.Number | Annotated[str, Meta(max_length=VALUE_MAX)]


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
