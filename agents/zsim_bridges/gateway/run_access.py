"""What the gateway's clients can do in a run: read last values, publish, and send requests."""

import asyncio
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.framing import GateMessages, run_key_table
from zsim.contract.messages import Info
from zsim.contract.run_messages import ControlAnswer
from zsim.errors import DecodeError
from zsim.runtime.participant import Participant
from zsim.scenario import rights, scenario_file
from zsim.sensors.camera import CAMERAS
from zsim.transport.session import RawSample, ReceivedSample, Session, check_expression
from zsim.transport.traffic import Passed, Traffic
from zsim_bridges.gateway.client_messages import (
    ForbiddenError,
    MessageDefaults,
    TooManyError,
    UnknownError,
    check_not_reserved,
    is_client_key,
    is_control_key,
    is_sound,
    json_to_payload,
)
from zsim_bridges.gateway.publications import LastValues

TICK_S = 0.1  # how often health is published and a stop is noticed while nothing arrives
REQUESTS_MAX = 64  # requests under way at once; each has a thread that waits for Zenoh


class RunAccess:
    """Access to the current run.

    Args:
        link: an open session.
        info: of the run.
        observer: of the gateway in it.
        secured: whether access control decides what it may do.

    Attributes:
        values: last ones.
        defaults: of messages in the gateway's own name.
        required_processes: (process, drone or cluster that it serves) of all without which the run does not start.
    """

    def __init__(self, link: Session, info: Info, observer: Participant, secured: bool) -> None:
        self.link = link
        self.info = info
        self.values = LastValues(run_key_table(info))
        self.defaults = MessageDefaults(observer.name)
        self.bare_link = link.unprefixed()
        self._observer = observer
        self._prefix = f"{link.federation}/"
        self._threads = ThreadPoolExecutor(REQUESTS_MAX, thread_name_prefix="ask")
        self._pending = 0
        self._traffic: Traffic | None = None
        scenario = scenario_file.from_text(info.scenario)
        self._may_write = rights.of(observer.name, scenario).writes if secured else None
        self.required_processes = [(name, name.partition(".")[2]) for name in scenario.expected()]
        self._known_names = {"drone": [d.name for d in info.drones], "cluster": [c.name for c in info.clusters]}

    @property
    def now_ns(self) -> int:
        """Simulated time of the newest gate."""
        return self._observer.now_ns

    # What passes the world

    def open(self) -> None:
        """Subscribe to what passes the world, and read the last values of before."""
        self._traffic = Traffic(self.link, run_key_table(self.info), self.count_refused)
        # Views do not pass the world.
        self.link.declare_subscriber("view/**", lambda sample: self._keep(self.values.add, sample))
        for expression in rights.LAST_VALUES:
            for sample in self.link.get(expression):
                self._keep(self.values.add, sample)
                if sample.key == keys.CLOCK:
                    self._observer.update_clock(sample.payload)

    def receive_until_end(self, stopped: Callable[[], bool]) -> None:
        """Store what passes the world until the run is over or `stopped` returns true."""
        assert self._traffic is not None
        over = threading.Event()
        ticker = threading.Thread(target=_tick, args=(self._traffic, over), name="tick", daemon=True)
        ticker.start()
        try:
            while not self._observer.end_reason and not stopped():
                self._add_passed(self._traffic.receive())
                self._observer.tick()
        finally:
            over.set()
            ticker.join()

    def _add_passed(self, passed: Sequence[Passed]) -> None:
        self._observer.health.received += bool(passed)
        for entry in passed:
            if isinstance(entry, GateMessages):
                self.values.add_gate(entry)
                continue
            self._keep(self.values.add_passed, entry)
            if entry.key == keys.CLOCK:
                self._observer.update_clock(entry.payload)

    def _keep(self, add: Callable[[str, bytes], None], sample: RawSample | ReceivedSample) -> None:
        """Keep a last value; of what is no message, which anybody may publish, the one before stays."""
        if is_sound(sample.key, sample.payload):
            add(sample.key, sample.payload)
        else:
            self.count_refused()

    def close(self) -> None:
        """Give up requests that wait."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    # By keys without the federation's name

    def put(self, key: str, value: Any, defaults: MessageDefaults) -> None:
        """Publish plain data on a key, checked, with what it leaves out filled in.

        Raises:
            DecodeError: with key, field, value and what is allowed.
            ForbiddenError: the key is reserved.
            UnknownError: the run has no such drone or cluster.
            SessionError: it is no key.
        """
        self.check_writable(key)
        with defaults.transaction():
            payload = self.encode(key, defaults.fill(key, value, self.now_ns))
        self.publish([(key, payload)])

    def publish(self, checked: Sequence[tuple[str, bytes]]) -> None:
        """Publish payloads that have been checked."""
        for key, payload in checked:
            self.link.put_sample(key, payload, messages.encoding(key))
            if not keys.is_picture(key):  # nobody's last value: they are large, and the world keeps none either
                self.values.add_own(key, payload)

    def encode(self, key: str, value: Any) -> bytes:
        """Return plain data as the payload of a key on which clients may publish.

        Raises:
            DecodeError: with key, field, value and what is allowed.
            ForbiddenError: the key is reserved.
        """
        self._check_key(key)
        return json_to_payload(key, value)

    def _check_key(self, key: str) -> None:
        """Refuse a key of the federation that is reserved, or is no key."""
        check_not_reserved(key)
        check_expression(key)
        self.check_known(key)
        if is_client_key(key) and messages.type_of(key) is None:
            raise DecodeError(f"{key[:80]}: is no key of the contract; see docs/protocol.md")

    def check_writable(self, key: str) -> None:
        """Refuse a key on which access control drops the gateway's messages.

        Raises:
            ForbiddenError: with those on which it does not.
        """
        if self._may_write is not None and not rights.permits(self._may_write, key):
            raise ForbiddenError(
                f"{key[:80]}: the gateway's certificate lets it write on {', '.join(self._may_write)} only"
            )

    def check_known(self, key: str) -> None:
        """Refuse a message of the contract about a drone or a cluster that the run does not have.

        Raises:
            UnknownError: with those that it has.
        """
        kind, thing, _ = keys.parts(key.removeprefix("view/"))
        names = self._known_names.get(kind)
        if names is not None and (messages.type_of(key) or is_control_key(key)) and thing not in names:
            raise UnknownError(f"{key[:80]}: {kind} is {thing[:40]!r}; must be one of {', '.join(names) or 'none'}")
        if kind == "estimates" and not keys.PROCESS_NAME.fullmatch(thing):
            raise UnknownError(f"{key[:80]}: process is {thing[:60]!r}; must be 1 to 48 of a-z 0-9 _ . -")

    def camera_key(self, drone: str, camera: str) -> str:
        """Return the key of a camera's pictures.

        Raises:
            UnknownError: with the drones that the run has, or the cameras of a drone.
        """
        if camera not in CAMERAS:
            raise UnknownError(f"camera is {camera[:40]!r}; must be {' or '.join(CAMERAS)}")
        if drone not in self._known_names["drone"]:
            raise UnknownError(f"drone is {drone[:40]!r}; must be one of {', '.join(self._known_names['drone'])}")
        return keys.camera(drone, camera)

    def count_refused(self) -> None:
        """Count a message that is not what its key promises."""
        self._observer.health.refused += 1

    async def request(
        self, key: str, op: str, args: dict[str, Any], source: str, timeout_s: float = 5.0
    ) -> ControlAnswer:
        """Send a control request to whoever answers on a key.

        Raises:
            SessionError: it is no key.
            TooManyError: REQUESTS_MAX others wait already.
        """
        if "*" in key:
            raise DecodeError(f"{key[:80]!r}: is no key; a request goes to one, without wildcards")
        self.check_known(key)
        return await self._in_thread(self.link.request, key, op, source, args, timeout_s)

    # By full keys, with the federation's name; keys of other federations too

    def last_samples(self, expression: str) -> list[RawSample]:
        """Return the last values that a full expression matches."""
        return [
            RawSample("PUT", f"{self._prefix}{key}", payload, self.values.encoding(key), None)
            for key, payload in self.values.matching(expression, self._prefix)
        ]

    async def query(self, expression: str, parameters: str, payload: bytes, encoding: str) -> list[RawSample]:
        """Return the answers to a Zenoh get on a full expression.

        Raises:
            SessionError: it is no key expression.
            TooManyError: REQUESTS_MAX others wait already.
        """
        return await self._in_thread(self.bare_link.query, expression, parameters, payload, encoding)

    def put_full_key(self, key: str, payload: bytes, encoding: str) -> None:
        """Publish a payload on a full key.

        Raises:
            DecodeError: it is not the message that the contract puts there.
            ForbiddenError: the key is reserved.
            SessionError: it is no key.
        """
        own = self._federation_key(key)
        if own is not None and messages.type_of(own) is not None:
            messages.decode(own, payload)
        if own is None:
            self.bare_link.put_sample(key, payload, encoding)
            return
        self.link.put_sample(own, payload, encoding)
        if not keys.is_picture(own):
            self.values.add_own(own, payload, encoding)

    def delete_full_key(self, key: str) -> None:
        """Publish that a full key has no value any more.

        Raises:
            ForbiddenError: the key is reserved.
            SessionError: it is no key.
        """
        own = self._federation_key(key)
        self.bare_link.delete(key)
        if own is not None:
            self.values.drop(own)

    def _federation_key(self, key: str) -> str | None:
        """Return a full key without this federation's name; None for a key of no federation or of another one.

        Raises:
            DecodeError, ForbiddenError, UnknownError: clients may not publish there, in any federation.
        """
        own = key.removeprefix(self._prefix)
        if own != key:
            self._check_key(own)
            self.check_writable(own)
            return own
        check_not_reserved(key)
        check_not_reserved(key.partition("/")[2] or key)
        return None

    async def _in_thread(self, wait: Callable[..., Any], *args: Any) -> Any:
        if self._pending >= REQUESTS_MAX:
            raise TooManyError(f"{REQUESTS_MAX} requests wait for their answers already; ask again later")
        self._pending += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, wait, *args)
        finally:
            self._pending -= 1


def _tick(traffic: Traffic, over: threading.Event) -> None:
    while not over.wait(TICK_S):
        traffic.wake()
