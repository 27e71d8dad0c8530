"""Who may open which page, and what a page may say. Pure."""

import hmac
from typing import Annotated, NamedTuple, Protocol
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta, Struct

from zsim.contract import messages
from zsim.errors import RunError
from zsim_bridges.gateway.http.access_check import is_loopback

OPERATOR, VIEWER = "operator", "viewer"
VIEW_PATH = "/view"
MESSAGE_MAX = 100_000  # bytes of one thing that a page says
VALUE_MAX = 2_000  # characters of a control's text: expressions of twelve variables, a line each

Value = bool | messages.Number | Annotated[str, Meta(max_length=VALUE_MAX)]


class Camera(Struct, tag_field="type", tag="ViewerCameraMessage"):
    """What every page says: where its camera is."""

    wxyz: messages.Quaternion
    position: messages.Vector3
    fov: messages.Number
    near: messages.Number
    far: messages.Number
    image_height: messages.Number
    image_width: messages.Number
    look_at: messages.Vector3
    up_direction: messages.Vector3


class ControlUpdate(Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """What a page says when somebody moves a control."""

    class Updates(Struct, forbid_unknown_fields=True):
        """Of a control its value alone."""

        value: Value

    uuid: str
    updates: Updates


_DECODER = msgspec.msgpack.Decoder(Camera | ControlUpdate)
"""All else is nobody's: to ask viser to show the page on the Internet, or to upload files."""


class PageRequest(NamedTuple):
    """What a request over HTTP shows of itself."""

    path: str
    host: str  # of its Host header
    origin: str | None
    token: str  # in its address; empty for none
    cookies: dict[str, str]


class PageTokens:
    """Knows the tokens.

    Args:
        listen: the address on which pages are served.
        port: and the port.
        operator, viewer: tokens; the first is None where only this machine can connect.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(self, listen: str, port: int, operator: str | None, viewer: str) -> None:
        if operator == "":
            raise RunError("console: the token is empty; give it one, or leave --token and ZSIM_TOKEN away")
        if operator is None and not is_loopback(listen):
            raise RunError(f"console: {listen} can be reached by others; give it a --token, or --listen 127.0.0.1")
        self._tokens = {OPERATOR: operator, VIEWER: viewer}
        self._port = port

    def cookie(self, role: str) -> str:
        """Return the name of a role's cookie: a browser keeps those of all ports of a host together."""
        return f"zsim_{role}_{self._port}"

    def role_of(self, asked: PageRequest) -> str | None:
        """Return as what a page of this path may be opened, None if it may not."""
        wanted = VIEWER if asked.path.startswith(VIEW_PATH) else OPERATOR
        if self._tokens[OPERATOR] is None:
            return wanted if _is_from_own_page(asked) else None
        if asked.origin is not None and _origin_address(asked.origin) != asked.host:
            return None
        enough = (OPERATOR,) if wanted == OPERATOR else (VIEWER, OPERATOR)
        return wanted if any(self._has_token(asked, role) for role in enough) else None

    def role_of_address(self, asked: PageRequest) -> str | None:
        """Return the role whose token stands in the address, None if none does: it is to become a cookie."""
        return next((role for role in (OPERATOR, VIEWER) if asked.token and self._is_token(asked.token, role)), None)

    def _has_token(self, asked: PageRequest, role: str) -> bool:
        return self._is_token(asked.token, role) or self._is_token(asked.cookies.get(self.cookie(role), ""), role)

    def _is_token(self, shown: str, role: str) -> bool:
        token = self._tokens[role]
        return token is not None and hmac.compare_digest(shown.encode(errors="replace"), token.encode())


def _origin_address(origin: str) -> str | None:
    """Return host and port of an Origin header, None where it has none that can be read."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def _is_from_own_page(asked: PageRequest) -> bool:
    """Tell whether a request comes from this machine's own pages, by a name of this machine."""
    try:
        page = asked.host if asked.origin is None else urlsplit(asked.origin).netloc
        return page == asked.host and is_loopback(urlsplit(f"//{asked.host}").hostname or "")
    except ValueError:
        return False


class ControlRights(Protocol):
    """What is known of the controls of pages, by their ids."""

    def is_local(self, uuid: str) -> bool:
        """Tell whether a control changes nothing but its own page."""
        ...

    def accepts(self, uuid: str, value: Value) -> bool:
        """Tell whether a control takes such a value."""
        ...


def is_permitted(said: bytes, role: str, controls: ControlRights) -> bool:
    """Tell whether something that a page says may reach the console.

    Args:
        said: one message of viser's: a msgpack map with its type.
        role: of the page.
        controls: of all pages.
    """
    if len(said) > MESSAGE_MAX:
        return False
    try:
        message = _DECODER.decode(said)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if isinstance(message, Camera):
        return True
    permitted = role == OPERATOR or controls.is_local(message.uuid)
    return permitted and controls.accepts(message.uuid, message.updates.value)
