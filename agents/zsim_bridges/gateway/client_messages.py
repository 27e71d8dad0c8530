"""Messages of clients: on which keys they publish, what they may leave out, and their JSON. Pure.

Order of this file: errors, keys, defaults of messages, JSON.
"""

import base64
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import msgspec

from zsim.contract import keys, messages
from zsim.errors import DecodeError, ZsimError
from zsim.transport.session import RawSample

COUNTED_KEYS = (keys.command("*", "*"), keys.estimate("*"), keys.cluster_state("*"))  # contract: `sent` of a done
CAMERA_KEYS = (keys.camera("*", "*"), keys.camera_info("*", "*"), keys.detections("*"))
"""Of cameras, renderers and detectors of clients' own."""
CLIENT_KEYS = (*COUNTED_KEYS, keys.cluster_view("*"), keys.estimates_view("*"), *CAMERA_KEYS)
"""Keys of the contract on which clients publish."""
CONTROL_KEYS = (keys.CONTROL, keys.cluster_control("*"))  # requests go there
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
    CONTROL_KEYS[1],
    keys.cluster_request("*"),
)
"""Keys on which the world, or a process in its own name, publishes: a client's message would be taken for theirs.

A driver is asked to arm by operators on Zenoh alone.
"""
CACHED_VALUES = 256  # values; one goes to many clients, and is encoded once
INTEGER_MAX = 2.0**63  # a double above it is no integer of 64 bits
JSON = ("application/json", "text/json", "text/json5")
TEXT = ("text/plain", "zenoh/string")
_to_json = msgspec.json.Encoder().encode


class ForbiddenError(ZsimError):
    """A key or a page that the client may not use."""


class TooManyError(ZsimError):
    """More requests, clients or subscriptions than the gateway takes at once."""


class UnknownError(ZsimError):
    """A drone or a cluster that the run does not have."""


class MethodError(ZsimError):
    """An HTTP method that a key does not have.

    Args:
        text: of the error.
        allowed: HTTP methods that it has.
    """

    def __init__(self, text: str, allowed: tuple[str, ...]) -> None:
        super().__init__(text)
        self.allowed = allowed


def is_counted_key(key: str) -> bool:
    """Return whether a done counts the messages of a key."""
    return _matches_any(COUNTED_KEYS, key)


def is_client_key(key: str) -> bool:
    """Return whether a key is one of the contract's on which clients publish."""
    return _matches_any(CLIENT_KEYS, key)


def is_control_key(key: str) -> bool:
    """Return whether requests go to a key."""
    return _matches_any(CONTROL_KEYS, key)


def is_reserved(key: str) -> bool:
    """Return whether clients may not publish on a key."""
    return _matches_any(RESERVED_KEYS, key) or key.startswith("@") or "/@" in key


def check_not_reserved(key: str) -> None:
    """Refuse a key on which clients may not publish.

    Raises:
        DecodeError: it is no key.
        ForbiddenError: it is reserved.
    """
    if "*" in key or not key:
        raise DecodeError(f"{key[:80]!r}: is no key; must be names with / between them")
    if is_reserved(key):
        raise ForbiddenError(
            f"{key[:80]}: only the process that this is about writes here; a client may write on "
            f"{', '.join(CLIENT_KEYS).replace('*', '…')} and keys of its own"
        )


def check_shown(expression: str) -> None:
    """Refuse an expression of Zenoh's own keys: its sessions and routers, and who is connected to them.

    Wildcards do not match these; they have to be named.

    Raises:
        ForbiddenError: with what may be read.
    """
    if any(part.startswith("@") for part in expression.split("/")):
        raise ForbiddenError(f"{expression[:80]}: Zenoh's own keys are not shown; must be keys without @, as zsim/**")


def _matches_any(expressions: Sequence[str], key: str) -> bool:
    return any(keys.matches(expression, key) for expression in expressions)


class MessageDefaults:
    """Fills in time, sequence number and source of one client's messages.

    Args:
        source: name under which the client publishes.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self._next_seq: Counter[str] = Counter()

    def fill(self, key: str, value: Any, now_ns: int) -> Any:
        """Return a value with `t_ns`, `seq` and `source` where its message has them and the value does not.

        Args:
            key: on which it is published.
            value: plain data; what is no map is returned as it is.
            now_ns: simulated time of the newest gate [ns].
        """
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
        """Undo the counting of what is filled in meanwhile if anything is refused: numbers have no gaps."""
        before = self._next_seq.copy()
        try:
            yield
        except BaseException:
            self._next_seq = before
            raise


def payload_to_json(key: str, payload: bytes, encoding: str = "") -> bytes:
    """Return a payload as JSON.

    A message of the contract comes with all of its fields; JSON, text and msgpack on other keys as their value, bytes
    within as base64; anything else as base64 of the whole.

    Args:
        key: on which it was published.
        payload: as published.
        encoding: Zenoh's, where it is known.

    Raises:
        DecodeError: it is not the message that the contract puts on its key.
    """
    known = messages.type_of(key) is not None
    return _to_json(messages.decode(key, payload) if known else decode_foreign(payload, encoding))


def is_sound(key: str, payload: bytes) -> bool:
    """Tell whether a payload is the message that the contract puts on its key; on other keys anything is."""
    try:
        return messages.type_of(key) is None or messages.decode(key, payload) is not None
    except DecodeError:
        return False


def decode_foreign(payload: bytes, encoding: str) -> Any:
    """Return the value of a payload that is no message of the contract, as JSON can write it."""
    kind = encoding.partition(";")[0]
    try:
        if kind in JSON:
            return msgspec.json.decode(payload)
        if kind in TEXT:
            return payload.decode()
        return json_value(msgspec.msgpack.decode(payload))
    except messages.REFUSALS:
        return base64.b64encode(payload).decode()


def json_value(value: Any) -> Any:
    """Return a value if JSON can write it, otherwise its msgpack as base64."""
    try:
        _to_json(value)
    except messages.REFUSALS:
        return base64.b64encode(msgspec.msgpack.encode(value)).decode()
    return value


def json_to_payload(key: str, value: Any) -> bytes:
    """Return plain data, as decoded from JSON, as the payload of a key.

    Where a field is an integer, 20000000.0 will do: languages that have only doubles write it so.

    Raises:
        DecodeError: with key, field, value and what is allowed; a key outside of the contract takes anything.
    """
    if messages.type_of(key) is None:
        return _pack(key, value)
    if keys.is_picture(key):
        value = _with_picture(value, key)
    try:
        return messages.encode(messages.decode(key, _pack(key, value)))
    except DecodeError:
        return messages.encode(messages.decode(key, _pack(key, _with_integers(value, key))))


def _with_picture(value: Any, key: str) -> Any:
    """Return an image whose data is base64, as JSON has it, with the bytes themselves."""
    if not isinstance(value, dict) or not isinstance(value.get("data"), str):
        return value
    try:
        return {**value, "data": base64.b64decode(value["data"], validate=True)}
    except ValueError as error:
        raise DecodeError(f"{key[:80]}: data is no base64 ({error}); must be a JPEG as base64") from error


def _pack(key: str, value: Any) -> bytes:
    try:
        return msgspec.msgpack.encode(value)
    except messages.REFUSALS as error:
        raise DecodeError(f"{key:.80}: {error}; must be JSON of numbers of 64 bits") from error


def _with_integers(value: Any, key: str) -> Any:
    try:
        return _integers_in(value)
    except RecursionError as error:
        raise DecodeError(
            f"{key[:80]}: too many lists in each other; must be the message of docs/protocol.md"
        ) from error


def _integers_in(value: Any) -> Any:
    """Return a value with the floats in it that are whole as integers."""
    if isinstance(value, dict):
        return {name: _integers_in(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_integers_in(entry) for entry in value]
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < INTEGER_MAX else value


def json_entry(key: str, payload: bytes, encoding: str = "") -> dict[str, Any]:
    """Return a key and its value, to be encoded."""
    return {"key": key, "value": msgspec.Raw(payload_to_json(key, payload, encoding))}


@lru_cache(maxsize=CACHED_VALUES)
def value_line(sample: RawSample) -> bytes:
    """Return the line of a value for a client; null for a key that was deleted, nothing for what is no message."""
    try:
        value = payload_to_json(sample.key, sample.payload, sample.encoding) if sample.payload else b"null"
    except DecodeError:
        return b""
    return b'{"op":"value","key":%b,"value":%b}\n' % (_to_json(sample.key), value)
