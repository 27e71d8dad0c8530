"""One client on a stream: its requests are executed, answers and values go into its outbox."""

import asyncio
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from zsim.contract import keys
from zsim.errors import DecodeError, NoWorldError, ZsimError
from zsim.runtime.rate_limit import RateLimit
from zsim.transport.session import RawSample, check_expression
from zsim_bridges.gateway import stream_requests
from zsim_bridges.gateway.access_check import count_request
from zsim_bridges.gateway.client_messages import (
    ForbiddenError,
    MessageDefaults,
    TooManyError,
    json_entry,
    json_value,
    value_line,
)
from zsim_bridges.gateway.client_streams import OUTBOX_BYTES_MAX, Outbox
from zsim_bridges.gateway.lockstep_session import LockstepSession
from zsim_bridges.gateway.publications import SharedSubscriptions
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.gateway.stream_requests import StreamRequest

SUBSCRIPTIONS_MAX = 100  # of one client; `drone/*/truth` is one
ANSWER_MAX = OUTBOX_BYTES_MAX  # bytes of an answer
PENDING_MAX = 8  # requests of one client that wait for their answers
ROLE = "client"  # of a name without a role
_encode = msgspec.json.Encoder().encode


class GatewayApi(Protocol):
    """What a client needs of the gateway."""

    loop: asyncio.AbstractEventLoop
    name: str  # of its process
    subscriptions: SharedSubscriptions

    def run(self) -> RunAccess:
        """Return the current run; NoWorldError where there is none."""
        ...

    def is_token(self, token: str) -> bool:
        """Return whether a token is the right one."""
        ...

    def start_lockstep(self, session: LockstepSession, ended: Callable[[str], None]) -> None:
        """Run a session until its client leaves; `ended` is called with the reason."""
        ...

    def report(self, text: str) -> None:
        """Print a fault of the gateway itself."""
        ...

    def admit(self, client: "Client") -> None:
        """Count a client as authenticated; TooManyError where the limit is reached."""
        ...

    def remove(self, client: "Client") -> None:
        """Forget a client that is gone, and release the drones that it commanded."""
        ...


class Client:
    """One connection.

    Args:
        gateway: see GatewayApi.
        outbox: of the connection.
        source: name under which it publishes until it gives its own.
        authenticated: whether it has shown the token already, or needs none.
        limit: of its requests.

    Attributes:
        source: name under which it publishes.
        authenticated: whether it has shown the token, or needs none.
        commanded: (source, drone) of the drones that it has commanded, outside of a lockstep session, in this run.
    """

    def __init__(self, gateway: GatewayApi, outbox: Outbox, source: str, authenticated: bool, limit: RateLimit) -> None:
        self._gateway = gateway
        self._outbox = outbox
        self.authenticated = authenticated
        self._limit = limit
        self._defaults = MessageDefaults(source)
        self._subscriptions: dict[str, Callable[[], None]] = {}
        self.commanded: set[tuple[str, str]] = set()
        self._pending: set[asyncio.Task[None]] = set()
        self._session: LockstepSession | None = None
        self._closed = False
        self.source = source

    async def handle_line(self, line: bytes) -> None:
        """Execute the request in a line; an error is an answer."""
        request: StreamRequest | None = None
        try:
            count_request(self._limit)
            if line.isspace():
                return
            request = stream_requests.decode_request(line)
            if not self.authenticated and not isinstance(request, stream_requests.HelloRequest):
                raise ForbiddenError('a token is asked for here; begin with {"op": "hello", "token": "…"}')
            getattr(self, f"_{request.__struct_config__.tag}")(request)  # the method that has the name of the op
        except ZsimError as error:
            self.refuse_line(str(error), request)
        except Exception as error:  # a fault of the gateway: this client and the others are served on
            self._gateway.report(f"{self.source}: {line[:80]!r}: {error!r}")
            self.refuse_line(f"the gateway failed ({type(error).__name__}); its terminal says more", request)

    def send(self, answer: dict[str, Any], request: StreamRequest | None = None) -> None:
        """Put an answer into the outbox, with the id of its request."""
        if request is not None and request.id is not None:
            answer["id"] = request.id
        line = _encode(answer) + b"\n"
        if len(line) > ANSWER_MAX:
            error = f"{answer['op']}: the answer has {len(line)} bytes, more than {ANSWER_MAX}; ask for less at a time"
            line = _encode({"op": "error", "error": error, "id": answer.get("id")}) + b"\n"
        self._outbox.put(line)

    def refuse_line(self, error: str, request: StreamRequest | None = None) -> None:
        """Answer a request, or a line that is none, with an error."""
        self.send({"op": "error", "error": error}, request)

    def _hello(self, request: stream_requests.HelloRequest) -> None:
        if not self.authenticated and not self._gateway.is_token(request.token):
            self.refuse("hello: no token, or a wrong one; ask whoever started the gateway for it", request)
            return
        name = self._process_name(request.name) if request.name else self.source
        if not self.authenticated:
            self._gateway.admit(self)
            self.authenticated = True
        if self._session is None and name != self.source:
            self.source, self._defaults = name, MessageDefaults(name)
        self.send({"op": "hello", "name": self.source, **self._run_fields()}, request)

    def refuse(self, error: str, request: StreamRequest | None = None) -> None:
        """Answer with an error and close the connection."""
        self.refuse_line(error, request)
        self._outbox.close()

    def expire(self) -> None:
        """Close the connection of a client that has not shown the token."""
        if not self.authenticated and not self._closed:
            self.refuse("hello: none came with the token in time")

    def _run_fields(self) -> dict[str, Any]:
        try:
            run = self._gateway.run()
        except NoWorldError:
            return {"run_id": None}
        info = run.info
        return {
            "run_id": info.run_id,
            "federation": info.federation,
            "mode": info.mode,
            "gate_s": info.gate_ns / 1e9,
            "t_ns": run.now_ns,
            "drones": [drone.name for drone in info.drones],
            "clusters": [{"name": cluster.name, "drones": cluster.drones} for cluster in info.clusters],
        }

    def _latest(self, request: stream_requests.LatestRequest) -> None:
        check_expression(request.key)
        last = self._gateway.run().values
        entries = [json_entry(key, payload, last.encoding(key)) for key, payload in last.matching(request.key)]
        self.send({"op": "latest", "values": entries}, request)

    def _put(self, request: stream_requests.PutRequest) -> None:
        self._gateway.run().put(request.key, request.value, self._defaults)
        if keys.matches(keys.command("*", "*"), request.key):
            self.commanded.add((self.source, keys.thing(request.key)))
        if not request.quiet:
            self.send({"op": "put", "key": request.key}, request)

    def _ask(self, request: stream_requests.AskRequest) -> None:
        if len(self._pending) >= PENDING_MAX:
            raise TooManyError(f"ask: {PENDING_MAX} of this client wait for their answers already")
        task = asyncio.create_task(self._send_answer(request, self._gateway.run()))
        self._pending.add(task)
        task.add_done_callback(self._pending.discard)

    async def _send_answer(self, request: stream_requests.AskRequest, run: RunAccess) -> None:
        """Wait for an answer while other requests are executed: the answer may need the client's next done."""
        try:
            answer = await run.request(request.key, request.request, request.args, self.source, request.timeout_s)
        except ZsimError as error:
            self.refuse_line(str(error), request)
            return
        result = json_value(answer.result)
        self.send({"op": "answer", "ok": answer.ok, "error": answer.error, "result": result}, request)

    def _process_name(self, name: str) -> str:
        """Return the process name of a client: a name without a role gets ROLE.

        Raises:
            DecodeError: it is no process name, or the gateway's.
        """
        process = name if "." in name else f"{ROLE}.{name}"
        if not keys.PROCESS_NAME.fullmatch(process) or "." not in process.strip(".") or process == self._gateway.name:
            raise DecodeError(
                f"name is {name[:60]!r}; must be NAME or ROLE.NAME of a-z 0-9 _ -, at most 48, e.g. myctrl or "
                "matlab.main, and not the gateway's"
            )
        return process

    # Subscriptions

    def _subscribe(self, request: stream_requests.SubscribeRequest) -> None:
        if request.key not in self._subscriptions:
            if len(self._subscriptions) >= SUBSCRIPTIONS_MAX:
                raise TooManyError(
                    f"subscribe: there are {SUBSCRIPTIONS_MAX} already; unsubscribe some, or use wildcards"
                )
            self._subscriptions[request.key] = self._gateway.subscriptions.subscribe(request.key, self._on_value)
        self.send({"op": "subscribe", "key": request.key}, request)

    def _on_value(self, sample: RawSample) -> None:
        if line := value_line(sample):
            self._outbox.put(line, droppable=True)

    def _unsubscribe(self, request: stream_requests.UnsubscribeRequest) -> None:
        if request.key not in self._subscriptions:
            raise DecodeError(f"unsubscribe: {request.key[:80]!r} is not subscribed to")
        self._subscriptions.pop(request.key)()
        self.send({"op": "unsubscribe", "key": request.key}, request)

    # Lockstep

    def _join(self, request: stream_requests.JoinRequest) -> None:
        if self._session is not None:
            raise DecodeError(f"join: is {self._session.name} already; leave first, or use another connection")
        name = self._process_name(request.name)
        session = LockstepSession(name, request, self._gateway.run(), self._gateway.loop, self._outbox.put)
        self._session, self.source, self._defaults = session, name, session.defaults
        self._gateway.start_lockstep(session, lambda reason: self._on_session_ended(session, reason))
        self.send({"op": "join", "name": name, "gates": session.gate_keys}, request)

    def _done(self, request: stream_requests.DoneRequest) -> None:
        if self._session is None:
            raise DecodeError("done: has not joined; must say join first")
        self._session.answer_gate(request)

    def lose_lockstep(self, successor: LockstepSession, reason: str) -> None:
        """End another session of the same name: its name has been taken."""
        session = self._session
        if session is not None and session.name == successor.name and session is not successor:
            session.leave(connection_lost=True)
            self._on_session_ended(session, reason)

    def end_lockstep(self, run: RunAccess, reason: str) -> None:
        """End the session in a run that is over, answered or not."""
        session = self._session
        if session is not None and session.run is run:
            session.leave()
            self._on_session_ended(session, reason)

    def _on_session_ended(self, session: LockstepSession, reason: str) -> None:
        if self._session is session:
            self._session = None
            self.send({"op": "left", "reason": reason})

    def _leave(self, request: stream_requests.LeaveRequest) -> None:
        if self._session is None:
            raise DecodeError("leave: has not joined; there is nothing to leave")
        self._session.leave()
        self._session = None
        self.send({"op": "leave"}, request)

    # Runs, and the end of the connection

    def notify_run(self, state: str, run_id: str) -> None:
        """Send that a run has begun or ended, or that the link to its world is lost or back."""
        if state == "begun":
            self._defaults = MessageDefaults(self.source)
            self.commanded.clear()
        if self.authenticated:
            self.send({"op": "run", "state": state, "run_id": run_id})

    def close(self, connection_lost: bool = True) -> None:
        """End everything that it has.

        Args:
            connection_lost: whether the connection broke, so that its process in the lockstep dies rather than leaves.
        """
        if self._closed:
            return
        self._closed = True
        for task in self._pending:
            task.cancel()
        for unsubscribe in self._subscriptions.values():
            unsubscribe()
        if self._session is not None:
            self._session.leave(connection_lost)
        self._outbox.close()
        self._gateway.remove(self)
