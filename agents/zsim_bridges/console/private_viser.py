"""viser's server, reachable only through the console's HTTP server, and a filter of the messages of pages to it.

This is the only file that uses internals of viser 1.1 and websockets, which have no public interface to
- refuse connections without a secret (`_requiring_secret`),
- refuse one page the use of a control that all pages share (`_guard_controls`),
- find a control by its id, or the id of a control (`control_ids`, `control_id`, `PageControls`),
- show a JPEG on a camera's frustum without decoding it (`show_jpeg`),
- wake the event loop safely from other threads, as viser's message buffer does (`AnyThreadEvent`),
- write to a page that closes meanwhile without a warning (`Buffer`).
"""

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

NAME_MAX = 64  # characters of a key that modifies a click
VALUE_MAX = 2_000  # characters of a control's text: expressions of twelve variables, a line each
EXACT_MAX = 2**53  # a page's numbers are exact up to it; a larger one does not fit any message

Value = bool | message.Number | Annotated[str, Meta(max_length=VALUE_MAX)]
Permits = Callable[[int, str], bool]
"""Returns whether a page, by viser's number, may use a shared control, by its id."""


class AnyThreadEvent(asyncio.Event):
    """An event that other threads may set; the tasks that wait wake when the loop sets it, too.

    An asyncio.Event iterates over its waiters, and fails if the loop changes them meanwhile.
    """

    def set(self) -> None:
        """Set the event; on the loop, wake the waiters even if another thread has already set it."""
        if asyncio._get_running_loop() is None:
            self._value = True
        else:
            self._value = False
            super().set()


class Buffer(AsyncMessageBuffer):
    """viser's message buffer, which sets its event in every thread, and drops writes to closed pages silently."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.message_event = AnyThreadEvent()
        self._warned_push_after_done = True  # a page may close while a picture is being drawn for it


viser.infra._infra.AsyncMessageBuffer = Buffer  # type: ignore[misc]


class PrivateViser:
    """A viser server on a port of loopback that refuses connections without a secret in SECRET_HEADER.

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
        """Stop the server, without printing an address as viser does."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()


def _guard_controls(server: viser.ViserServer, permits: Permits) -> None:
    handle_update, pages = server.gui._handle_gui_updates, server.gui._websock_interface

    async def guarded(client_id: Any, message: GuiUpdateMessage) -> None:
        if permits(client_id, message.uuid):
            await handle_update(client_id, message)
            return
        control: Any = server.gui._gui_input_handle_from_uuid.get(message.uuid)
        page = server.get_clients().get(client_id)
        if control is not None and page is not None and not control._impl.is_button:
            previous = GuiUpdateMessage(message.uuid, {"value": control.value})
            page.gui._websock_interface.queue_message(previous)

    pages.unregister_handler(GuiUpdateMessage, handle_update)
    pages.register_handler(GuiUpdateMessage, guarded)


@contextlib.contextmanager
def _requiring_secret(secret: str) -> Iterator[None]:
    """Let servers started in this context refuse connections without the secret."""
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
    """A click into the scene; only the ray is used."""

    event_type: Literal["click"]
    ray_origin: message.Vector3
    ray_direction: message.Vector3
    screen_pos: tuple[tuple[message.Number, message.Number]]
    modifier: Annotated[str, Meta(max_length=NAME_MAX)] | None = None


_DECODER = msgspec.msgpack.Decoder(ViewerCamera | ControlUpdate | SceneClick)
"""All other messages are refused, such as those that share the page on the Internet or upload files."""


class PageControls:
    """The controls known to viser: those shared by all pages, and those of each of the open `pages`."""

    def __init__(self, gui: viser.GuiApi, pages: Callable[[], Sequence[viser.GuiApi]] = tuple) -> None:
        self._gui = gui
        self._pages = pages

    def accepts(self, uuid: str, value: Value) -> bool:
        """Return whether a control accepts a value; viser would fail to convert an invalid one."""
        found = (gui._gui_input_handle_from_uuid.get(uuid) for gui in (self._gui, *self._pages()))
        handle: Any = next((each for each in found if each is not None), None)
        if handle is None or getattr(handle, "disabled", False):
            return False
        options = getattr(handle, "options", None)
        if options is not None:
            return value in options
        for kind in (bool, str):
            if isinstance(handle.value, kind) or isinstance(value, kind):
                return isinstance(handle.value, kind) and isinstance(value, kind)
        return abs(value) <= EXACT_MAX  # type: ignore[arg-type]


def is_permitted(data: bytes, role: str, controls: PageControls) -> bool:
    """Return whether a message of a page of this role, a msgpack map with its type, may reach viser."""
    if len(data) > MESSAGE_MAX:
        return False
    try:
        message = _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if not isinstance(message, ControlUpdate):
        return True
    return role == OPERATOR and controls.accepts(message.uuid, message.updates.value)
