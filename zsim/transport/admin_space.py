"""What Zenoh's routers know of the sessions around them, by their admin space: the hub reads it, see decision 2.

Sessions go by Zenoh's name of them (hexadecimal digits).
"""

from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec import Struct

from zsim.transport.session import Session

ANSWER_S = 0.5  # the own router answers within a millisecond; another one within a round trip


class _Sources(Struct):
    """The sessions from which something comes, as a router lists them."""

    routers: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    clients: tuple[str, ...] = ()


_decode_sources = msgspec.json.Decoder(_Sources).decode


class AdminSpace:
    """The admin space of a router that this process is.

    Args:
        link: its session, which listens.
    """

    def __init__(self, link: Session) -> None:
        self._link = link.unprefixed()
        self._prefix = f"{link.federation}/"
        self._own = link.zid()

    def token_holders(self, expression: str) -> dict[str, frozenset[str]]:
        """Return the sessions that hold each liveliness token, by the token's key.

        Of those behind another router that router knows; one that does not answer stands for all of them.
        """
        found = self._sources("token", self._prefix + expression)
        return {key.removeprefix(self._prefix): sessions for key, sessions in found.items()}

    def subscribers(self) -> dict[str, frozenset[str]]:
        """Return the sessions that subscribe to each expression, which is a whole one: it may be of all federations."""
        return self._sources("subscriber", "**")

    def _sources(self, kind: str, expression: str) -> dict[str, frozenset[str]]:
        own = dict(self._ask(self._own, kind, expression))
        found = {key: {*sources.clients, *sources.peers} for key, sources in own.items()}
        routers = {key: {*sources.routers} - {self._own} for key, sources in own.items()}
        for router in set[str]().union(*routers.values()):
            theirs = dict(self._ask(router, kind, expression))
            for key in [key for key, through in routers.items() if router in through]:
                behind = theirs.get(key)
                found[key] |= {router} if behind is None else {*behind.clients, *behind.peers}
        return {key: frozenset(sessions) for key, sessions in found.items()}

    def _ask(self, router: str, kind: str, expression: str) -> Iterator[tuple[str, _Sources]]:
        head = f"@/{router}/router/{kind}/"
        for reply in self._link.query(head + expression, timeout_s=ANSWER_S):
            sources = _decoded(reply.payload)
            if reply.key.startswith(head) and sources is not None:
                yield reply.key.removeprefix(head), sources


def _decoded(payload: bytes) -> Any:
    """Return the sources in a reply, None where another version of Zenoh answers otherwise."""
    try:
        return _decode_sources(payload)
    except msgspec.MsgspecError:
        return None
