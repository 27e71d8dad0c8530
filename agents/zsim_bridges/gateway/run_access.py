"""A run as the gateway's clients meet it: last values, what they say, what they ask, whose time it is."""

import asyncio
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages
from zsim.contract.messages import ControlAnswer, Info
from zsim.errors import DecodeError
from zsim.scenario import rights, scenario_file
from zsim.transport.session import Heard, Session, check_expression
from zsim.transport.traffic import Passed, Traffic
from zsim_bridges.gateway.http.http_errors import ForbiddenError, TooManyError, UnknownError
from zsim_bridges.gateway.key_policy import is_control, is_spoken, refuse_others
from zsim_bridges.gateway.last_values import Values
from zsim_bridges.gateway.message_defaults import Stamps
from zsim_bridges.gateway.transcoding import to_payload
from zsim_bridges.observer_process import Presence

TICK_S = 0.1  # how often health and a stop are looked at while nothing arrives
ASKED_MAX = 64  # requests under way at once; each has a thread that waits for Zenoh


class Flight:
    """What clients need of the run that goes on.

    Args:
        link: an open session.
        info: of the run.
        presence: of the gateway in it.
        secured: whether access control decides what it may do.

    Attributes:
        values: last ones.
        stamps: of what is said in the gateway's own name.
        served: (process, drone or cluster that it is about) of all without which the run does not start.
    """

    def __init__(self, link: Session, info: Info, presence: Presence, secured: bool) -> None:
        self.link = link
        self.info = info
        self.values = Values([drone.name for drone in info.drones])
        self.stamps = Stamps(presence.name)
        self.whole = link.bare()
        self._presence = presence
        self._prefix = f"{link.federation}/"
        self._threads = ThreadPoolExecutor(ASKED_MAX, thread_name_prefix="ask")
        self._asked = 0
        self._traffic: Traffic | None = None
        scenario = scenario_file.from_text(info.scenario)
        self._may_write = rights.of(presence.name, scenario).writes if secured else None
        self.served = [(name, name.partition(".")[2]) for name in scenario.expected()]
        self._things = {"drone": [d.name for d in info.drones], "cluster": [c.name for c in info.clusters]}

    @property
    def now_ns(self) -> int:
        """Simulated time of the newest gate."""
        return self._presence.now_ns

    # What passes the world

    def enter(self) -> None:
        """Begin to hear what passes the world, and take in what was said before."""
        self._traffic = Traffic(self.link, [drone.name for drone in self.info.drones], self._count_refused)
        self.link.hear("view/**", lambda heard: self.values.add(heard.key, heard.payload))  # they do not pass it
        for expression in rights.LAST_VALUES:
            for sample in self.link.get(expression):
                self.values.add(sample.key, sample.payload)
                if sample.key == keys.CLOCK:
                    self._presence.heed(sample.payload)

    def follow(self, stopped: Callable[[], bool]) -> None:
        """Take in what passes the world until the run is over, or somebody says stop."""
        assert self._traffic is not None
        over = threading.Event()
        ticker = threading.Thread(target=_tick, args=(self._traffic, over), name="tick", daemon=True)
        ticker.start()
        try:
            while not self._presence.over and not stopped():
                self._take_in(self._traffic.receive())
                self._presence.tick()
        finally:
            over.set()
            ticker.join()

    def _take_in(self, passed: Sequence[Passed]) -> None:
        self._presence.health.received += bool(passed)
        for entry in passed:
            if isinstance(entry, GateMessages):
                self.values.add_gate(entry)
                continue
            self.values.add_passed(entry.key, entry.payload)
            if entry.key == keys.CLOCK:
                self._presence.heed(entry.payload)

    def _count_refused(self) -> None:
        self._presence.health.refused += 1

    def close(self) -> None:
        """Wait for nobody any more."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    # What clients say and ask, by keys of the federation

    def put(self, key: str, value: Any, stamps: Stamps) -> None:
        """Publish plain data on a key, checked, with what it leaves out filled in.

        Raises:
            DecodeError: names key, field, found and allowed.
            ForbiddenError: somebody else speaks there.
            UnknownError: the run has no such drone or cluster.
            SessionError: it is no key.
        """
        self.refuse_unwritable(key)
        with stamps.all_or_none():
            payload = self.payload(key, stamps.filled(key, value, self.now_ns))
        self.publish([(key, payload)])

    def publish(self, said: Sequence[tuple[str, bytes]]) -> None:
        """Publish payloads that have been checked."""
        for key, payload in said:
            self.link.put_as(key, payload, messages.encoding(key))
            self.values.say(key, payload)

    def payload(self, key: str, value: Any) -> bytes:
        """Return plain data as the payload of a key on which a client may speak.

        Raises:
            DecodeError: names key, field, found and allowed.
            ForbiddenError: somebody else speaks there.
        """
        self._refuse(key)
        return to_payload(key, value)

    def _refuse(self, key: str) -> None:
        """Refuse a key of the federation on which a client may not speak, or that is none."""
        refuse_others(key)
        check_expression(key)
        self.refuse_unknown(key)
        if is_spoken(key) and messages.type_of(key) is None:
            raise DecodeError(f"{key[:80]}: is no key of the contract; see docs/protocol.md")

    def refuse_unwritable(self, key: str) -> None:
        """Refuse a key on which access control drops what the gateway itself says.

        Raises:
            ForbiddenError: with those on which it does not.
        """
        if self._may_write is not None and not rights.permits(self._may_write, key):
            raise ForbiddenError(
                f"{key[:80]}: the gateway's certificate lets it speak on {', '.join(self._may_write)} only"
            )

    def refuse_unknown(self, key: str) -> None:
        """Refuse a message of the contract about a drone or a cluster that the run does not have.

        Raises:
            UnknownError: with those that it has.
        """
        kind, thing, _ = keys.parts(key.removeprefix("view/"))
        known = self._things.get(kind)
        if known is not None and (messages.type_of(key) or is_control(key)) and thing not in known:
            raise UnknownError(f"{key[:80]}: {kind} is {thing[:40]!r}; must be one of {', '.join(known) or 'none'}")
        if kind == "estimates" and not keys.PROCESS_NAME.fullmatch(thing):
            raise UnknownError(f"{key[:80]}: process is {thing[:60]!r}; must be 1 to 48 of a-z 0-9 _ . -")

    async def ask(self, key: str, op: str, args: dict[str, Any], source: str, timeout_s: float = 5.0) -> ControlAnswer:
        """Ask whoever answers on a key.

        Raises:
            SessionError: it is no key.
            TooManyError: ASKED_MAX others ask already.
        """
        if "*" in key:
            raise DecodeError(f"{key[:80]!r}: is no key; a request goes to one, without wildcards")
        self.refuse_unknown(key)
        return await self._in_thread(self.link.request, key, op, source, args, timeout_s)

    # The same by whole keys, the federation's name included: of others' keys too

    def known(self, expression: str) -> list[Heard]:
        """Return the last values that a whole expression takes."""
        return [
            Heard("PUT", f"{self._prefix}{key}", payload, self.values.encoding(key), None)
            for key, payload in self.values.of(expression, self._prefix)
        ]

    async def inquire(self, expression: str, parameters: str, payload: bytes, encoding: str) -> list[Heard]:
        """Return what is answered to a get on a whole expression.

        Raises:
            SessionError: it is no key expression.
            TooManyError: ASKED_MAX others ask already.
        """
        return await self._in_thread(self.whole.inquire, expression, parameters, payload, encoding)

    def put_whole(self, key: str, payload: bytes, encoding: str) -> None:
        """Publish a payload on a whole key.

        Raises:
            DecodeError: it is none of the message that the contract puts there.
            ForbiddenError: somebody else speaks there.
            SessionError: it is no key.
        """
        own = self._own(key)
        if own is not None and messages.type_of(own) is not None:
            messages.decode(own, payload)
        self.whole.put_as(key, payload, encoding)
        if own is not None:
            self.values.say(own, payload, encoding)

    def delete_whole(self, key: str) -> None:
        """Publish that a whole key has no value any more.

        Raises:
            ForbiddenError: somebody else speaks there.
            SessionError: it is no key.
        """
        own = self._own(key)
        self.whole.delete(key)
        if own is not None:
            self.values.drop(own)

    def _own(self, key: str) -> str | None:
        """Return a whole key without this federation's name; None for a key of nobody's.

        Raises:
            DecodeError, ForbiddenError, UnknownError: it is no key on which a client may speak, in any federation.
        """
        own = key.removeprefix(self._prefix)
        if own != key:
            self._refuse(own)
            self.refuse_unwritable(own)
            return own
        refuse_others(key)
        refuse_others(key.partition("/")[2] or key)
        return None

    async def _in_thread(self, wait: Callable[..., Any], *args: Any) -> Any:
        if self._asked >= ASKED_MAX:
            raise TooManyError(f"{ASKED_MAX} requests wait for their answers already; ask again later")
        self._asked += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, wait, *args)
        finally:
            self._asked -= 1


def _tick(traffic: Traffic, over: threading.Event) -> None:
    while not over.wait(TICK_S):
        traffic.wake()
