"""Outputs that a participant's done counted and that did not come, as after a cut link. Pure."""

from typing import Any, NamedTuple

from zsim.contract import messages
from zsim.contract.framing import pairs_of
from zsim.contract.messages import ClusterRequest, ClusterState, Command, Estimate
from zsim.errors import DecodeError
from zsim.transport.session import Sample
from zsim_world.server.message_history import History


class _Mark(NamedTuple):
    """What makes an output the same as another."""

    key: str
    t_ns: int
    seq: int
    source: str


def unheard(kept: Any, done_ns: int, history: History) -> list[Sample]:
    """Return those of the outputs that a participant kept that have not come, each once.

    What it kept of gates later than its newest done is left out: that is on its way, or its done will say so.

    Args:
        kept: the result of its answer.
        done_ns: newest gate that it is through with.
        history: what has come.

    Raises:
        DecodeError: the result is no list of [key, payload].
    """
    found: dict[_Mark | None, Sample] = {}
    for key, payload in pairs_of(kept):
        mark = _mark(key, payload)
        if mark is not None and mark.t_ns <= done_ns:
            found[mark] = Sample(key, payload)
    for key, payload in history.said({(mark.key, mark.t_ns) for mark in found if mark}):
        found.pop(_mark(key, payload), None)
    return list(found.values())


def _mark(key: str, payload: bytes) -> _Mark | None:
    """Return the mark of an output, None for anything that a done does not count or a reader refuses."""
    kind = messages.type_of(key)
    if kind is None or not issubclass(kind, Command | Estimate | ClusterState | ClusterRequest):
        return None
    try:
        message = messages.decode(key, payload)
    except DecodeError:
        return None
    return _Mark(key, message.t_ns, message.seq, message.source)
