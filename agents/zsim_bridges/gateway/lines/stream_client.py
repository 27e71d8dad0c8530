"""One client on a stream: what it asks for is done, what it is to know goes into its outbox."""

import asyncio
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from zsim.contract import keys
from zsim.errors import DecodeError, NoWorldError, ZsimError
from zsim.transport.session import Heard, check_expression
from zsim_bridges.gateway.client_limits import Bucket
from zsim_bridges.gateway.http.http_errors import ForbiddenError, TooManyError
from zsim_bridges.gateway.lines import stream_requests
from zsim_bridges.gateway.lines.outbox import BYTES_MAX, Outbox
from zsim_bridges.gateway.lines.stream_requests import Request
from zsim_bridges.gateway.lockstep_agent import Seat
from zsim_bridges.gateway.lockstep_session import Place
from zsim_bridges.gateway.message_defaults import Stamps
from zsim_bridges.gateway.run_access import Flight
from zsim_bridges.gateway.subscriptions import Feed
from zsim_bridges.gateway.transcoding import entry, plain, value_line

SUBSCRIPTIONS_MAX = 100  # of one client; `drone/*/truth` is one
ANSWER_MAX = BYTES_MAX  # of an answer: what may wait for a client
ASKS_MAX = 8  # of one client under way
ROLE = "client"  # of a name that does not say its role
_encode = msgspec.json.Encoder().encode


class House(Protocol):
    """What a client needs of the gateway."""

    loop: asyncio.AbstractEventLoop
    feed: Feed

    @property
    def name(self) -> str:
        """Process name of the gateway."""
        ...

    def flight(self) -> Flight:
        """Return the run that goes on; NoWorldError where there is none."""
        ...

    def knows(self, token: str) -> bool:
        """Tell whether a token is the right one."""
        ...

    def sit(self, seat: Seat, lost: Callable[[str], None]) -> None:
        """Run a seat until it is left; tell why there is none any more."""
        ...

    def report(self, text: str) -> None:
        """Tell a person of a fault of ours."""
        ...

    def trust(self, client: "Client") -> None:
        """Count a client that has shown the token among those who have; TooManyError where there are too many."""
        ...

    def part(self, client: "Client") -> None:
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

    def __init__(self, house: House, outbox: Outbox, source: str, trusted: bool, bucket: Bucket) -> None:
        self._house = house
        self._outbox = outbox
        self._trusted = trusted
        self._bucket = bucket
        self._stamps = Stamps(source)
        self._subscribed: dict[str, Callable[[], None]] = {}
        self._flown: set[tuple[str, str]] = set()
        self._asking: set[asyncio.Task[None]] = set()
        self._place: Place | None = None
        self._closed = False
        self.source = source

    @property
    def trusted(self) -> bool:
        """Whether it has shown the token, or need not."""
        return self._trusted

    @property
    def flown(self) -> frozenset[tuple[str, str]]:
        """(source, drone) of the drones that it has commanded, outside of a seat, in this run."""
        return frozenset(self._flown)

    async def take(self, line: bytes) -> None:
        """Do what a line asks for; a refusal is an answer."""
        asked: Request | None = None
        try:
            self._bucket.take()
            if line.isspace():
                return
            asked = stream_requests.read(line)
            if not self._trusted and not isinstance(asked, stream_requests.Hello):
                raise ForbiddenError('a token is asked for here; begin with {"op": "hello", "token": "…"}')
            await self._do(asked)
        except ZsimError as error:
            self.say({"op": "error", "error": str(error)}, asked)
        except Exception as error:  # a fault of ours: this client and the others are served on
            self._house.report(f"{self.source}: {line[:80]!r}: {error!r}")
            said = f"the gateway failed ({type(error).__name__}); its terminal says more"
            self.say({"op": "error", "error": said}, asked)

    async def _do(self, asked: Request) -> None:
        match asked:
            case stream_requests.Done():
                self._done(asked)
            case stream_requests.Put():
                self._put(asked)
            case stream_requests.Latest():
                check_expression(asked.key)
                values = self._house.flight().values
                found = [entry(key, payload, values.encoding(key)) for key, payload in values.of(asked.key)]
                self.say({"op": "latest", "values": found}, asked)
            case stream_requests.Subscribe():
                self._subscribe(asked)
            case stream_requests.Unsubscribe():
                self._unsubscribe(asked)
            case stream_requests.Ask():
                if len(self._asking) >= ASKS_MAX:
                    raise TooManyError(f"ask: {ASKS_MAX} of this client wait for their answers already")
                task = asyncio.create_task(self._ask(asked, self._house.flight()))
                self._asking.add(task)
                task.add_done_callback(self._asking.discard)
            case stream_requests.Hello():
                self._hello(asked)
            case stream_requests.Join():
                self._join(asked)
            case stream_requests.Leave():
                self._leave(asked)

    def say(self, answer: dict[str, Any], asked: Request | None = None) -> None:
        """Put an answer into the outbox, with the id of what was asked."""
        if asked is not None and asked.id is not None:
            answer["id"] = asked.id
        line = _encode(answer) + b"\n"
        if len(line) > ANSWER_MAX:
            error = f"{answer['op']}: the answer has {len(line)} bytes, more than {ANSWER_MAX}; ask for less at a time"
            line = _encode({"op": "error", "error": error, "id": answer.get("id")}) + b"\n"
        self._outbox.put(line)

    def _hello(self, asked: stream_requests.Hello) -> None:
        if not self._trusted and not self._house.knows(asked.token):
            self.refuse("hello: no token, or a wrong one; ask whoever started the gateway for it", asked)
            return
        name = self._named(asked.name) if asked.name else self.source
        if not self._trusted:
            self._house.trust(self)
            self._trusted = True
        if self._place is None and name != self.source:
            self.source, self._stamps = name, Stamps(name)
        self.say({"op": "hello", "name": self.source, **self._run()}, asked)

    def refuse(self, reason: str, asked: Request | None = None) -> None:
        """Say why this is no client of ours, and hang up."""
        self.say({"op": "error", "error": reason}, asked)
        self._outbox.close()

    def expire(self) -> None:
        """Hang up on a client that has not shown the token."""
        if not self._trusted and not self._closed:
            self.refuse("hello: none came with the token in time")

    def _run(self) -> dict[str, Any]:
        try:
            flight = self._house.flight()
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

    def _put(self, asked: stream_requests.Put) -> None:
        self._house.flight().put(asked.key, asked.value, self._stamps)
        if keys.matches(keys.command("*", "*"), asked.key):
            self._flown.add((self.source, keys.thing(asked.key)))
        if not asked.quiet:
            self.say({"op": "put", "key": asked.key}, asked)

    async def _ask(self, asked: stream_requests.Ask, flight: Flight) -> None:
        """Wait for an answer beside what else it asks for: the answer may need its next done."""
        try:
            answer = await flight.ask(asked.key, asked.request, asked.args, self.source, asked.timeout_s)
            self.say({"op": "answer", "ok": answer.ok, "error": answer.error, "result": plain(answer.result)}, asked)
        except ZsimError as error:
            self.say({"op": "error", "error": str(error)}, asked)

    def _named(self, name: str) -> str:
        """Return the process name of a client: a name without a role is a client's."""
        whole = name if "." in name else f"{ROLE}.{name}"
        if not keys.PROCESS_NAME.fullmatch(whole) or "." not in whole.strip(".") or whole == self._house.name:
            raise DecodeError(
                f"name is {name[:60]!r}; must be NAME or ROLE.NAME of a-z 0-9 _ -, at most 48, e.g. myctrl or "
                "matlab.main, and not the gateway's"
            )
        return whole

    # What it hears

    def _subscribe(self, asked: stream_requests.Subscribe) -> None:
        if asked.key not in self._subscribed:
            if len(self._subscribed) >= SUBSCRIPTIONS_MAX:
                raise TooManyError(
                    f"subscribe: there are {SUBSCRIPTIONS_MAX} already; unsubscribe some, or use wildcards"
                )
            self._subscribed[asked.key] = self._house.feed.subscribe(asked.key, self._on_value)
        self.say({"op": "subscribe", "key": asked.key}, asked)

    def _on_value(self, heard: Heard) -> None:
        self._outbox.put(value_line(heard), may_go=True)

    def _unsubscribe(self, asked: stream_requests.Unsubscribe) -> None:
        if asked.key not in self._subscribed:
            raise DecodeError(f"unsubscribe: {asked.key[:80]!r} is not subscribed to")
        self._subscribed.pop(asked.key)()
        self.say({"op": "unsubscribe", "key": asked.key}, asked)

    # The lockstep

    def _join(self, asked: stream_requests.Join) -> None:
        if self._place is not None:
            raise DecodeError(f"join: is {self._place.seat.name} already; leave first, or use another connection")
        name = self._named(asked.name)
        place = Place(name, asked, self._house.flight(), self._house.loop, self._outbox.put)
        self._place, self.source, self._stamps = place, name, place.stamps
        self._house.sit(place.seat, lambda reason: self._on_place_lost(place, reason))
        self.say({"op": "join", "name": name, "gates": place.seat.gate_keys}, asked)

    def _done(self, asked: stream_requests.Done) -> None:
        if self._place is None:
            raise DecodeError("done: has not joined; must say join first")
        self._place.done(asked)

    def lose_seat(self, name: str, reason: str, but: Seat) -> None:
        """Lose the seat of a name, unless it is a certain one: it dies, as another lives in its place."""
        if self._place is not None and self._place.seat.name == name and self._place.seat is not but:
            place = self._place
            place.seat.leave(deserted=True)
            self._on_place_lost(place, reason)

    def end_seat(self, flight: Flight, reason: str) -> None:
        """End the seat in a run that is over, answered or not."""
        if self._place is not None and self._place.flight is flight:
            place = self._place
            place.seat.leave()
            self._on_place_lost(place, reason)

    def _on_place_lost(self, place: Place, reason: str) -> None:
        """Tell that there is no place any more."""
        if self._place is place:
            self._place = None
            self.say({"op": "left", "reason": reason})

    def _leave(self, asked: stream_requests.Leave) -> None:
        if self._place is None:
            raise DecodeError("leave: has not joined; there is nothing to leave")
        self._place.seat.leave()
        self._place = None
        self.say({"op": "leave"}, asked)

    # Runs come and go, and so does it

    def tell_of_run(self, state: str, run_id: str) -> None:
        """Tell that a run has begun or ended, or that the link to its world is lost or back."""
        if state == "begun":
            self._stamps = Stamps(self.source)
            self._flown.clear()
        if self._trusted:
            self.say({"op": "run", "state": state, "run_id": run_id})

    def close(self, deserted: bool = True) -> None:
        """End all that it has.

        Args:
            deserted: whether its connection broke, so that its seat in the lockstep dies rather than leaves.
        """
        if self._closed:
            return
        self._closed = True
        for task in self._asking:
            task.cancel()
        for end in self._subscribed.values():
            end()
        if self._place is not None:
            self._place.seat.leave(deserted)
        self._outbox.close()
        self._house.part(self)


def lost_line(lost: int) -> bytes:
    """Return the line that tells a client how many values went."""
    return _encode({"op": "lost", "lines": lost}) + b"\n"
