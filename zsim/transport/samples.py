"""What arrives over a session: samples, and the key expressions that they are asked for by."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import zenoh

from zsim.errors import SessionError


class ReceivedSample(NamedTuple):
    """One message off the wire, not decoded; its key is without the federation's prefix."""

    key: str
    payload: bytes


class RawSample(NamedTuple):
    """A publication, or a reply to a query, with all that Zenoh knows of it.

    Attributes:
        kind: "PUT" or "DELETE"; "ERROR" for a reply that refuses, which has no key.
        key: without the prefix of the session that received it.
        payload: as sent.
        encoding: Zenoh's text of it, e.g. "application/msgpack;Imu".
        timestamp: of Zenoh, as text; None where nobody stamped it.
        attachment: what was sent beside the payload; empty where nothing was.
    """

    kind: str
    key: str
    payload: bytes
    encoding: str
    timestamp: str | None
    attachment: bytes = b""


def raw_sample(sample: zenoh.Sample, prefix: str) -> RawSample:
    """Return a sample of Zenoh's; `prefix` is taken off its key."""
    return RawSample(
        kind="PUT" if sample.kind == zenoh.SampleKind.PUT else "DELETE",
        key=str(sample.key_expr).removeprefix(prefix),
        payload=sample.payload.to_bytes(),
        encoding=str(sample.encoding),
        timestamp=str(sample.timestamp) if sample.timestamp is not None else None,
        attachment=sample.attachment.to_bytes() if sample.attachment is not None else b"",
    )


def raw_reply(reply: zenoh.Reply, prefix: str) -> RawSample:
    """Return the sample in a reply, or its refusal; `prefix` is taken off its key."""
    if reply.ok is not None:
        return raw_sample(reply.ok, prefix)
    assert reply.err is not None
    return RawSample("ERROR", "", reply.err.payload.to_bytes(), str(reply.err.encoding), None)


def check_expression(expression: str) -> None:
    """Refuse what is no key expression.

    Raises:
        SessionError: with what was found and what is allowed.
    """
    with key_errors(expression):
        zenoh.KeyExpr(expression)


@contextmanager
def key_errors(expression: str) -> Iterator[None]:
    """Turn Zenoh's refusal of a key into a SessionError in the contract's words."""
    try:
        yield
    except zenoh.ZError as error:
        stripped = re.sub("//+", "/", expression.strip("/"))
        allowed = "must be names with / between them, * for any name, ** for any number of them"
        instead = f"must be {stripped}, without / at its ends" if stripped not in (expression, "") else allowed
        raise SessionError(f"key is {expression!r} ({first_sentence(error).split('`: ')[-1]}); {instead}") from error


def first_sentence(error: Exception) -> str:
    """Return the first sentence of a Zenoh error without its source location."""
    return str(error).split(" at ", 1)[0].split("\n", 1)[0][:160]
