"""The routes of the gateway's HTTP server, and their OpenAPI 3.1 description, made from the messages' schemas."""

from collections.abc import Awaitable, Callable
from functools import cache
from typing import Any

import msgspec
from aiohttp import web

from zsim import __version__
from zsim.contract import messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.sensors.camera import CAMERAS
from zsim_bridges.gateway.access_check import AccessCheck
from zsim_bridges.gateway.client_messages import is_client_key
from zsim_bridges.gateway.client_streams import LINE_MAX, ClientFactory, serve_websocket
from zsim_bridges.gateway.http_trees import JSON_PREFIX, ONE_PICTURE, CameraTree, JsonTree, RestTree

DEFAULTED = ("t_ns", "seq", "source")  # fields that a client may leave out
CONTROL_PATHS = ("world/control", "cluster/{cluster}/control")
_REF = "#/components/schemas/{name}"
_OWN_KEY = "^[A-Za-z0-9_.-]{1,64}$"  # of a client's own key; Zenoh takes more
_ERRORS = {
    400: "an invalid key or value",
    401: "no token, or a wrong one",
    403: "a reserved key, or a page of another server",
    404: "no such drone or cluster, or no value yet",
    405: "a method that this key does not have",
    408: "a request that did not come whole in its time",
    413: "a body that is too long",
    429: "too many requests",
    503: "there is no run now",
}


@cache
def description() -> dict[str, Any]:
    """Return the document."""
    shapes = messages.types_by_shape()
    kinds = dict.fromkeys([*shapes.values(), ControlRequest, ControlAnswer])
    _, components = msgspec.json.schema_components(list(kinds), ref_template=_REF)
    schemas = _without_prefix_items(components)
    refusal = {"type": "object", "properties": {"error": {"type": "string"}}, "required": ["error"]}
    paths = {path: item for shape, kind in shapes.items() for path, item in [_value_path(shape, kind)]}
    return {
        "openapi": "3.1.0",
        "info": {"title": "zsim gateway", "version": __version__, "description": "See docs/gateway.md."},
        "servers": [{"url": "."}],  # beside this description, below whatever path a proxy has it
        "paths": {
            **paths,
            **dict(map(_control_path, CONTROL_PATHS)),
            **_own_key_path(),
            **_camera_paths(),
            **_zenoh_path(),
        },
        "components": {
            "schemas": {**schemas, **_sent_schemas(shapes, schemas), "Refusal": refusal},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _without_prefix_items(schema: Any) -> Any:
    """Return a schema with vectors as arrays of one kind of entry: fewer tools know `prefixItems`."""
    if isinstance(schema, list):
        return [_without_prefix_items(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    parts = {name: _without_prefix_items(part) for name, part in schema.items()}
    if "prefixItems" in parts:
        parts["items"] = parts.pop("prefixItems")[0]
    return parts


def _value_path(shape: str, kind: type[msgspec.Struct]) -> tuple[str, dict[str, Any]]:
    path, parameters = _path(shape)
    item: dict[str, Any] = {"parameters": parameters, "get": _get_operation(kind.__name__, kind.__doc__ or "")}
    if is_client_key(shape.replace("*", "any")):
        item["put"] = {
            "summary": f"Publish a {kind.__name__}; {', '.join(DEFAULTED)} may be left out",
            "requestBody": _request_body(f"{kind.__name__}Sent"),
            "responses": {"200": {"description": "published"}, **_error_responses()},
        }
    return f"/json/{path}", item


def _path(shape: str) -> tuple[str, list[dict[str, Any]]]:
    """Return the path of a key's shape, and its parameters."""
    parts = shape.split("/")
    names = [parts[i - 1] for i, part in enumerate(parts) if part == "*"]
    path = "/".join(f"{{{parts[i - 1]}}}" if part == "*" else part for i, part in enumerate(parts))
    return path, [_parameter(name) for name in names]


def _parameter(name: str) -> dict[str, Any]:
    length_max = 48 if name in ("process", "estimates") else 32  # of a process's name, or of a drone's or cluster's
    schema = {"type": "string", "pattern": f"^[a-z0-9_.-]{{1,{length_max}}}$"}
    return {"name": name, "in": "path", "required": True, "schema": schema}


def _get_operation(kind: str, text: str) -> dict[str, Any]:
    return {
        "summary": f"The last {kind}, or with Accept: text/event-stream every one from now on",
        "description": text,
        "responses": {
            "200": _response({"$ref": _REF.format(name=kind)}),
            **_error_responses(),
        },
    }


def _control_path(key: str) -> tuple[str, dict[str, Any]]:
    parameters = [_parameter("cluster")] if "{cluster}" in key else []
    post = {
        "summary": "Send a control request; the answer says whether it was done",
        "requestBody": _request_body("ControlRequest"),
        "responses": {"200": _response({"$ref": _REF.format(name="ControlAnswer")}), **_error_responses()},
    }
    return f"/json/{key}", {"parameters": parameters, "post": post}


def _own_key_path() -> dict[str, Any]:
    """Return the path of clients' own keys."""
    key = {"name": "key", "in": "path", "required": True, "schema": {"type": "string", "pattern": _OWN_KEY}}
    anything = {"description": "a value, or of an expression a list of key and value"}
    return {
        "/json/{key}": {
            "parameters": [key],
            "get": {"summary": "The last value", "responses": {"200": _response(anything), **_error_responses()}},
            "put": {
                "summary": "Publish any JSON on a key of one's own",
                "requestBody": {"required": True, "content": {"application/json": {"schema": {}}}},
                "responses": {"200": {"description": "published"}, **_error_responses()},
            },
        }
    }


def _camera_paths() -> dict[str, Any]:
    """Return the paths of the pictures of cameras."""
    camera = {"name": "camera", "in": "path", "required": True, "schema": {"type": "string", "enum": list(CAMERAS)}}
    texts = {"": "The pictures of a camera from now on", ONE_PICTURE: "The newest picture of a camera"}
    kinds = {"": "multipart/x-mixed-replace", ONE_PICTURE: "image/jpeg"}
    picture = {"schema": {"type": "string", "format": "binary"}}
    return {
        f"/camera/{{drone}}/{{camera}}{end}": {
            "parameters": [_parameter("drone"), camera],
            "get": {
                "summary": text,
                "responses": {
                    "200": {"description": "JPEG", "content": {kinds[end]: picture}},
                    **_error_responses(),
                },
            },
        }
        for end, text in texts.items()
    }


def _zenoh_path() -> dict[str, Any]:
    """Return the path of full keys, as Zenoh's REST plugin has it."""
    examples = {"federation": "zsim", "key": "world/info"}
    parameters = [
        {
            "name": name,
            "in": "path",
            "required": True,
            "schema": {"type": "string", "pattern": _OWN_KEY},
            "example": example,
        }
        for name, example in examples.items()
    ]
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
    response = {"200": _response({"type": "array", "items": entry}), **_error_responses()}
    done = {"200": {"description": "done"}, **_error_responses()}
    body = {"content": {"*/*": {"schema": {"type": "string", "format": "binary"}}}}
    return {
        "/{federation}/{key}": {
            "parameters": parameters,
            "get": {"summary": "Query", "responses": response},
            "post": {"summary": "Query with a payload", "requestBody": body, "responses": response},
            "put": {"summary": "Publish", "requestBody": body, "responses": done},
            "patch": {"summary": "Publish", "requestBody": body, "responses": done},
            "delete": {"summary": "Delete", "responses": done},
        }
    }


def _sent_schemas(shapes: dict[str, type[msgspec.Struct]], schemas: dict[str, Any]) -> dict[str, Any]:
    """Return the schemas of messages that clients send: fields that are filled in are not required."""
    kinds = [kind.__name__ for shape, kind in shapes.items() if is_client_key(shape.replace("*", "any"))]
    return {
        f"{kind}Sent": {
            **schemas[kind],
            "required": [name for name in schemas[kind]["required"] if name not in DEFAULTED],
        }
        for kind in kinds
    }


def _request_body(schema: str) -> dict[str, Any]:
    return {"required": True, "content": {"application/json": {"schema": {"$ref": _REF.format(name=schema)}}}}


def _response(schema: dict[str, Any], text: str = "answered") -> dict[str, Any]:
    return {"description": text, "content": {"application/json": {"schema": schema}}}


def _error_responses() -> dict[str, Any]:
    schema = {"$ref": _REF.format(name="Refusal")}
    return {str(status): _response(schema, text) for status, text in _ERRORS.items()}


STREAM, DESCRIPTION, CAMERA = "/stream", "/openapi.json", "/camera/{drone}/{camera}"
TREE = {"GET": "get", "POST": "get", "PUT": "put", "PATCH": "put", "DELETE": "delete"}


def application(
    access_check: AccessCheck, rest: RestTree, tree: JsonTree, cameras: CameraTree, new_client: ClientFactory
) -> web.Application:
    """Return the web application of a gateway.

    Args:
        access_check: of requests.
        rest: of full keys.
        tree: of JSON.
        cameras: of pictures.
        new_client: makes the client of a WebSocket.
    """
    app = web.Application(middlewares=[access_check.check], client_max_size=LINE_MAX)
    app.router.add_get("/", _index)
    app.router.add_get(DESCRIPTION, _describe)
    app.router.add_get(STREAM, lambda request: serve_websocket(request, new_client))
    for method in ("get", "put", "post"):
        app.router.add_route(method.upper(), f"{JSON_PREFIX}{{key:.*}}", getattr(tree, method))
    app.router.add_route("*", f"{JSON_PREFIX}{{key:.*}}", _method_not_allowed("GET", "POST", "PUT"))
    app.router.add_get(CAMERA, cameras.get, allow_head=False)
    for path in (STREAM, DESCRIPTION, CAMERA):
        app.router.add_route("*", path, _method_not_allowed("GET"))
    for method, handler in TREE.items():
        app.router.add_route(method, "/{key:.*}", getattr(rest, handler))
    return app


async def _index(request: web.Request) -> web.Response:
    cameras = {"camera": "/camera/DRONE/CAMERA", "picture": f"/camera/DRONE/CAMERA{ONE_PICTURE}"}
    paths = {"description": DESCRIPTION, "json": JSON_PREFIX, "stream": STREAM, **cameras, "zenoh": "/FEDERATION/KEY"}
    return web.json_response({"zsim": "gateway", **paths})


async def _describe(request: web.Request) -> web.Response:
    return web.json_response(description())


def _method_not_allowed(*allowed: str) -> Callable[[web.Request], Awaitable[web.StreamResponse]]:
    """Return a handler that refuses all other methods of a path."""

    async def refuse(request: web.Request) -> web.StreamResponse:
        raise web.HTTPMethodNotAllowed(request.method, allowed)

    return refuse
