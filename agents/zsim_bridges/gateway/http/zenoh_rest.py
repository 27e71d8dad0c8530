"""The tree of the Zenoh REST plugin: whole keys, payloads as they are.

GET and POST ask, PUT and PATCH publish, DELETE deletes; `Accept: text/event-stream` subscribes; `?_raw` gives the first
payload as it is. Source: zenoh, plugins/zenoh-plugin-rest.
"""

import base64
import html
import json
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any
from urllib.parse import unquote

from aiohttp import web

from zsim.errors import DecodeError
from zsim.transport.session import Heard
from zsim_bridges.gateway.http.event_stream import event_bytes, stream_events
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.gateway.subscriptions import SharedSubscriptions
from zsim_bridges.gateway.transcoding import JSON, CACHED_VALUES, TEXT

RAW, TOKEN = "_raw", "token"
BYTES = "zenoh/bytes"  # what the plugin says of a body without Content-Type


class RestTree:
    """Handlers of the tree.

    Args:
        flight: returns the run that goes on.
        feed: of whole keys.
    """

    def __init__(self, flight: Callable[[], RunAccess], feed: SharedSubscriptions) -> None:
        self._run = flight
        self._subscriptions = feed

    async def get(self, request: web.Request) -> web.StreamResponse:
        """Answer a GET or a POST."""
        expression, accepted = key_of(request), first_accepted(request)
        if accepted == "text/event-stream":
            return await stream_events(request, self._subscriptions, expression, _event)
        found = await self._query(request, expression)
        if RAW in request.query:
            return _as_raw(found)
        if accepted == "text/html":
            return web.Response(text=_as_html(found), content_type="text/html")
        return web.Response(text=json.dumps([described_sample(heard) for heard in found]), content_type="application/json")

    async def put(self, request: web.Request) -> web.Response:
        """Publish a body on a key."""
        key, body = key_of(request), await request.read()
        self._run().put_full_key(key, body, encoding_of(request))
        return web.Response()

    async def delete(self, request: web.Request) -> web.Response:
        """Publish that a key has no value any more."""
        self._run().delete_full_key(key_of(request))
        return web.Response()

    async def _query(self, request: web.Request, expression: str) -> list[Heard]:
        body, flight = await request.read(), self._run()
        known = [] if body else flight.known(expression)
        if known and "*" not in expression:
            return known
        answered = await flight.query(expression, _zenoh_parameters(request), body, encoding_of(request))
        there = {heard.key for heard in known}
        return [*known, *(heard for heard in answered if heard.kind == "ERROR" or heard.key not in there)]


def key_of(request: web.Request, below: str = "/") -> str:
    """Return the key expression in a path.

    Raises:
        DecodeError: there is none.
    """
    try:
        key = unquote(request.raw_path.partition("?")[0], errors="strict").removeprefix(below)
    except UnicodeDecodeError as error:
        raise DecodeError(f"path is {request.raw_path[:80]!r}; must be UTF-8, percent-encoded") from error
    if not key:
        raise DecodeError("path is '/'; must be a key expression, e.g. /zsim/world/info")
    return key


def encoding_of(request: web.Request) -> str:
    """Return the Zenoh encoding of a body.

    Raises:
        DecodeError: it is none.
    """
    kind = request.headers.get("Content-Type") or BYTES
    if not (kind.isascii() and kind.isprintable()):
        raise DecodeError(f"Content-Type is {kind[:80]!a}; must be ASCII, e.g. application/json")
    return kind


def first_accepted(request: web.Request) -> str:
    """Return the first media type that is accepted: the plugin looks at no other."""
    return request.headers.get("Accept", "application/json").split(",")[0].split(";")[0].strip()


def described_sample(heard: Heard) -> dict[str, Any]:
    """Return an answer or a publication as the plugin does."""
    key = "ERROR" if heard.kind == "ERROR" else heard.key
    return {"key": key, "value": _value(heard), "encoding": heard.encoding, "timestamp": heard.timestamp}


def _zenoh_parameters(request: web.Request) -> str:
    """Return what follows the `?` as Zenoh's parameters, without what is meant for us alone."""
    given = (part for part in request.query_string.split("&") if part.partition("=")[0] not in (TOKEN, ""))
    return ";".join(given)


def _value(heard: Heard) -> Any:
    if not heard.payload:
        return None
    kind = heard.encoding.partition(";")[0]
    try:
        if kind in JSON:
            return json.loads(heard.payload)
        if kind in TEXT:
            return heard.payload.decode()
    except (ValueError, RecursionError):
        pass  # not what its encoding says: as bytes
    return base64.b64encode(heard.payload).decode()


@lru_cache(maxsize=CACHED_VALUES)
def _event(heard: Heard) -> bytes:
    return event_bytes(heard.kind, json.dumps(described_sample(heard)).encode())


def _as_raw(found: list[Heard]) -> web.Response:
    if not found:
        return web.Response()
    return web.Response(body=found[0].payload, headers={"Content-Type": found[0].encoding})


def _as_html(found: Iterable[Heard]) -> str:
    texts = ((heard.key or "ERROR", heard.payload.decode(errors="replace")) for heard in found)
    shown = "\n".join(f"<dt>{html.escape(key)}</dt>\n<dd>{html.escape(text)}</dd>\n" for key, text in texts)
    return f"<dl>\n{shown}\n</dl>\n"
