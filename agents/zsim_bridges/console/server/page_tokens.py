"""Who may open pages of the console, and in which role: by tokens; on this machine alone by a request's origin."""

from typing import NamedTuple
from urllib.parse import urlsplit

from zsim_bridges.console.page.control_desk import OPERATOR, VIEWER
from zsim_bridges.web.loopback import is_loopback_authority
from zsim_bridges.web.web_server import check_token, tokens_match

VIEW_PATH = "/view"


class PageRequest(NamedTuple):
    """The fields of an HTTP request that identify its sender."""

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
        roles = (role for role in (OPERATOR, VIEWER) if self._is_token(request.token, role))
        return next(roles, None) if request.token else None

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
