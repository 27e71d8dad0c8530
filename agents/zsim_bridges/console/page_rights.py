"""Who may open which page, and which messages of a page may reach the console."""

from typing import Annotated, Any, NamedTuple
from urllib.parse import urlsplit

import msgspec
import viser
from msgspec import Meta, Struct

from zsim.contract import flight_messages
from zsim.schema.message import Number, Vector3
from zsim_bridges.web_server import check_token, is_loopback_authority, tokens_match

OPERATOR, VIEWER = "operator", "viewer"
VIEW_PATH = "/view"
MESSAGE_MAX = 100_000  # bytes of one message of a page
VALUE_MAX = 2_000  # characters of a control's text: expressions of twelve variables, a line each
EXACT_MAX = 2**53  # a page's numbers are exact up to it; a larger one fits no message

Value = bool | Number | Annotated[str, Meta(max_length=VALUE_MAX)]


class PageRequest(NamedTuple):
    """An HTTP request, as far as it shows who sent it."""

    path: str
    host: str  # of its Host header
    origin: str | None
    token: str  # in its address; empty for none
    cookies: dict[str, str]


class PageTokens:
    """Decides by tokens who may open pages.

    Args:
        listen: the address on which pages are served.
        port: and the port.
        operator, viewer: tokens; the first is None where only this machine can connect.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(self, listen: str, port: int, operator: str | None, viewer: str) -> None:
        check_token("console", listen, operator)
        self._tokens = {OPERATOR: operator, VIEWER: viewer}
        self._port = port

    def cookie(self, role: str) -> str:
        """Return the name of a role's cookie: a browser keeps those of all ports of a host together."""
        return f"zsim_{role}_{self._port}"

    def role_of(self, request: PageRequest) -> str | None:
        """Return the role in which the page of this path may be opened, None if it may not."""
        role = VIEWER if request.path.startswith(VIEW_PATH) else OPERATOR
        if self._tokens[OPERATOR] is None:
            return role if _is_from_own_page(request) else None
        if request.origin is not None and _origin_address(request.origin) != request.host:
            return None
        sufficient = (OPERATOR,) if role == OPERATOR else (VIEWER, OPERATOR)
        return role if any(self._has_token(request, each) for each in sufficient) else None

    def role_of_address(self, request: PageRequest) -> str | None:
        """Return the role whose token stands in the address, None if none does: it is to become a cookie."""
        return next(
            (role for role in (OPERATOR, VIEWER) if request.token and self._is_token(request.token, role)), None
        )

    def _has_token(self, request: PageRequest, role: str) -> bool:
        cookie = request.cookies.get(self.cookie(role), "")
        return self._is_token(request.token, role) or self._is_token(cookie, role)

    def _is_token(self, received: str, role: str) -> bool:
        token = self._tokens[role]
        return token is not None and tokens_match(received, token)


def _origin_address(origin: str) -> str | None:
    """Return host and port of an Origin header, None where it cannot be parsed."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def _is_from_own_page(request: PageRequest) -> bool:
    """Return whether a request comes from the console's own page, by a name of this machine."""
    own_page = request.origin is None or _origin_address(request.origin) == request.host
    try:
        return own_page and is_loopback_authority(request.host)
    except ValueError:
        return False


# Messages of a page


class Camera(Struct, tag_field="type", tag="ViewerCameraMessage"):
    """Every page sends where its camera is."""

    wxyz: flight_messages.Quaternion
    position: Vector3
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: Vector3
    up_direction: Vector3


class ControlUpdate(Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """A page sends this when somebody uses a control."""

    class Updates(Struct, forbid_unknown_fields=True):
        """Only the value of a control."""

        value: Value

    uuid: str
    updates: Updates


_DECODER = msgspec.msgpack.Decoder(Camera | ControlUpdate)
"""All other messages are refused, such as to show the page on the Internet, or to upload files."""


class PageControls:
    """The controls that viser knows, and the switches that each page has for itself.

    Args:
        gui: of all pages.
        switches: ids of those of single pages.
    """

    def __init__(self, gui: viser.GuiApi, switches: set[str]) -> None:
        self._gui = gui
        self._switches = switches

    def is_local(self, uuid: str) -> bool:
        """Return whether a control changes nothing but its own page."""
        return uuid in self._switches

    def accepts(self, uuid: str, value: Value) -> bool:
        """Return whether a control takes such a value: viser converts it to its type, and fails where it cannot."""
        if uuid in self._switches:
            return isinstance(value, bool)
        handle: Any = self._gui._gui_input_handle_from_uuid.get(uuid)  # viser has no public way to a control by its id
        return handle is not None and _accepts(handle, value)


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
    if isinstance(message, Camera):
        return True
    permitted = role == OPERATOR or controls.is_local(message.uuid)
    return permitted and controls.accepts(message.uuid, message.updates.value)
