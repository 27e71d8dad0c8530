"""The OpenAPI 3.1 description of the gateway's HTTP server, made from the messages' schemas."""

from functools import cache
from typing import Any

import msgspec

from zsim import __version__
from zsim.contract import messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.sensors.camera import CAMERAS
from zsim_bridges.gateway.client_messages import is_client_key

JSON_PREFIX = "/json/"
ONE_PICTURE = ".jpg"  # end of the path of a single picture
DEFAULTED = ("t_ns", "seq", "source")  # fields that a client may leave out
CONTROL_PATHS = ("world/control", "cluster/{cluster}/control", "drone/{drone}/control")
_REF = "#/components/schemas/{name}"
_OWN_KEY = {"type": "string", "pattern": "^[A-Za-z0-9_.-]{1,64}$"}  # of a client's own key; Zenoh takes more
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
    paths: dict[str, Any] = {}
    for shape, kind in shapes.items():
        name, parts = kind.__name__, shape.split("/")
        names = [parts[i - 1] for i, part in enumerate(parts) if part == "*"]
        path = "/".join(f"{{{parts[i - 1]}}}" if part == "*" else part for i, part in enumerate(parts))
        get = {
            "summary": f"The last {name}, or with Accept: text/event-stream every one from now on",
            "description": kind.__doc__ or "",
            "responses": _responses(_json({"$ref": _REF.format(name=name)})),
        }
        paths[f"{JSON_PREFIX}{path}"] = item = {"parameters": [_named(each) for each in names], "get": get}
        if is_client_key(shape.replace("*", "any")):
            # Fields that are filled in are not required of what clients send.
            required = [field for field in schemas[name]["required"] if field not in DEFAULTED]
            schemas[f"{name}Sent"] = {**schemas[name], "required": required}
            item["put"] = {
                "summary": f"Publish a {name}; {', '.join(DEFAULTED)} may be left out",
                "requestBody": {"required": True, **_json({"$ref": _REF.format(name=f"{name}Sent")})},
                "responses": _responses(text="published"),
            }
    refusal = {"type": "object", "properties": {"error": {"type": "string"}}, "required": ["error"]}
    return {
        "openapi": "3.1.0",
        "info": {"title": "zsim gateway", "version": __version__, "description": "See docs/gateway.md."},
        "servers": [{"url": "."}],  # beside this description, below whatever path a proxy has it
        "paths": {**paths, **_other_paths()},
        "components": {
            "schemas": {**schemas, "Refusal": refusal},
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


def _other_paths() -> dict[str, Any]:
    """Return the paths of control requests, clients' own keys, pictures, and full keys."""
    paths: dict[str, Any] = {}
    for key in CONTROL_PATHS:
        post = {
            "summary": "Send a control request; the answer says whether it was done",
            "requestBody": {"required": True, **_json({"$ref": _REF.format(name="ControlRequest")})},
            "responses": _responses(_json({"$ref": _REF.format(name="ControlAnswer")})),
        }
        paths[f"{JSON_PREFIX}{key}"] = {
            "parameters": [_named("cluster")] if "{cluster}" in key else [],
            "post": post,
        }

    anything = {"description": "a value, or of an expression a list of key and value"}
    paths[f"{JSON_PREFIX}{{key}}"] = {
        "parameters": [_parameter("key", _OWN_KEY)],
        "get": {"summary": "The last value", "responses": _responses(_json(anything))},
        "put": {
            "summary": "Publish any JSON on a key of one's own",
            "requestBody": {"required": True, **_json({})},
            "responses": _responses(text="published"),
        },
    }

    binary = {"schema": {"type": "string", "format": "binary"}}
    camera = _parameter("camera", {"type": "string", "enum": list(CAMERAS)})
    for end, kind, text in (
        ("", "multipart/x-mixed-replace", "The pictures of a camera from now on"),
        (ONE_PICTURE, "image/jpeg", "The newest picture of a camera"),
    ):
        get = {"summary": text, "responses": _responses({"content": {kind: binary}}, "JPEG")}
        paths[f"/camera/{{drone}}/{{camera}}{end}"] = {"parameters": [_named("drone"), camera], "get": get}

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
    answered, done = _responses(_json({"type": "array", "items": entry})), _responses(text="done")
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


def _named(kind: str) -> dict[str, Any]:
    """Return the parameter of the name of a process, a drone, a cluster."""
    length_max = 48 if kind in ("process", "estimates") else 32
    return _parameter(kind, {"type": "string", "pattern": f"^[a-z0-9_.-]{{1,{length_max}}}$"})


def _json(schema: dict[str, Any]) -> dict[str, Any]:
    return {"content": {"application/json": {"schema": schema}}}


def _responses(content: dict[str, Any] | None = None, text: str = "answered") -> dict[str, Any]:
    """Return the responses of an operation: what it answers, and the errors."""
    errors = _json({"$ref": _REF.format(name="Refusal")})
    refusals = {str(status): {"description": text, **errors} for status, text in _ERRORS.items()}
    return {"200": {"description": text, **(content or {})}, **refusals}
