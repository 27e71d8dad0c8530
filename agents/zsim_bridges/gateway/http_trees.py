"""The keys as trees of HTTP: that of the Zenoh REST plugin, one of JSON by the schema of each message, and pictures.

RestTree: full keys, payloads as they are. GET and POST query, PUT and PATCH publish, DELETE deletes; `Accept:
text/event-stream` subscribes; `?_raw` returns the first payload alone. Source: zenoh, plugins/zenoh-plugin-rest.

JsonTree: /json/KEY without the federation's name.
GET    /json/drone/drone1/sensor/imu      the last value; of an expression, a list of {key, value}
GET    … with Accept: text/event-stream   every value from now on
PUT    /json/drone/drone1/cmd/velocity    {"velocity_m_s": [1, 0, 0]}; t_ns, seq and source are filled in
POST   /json/world/control                {"op": "pause", "args": {}}

CameraTree: /camera/DRONE/CAMERA, a stream of pictures; /camera/DRONE/CAMERA.jpg, the newest one.
"""

import base64
import html
import json
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any
from urllib.parse import unquote

import msgspec
from aiohttp import web

from zsim.contract import messages
from zsim.contract.messages import REFUSALS
from zsim.contract.run_messages import ControlRequest
from zsim.errors import DecodeError
from zsim.transport.session import RawSample, check_expression
from zsim_bridges.gateway.access_check import ConnectionLimit, error_response
from zsim_bridges.gateway.client_messages import (
    CACHED_VALUES,
    JSON,
    TEXT,
    MethodError,
    check_shown,
    is_control_key,
    is_reserved,
    json_entry,
    json_value,
)
from zsim_bridges.gateway.client_streams import event_bytes, stream_events
from zsim_bridges.gateway.publications import SharedSubscriptions
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.web.picture_streams import PictureFeeds, as_file, stream_pictures

EVENT_STREAM = "text/event-stream"
RAW, TOKEN = "_raw", "token"
BYTES = "zenoh/bytes"  # encoding that the plugin gives a body without Content-Type
JSON_PREFIX = "/json/"
ONE_PICTURE = ".jpg"  # end of the path of a single picture
PICTURE_S = 2.0  # wall time that the first picture is waited for; twice the period of a slow camera
NO_PICTURE = "no picture yet; does a camera process publish there, and does time run?"
NO_VALUE = "no value yet; is the key right, and does somebody publish it?"
_encode = msgspec.json.Encoder().encode
_control_request = msgspec.json.Decoder(ControlRequest).decode


class RestTree:
    """Handlers of the tree of full keys.

    Args:
        run: returns the current run.
        subscriptions: to full keys.
    """

    def __init__(self, run: Callable[[], RunAccess], subscriptions: SharedSubscriptions) -> None:
        self._run = run
        self._subscriptions = subscriptions

    async def get(self, request: web.Request) -> web.StreamResponse:
        """Answer a GET or a POST."""
        expression, accepted = _key_of(request, "/"), _first_accepted(request)
        check_shown(expression)
        if accepted == EVENT_STREAM:
            return await stream_events(request, self._subscriptions, expression, _sample_event)
        samples = await self._query(request, expression)
        if RAW in request.query:
            return _as_raw(samples)
        if accepted == "text/html":
            return web.Response(text=_as_html(samples), content_type="text/html")
        return web.json_response([described_sample(sample) for sample in samples])

    async def put(self, request: web.Request) -> web.Response:
        """Publish a body on a key."""
        key, body = _key_of(request, "/"), await request.read()
        self._run().put_full_key(key, body, _encoding_of(request))
        return web.Response()

    async def delete(self, request: web.Request) -> web.Response:
        """Publish that a key has no value any more."""
        self._run().delete_full_key(_key_of(request, "/"))
        return web.Response()

    async def _query(self, request: web.Request, expression: str) -> list[RawSample]:
        body, run = await request.read(), self._run()
        stored = [] if body else run.last_samples(expression)
        if stored and "*" not in expression:
            return stored
        answers = await run.query(expression, _zenoh_parameters(request), body, _encoding_of(request))
        stored_keys = {sample.key for sample in stored}
        return [*stored, *(answer for answer in answers if answer.kind == "ERROR" or answer.key not in stored_keys)]


class JsonTree:
    """Handlers of the tree of JSON.

    Args:
        run: returns the current run.
        subscriptions: to keys without the federation's name.
        source: of control requests that name none.
    """

    def __init__(self, run: Callable[[], RunAccess], subscriptions: SharedSubscriptions, source: str) -> None:
        self._run = run
        self._subscriptions = subscriptions
        self._source = source

    async def get(self, request: web.Request) -> web.StreamResponse:
        """Answer with the last values, or with every value from now on."""
        expression = _checked_key(request)
        if _first_accepted(request) == EVENT_STREAM:
            return await stream_events(request, self._subscriptions, expression, value_event)
        last = self._run().values
        entries = [json_entry(key, payload, last.encoding(key)) for key, payload in last.matching(expression)]
        if "*" in expression:
            return _as_json(entries)
        return _as_json(entries[0]["value"]) if entries else error_response(404, f"{expression[:80]}: {NO_VALUE}")

    async def put(self, request: web.Request) -> web.Response:
        """Publish a value."""
        key = _checked_key(request)
        value, run = _decode_body(key, await request.read()), self._run()
        run.put(key, value, run.defaults)
        return _as_json({})

    async def post(self, request: web.Request) -> web.Response:
        """Send a control request to whoever answers on a key."""
        key = _checked_key(request)
        try:
            control = _control_request(await request.read())
        except REFUSALS as error:
            raise DecodeError(f"{key[:80]}: {error}; must be a JSON object with op and args") from error
        answer = await self._run().request(key, control.op, control.args, control.source or self._source)
        return _as_json({"ok": answer.ok, "error": answer.error, "result": json_value(answer.result)})


class CameraTree:
    """Handlers of the pictures of cameras.

    Args:
        run: returns the current run.
        feeds: of the cameras.
        limit: of clients, in which streams count.
    """

    def __init__(self, run: Callable[[], RunAccess], feeds: PictureFeeds, limit: ConnectionLimit) -> None:
        self._run = run
        self._feeds = feeds
        self._limit = limit

    async def get(self, request: web.Request) -> web.StreamResponse:
        """Answer with all pictures from now on, or with the newest one alone where the path ends with `.jpg`."""
        camera = request.match_info["camera"]
        key = self._run().camera_key(request.match_info["drone"], camera.removesuffix(ONE_PICTURE))
        self._limit.enter()
        try:
            with self._feeds.watched(key) as feed:
                if not camera.endswith(ONE_PICTURE):
                    return await stream_pictures(request, feed)
                picture = feed.newest or await feed.after(-1, PICTURE_S)
        finally:
            self._limit.leave()
        return as_file(picture.image) if picture else error_response(404, f"{key}: {NO_PICTURE}")


def methods_of(key: str) -> tuple[str, ...]:
    """Return the HTTP methods of a key: control keys take requests, reserved ones are read, clients' own take all."""
    if is_control_key(key):
        return ("POST",)
    if is_reserved(key):
        return ("GET",)
    return ("GET", "PUT") if messages.type_of(key) else ("GET", "PUT", "POST")


# Requests


def _key_of(request: web.Request, prefix: str) -> str:
    """Return the key expression in a path.

    Raises:
        DecodeError: there is none.
    """
    try:
        key = unquote(request.raw_path.partition("?")[0], errors="strict").removeprefix(prefix)
    except UnicodeDecodeError as error:
        raise DecodeError(f"path is {request.raw_path[:80]!r}; must be UTF-8, percent-encoded") from error
    if not key:
        raise DecodeError("path is '/'; must be a key expression, e.g. /zsim/world/info")
    return key


def _checked_key(request: web.Request) -> str:
    """Return the key of a request that has its method.

    Raises:
        SessionError: it is no key expression.
        MethodError: the key has other methods.
    """
    key = _key_of(request, JSON_PREFIX)
    check_expression(key)
    allowed = methods_of(key)
    if request.method not in allowed:
        raise MethodError(
            f"{key[:80]}: {request.method} is nothing for this key; must be {' or '.join(allowed)}", allowed
        )
    return key


def _encoding_of(request: web.Request) -> str:
    """Return the Zenoh encoding of a body.

    Raises:
        DecodeError: it is none.
    """
    kind = request.headers.get("Content-Type") or BYTES
    if not (kind.isascii() and kind.isprintable()):
        raise DecodeError(f"Content-Type is {kind[:80]!a}; must be ASCII, e.g. application/json")
    return kind


def _first_accepted(request: web.Request) -> str:
    """Return the first media type that is accepted: the plugin looks at no other."""
    return request.headers.get("Accept", "application/json").split(",")[0].split(";")[0].strip()


def _zenoh_parameters(request: web.Request) -> str:
    """Return what follows the `?` as Zenoh's parameters, without the gateway's own."""
    parameters = (part for part in request.query_string.split("&") if part.partition("=")[0] not in (TOKEN, ""))
    return ";".join(parameters)


def _decode_body(key: str, body: bytes) -> Any:
    try:
        return msgspec.json.decode(body)
    except REFUSALS as error:
        raise DecodeError(f"{key[:80]}: {error}; must be JSON") from error


# Responses


def described_sample(sample: RawSample) -> dict[str, Any]:
    """Return an answer or a publication as the plugin describes it."""
    key = "ERROR" if sample.kind == "ERROR" else sample.key
    return {"key": key, "value": _plugin_value(sample), "encoding": sample.encoding, "timestamp": sample.timestamp}


def _plugin_value(sample: RawSample) -> Any:
    if not sample.payload:
        return None
    kind = sample.encoding.partition(";")[0]
    try:
        if kind in JSON:
            return json.loads(sample.payload)
        if kind in TEXT:
            return sample.payload.decode()
    except (ValueError, RecursionError):
        pass  # not of its encoding: as bytes
    return base64.b64encode(sample.payload).decode()


@lru_cache(maxsize=CACHED_VALUES)
def _sample_event(sample: RawSample) -> bytes:
    return event_bytes(sample.kind, json.dumps(described_sample(sample)).encode())


@lru_cache(maxsize=CACHED_VALUES)
def value_event(sample: RawSample) -> bytes:
    """Return a publication as an event; nothing for what is no message."""
    deleted = {"key": sample.key, "value": None}
    try:
        value = json_entry(sample.key, sample.payload, sample.encoding) if sample.payload else deleted
    except DecodeError:
        return b""
    return event_bytes(sample.kind, _encode(value))


def _as_json(value: Any) -> web.Response:
    return web.Response(body=_encode(value), content_type="application/json")


def _as_raw(samples: list[RawSample]) -> web.Response:
    if not samples:
        return web.Response()
    return web.Response(body=samples[0].payload, headers={"Content-Type": samples[0].encoding})


def _as_html(samples: Iterable[RawSample]) -> str:
    texts = ((sample.key or "ERROR", sample.payload.decode(errors="replace")) for sample in samples)
    items = "\n".join(f"<dt>{html.escape(key)}</dt>\n<dd>{html.escape(text)}</dd>\n" for key, text in texts)
    return f"<dl>\n{items}\n</dl>\n"
