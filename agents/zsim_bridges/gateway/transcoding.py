"""Messages as JSON and back, by the schema of their key. Pure."""

import base64
from functools import lru_cache
from typing import Any

import msgspec

from zsim.contract import messages
from zsim.errors import DecodeError
from zsim.transport.samples import RawSample

CACHED_VALUES = 256  # values; one goes to many clients, and is encoded once
INTEGER_MAX = 2.0**63  # a double above it is no integer of 64 bits
JSON = ("application/json", "text/json", "text/json5")
TEXT = ("text/plain", "zenoh/string")
_to_json = msgspec.json.Encoder().encode


def payload_to_json(key: str, payload: bytes, encoding: str = "") -> bytes:
    """Return a payload as JSON.

    A message of the contract comes with all of its fields; JSON, text and msgpack on other keys as their value, bytes
    within as base64; anything else as base64 of the whole.

    Args:
        key: on which it was published.
        payload: as published.
        encoding: Zenoh's, where it is known.
    """
    try:
        return _to_json(messages.decode(key, payload))
    except DecodeError:
        return _to_json(decode_foreign(payload, encoding))


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
        DecodeError: names key, field, found and allowed; a key outside of the contract takes anything.
    """
    if messages.type_of(key) is None:
        return _pack(key, value)
    try:
        return messages.encode(messages.decode(key, _pack(key, value)))
    except DecodeError:
        return messages.encode(messages.decode(key, _pack(key, _with_integers(value, key))))


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
    """Return the line of a value for a client; null for a key that was deleted."""
    value = payload_to_json(sample.key, sample.payload, sample.encoding) if sample.payload else b"null"
    return b'{"op":"value","key":%b,"value":%b}\n' % (_to_json(sample.key), value)
