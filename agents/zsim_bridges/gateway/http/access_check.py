"""Who may ask the gateway, how often, and from which page; and what a refusal looks like over HTTP."""

import hmac
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable
from ipaddress import ip_address
from urllib.parse import urlsplit

import msgspec
from aiohttp import web

from zsim.errors import DecodeError, NoWorldError, SessionError, ZsimError
from zsim_bridges.gateway.client_limits import TokenBucket
from zsim_bridges.gateway.http.http_errors import ForbiddenError, MethodError, TooManyError, UnknownError

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
HTTP_RATE_HZ = 5_000.0  # requests per wall second of one address: 500 clients that ask ten times a second
HTTP_BURST = 10_000.0
ADDRESSES_MAX = 10_000  # remembered
STATUS: tuple[tuple[type[ZsimError], int], ...] = (
    (NoWorldError, 503),
    (TooManyError, 429),
    (MethodError, 405),
    (UnknownError, 404),
    (ForbiddenError, 403),
    (DecodeError, 400),
    (SessionError, 400),
)
METHODS = "GET, POST, PUT, PATCH, DELETE, OPTIONS"


class AccessCheck:
    """Lets requests through or refuses them.

    Args:
        token: that everybody must show; None where only this machine can connect.
        report: told of a fault of ours.
    """

    def __init__(self, token: str | None, report: Callable[[str], None]) -> None:
        self._token = token
        self._report = report
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()

    @property
    def needs_token(self) -> bool:
        """Whether a token must be shown."""
        return self._token is not None

    def is_token(self, shown: str) -> bool:
        """Tell whether a token is the right one."""
        return self._token is None or hmac.compare_digest(_bytes(shown), _bytes(self._token))

    @web.middleware
    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse who shows no token, comes from a stranger's page or too often; turn refusals into answers."""
        response = await self._answer(request, handler)
        if not response.prepared:
            response.headers.setdefault("Access-Control-Allow-Origin", "*")
        return response

    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        if request.method == "OPTIONS":  # a browser asks whether it may ask, without a token
            allowed = {"Access-Control-Allow-Methods": METHODS, "Access-Control-Allow-Headers": "*"}
            return web.Response(status=204, headers=allowed)
        try:
            self._bucket(request.remote or "").spend()
            self._check_access(request)
            return await handler(request)
        except ZsimError as error:
            status = 401 if isinstance(error, _MissingTokenError) else _status(error)
            return error_response(status, str(error), error.allowed if isinstance(error, MethodError) else ())
        except web.HTTPException as error:
            allowed = error.allowed_methods if isinstance(error, web.HTTPMethodNotAllowed) else ()
            text = " ".join((error.text or error.reason).split())
            return error_response(error.status, f"{request.method} {request.path[:80]}: {text}", sorted(allowed))
        except ConnectionError:
            raise
        except Exception as error:  # a fault of ours: the others are served on
            self._report(f"{request.method} {request.path[:80]}: {error!r}")
            return error_response(500, f"the gateway failed ({type(error).__name__}); its terminal says more")

    def _check_access(self, request: web.Request) -> None:
        if not self.is_token(_token_of(request)):
            raise _MissingTokenError("no token, or a wrong one; send Authorization: Bearer TOKEN, or ?token=TOKEN")
        if not self.needs_token and not _is_from_this_machine(request):
            raise ForbiddenError("a page of another site may not ask here; give the gateway a token, and ask with it")

    def _bucket(self, address: str) -> TokenBucket:
        bucket = self._buckets.get(address)
        if bucket is None:
            bucket = self._buckets[address] = TokenBucket(HTTP_RATE_HZ, HTTP_BURST, time.monotonic)
            if len(self._buckets) > ADDRESSES_MAX:
                self._buckets.popitem(last=False)
        return bucket


class _MissingTokenError(ForbiddenError):
    """Who asks has not shown the token."""


def is_loopback(host: str) -> bool:
    """Tell whether a host is this machine alone."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def error_response(status: int, text: str, allowed: Iterable[str] = ()) -> web.Response:
    """Return the answer that says why there is none, and with what methods there is one."""
    headers = {"Allow": ", ".join(allowed)} if allowed else None
    body = msgspec.json.encode({"error": text})
    return web.Response(status=status, body=body, content_type="application/json", headers=headers)


def _is_from_this_machine(request: web.Request) -> bool:
    """Tell whether a request comes from a program or a page of this machine: browsers say whose page asks.

    The name by which we are asked counts too: a stranger's page can let its own name lead to this machine.
    """
    origin = request.headers.get("Origin")  # "null" for a frame that its page shut in: any page can make one
    try:
        page = "localhost" if origin is None else urlsplit(origin).hostname or ""
        return is_loopback(page) and is_loopback(urlsplit(f"//{request.host}").hostname or "")
    except ValueError:
        return False


def _token_of(request: web.Request) -> str:
    kind, _, token = request.headers.get("Authorization", "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else request.query.get("token", "")


def _bytes(text: str) -> bytes:
    """Return the bytes of a header, whatever they were."""
    return text.encode(errors="surrogateescape")


def _status(error: ZsimError) -> int:
    return next((status for kind, status in STATUS if isinstance(error, kind)), 500)
