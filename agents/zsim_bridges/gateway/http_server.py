"""The gateway's HTTP server: access checks, and handlers for two trees of keys and for camera pictures.

Full keys are served as by the Zenoh REST plugin, with unchanged payloads. GET and POST query, PUT and PATCH publish,
DELETE deletes; `Accept: text/event-stream` subscribes; `?_raw` returns only the first payload. Source: zenoh,
plugins/zenoh-plugin-rest.

/json/KEY, where KEY lacks the federation's name, exchanges JSON by the schema of each message:
GET    /json/drone/drone1/sensor/imu      the last value; for an expression, a list of {key, value}
GET    … with Accept: text/event-stream   every value from now on
PUT    /json/drone/drone1/cmd/velocity    {"velocity_m_s": [1, 0, 0]}; t_ns, seq and source are filled in
POST   /json/world/control                {"op": "pause", "args": {}}

/camera/DRONE/CAMERA is a stream of pictures, /camera/DRONE/CAMERA.jpg the newest one; /stream is a WebSocket.
"""

import base64
import html
import json
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any
from urllib.parse import unquote, urlsplit

import msgspec
from aiohttp import web

from zsim import __version__
from zsim.contract import messages
from zsim.contract.messages import REFUSALS
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import DecodeError, NoWorldError, SessionError, ZsimError
from zsim.runtime.rate_limit import RateLimit
from zsim.sensors.camera import CAMERAS
from zsim.transport.session import RawSample, check_expression
from zsim_bridges.gateway.client_messages import (
    CACHED_VALUES,
    JSON,
    TEXT,
    ClientLimit,
    ForbiddenError,
    MethodError,
    TooManyError,
    UnknownError,
    count_request,
    is_client_key,
    is_control_key,
    is_reserved,
    json_entry,
    json_value,
)
from zsim_bridges.gateway.client_streams import (
    LINE_MAX,
    PICTURE_HEADERS,
    ClientFactory,
    PictureFeeds,
    exposure_s,
    serve_websocket,
    stream_events,
    stream_pictures,
)
from zsim_bridges.gateway.run_access import RunAccess, SharedSubscriptions
from zsim_bridges.web import is_loopback_authority
from zsim_bridges.web.web_server import tokens_match

HTTP_RATE_HZ = 5_000.0  # requests per second of wall time from one address: 500 clients with ten requests a second each
HTTP_BURST = 10_000.0
METHODS = "GET, POST, PUT, PATCH, DELETE, OPTIONS"
EVENT_STREAM = "text/event-stream"
RAW, TOKEN = "_raw", "token"
BYTES = "zenoh/bytes"  # the plugin's encoding for a body without Content-Type
PICTURE_TIMEOUT_S = 2.0  # wall time to wait for the first picture: twice the period of a slow camera
NO_PICTURE = "no picture yet; is a camera process publishing there, and is time running?"
NO_VALUE = "no value yet; is the key right, and does a process publish it?"
STREAM, DESCRIPTION, CAMERA = "/stream", "/openapi.json", "/camera/{drone}/{camera}"
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
_encode = msgspec.json.Encoder().encode
_control_request = msgspec.json.Decoder(ControlRequest).decode
JSON_PREFIX = "/json/"
JPEG_SUFFIX = ".jpg"  # suffix of the path of a single picture
DEFAULTED_FIELDS = ("t_ns", "seq", "source")  # fields that a client may leave out
CONTROL_PATHS = ("world/control", "cluster/{cluster}/control", "drone/{drone}/control")
_REF = "#/components/schemas/{name}"
_OWN_KEY = {"type": "string", "pattern": "^[A-Za-z0-9_.-]{1,64}$"}  # schema of a client's own key; Zenoh accepts more
_ERRORS = {
    400: "an invalid key or value",
    401: "no token, or a wrong one",
    403: "a reserved key, or a page of another server",
    404: "no such drone, cluster or camera, or no value yet",
    405: "a method that this key does not support",
    408: "a request that did not arrive completely in time",
    413: "a body that is too long",
    429: "too many requests",
    503: "there is no run now",
}


class MissingTokenError(ForbiddenError):
    """A request without the token, or with a wrong one."""


STATUS: tuple[tuple[type[ZsimError], int], ...] = (
    (NoWorldError, 503),
    (TooManyError, 429),
    (MethodError, 405),
    (UnknownError, 404),
    (MissingTokenError, 401),
    (ForbiddenError, 403),
    (DecodeError, 400),
    (SessionError, 400),
    (ZsimError, 500),
)


def application(access_check: "AccessCheck", trees: "KeyTrees", new_client: ClientFactory) -> web.Application:
    """Return the web application of a gateway; `new_client` creates the client of a WebSocket."""

    async def index(request: web.Request) -> web.Response:
        cameras = {"camera": "/camera/DRONE/CAMERA", "picture": f"/camera/DRONE/CAMERA{JPEG_SUFFIX}"}
        paths = {"description": DESCRIPTION, "json": JSON_PREFIX, "stream": STREAM, **cameras}
        return web.json_response({"zsim": "gateway", **paths, "zenoh": "/FEDERATION/KEY"})

    async def describe(request: web.Request) -> web.Response:
        return web.json_response(description())

    def not_allowed(*allowed: str) -> Handler:
        """Return a handler for the methods of a path that are not allowed."""

        async def refuse(request: web.Request) -> web.StreamResponse:
            raise web.HTTPMethodNotAllowed(request.method, allowed)

        return refuse

    app = web.Application(middlewares=[access_check.check], client_max_size=LINE_MAX)
    json_path, full_path = f"{JSON_PREFIX}{{key:.*}}", "/{key:.*}"
    app.router.add_get("/", index)
    app.router.add_get(DESCRIPTION, describe)
    app.router.add_get(STREAM, lambda request: serve_websocket(request, new_client))
    app.router.add_get(json_path, trees.get_json, allow_head=False)
    app.router.add_put(json_path, trees.put_json)
    app.router.add_post(json_path, trees.post_json)
    app.router.add_route("*", json_path, not_allowed("GET", "POST", "PUT"))
    app.router.add_get(CAMERA, trees.get_pictures, allow_head=False)
    for path in (STREAM, DESCRIPTION, CAMERA):
        app.router.add_route("*", path, not_allowed("GET"))
    app.router.add_get(full_path, trees.get_full, allow_head=False)
    app.router.add_post(full_path, trees.get_full)
    app.router.add_put(full_path, trees.put_full)
    app.router.add_patch(full_path, trees.put_full)
    app.router.add_delete(full_path, trees.delete_full)
    return app


class AccessCheck:
    """Middleware that forwards or refuses requests.

    Args:
        token: token that every request must carry; None if only this machine can connect.
        report: prints an internal error of the gateway.
    """

    def __init__(self, token: str | None, report: Callable[[str], None]) -> None:
        self._token = token
        self._report = report
        self._limit = RateLimit(1 / HTTP_RATE_HZ, HTTP_BURST)

    def is_token(self, received: str) -> bool:
        return self._token is None or tokens_match(received, self._token)

    @web.middleware
    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests above the rate limit, without the token or, if no token is set, from other servers' pages."""
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
            kind, _, token = request.headers.get("Authorization", "").partition(" ")
            if not self.is_token(token.strip() if kind.lower() == "bearer" else request.query.get(TOKEN, "")):
                raise MissingTokenError("no token, or a wrong one; send Authorization: Bearer TOKEN, or ?token=TOKEN")
            if self._token is None and not _is_from_this_machine(request):
                raise ForbiddenError("pages of another server need a token; start the gateway with one, and send it")
            return await handler(request)
        except ZsimError as error:
            status = next(status for kind, status in STATUS if isinstance(error, kind))
            return error_response(status, str(error), error.allowed if isinstance(error, MethodError) else ())
        except web.HTTPException as error:
            allowed = error.allowed_methods if isinstance(error, web.HTTPMethodNotAllowed) else ()
            text = " ".join((error.text or error.reason).split())
            return error_response(error.status, f"{request.method} {request.path[:80]}: {text}", sorted(allowed))
        except ConnectionError:
            raise
        except Exception as error:  # an internal error: the gateway continues
            if isinstance(error, RuntimeError) and request.transport is None:  # raised by aiohttp for a truncated body
                raise ConnectionResetError("the client is gone") from error
            self._report(f"{request.method} {request.path[:80]}: {error!r}")
            return error_response(500, f"the gateway failed ({type(error).__name__}); its terminal shows the error")


def error_response(status: int, text: str, allowed: Iterable[str] = ()) -> web.Response:
    """Return a response with an error and, if given, the methods that the key allows."""
    headers = {"Allow": ", ".join(allowed)} if allowed else None
    return web.Response(status=status, body=_encode({"error": text}), content_type="application/json", headers=headers)


def _is_from_this_machine(request: web.Request) -> bool:
    """Return whether a request is from a program on this machine and, by its origin, not from another server's page.

    A server on another port of this machine is another server, so its pages are not trusted. The Host header must be
    checked too, since another site can make its own name resolve to this machine.
    """
    origin = request.headers.get("Origin")  # "null" for a sandboxed frame, which any page can create
    try:
        is_own = origin is None or urlsplit(origin).netloc == request.host
        return is_own and is_loopback_authority(request.host)
    except ValueError:
        return False


@dataclass(frozen=True)
class KeyTrees:
    """Handlers for the trees of full keys, of JSON, and of camera pictures."""

    run: Callable[[], RunAccess]  # returns the current run
    full_subscriptions: SharedSubscriptions  # subscriptions to full keys
    subscriptions: SharedSubscriptions  # subscriptions to keys without the federation's name
    feeds: PictureFeeds
    limit: ClientLimit  # bounds the number of clients; each stream of pictures is one client
    source: str  # source of control requests that name none

    async def get_full(self, request: web.Request) -> web.StreamResponse:
        """Answer a GET or a POST on a full key."""
        expression, accepted = _key_of(request, "/"), _first_accepted(request)
        if any(part.startswith("@") for part in expression.split("/")):  # wildcards match no such parts
            raise ForbiddenError(
                f"{expression[:80]}: Zenoh's own keys are not shown; must be keys without @, such as zsim/**"
            )
        if accepted == EVENT_STREAM:
            return await stream_events(request, self.full_subscriptions, expression, _sample_event)
        samples = await self._query(request, expression)
        if RAW in request.query:
            if not samples:
                return web.Response()
            return web.Response(body=samples[0].payload, headers={"Content-Type": samples[0].encoding})
        if accepted == "text/html":
            texts = ((sample.key or "ERROR", sample.payload.decode(errors="replace")) for sample in samples)
            items = "\n".join(f"<dt>{html.escape(key)}</dt>\n<dd>{html.escape(text)}</dd>\n" for key, text in texts)
            return web.Response(text=f"<dl>\n{items}\n</dl>\n", content_type="text/html")
        return web.json_response([sample_to_json(sample) for sample in samples])

    async def _query(self, request: web.Request, expression: str) -> list[RawSample]:
        body, run = await request.read(), self.run()
        stored = [] if body else run.last_samples(expression)
        if stored and "*" not in expression:
            return stored
        # The query string may contain the gateway's token besides Zenoh's parameters.
        parts = [part for part in request.query_string.split("&") if part.partition("=")[0] not in (TOKEN, "")]
        answers = await run.query(expression, ";".join(parts), body, _encoding_of(request))
        stored_keys = {sample.key for sample in stored}
        return [*stored, *(answer for answer in answers if answer.kind == "ERROR" or answer.key not in stored_keys)]

    async def put_full(self, request: web.Request) -> web.Response:
        key, body = _key_of(request, "/"), await request.read()
        self.run().put_full_key(key, body, _encoding_of(request))
        return web.Response()

    async def delete_full(self, request: web.Request) -> web.Response:
        self.run().delete_full_key(_key_of(request, "/"))
        return web.Response()

    async def get_json(self, request: web.Request) -> web.StreamResponse:
        """Answer with the last values, or with every value from now on."""
        expression = _checked_key(request)
        if _first_accepted(request) == EVENT_STREAM:
            return await stream_events(request, self.subscriptions, expression, value_event)
        values = self.run().values
        entries = [json_entry(key, payload, values.encoding(key)) for key, payload in values.matching(expression)]
        if "*" in expression:
            return _json_response(entries)
        return _json_response(entries[0]["value"]) if entries else error_response(404, f"{expression[:80]}: {NO_VALUE}")

    async def put_json(self, request: web.Request) -> web.Response:
        key, body = _checked_key(request), await request.read()
        try:
            value = msgspec.json.decode(body)
        except REFUSALS as error:
            raise DecodeError(f"{key[:80]}: {error}; must be JSON") from error
        run = self.run()
        run.put(key, value, run.defaults)
        return _json_response({})

    async def post_json(self, request: web.Request) -> web.Response:
        """Send a control request to the process that answers on a key."""
        key = _checked_key(request)
        try:
            control = _control_request(await request.read())
        except REFUSALS as error:
            raise DecodeError(f"{key[:80]}: {error}; must be a JSON object with op and args") from error
        answer = await self.run().request(key, control.op, control.args, control.source or self.source)
        return _json_response({"ok": answer.ok, "error": answer.error, "result": json_value(answer.result)})

    async def get_pictures(self, request: web.Request) -> web.StreamResponse:
        """Answer with all pictures from now on, or with only the newest one if the path ends with `.jpg`."""
        camera = request.match_info["camera"]
        key = self.run().camera_key(request.match_info["drone"], camera.removesuffix(JPEG_SUFFIX))
        self.limit.enter()
        try:
            with self.feeds.watched(key) as feed:
                if not camera.endswith(JPEG_SUFFIX):
                    return await stream_pictures(request, feed)
                picture = feed.newest or await feed.wait_after(-1, PICTURE_TIMEOUT_S)
        finally:
            self.limit.leave()
        if picture is None:
            return error_response(404, f"{key}: {NO_PICTURE}")
        headers = {**PICTURE_HEADERS, "X-Timestamp": exposure_s(picture.image)}
        return web.Response(body=picture.image.data, content_type="image/jpeg", headers=headers)


def methods_of(key: str) -> tuple[str, ...]:
    """Return a key's methods: POST for control keys, GET for reserved ones; else GET, PUT and, for own keys, POST."""
    if is_control_key(key):
        return ("POST",)
    if is_reserved(key):
        return ("GET",)
    return ("GET", "PUT") if messages.type_of(key) else ("GET", "PUT", "POST")


# Requests


def _key_of(request: web.Request, prefix: str) -> str:
    """Return the key expression in a path, or raise a DecodeError."""
    try:
        key = unquote(request.raw_path.partition("?")[0], errors="strict").removeprefix(prefix)
    except UnicodeDecodeError as error:
        raise DecodeError(f"path is {request.raw_path[:80]!r}; must be UTF-8, percent-encoded") from error
    if not key:
        raise DecodeError("path has no key expression; must have one, e.g. /zsim/world/info or /json/world/info")
    return key


def _checked_key(request: web.Request) -> str:
    """Return the key of a request, or raise a MethodError if the key does not support its method."""
    key = _key_of(request, JSON_PREFIX)
    check_expression(key)
    allowed = methods_of(key)
    if request.method not in allowed:
        raise MethodError(
            f"{key[:80]}: {request.method} is not a method of this key; must be {' or '.join(allowed)}", allowed
        )
    return key


def _encoding_of(request: web.Request) -> str:
    """Return the Zenoh encoding of a body, or raise a DecodeError."""
    kind = request.headers.get("Content-Type") or BYTES
    if not (kind.isascii() and kind.isprintable()):
        raise DecodeError(f"Content-Type is {kind[:80]!a}; must be ASCII, e.g. application/json")
    return kind


def _first_accepted(request: web.Request) -> str:
    """Return the first accepted media type; like the plugin, ignore the others."""
    return request.headers.get("Accept", "application/json").split(",")[0].split(";")[0].strip()


# Responses


def sample_to_json(sample: RawSample) -> dict[str, Any]:
    """Return an answer or a publication in the plugin's JSON format."""
    kind, payload = sample.encoding.partition(";")[0], sample.payload
    value: Any = base64.b64encode(payload).decode() if payload else None  # unless its encoding is JSON or text
    try:
        if payload and kind in JSON:
            value = json.loads(payload)
        elif payload and kind in TEXT:
            value = payload.decode()
    except (ValueError, RecursionError):
        pass
    key = "ERROR" if sample.kind == "ERROR" else sample.key
    return {"key": key, "value": value, "encoding": sample.encoding, "timestamp": sample.timestamp}


@lru_cache(maxsize=CACHED_VALUES)
def _sample_event(sample: RawSample) -> bytes:
    return _event(sample.kind, json.dumps(sample_to_json(sample)).encode())


@lru_cache(maxsize=CACHED_VALUES)
def value_event(sample: RawSample) -> bytes:
    """Return a publication as a server-sent event; empty for an invalid message."""
    deleted = {"key": sample.key, "value": None}
    try:
        value = json_entry(sample.key, sample.payload, sample.encoding) if sample.payload else deleted
    except DecodeError:
        return b""
    return _event(sample.kind, _encode(value))


def _event(kind: str, data: bytes) -> bytes:
    return b"event: %b\ndata: %b\n\n" % (kind.encode(), data)


def _json_response(value: Any) -> web.Response:
    return web.Response(body=_encode(value), content_type="application/json")


@cache
def description() -> dict[str, Any]:
    """Return the OpenAPI 3.1 description of this server, derived from the messages' schemas."""
    shapes = messages.types_by_shape()
    kinds = dict.fromkeys([*shapes.values(), ControlRequest, ControlAnswer])
    _, components = msgspec.json.schema_components(list(kinds), ref_template=_REF)
    schemas = _without_prefix_items(components)
    paths: dict[str, Any] = {}
    for shape, kind in shapes.items():
        name, parts = kind.__name__, shape.split("/")
        names = [parts[i - 1] for i, part in enumerate(parts) if part == "*"]
        path = "/".join(f"{{{parts[i - 1]}}}" if part == "*" else part for i, part in enumerate(parts))
        get = {
            "summary": f"The last {name}, or with Accept: text/event-stream each one from now on",
            "description": kind.__doc__ or "",
            "responses": _responses(_json_content({"$ref": _REF.format(name=name)})),
        }
        paths[f"{JSON_PREFIX}{path}"] = item = {"parameters": [_name_parameter(each) for each in names], "get": get}
        if is_client_key(shape.replace("*", "any")):
            # Fields that the gateway fills in are optional for clients.
            required = [field for field in schemas[name]["required"] if field not in DEFAULTED_FIELDS]
            schemas[f"{name}Sent"] = {**schemas[name], "required": required}
            item["put"] = {
                "summary": f"Publish a {name}; {', '.join(DEFAULTED_FIELDS)} may be left out",
                "requestBody": {"required": True, **_json_content({"$ref": _REF.format(name=f"{name}Sent")})},
                "responses": _responses(text="published"),
            }
    refusal = {"type": "object", "properties": {"error": {"type": "string"}}, "required": ["error"]}
    return {
        "openapi": "3.1.0",
        "info": {"title": "zsim gateway", "version": __version__, "description": "See docs/gateway.md."},
        "servers": [{"url": "."}],  # relative to this description, so that it is valid behind a proxy under any path
        "paths": {**paths, **_other_paths()},
        "components": {
            "schemas": {**schemas, "Refusal": refusal},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _without_prefix_items(schema: Any) -> Any:
    """Return a schema with vectors as arrays of one item type, since few tools support `prefixItems`."""
    if isinstance(schema, list):
        return [_without_prefix_items(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    parts = {name: _without_prefix_items(part) for name, part in schema.items()}
    if "prefixItems" in parts:
        parts["items"] = parts.pop("prefixItems")[0]
    return parts


def _other_paths() -> dict[str, Any]:
    """Return the paths of control requests, clients' own keys, pictures, and full keys."""
    paths: dict[str, Any] = {}
    for key in CONTROL_PATHS:
        post = {
            "summary": "Send a control request; the answer says whether it was done",
            "requestBody": {"required": True, **_json_content({"$ref": _REF.format(name="ControlRequest")})},
            "responses": _responses(_json_content({"$ref": _REF.format(name="ControlAnswer")})),
        }
        paths[f"{JSON_PREFIX}{key}"] = {
            "parameters": [_name_parameter(name) for name in ("drone", "cluster") if f"{{{name}}}" in key],
            "post": post,
        }

    any_value = {"description": "a value, or for an expression a list of keys and values"}
    paths[f"{JSON_PREFIX}{{key}}"] = {
        "parameters": [_parameter("key", _OWN_KEY)],
        "get": {"summary": "The last value", "responses": _responses(_json_content(any_value))},
        "put": {
            "summary": "Publish any JSON on a key of your own",
            "requestBody": {"required": True, **_json_content({})},
            "responses": _responses(text="published"),
        },
    }

    binary = {"schema": {"type": "string", "format": "binary"}}
    camera = _parameter("camera", {"type": "string", "enum": list(CAMERAS)})
    for suffix, kind, text in (
        ("", "multipart/x-mixed-replace", "The pictures of a camera from now on"),
        (JPEG_SUFFIX, "image/jpeg", "The newest picture of a camera"),
    ):
        get = {"summary": text, "responses": _responses({"content": {kind: binary}}, "JPEG")}
        paths[f"/camera/{{drone}}/{{camera}}{suffix}"] = {"parameters": [_name_parameter("drone"), camera], "get": get}

    entry = {
        "type": "object",
        "required": ["key", "value", "encoding", "timestamp"],
        "properties": {
            "key": {"type": "string"},
            "value": {"description": "base64, unless the encoding is JSON or text"},
            "encoding": {"type": "string"},
            "timestamp": {"type": ["string", "null"]},
        },
    }
    answered, done = _responses(_json_content({"type": "array", "items": entry})), _responses(text="done")
    body = {"content": {"*/*": binary}}
    examples = {"federation": "zsim", "key": "world/info"}
    paths["/{federation}/{key}"] = {
        "parameters": [{**_parameter(name, _OWN_KEY), "example": example} for name, example in examples.items()],
        "get": {"summary": "Query", "responses": answered},
        "post": {"summary": "Query with a payload", "requestBody": body, "responses": answered},
        "put": {"summary": "Publish", "requestBody": body, "responses": done},
        "patch": {"summary": "Publish", "requestBody": body, "responses": done},
        "delete": {"summary": "Delete", "responses": done},
    }
    return paths


def _parameter(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "in": "path", "required": True, "schema": schema}


def _name_parameter(kind: str) -> dict[str, Any]:
    """Return the path parameter with the name of a process, a drone or a cluster."""
    length_max = 48 if kind in ("process", "estimates") else 32
    return _parameter(kind, {"type": "string", "pattern": f"^[a-z0-9_.-]{{1,{length_max}}}$"})


def _json_content(schema: dict[str, Any]) -> dict[str, Any]:
    return {"content": {"application/json": {"schema": schema}}}


def _responses(content: dict[str, Any] | None = None, text: str = "answered") -> dict[str, Any]:
    """Return the responses of an operation: its answer, and the errors."""
    errors = _json_content({"$ref": _REF.format(name="Refusal")})
    refusals = {str(status): {"description": text, **errors} for status, text in _ERRORS.items()}
    return {"200": {"description": text, **(content or {})}, **refusals}
