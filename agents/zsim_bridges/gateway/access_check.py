"""Who may send HTTP requests, how many, and from which page; and the responses to errors."""

from collections.abc import Awaitable, Callable, Iterable
from urllib.parse import urlsplit

import msgspec
from aiohttp import web

from zsim.errors import DecodeError, NoWorldError, SessionError, ZsimError
from zsim.runtime.rate_limit import RateLimit
from zsim_bridges.gateway.client_messages import ForbiddenError, MethodError, TooManyError, UnknownError
from zsim_bridges.web import is_loopback_authority
from zsim_bridges.web.web_server import tokens_match

HTTP_RATE_HZ = 5_000.0  # requests per wall second of one address: 500 clients that ask ten times a second
HTTP_BURST = 10_000.0
METHODS = "GET, POST, PUT, PATCH, DELETE, OPTIONS"
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def count_request(limit: RateLimit, address: str = "") -> None:
    """Count a request of an address.

    Raises:
        TooManyError: there have been too many, with how long to wait.
    """
    if not limit.spend(address):
        wait_s = limit.wait(address)
        raise TooManyError(f"more than {1 / limit.period:g} requests a second; wait {wait_s:.3f} s")


class ConnectionLimit:
    """Bounds how many connections there are at a time.

    Args:
        limit: the largest number.
        what: is counted, for the error.
    """

    def __init__(self, limit: int, what: str) -> None:
        self._limit = limit
        self._what = what
        self._count = 0

    def enter(self) -> None:
        """Count one more.

        Raises:
            TooManyError: the limit is reached.
        """
        if self._count >= self._limit:
            raise TooManyError(f"there are {self._limit} {self._what} already; try again later")
        self._count += 1

    def leave(self) -> None:
        """Count one less."""
        self._count -= 1


class MissingTokenError(ForbiddenError):
    """A request without the token."""


STATUS: tuple[tuple[type[ZsimError], int], ...] = (
    (NoWorldError, 503),
    (TooManyError, 429),
    (MethodError, 405),
    (UnknownError, 404),
    (MissingTokenError, 401),
    (ForbiddenError, 403),
    (DecodeError, 400),
    (SessionError, 400),
)


class AccessCheck:
    """Passes requests on or refuses them.

    Args:
        token: that every request must have; None where only this machine can connect.
        report: prints a fault of the gateway itself.
    """

    def __init__(self, token: str | None, report: Callable[[str], None]) -> None:
        self._token = token
        self._report = report
        self._limit = RateLimit(1 / HTTP_RATE_HZ, HTTP_BURST)

    @property
    def needs_token(self) -> bool:
        """Whether a token must be shown."""
        return self._token is not None

    def is_token(self, received: str) -> bool:
        """Return whether a token is the right one."""
        return self._token is None or tokens_match(received, self._token)

    @web.middleware
    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests without the token, from other sites' pages, or too many; answer errors."""
        response = await self._answer(request, handler)
        if not response.prepared:
            response.headers.setdefault("Access-Control-Allow-Origin", "*")
        return response

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.method == "OPTIONS":  # a browser's preflight request, without a token
            allowed = {"Access-Control-Allow-Methods": METHODS, "Access-Control-Allow-Headers": "*"}
            return web.Response(status=204, headers=allowed)
        try:
            count_request(self._limit, request.remote or "")
            self._check_access(request)
            return await handler(request)
        except ZsimError as error:
            return error_response(_status(error), str(error), error.allowed if isinstance(error, MethodError) else ())
        except web.HTTPException as error:
            allowed = error.allowed_methods if isinstance(error, web.HTTPMethodNotAllowed) else ()
            text = " ".join((error.text or error.reason).split())
            return error_response(error.status, f"{request.method} {request.path[:80]}: {text}", sorted(allowed))
        except ConnectionError:
            raise
        except Exception as error:  # a fault of the gateway: other requests are served on
            if isinstance(error, RuntimeError) and request.transport is None:  # aiohttp's for a body that is cut
                raise ConnectionResetError("the client is gone") from error
            self._report(f"{request.method} {request.path[:80]}: {error!r}")
            return error_response(500, f"the gateway failed ({type(error).__name__}); its terminal says more")

    def _check_access(self, request: web.Request) -> None:
        if not self.is_token(_token_of(request)):
            raise MissingTokenError("no token, or a wrong one; send Authorization: Bearer TOKEN, or ?token=TOKEN")
        if not self.needs_token and not _is_from_this_machine(request):
            raise ForbiddenError("a page of another server may not ask here; give the gateway a token, and ask with it")


def error_response(status: int, text: str, allowed: Iterable[str] = ()) -> web.Response:
    """Return a response that has no value but an error, and the methods that the key has."""
    headers = {"Allow": ", ".join(allowed)} if allowed else None
    body = msgspec.json.encode({"error": text})
    return web.Response(status=status, body=body, content_type="application/json", headers=headers)


def _is_from_this_machine(request: web.Request) -> bool:
    """Return whether a program of this machine sent a request, and no page of another server: browsers give its origin.

    A server on another port of this machine is another one, whose pages may be anybody's. The Host header counts too:
    another site can let its own name resolve to this machine.
    """
    origin = request.headers.get("Origin")  # "null" for a sandboxed frame: any page can make one
    try:
        is_own = origin is None or urlsplit(origin).netloc == request.host
        return is_own and is_loopback_authority(request.host)
    except ValueError:
        return False


def _token_of(request: web.Request) -> str:
    kind, _, token = request.headers.get("Authorization", "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else request.query.get("token", "")


def _status(error: ZsimError) -> int:
    return next((status for kind, status in STATUS if isinstance(error, kind)), 500)
