"""One client on a stream: what it asks for is done, what it is to know goes into its outbox."""

import asyncio
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from zsim.contract import keys
from zsim.errors import DecodeError, NoWorldError, ZsimError
from zsim.transport.session import Heard, check_expression
from zsim_bridges.gateway.client_limits import TokenBucket
from zsim_bridges.gateway.http.http_errors import ForbiddenError, TooManyError
from zsim_bridges.gateway.lines import stream_requests
from zsim_bridges.gateway.lines.outbox import BYTES_MAX, Outbox
from zsim_bridges.gateway.lines.stream_requests import StreamRequest
from zsim_bridges.gateway.lockstep_agent import LockstepAgent
from zsim_bridges.gateway.lockstep_session import LockstepSession
from zsim_bridges.gateway.message_defaults import MessageDefaults
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.gateway.subscriptions import SharedSubscriptions
from zsim_bridges.gateway.transcoding import json_entry, json_value, value_line

SUBSCRIPTIONS_MAX = 100  # of one client; `drone/*/truth` is one
ANSWER_MAX = BYTES_MAX  # of an answer: what may wait for a client
PENDING_MAX = 8  # of one client under way
ROLE = "client"  # of a name that does not say its role
_encode = msgspec.json.Encoder().encode


class GatewayApi(Protocol):
    """What a client needs of the gateway."""

    loop: asyncio.AbstractEventLoop
    subscriptions: SharedSubscriptions

    @property
    def name(self) -> str:
        """Process name of the gateway."""
        ...

    def run(self) -> RunAccess:
        """Return the run that goes on; NoWorldError where there is none."""
        ...

    def is_token(self, token: str) -> bool:
        """Tell whether a token is the right one."""
        ...

    def start_lockstep(self, seat: LockstepAgent, lost: Callable[[str], None]) -> None:
        """Run a seat until it is left; tell why there is none any more."""
        ...

    def report(self, text: str) -> None:
        """Tell a person of a fault of ours."""
        ...

    def admit(self, client: "Client") -> None:
        """Count a client that has shown the token among those who have; TooManyError where there are too many."""
        ...

    def remove(self, client: "Client") -> None:
        """Forget a client that is gone, and let others fly the drones that it flew."""
        ...


class Client:
    """One connection.

    Args:
        house: the gateway.
        outbox: takes lines.
        source: in whose name it speaks until it says who it is.
        trusted: whether it has shown the token already, or need not.
        bucket: of its requests.
    """

    def __init__(self, house: GatewayApi, outbox: Outbox, source: str, trusted: bool, bucket: TokenBucket) -> None:
        self._gateway = house
        self._outbox = outbox
        self._trusted = trusted
        self._bucket = bucket
        self._defaults = MessageDefaults(source)
        self._subscriptions: dict[str, Callable[[], None]] = {}
        self._commanded: set[tuple[str, str]] = set()
        self._pending: set[asyncio.Task[None]] = set()
        self._session: LockstepSession | None = None
        self._closed = False
        self.source = source

    @property
    def trusted(self) -> bool:
        """Whether it has shown the token, or need not."""
        return self._trusted

    @property
    def commanded(self) -> frozenset[tuple[str, str]]:
        """(source, drone) of the drones that it has commanded, outside of a seat, in this run."""
        return frozenset(self._commanded)

    async def handle_line(self, line: bytes) -> None:
        """Do what a line asks for; a refusal is an answer."""
        asked: StreamRequest | None = None
        try:
            self._bucket.spend()
            if line.isspace():
                return
            asked = stream_requests.decode_request(line)
            if not self._trusted and not isinstance(asked, stream_requests.HelloRequest):
                raise ForbiddenError('a token is asked for here; begin with {"op": "hello", "token": "…"}')
            await self._handle(asked)
        except ZsimError as error:
            self.send({"op": "error", "error": str(error)}, asked)
        except Exception as error:  # a fault of ours: this client and the others are served on
            self._gateway.report(f"{self.source}: {line[:80]!r}: {error!r}")
            said = f"the gateway failed ({type(error).__name__}); its terminal says more"
            self.send({"op": "error", "error": said}, asked)

    async def _handle(self, asked: StreamRequest) -> None:
        match asked:
            case stream_requests.DoneRequest():
                self._done(asked)
            case stream_requests.PutRequest():
                self._put(asked)
            case stream_requests.LatestRequest():
                check_expression(asked.key)
                values = self._gateway.run().values
                found = [json_entry(key, payload, values.encoding(key)) for key, payload in values.matching(asked.key)]
                self.send({"op": "latest", "values": found}, asked)
            case stream_requests.SubscribeRequest():
                self._subscribe(asked)
            case stream_requests.UnsubscribeRequest():
                self._unsubscribe(asked)
            case stream_requests.AskRequest():
                if len(self._pending) >= PENDING_MAX:
                    raise TooManyError(f"ask: {PENDING_MAX} of this client wait for their answers already")
                task = asyncio.create_task(self._ask(asked, self._gateway.run()))
                self._pending.add(task)
                task.add_done_callback(self._pending.discard)
            case stream_requests.HelloRequest():
                self._hello(asked)
            case stream_requests.JoinRequest():
                self._join(asked)
            case stream_requests.LeaveRequest():
                self._leave(asked)

    def send(self, answer: dict[str, Any], asked: StreamRequest | None = None) -> None:
        """Put an answer into the outbox, with the id of what was asked."""
        if asked is not None and asked.id is not None:
            answer["id"] = asked.id
        line = _encode(answer) + b"\n"
        if len(line) > ANSWER_MAX:
            error = f"{answer['op']}: the answer has {len(line)} bytes, more than {ANSWER_MAX}; ask for less at a time"
            line = _encode({"op": "error", "error": error, "id": answer.get("id")}) + b"\n"
        self._outbox.put(line)

    def _hello(self, asked: stream_requests.HelloRequest) -> None:
        if not self._trusted and not self._gateway.is_token(asked.token):
            self.refuse("hello: no token, or a wrong one; ask whoever started the gateway for it", asked)
            return
        name = self._process_name(asked.name) if asked.name else self.source
        if not self._trusted:
            self._gateway.admit(self)
            self._trusted = True
        if self._session is None and name != self.source:
            self.source, self._defaults = name, MessageDefaults(name)
        self.send({"op": "hello", "name": self.source, **self._run_fields()}, asked)

    def refuse(self, reason: str, asked: StreamRequest | None = None) -> None:
        """Say why this is no client of ours, and hang up."""
        self.send({"op": "error", "error": reason}, asked)
        self._outbox.close()

    def expire(self) -> None:
        """Hang up on a client that has not shown the token."""
        if not self._trusted and not self._closed:
            self.refuse("hello: none came with the token in time")

    def _run_fields(self) -> dict[str, Any]:
        try:
            flight = self._gateway.run()
        except NoWorldError:
            return {"run_id": None}
        info = flight.info
        return {
            "run_id": info.run_id,
            "federation": info.federation,
            "mode": info.mode,
            "gate_s": info.gate_ns / 1e9,
            "t_ns": flight.now_ns,
            "drones": [drone.name for drone in info.drones],
            "clusters": [{"name": cluster.name, "drones": cluster.drones} for cluster in info.clusters],
        }

    def _put(self, asked: stream_requests.PutRequest) -> None:
        self._gateway.run().put(asked.key, asked.value, self._defaults)
        if keys.matches(keys.command("*", "*"), asked.key):
            self._commanded.add((self.source, keys.thing(asked.key)))
        if not asked.quiet:
            self.send({"op": "put", "key": asked.key}, asked)

    async def _ask(self, asked: stream_requests.AskRequest, flight: RunAccess) -> None:
        """Wait for an answer beside what else it asks for: the answer may need its next done."""
        try:
            answer = await flight.request(asked.key, asked.request, asked.args, self.source, asked.timeout_s)
            self.send({"op": "answer", "ok": answer.ok, "error": answer.error, "result": json_value(answer.result)}, asked)
        except ZsimError as error:
            self.send({"op": "error", "error": str(error)}, asked)

    def _process_name(self, name: str) -> str:
        """Return the process name of a client: a name without a role is a client's."""
        whole = name if "." in name else f"{ROLE}.{name}"
        if not keys.PROCESS_NAME.fullmatch(whole) or "." not in whole.strip(".") or whole == self._gateway.name:
            raise DecodeError(
                f"name is {name[:60]!r}; must be NAME or ROLE.NAME of a-z 0-9 _ -, at most 48, e.g. myctrl or "
                "matlab.main, and not the gateway's"
            )
        return whole

    # What it hears

    def _subscribe(self, asked: stream_requests.SubscribeRequest) -> None:
        if asked.key not in self._subscriptions:
            if len(self._subscriptions) >= SUBSCRIPTIONS_MAX:
                raise TooManyError(
                    f"subscribe: there are {SUBSCRIPTIONS_MAX} already; unsubscribe some, or use wildcards"
                )
            self._subscriptions[asked.key] = self._gateway.subscriptions.subscribe(asked.key, self._on_value)
        self.send({"op": "subscribe", "key": asked.key}, asked)

    def _on_value(self, heard: Heard) -> None:
        self._outbox.put(value_line(heard), may_go=True)

    def _unsubscribe(self, asked: stream_requests.UnsubscribeRequest) -> None:
        if asked.key not in self._subscriptions:
            raise DecodeError(f"unsubscribe: {asked.key[:80]!r} is not subscribed to")
        self._subscriptions.pop(asked.key)()
        self.send({"op": "unsubscribe", "key": asked.key}, asked)

    # The lockstep

    def _join(self, asked: stream_requests.JoinRequest) -> None:
        if self._session is not None:
            raise DecodeError(f"join: is {self._session.agent.name} already; leave first, or use another connection")
        name = self._process_name(asked.name)
        place = LockstepSession(name, asked, self._gateway.run(), self._gateway.loop, self._outbox.put)
        self._session, self.source, self._defaults = place, name, place.defaults
        self._gateway.start_lockstep(place.agent, lambda reason: self._on_session_lost(place, reason))
        self.send({"op": "join", "name": name, "gates": place.agent.gate_keys}, asked)

    def _done(self, asked: stream_requests.DoneRequest) -> None:
        if self._session is None:
            raise DecodeError("done: has not joined; must say join first")
        self._session.answer_gate(asked)

    def lose_lockstep(self, name: str, reason: str, but: LockstepAgent) -> None:
        """Lose the seat of a name, unless it is a certain one: it dies, as another lives in its place."""
        if self._session is not None and self._session.agent.name == name and self._session.agent is not but:
            place = self._session
            place.agent.leave(deserted=True)
            self._on_session_lost(place, reason)

    def end_lockstep(self, flight: RunAccess, reason: str) -> None:
        """End the seat in a run that is over, answered or not."""
        if self._session is not None and self._session.run is flight:
            place = self._session
            place.agent.leave()
            self._on_session_lost(place, reason)

    def _on_session_lost(self, place: LockstepSession, reason: str) -> None:
        """Tell that there is no place any more."""
        if self._session is place:
            self._session = None
            self.send({"op": "left", "reason": reason})

    def _leave(self, asked: stream_requests.LeaveRequest) -> None:
        if self._session is None:
            raise DecodeError("leave: has not joined; there is nothing to leave")
        self._session.agent.leave()
        self._session = None
        self.send({"op": "leave"}, asked)

    # Runs come and go, and so does it

    def notify_run(self, state: str, run_id: str) -> None:
        """Tell that a run has begun or ended, or that the link to its world is lost or back."""
        if state == "begun":
            self._defaults = MessageDefaults(self.source)
            self._commanded.clear()
        if self._trusted:
            self.send({"op": "run", "state": state, "run_id": run_id})

    def close(self, deserted: bool = True) -> None:
        """End all that it has.

        Args:
            deserted: whether its connection broke, so that its seat in the lockstep dies rather than leaves.
        """
        if self._closed:
            return
        self._closed = True
        for task in self._pending:
            task.cancel()
        for end in self._subscriptions.values():
            end()
        if self._session is not None:
            self._session.agent.leave(deserted)
        self._outbox.close()
        self._gateway.remove(self)


def lost_line(lost: int) -> bytes:
    """Return the line that tells a client how many values went."""
    return _encode({"op": "lost", "lines": lost}) + b"\n"
