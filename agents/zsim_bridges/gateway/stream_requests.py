"""Requests of clients on a stream, one JSON object per line. Pure.

{"op": "put", "key": "drone/drone1/cmd/velocity", "value": {"velocity_m_s": [1, 0, 0]}, "id": 7}
"""

from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from zsim.contract.messages import REFUSALS
from zsim.errors import DecodeError

Id = int | str | None
Key = Annotated[str, Meta(max_length=1000)]
Keys = Annotated[list[Key], Meta(max_length=1000)]


class StreamRequest(Struct, tag_field="op", forbid_unknown_fields=True, kw_only=True):
    """Any request: its `id` comes back with the answer."""

    id: Id = None


class HelloRequest(StreamRequest, tag="hello"):
    """The client's name, and the token where one is needed. The answer describes the run."""

    name: str = ""
    token: str = ""


class LatestRequest(StreamRequest, tag="latest"):
    """The last values of a key, or of an expression."""

    key: Key


class SubscribeRequest(StreamRequest, tag="subscribe"):
    """Every value on a key expression from now on."""

    key: Key


class UnsubscribeRequest(StreamRequest, tag="unsubscribe"):
    """No more values on it."""

    key: Key


class PutRequest(StreamRequest, tag="put"):
    """A value for a key. `quiet`: an answer comes only if it is refused."""

    key: Key
    value: Any
    quiet: bool = False


class AskRequest(StreamRequest, tag="ask"):
    """A control request to whoever answers on a key: world/control, cluster/*/control."""

    key: Key
    request: str
    args: dict[str, Any] = {}
    timeout_s: Annotated[float, Meta(gt=0, le=60)] = 5.0


class JoinRequest(StreamRequest, tag="join"):
    """Take part in the lockstep: a `gate` comes every `period_s`, and time waits for its `done`.

    `reads` are the key expressions whose messages come with each gate; `gates` the keys that close one, of which a
    message comes at every gate: the status of its drones where none are given.
    """

    name: str
    period_s: Annotated[float, Meta(gt=0, le=3600)]
    reads: Keys = []
    gates: Keys = []


class LockstepOutput(Struct, forbid_unknown_fields=True):
    """An output of a gate."""

    key: Key
    value: Any


class DoneRequest(StreamRequest, tag="done"):
    """All outputs of the gate t_ns."""

    t_ns: int
    outputs: list[LockstepOutput] = []


class LeaveRequest(StreamRequest, tag="leave"):
    """Take part in the lockstep no more."""

    reason: str = ""


_decode = msgspec.json.Decoder(
    HelloRequest
    | LatestRequest
    | SubscribeRequest
    | UnsubscribeRequest
    | PutRequest
    | AskRequest
    | JoinRequest
    | DoneRequest
    | LeaveRequest
).decode
OPS = ("hello", "latest", "subscribe", "unsubscribe", "put", "ask", "join", "done", "leave")


def decode_request(line: bytes) -> StreamRequest:
    """Return the request in a line.

    Raises:
        DecodeError: it is none.
    """
    try:
        return _decode(line)
    except REFUSALS as error:
        raise DecodeError(f"request: {error}; must be a JSON object with op of {', '.join(OPS)}") from error
