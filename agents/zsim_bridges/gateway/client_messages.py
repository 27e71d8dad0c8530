"""The messages of the gateway's clients: errors, limits, permitted keys, defaults, JSON, stream requests. No I/O.

A stream carries one request per line, each a JSON object:
{"op": "put", "key": "drone/drone1/cmd/velocity", "value": {"velocity_m_s": [1, 0, 0]}, "id": 7}
"""

import base64
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Annotated, Any, Union

import msgspec
from msgspec import Meta, Struct

from zsim.contract import keys, messages
from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError, ZsimError
from zsim.runtime.rate_limit import RateLimit
from zsim.transport.session import RawSample

COUNTED_KEYS = (
    keys.command("*", "*"),
    keys.estimate("*"),
    keys.cluster_state("*"),
)  # keys whose messages are counted in the field `sent` of a `done`
CAMERA_KEYS = (keys.camera("*", "*"), keys.camera_info("*", "*"), keys.detections("*"))
"""Keys of clients' own cameras, renderers and detectors."""
CLIENT_KEYS = (*COUNTED_KEYS, keys.cluster_view("*"), keys.estimates_view("*"), *CAMERA_KEYS)
"""Keys of the contract on which clients publish."""
CONTROL_KEYS = (keys.CONTROL, keys.cluster_control("*"), keys.drone_control("*"))  # keys that accept requests
RESERVED_KEYS = (
    "world/**",
    keys.CLOCK,
    "process/**",
    keys.VIEW_DRONES,
    "drone/*/sensor/**",
    keys.truth("*"),
    keys.accepted("*", "*"),
    keys.link("*"),
    keys.driver("*"),
    *CONTROL_KEYS[1:],
    keys.cluster_request("*"),
    keys.drone_request("*"),
    keys.reference("*"),
)
"""Keys on which only the world, or a process in its own name, publishes: a client's message would impersonate it.

Only operators can arm drivers, and only over Zenoh.
"""
CACHED_VALUES = 256  # number of values kept as JSON, so that a value sent to many clients is encoded once
INTEGER_MAX = 2.0**63  # a double of this magnitude or more does not fit into a 64-bit integer
JSON = ("application/json", "text/json", "text/json5")
TEXT = ("text/plain", "zenoh/string")
_to_json = msgspec.json.Encoder().encode


class ForbiddenError(ZsimError):
    """A key or a page that the client may not use."""


class TooManyError(ZsimError):
    """More requests, clients or subscriptions than the gateway accepts at once."""


class UnknownError(ZsimError):
    """A drone, cluster or camera that the run does not have, or an invalid process name."""


class MethodError(ZsimError):
    """An HTTP method that a key does not support; `allowed` lists those that it does."""

    def __init__(self, text: str, allowed: tuple[str, ...]) -> None:
        super().__init__(text)
        self.allowed = allowed


def count_request(limit: RateLimit, address: str = "") -> None:
    """Count a request from an address, or raise a TooManyError that says how long to wait."""
    if not limit.spend(address):
        wait_s = limit.wait(address)
        raise TooManyError(f"more than {1 / limit.period:g} requests a second; wait {wait_s:.3f} s")


class ClientLimit:
    """Bounds the number of concurrent clients."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._count = 0

    def enter(self) -> None:
        """Count one more client, or raise a TooManyError."""
        if self._count >= self._limit:
            raise TooManyError(f"there are {self._limit} clients already; try again later")
        self._count += 1

    def leave(self) -> None:
        self._count -= 1


# Keys


def is_counted_key(key: str) -> bool:
    """Return whether the messages on a key are counted in a `done`."""
    return _matches_any(COUNTED_KEYS, key)


def is_client_key(key: str) -> bool:
    """Return whether a key of the contract is one on which clients publish."""
    return _matches_any(CLIENT_KEYS, key)


def is_control_key(key: str) -> bool:
    """Return whether a key accepts requests."""
    return _matches_any(CONTROL_KEYS, key)


def is_reserved(key: str) -> bool:
    """Return whether clients may not publish on a key."""
    return _matches_any(RESERVED_KEYS, key) or key.startswith("@") or "/@" in key


def _matches_any(expressions: Sequence[str], key: str) -> bool:
    return any(keys.matches(expression, key) for expression in expressions)


def check_not_reserved(key: str) -> None:
    """Raise a DecodeError for an invalid key, and a ForbiddenError for a key on which clients may not publish."""
    if "*" in key or not key:
        raise DecodeError(f"{key[:80]!r}: is not a key; must be names separated by /")
    if is_reserved(key):
        raise ForbiddenError(
            f"{key[:80]}: only the world or the process of that name publishes here; a client may publish on "
            f"{', '.join(CLIENT_KEYS).replace('*', '…')} and keys of its own"
        )


class MessageDefaults:
    """Fills in the time stamps, sequence numbers and source of one client's messages; `source` is its process name."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._next_seq: Counter[str] = Counter()

    def fill(self, key: str, value: Any, now_ns: int) -> Any:
        """Return `value` with `t_ns` (now_ns), `seq` and `source` filled in where its message has these fields."""
        kind = messages.type_of(key)
        if kind is None or not isinstance(value, dict):
            return value
        defaults = {"t_ns": now_ns, "seq": self._next_seq[key], "source": self._source}
        if "seq" not in value:
            self._next_seq[key] += 1
        fields = messages.fields(kind)
        return {**{name: default for name, default in defaults.items() if name in fields}, **value}

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Roll back the sequence numbers if an error leaves this context, so that refused messages cause no gaps."""
        saved = self._next_seq.copy()
        try:
            yield
        except BaseException:
            self._next_seq = saved
            raise


# JSON


def is_valid(key: str, payload: bytes) -> bool:
    """Return whether a payload is a message of the contract for its key; on other keys, any payload is valid."""
    try:
        return messages.type_of(key) is None or messages.decode(key, payload) is not None
    except DecodeError:
        return False


def payload_to_json(key: str, payload: bytes, encoding: str = "") -> bytes:
    """Return a payload as JSON.

    A message of the contract is returned with all of its fields. On other keys, JSON, text and msgpack are converted to
    values, in which bytes become base64; any other payload becomes base64. `encoding` is Zenoh's, if known.

    Raises:
        DecodeError: the payload is not the message of the contract for its key.
    """
    if messages.type_of(key) is not None:
        return _to_json(messages.decode(key, payload))
    kind = encoding.partition(";")[0]
    value: Any
    try:
        if kind in JSON:
            value = msgspec.json.decode(payload)
        elif kind in TEXT:
            value = payload.decode()
        else:
            value = json_value(msgspec.msgpack.decode(payload))
    except REFUSALS:
        value = base64.b64encode(payload).decode()
    return _to_json(value)


def json_value(value: Any) -> Any:
    """Return a value if JSON can represent it, otherwise its msgpack encoding as base64."""
    try:
        _to_json(value)
    except REFUSALS:
        return base64.b64encode(msgspec.msgpack.encode(value)).decode()
    return value


def json_to_payload(key: str, value: Any) -> bytes:
    """Return plain data, as decoded from JSON, as the payload of a key.

    An integer field also accepts a number such as 20000000.0, as written by languages that have only doubles.

    Raises:
        DecodeError: the data is not a message of the key; on other keys, a number exceeds 64 bits.
    """
    if messages.type_of(key) is None:
        return _pack(key, value)
    if keys.is_picture(key) and isinstance(value, dict) and isinstance(value.get("data"), str):
        try:
            value = {**value, "data": base64.b64decode(value["data"], validate=True)}
        except ValueError as error:
            raise DecodeError(f"{key[:80]}: data is not base64 ({error}); must be a JPEG as base64") from error
    try:
        return messages.encode(messages.decode(key, _pack(key, value)))
    except DecodeError:
        try:
            value = _with_integers(value)
        except RecursionError as error:
            must = "must be the message of docs/protocol.md"
            raise DecodeError(f"{key[:80]}: lists are nested too deeply; {must}") from error
        return messages.encode(messages.decode(key, _pack(key, value)))


def _pack(key: str, value: Any) -> bytes:
    try:
        return msgspec.msgpack.encode(value)
    except REFUSALS as error:
        raise DecodeError(f"{key:.80}: {error}; must be JSON with 64-bit numbers") from error


def _with_integers(value: Any) -> Any:
    """Return a value with its whole-number floats converted to integers."""
    if isinstance(value, dict):
        return {name: _with_integers(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_with_integers(entry) for entry in value]
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < INTEGER_MAX else value


def json_entry(key: str, payload: bytes, encoding: str = "") -> dict[str, Any]:
    return {"key": key, "value": msgspec.Raw(payload_to_json(key, payload, encoding))}


@lru_cache(maxsize=CACHED_VALUES)
def value_line(sample: RawSample) -> bytes:
    """Return the line that sends a value to a client: null for a deleted key; an empty line for an invalid message."""
    try:
        value = payload_to_json(sample.key, sample.payload, sample.encoding) if sample.payload else b"null"
    except DecodeError:
        return b""
    return b'{"op":"value","key":%b,"value":%b}\n' % (_to_json(sample.key), value)


# Requests on a stream

Key = Annotated[str, Meta(max_length=1000)]
Keys = Annotated[list[Key], Meta(max_length=1000)]


class StreamRequest(Struct, tag_field="op", forbid_unknown_fields=True, kw_only=True):
    """Base of all requests; the answer repeats `id`."""

    id: int | str | None = None


class HelloRequest(StreamRequest, tag="hello"):
    """Gives the client's name, and the token if one is needed; the answer describes the run."""

    name: str = ""
    token: str = ""


class LatestRequest(StreamRequest, tag="latest"):
    """Requests the last value of a key, or of each key that an expression matches."""

    key: Key


class SubscribeRequest(StreamRequest, tag="subscribe"):
    """Requests every value on a key expression from now on."""

    key: Key


class UnsubscribeRequest(StreamRequest, tag="unsubscribe"):
    """Ends the subscription to a key expression."""

    key: Key


class PutRequest(StreamRequest, tag="put"):
    """Publishes a value on a key; if `quiet`, it is answered only when refused."""

    key: Key
    value: Any
    quiet: bool = False


class AskRequest(StreamRequest, tag="ask"):
    """Sends a control request to the process that answers on a key, such as world/control or cluster/NAME/control."""

    key: Key
    request: str
    args: dict[str, Any] = {}
    timeout_s: Annotated[float, Meta(gt=0, le=60)] = 5.0


class JoinRequest(StreamRequest, tag="join"):
    """Joins the lockstep: a `gate` is sent every `period_s`, and simulated time waits for the client's `done`.

    `period_s` is simulated time; `reads` are the key expressions whose messages are sent with each gate. A gate is
    complete once a message has arrived on each key of `gates`: by default, on the keys matched by `reads` that have a
    message at every gate, or else on `clock`.
    """

    name: str
    period_s: Annotated[float, Meta(gt=0, le=3600)]
    reads: Keys = []
    gates: Keys = []


class LockstepOutput(Struct, forbid_unknown_fields=True):
    """One output of a client at a gate."""

    key: Key
    value: Any


class DoneRequest(StreamRequest, tag="done"):
    """Answers the gate at `t_ns` with all outputs of the client."""

    t_ns: int
    outputs: list[LockstepOutput] = []


class LeaveRequest(StreamRequest, tag="leave"):
    """Leaves the lockstep."""

    reason: str = ""


_REQUESTS = (
    HelloRequest, LatestRequest, SubscribeRequest, UnsubscribeRequest, PutRequest, AskRequest, JoinRequest, DoneRequest,
    LeaveRequest,
)  # fmt: skip
_OPS = ", ".join(str(kind.__struct_config__.tag) for kind in _REQUESTS)
_decode = msgspec.json.Decoder(Union[_REQUESTS]).decode  # noqa: UP007 -- a union of a tuple


def decode_request(line: bytes) -> StreamRequest:
    """Return the request in a line, or raise a DecodeError."""
    try:
        return _decode(line)
    except REFUSALS as error:
        raise DecodeError(f"request: {error}; must be a JSON object whose op is one of {_OPS}") from error
