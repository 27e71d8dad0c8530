"""The same keys as JSON: /json/KEY without the federation's name, values by the schema of their message.

GET    /json/drone/drone1/sensor/imu      the last value; of an expression, a list of {key, value}
GET    … with Accept: text/event-stream   every value from now on
PUT    /json/drone/drone1/cmd/velocity    {"velocity_m_s": [1, 0, 0]}; t_ns, seq and source are filled in
POST   /json/world/control                {"op": "pause", "args": {}}
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import msgspec
from aiohttp import web

from zsim.contract import messages
from zsim.contract.messages import REFUSALS, ControlRequest
from zsim.errors import DecodeError
from zsim.transport.session import Heard, check_expression
from zsim_bridges.gateway.http.access_check import error_response
from zsim_bridges.gateway.http.event_stream import event_bytes, stream_events
from zsim_bridges.gateway.http.http_errors import MethodError
from zsim_bridges.gateway.http.zenoh_rest import first_accepted, key_of
from zsim_bridges.gateway.key_policy import is_control_key, is_reserved
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.gateway.subscriptions import SharedSubscriptions
from zsim_bridges.gateway.transcoding import CACHED_VALUES, json_entry, json_value

JSON_PREFIX = "/json/"
NO_VALUE = "no value yet; is the key right, and does somebody publish it?"
_encode = msgspec.json.Encoder().encode
_request = msgspec.json.Decoder(ControlRequest).decode


class JsonTree:
    """Handlers of the tree.

    Args:
        flight: returns the run that goes on.
        feed: of keys without the federation's name.
        source: in whose name commands go out that name no source.
    """

    def __init__(self, flight: Callable[[], RunAccess], feed: SharedSubscriptions, source: str) -> None:
        self._run = flight
        self._subscriptions = feed
        self._source = source

    async def get(self, request: web.Request) -> web.StreamResponse:
        """Answer with the last values, or with every value from now on."""
        expression = _checked_key(request)
        if first_accepted(request) == "text/event-stream":
            return await stream_events(request, self._subscriptions, expression, _event)
        values = self._run().values
        found = [json_entry(key, said, values.encoding(key)) for key, said in values.matching(expression)]
        if "*" in expression:
            return _json(found)
        return _json(found[0]["value"]) if found else error_response(404, f"{expression[:80]}: {NO_VALUE}")

    async def put(self, request: web.Request) -> web.Response:
        """Publish a value."""
        key = _checked_key(request)
        value, flight = _decode_body(key, await request.read()), self._run()
        flight.put(key, value, flight.defaults)
        return _json({})

    async def post(self, request: web.Request) -> web.Response:
        """Ask whoever answers on a key."""
        key = _checked_key(request)
        try:
            asked = _request(await request.read())
        except REFUSALS as error:
            raise DecodeError(f"{key[:80]}: {error}; must be a JSON object with op and args") from error
        answer = await self._run().request(key, asked.op, asked.args, asked.source or self._source)
        return _json({"ok": answer.ok, "error": answer.error, "result": json_value(answer.result)})


def _checked_key(request: web.Request) -> str:
    """Return the key of a request that may be made of it.

    Raises:
        SessionError: it is no key expression.
        MethodError: something else may be done with it.
    """
    key = key_of(request, JSON_PREFIX)
    check_expression(key)
    allowed = methods_of(key)
    if request.method not in allowed:
        raise MethodError(
            f"{key[:80]}: {request.method} is nothing for this key; must be {' or '.join(allowed)}", allowed
        )
    return key


def methods_of(key: str) -> tuple[str, ...]:
    """Return the HTTP methods of a key: requests go to some, on some only others speak, one's own take all."""
    if is_control_key(key):
        return ("POST",)
    if is_reserved(key):
        return ("GET",)
    return ("GET", "PUT") if messages.type_of(key) else ("GET", "PUT", "POST")


def _decode_body(key: str, body: bytes) -> Any:
    try:
        return msgspec.json.decode(body)
    except REFUSALS as error:
        raise DecodeError(f"{key[:80]}: {error}; must be JSON") from error


@lru_cache(maxsize=CACHED_VALUES)
def _event(heard: Heard) -> bytes:
    value = json_entry(heard.key, heard.payload, heard.encoding) if heard.payload else {"key": heard.key, "value": None}
    return event_bytes(heard.kind, _encode(value))


def _json(value: Any) -> web.Response:
    return web.Response(body=_encode(value), content_type="application/json")
