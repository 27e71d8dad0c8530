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
SAID_MAX = 100_000  # bytes of one thing that a page says
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


class Moved(Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """What a page says when somebody moves a control."""

    class Updates(Struct, forbid_unknown_fields=True):
        """Of a control its value alone."""

        value: Value

    uuid: str
    updates: Updates


_SAID = msgspec.msgpack.Decoder(Camera | Moved)
"""All else is nobody's: to ask viser to show the page on the Internet, or to upload files."""


class Asked(NamedTuple):
    """What a request over HTTP shows of itself."""

    path: str
    host: str  # of its Host header
    origin: str | None
    token: str  # in its address; empty for none
    cookies: dict[str, str]


class Guard:
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

    def role(self, asked: Asked) -> str | None:
        """Return as what a page of this path may be opened, None if it may not."""
        wanted = VIEWER if asked.path.startswith(VIEW_PATH) else OPERATOR
        if self._tokens[OPERATOR] is None:
            return wanted if _is_own(asked) else None
        if asked.origin is not None and _site(asked.origin) != asked.host:
            return None
        enough = (OPERATOR,) if wanted == OPERATOR else (VIEWER, OPERATOR)
        return wanted if any(self._shows(asked, role) for role in enough) else None

    def shown(self, asked: Asked) -> str | None:
        """Return the role whose token stands in the address, None if none does: it is to become a cookie."""
        return next((role for role in (OPERATOR, VIEWER) if asked.token and self._is(asked.token, role)), None)

    def _shows(self, asked: Asked, role: str) -> bool:
        return self._is(asked.token, role) or self._is(asked.cookies.get(self.cookie(role), ""), role)

    def _is(self, shown: str, role: str) -> bool:
        token = self._tokens[role]
        return token is not None and hmac.compare_digest(shown.encode(errors="replace"), token.encode())


def _site(origin: str) -> str | None:
    """Return host and port of an Origin header, None where it has none that can be read."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


def _is_own(asked: Asked) -> bool:
    """Tell whether a request comes from this machine's own pages, by a name of this machine."""
    try:
        page = asked.host if asked.origin is None else urlsplit(asked.origin).netloc
        return page == asked.host and is_loopback(urlsplit(f"//{asked.host}").hostname or "")
    except ValueError:
        return False


class Controls(Protocol):
    """What is known of the controls of pages, by their ids."""

    def harmless(self, uuid: str) -> bool:
        """Tell whether a control changes nothing but its own page."""
        ...

    def fits(self, uuid: str, value: Value) -> bool:
        """Tell whether a control takes such a value."""
        ...


def may_pass(said: bytes, role: str, controls: Controls) -> bool:
    """Tell whether something that a page says may reach the console.

    Args:
        said: one message of viser's: a msgpack map with its type.
        role: of the page.
        controls: of all pages.
    """
    if len(said) > SAID_MAX:
        return False
    try:
        message = _SAID.decode(said)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if isinstance(message, Camera):
        return True
    permitted = role == OPERATOR or controls.harmless(message.uuid)
    return permitted and controls.fits(message.uuid, message.updates.value)
