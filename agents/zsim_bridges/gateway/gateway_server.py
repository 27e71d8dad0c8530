"""The gateway: serves one run after another over HTTP, WebSocket and lines of JSON; and the client on each stream."""

import asyncio
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

import msgspec

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED
from zsim.errors import DecodeError, NoWorldError, RunError, ZsimError
from zsim.runtime.participant import ANOTHER_RUN, Participant
from zsim.runtime.rate_limit import RateLimit
from zsim.runtime.runner import Runner
from zsim.transport.session import RawSample, Session, check_expression
from zsim_bridges.gateway import client_messages
from zsim_bridges.gateway.client_messages import (
    ClientLimit,
    ForbiddenError,
    MessageDefaults,
    StreamRequest,
    TooManyError,
    count_request,
    json_entry,
    json_value,
    value_line,
)
from zsim_bridges.gateway.client_streams import LINE_MAX, OUTBOX_BYTES_MAX, Outbox, PictureFeeds, serve_lines
from zsim_bridges.gateway.http_server import AccessCheck, KeyTrees, application
from zsim_bridges.gateway.run_access import LockstepSession, RunAccess, SharedSubscriptions
from zsim_bridges.web.web_server import (
    ServedSite,
    cancel_other_tasks,
    check_token,
    open_on_thread,
    start_site,
    url_host,
)

CLIENTS_MAX = 500  # number of concurrent streams
UNAUTHENTICATED_MAX = 100  # number of concurrent unauthenticated connections
HELLO_TIMEOUT_S = 5.0  # time limit for a client to present its token
DRAIN_S = 2.0  # after the end of a run, how long agents may still answer their last gates
ERRORS_REPORTED_MAX = 100  # number of distinct errors that are printed
PICTURES_WAITING_MAX = 4  # number of waiting messages per camera; each may take megabytes
RELEASE_TIMEOUT_S = 1.0  # ample: the world answers within milliseconds
STREAM_RATE_HZ = 5_000.0  # requests per wall second on one stream; a loop in step with the fastest run makes 2 500
STREAM_BURST = 10_000.0
LEAVE_TIMEOUT_S = 2.0  # how long shutdown waits for the agents to leave
SUBSCRIPTIONS_MAX = 100  # number per client; `drone/*/truth` counts as one
ANSWER_MAX = OUTBOX_BYTES_MAX  # size limit of an answer [bytes]
PENDING_MAX = 8  # number of unanswered requests per client
ROLE = "client"  # role added to a name without one
_encode = msgspec.json.Encoder().encode


class GatewayPorts(NamedTuple):
    """The host and the ports on which the gateway listens."""

    host: str
    http_port: int
    lines_port: int


class Gateway:
    """A gateway: its servers, its clients, and the current run.

    Args:
        token: the clients' token; None if only this machine can connect.
        dial: opens a session to the world for a named process.
        say: prints a line.
        secured: whether access control restricts the keys on which the gateway may publish.

    Raises:
        RunError: other machines could reach the gateway without a token.
    """

    def __init__(
        self,
        ports: GatewayPorts,
        name: str,
        token: str | None,
        dial: Callable[[str], AbstractContextManager[tuple[Session, Info]]],
        say: Callable[[str], None],
        secured: bool = False,
    ) -> None:
        check_token("gateway", ports.host, token)
        self.loop = asyncio.new_event_loop()
        self.loop.set_exception_handler(self._on_loop_error)
        self._client_limit = ClientLimit(CLIENTS_MAX)
        self.subscriptions = SharedSubscriptions(self.loop, self._client_limit)
        self._full_key_subscriptions = SharedSubscriptions(self.loop, self._client_limit)
        self._picture_subscriptions = SharedSubscriptions(self.loop, self._client_limit, PICTURES_WAITING_MAX)
        self._pictures = PictureFeeds(self._picture_subscriptions.subscribe, self._refuse_picture)
        self._ports = ports
        self.name = name
        self._needs_token = token is not None
        self._access_check = AccessCheck(token, self.report)
        self.is_token = self._access_check.is_token
        self._dial = dial
        self._secured = secured
        self._say = say
        self._run: RunAccess | None = None
        self._link_lost = False
        self._reported_errors: set[str] = set()
        self._clients: set[Client] = set()
        self._unauthenticated: dict[Client, None] = {}  # unauthenticated clients, in order of connection
        self._lockstep_threads: set[threading.Thread] = set()

    # For clients

    def run(self) -> RunAccess:
        """Return the current run, or raise a NoWorldError."""
        if self._run is None:
            raise NoWorldError("there is no run now; the gateway is waiting for the next")
        return self._run

    def start_lockstep(self, session: LockstepSession, on_end: Callable[[str], None]) -> None:
        """Run a client's lockstep session on a link of its own until it ends; then call `on_end` with the reason."""
        for client in self._clients:
            client.lose_lockstep(session, "another client took the name")
        thread = threading.Thread(target=self._run_lockstep, args=(session, on_end), name=session.name, daemon=True)
        self._lockstep_threads.add(thread)
        thread.start()

    def _run_lockstep(self, session: LockstepSession, on_end: Callable[[str], None]) -> None:
        reason = "the gateway failed"
        try:
            with self._dial(session.name) as (link, info):
                has_left, is_lost = (lambda: session.has_left), (lambda: session.connection_lost)
                reason = Runner(link, info, session, has_left, self._say, is_lost).run()
        except ZsimError as error:
            reason = str(error)
        except Exception as error:  # an internal error: the client must not wait forever
            self.report(f"{session.name}: {error!r}")
        finally:
            self._say(f"{session.name}: left, {'its client is gone' if session.connection_lost else reason}")
            self._lockstep_threads.discard(threading.current_thread())
            with suppress(RuntimeError):  # the gateway has ended
                self.loop.call_soon_threadsafe(on_end, reason)

    def report(self, text: str) -> None:
        """Print an internal error of the gateway."""
        self._say(f"{self.name}: {text}")

    def remove(self, client: "Client") -> None:
        """Remove a client that is gone, and release drones that it commanded, unless another client has its name."""
        if client not in self._clients:
            return
        self._clients.discard(client)
        if client.authenticated:
            self._client_limit.leave()
        self._unauthenticated.pop(client, None)
        others = {other.source for other in self._clients}
        released = [(source, drone) for source, drone in client.commanded if source not in others]
        if self._run is not None and released:
            self.loop.run_in_executor(None, _release_drones, self._run.link, released)

    def admit(self, client: "Client") -> None:
        """Count a client as authenticated.

        Raises:
            TooManyError: there are too many clients, or this client has been evicted meanwhile.
        """
        if client not in self._unauthenticated:
            raise TooManyError("the connection was closed, since it waited too long for its token; connect again")
        self._client_limit.enter()
        del self._unauthenticated[client]

    # A run

    def serve(
        self,
        link: Session,
        info: Info,
        observer: Participant,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """Serve a run until it is over or `stopped` returns true."""
        run = RunAccess(link, info, observer, self._secured)
        run.open()
        self._call_on_loop(self._begin, run)
        self._observe_link(run)
        say(f"{self.name}: clients may use run {info.run_id}")
        try:
            run.receive_until_end(stopped)
        finally:
            if not observer.end_reason:  # the gateway exits while the run continues
                for client in list(self._clients):
                    _release_drones(link, client.commanded)
            self._call_on_loop(self._end, run, observer.end_reason == ANOTHER_RUN)
            run.close()

    def _call_on_loop(self, act: Callable[..., None], *args: Any) -> None:
        async def call() -> None:
            act(*args)

        asyncio.run_coroutine_threadsafe(call(), self.loop).result()

    def _begin(self, run: RunAccess) -> None:
        self._run, self._link_lost = run, False
        self.subscriptions.attach(run.link)
        self._full_key_subscriptions.attach(run.unprefixed_link)
        self._picture_subscriptions.attach(run.link)
        self._pictures.clear_pictures()
        self._notify_clients("begun", run)

    def _end(self, run: RunAccess, has_successor: bool = False) -> None:
        """End a run for the clients; `has_successor`: another run has begun, so the link is restored."""

        def end_lockstep_sessions() -> None:
            for client in self._clients:
                client.end_lockstep(run, RUN_ENDED)

        if has_successor:
            self._notify_link(run, True)
        self._run = None
        self.subscriptions.detach()
        self._full_key_subscriptions.detach()
        self._picture_subscriptions.detach()
        self._notify_clients("ended", run)
        self.loop.call_later(DRAIN_S, end_lockstep_sessions)

    def _notify_clients(self, state: str, run: RunAccess) -> None:
        for client in self._clients:
            client.notify_run(state, run.info.run_id)

    def _observe_link(self, run: RunAccess) -> None:
        def on_link(is_up: bool) -> None:
            with suppress(RuntimeError):  # called in a Zenoh thread, perhaps after the gateway has ended
                self.loop.call_soon_threadsafe(self._notify_link, run, is_up)

        run.link.on_link(on_link)
        if not run.link.links():  # the link was lost before it was observed, so no event follows
            on_link(False)

    def _notify_link(self, run: RunAccess, is_up: bool) -> None:
        """Notify clients that the link is lost or restored, but not if the world exits after its run has ended."""
        if run is self._run and is_up == self._link_lost:
            self._link_lost = not is_up
            self._notify_clients("back" if is_up else "lost", run)

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Print an error that no client receives, each text once: a flood of connections causes a flood of errors."""
        self._report_once(f"{context.get('message')}: {context.get('exception')!r}")

    def _refuse_picture(self, reason: str) -> None:
        if self._run is not None:
            self._run.count_refused()
        self._report_once(reason)

    def _report_once(self, text: str) -> None:
        if text not in self._reported_errors and len(self._reported_errors) < ERRORS_REPORTED_MAX:
            self._reported_errors.add(text)
            self.report(text)

    # Servers

    @contextmanager
    def open(self) -> Iterator[None]:
        """Serve clients in a separate thread; raise a RunError if a port is taken."""
        with open_on_thread(self.loop, "gateway servers", self._open, lambda servers: self._close(*servers)):
            yield

    async def _open(self) -> tuple[ServedSite, asyncio.Server]:
        host, http_port, lines_port = self._ports
        subscribed = self._full_key_subscriptions, self.subscriptions
        trees = KeyTrees(self.run, *subscribed, self._pictures, self._client_limit, self.name)
        app = application(self._access_check, trees, self._new_client)
        serve = partial(serve_lines, self._new_client, not self._needs_token)
        try:
            site = await start_site(app, host, (http_port,), shutdown_s=1.0)
            try:
                lines = await asyncio.start_server(serve, host, lines_port, limit=LINE_MAX)
            except OSError:
                await site.cleanup()
                raise
        except OSError as error:
            ports = f"{host}, ports {http_port} and {lines_port}"
            raise RunError(f"gateway: cannot listen on {ports} ({error.strerror}); give --http and --lines") from error
        address = f"http://{url_host(host)}:{http_port}"
        self._say(f"{self.name}: HTTP and WebSocket on {address}, lines on port {lines_port}")
        return site, lines

    async def _close(self, site: ServedSite, lines: asyncio.Server) -> None:
        def join_all(threads: list[threading.Thread]) -> None:
            deadline_s = time.monotonic() + LEAVE_TIMEOUT_S
            for thread in threads:
                thread.join(max(0.0, deadline_s - time.monotonic()))

        lines.close()
        for client in list(self._clients):
            client.close(connection_lost=False)
        await asyncio.to_thread(join_all, list(self._lockstep_threads))
        await cancel_other_tasks()
        await site.cleanup()

    def _new_client(self, outbox: Outbox, authenticated: bool) -> "Client":
        limit = RateLimit(1 / STREAM_RATE_HZ, STREAM_BURST)
        client = Client(self, outbox, f"client.{secrets.token_hex(3)}", authenticated, limit)
        if authenticated:
            try:
                self._client_limit.enter()
            except TooManyError as error:
                client.refuse(str(error))
                return client
        else:
            if len(self._unauthenticated) >= UNAUTHENTICATED_MAX:  # close the connection that has waited longest
                oldest = next(iter(self._unauthenticated))
                oldest.expire()
                self.remove(oldest)
            self._unauthenticated[client] = None
            self.loop.call_later(HELLO_TIMEOUT_S, client.expire)
        self._clients.add(client)
        return client


def _release_drones(link: Session, commanded: Iterable[tuple[str, str]]) -> None:
    """Request releases in the name of the source that commanded each drone; the world checks that it still does."""
    with suppress(ZsimError):
        for source, drone in commanded:
            link.request(keys.CONTROL, "release", source, {"drone": drone}, RELEASE_TIMEOUT_S)


class Client:
    """The client on one stream: executes its requests; answers and values go into its outbox.

    Args:
        source: name under which the client publishes until it gives its own.
        authenticated: whether the client has presented the token, or needs none.

    Attributes:
        commanded: (source, drone) of the drones that the client has commanded in this run by `put` requests.
    """

    def __init__(self, gateway: Gateway, outbox: Outbox, source: str, authenticated: bool, limit: RateLimit) -> None:
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
        """Execute the request in a line; an error is sent as an answer."""
        request: StreamRequest | None = None
        try:
            count_request(self._limit)
            if line.isspace():
                return
            request = client_messages.decode_request(line)
            if not self.authenticated and not isinstance(request, client_messages.HelloRequest):
                raise ForbiddenError('a token is required; begin with {"op": "hello", "token": "…"}')
            getattr(self, f"_{request.__struct_config__.tag}")(request)  # the method named after the op
        except ZsimError as error:
            self.refuse_line(str(error), request)
        except Exception as error:  # an internal error: the gateway continues
            self._gateway.report(f"{self.source}: {line[:80]!r}: {error!r}")
            self.refuse_line(f"the gateway failed ({type(error).__name__}); its terminal shows the error", request)

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
        """Answer a request, or an invalid line, with an error."""
        self.send({"op": "error", "error": error}, request)

    def refuse(self, error: str, request: StreamRequest | None = None) -> None:
        """Answer with an error and close the connection."""
        self.refuse_line(error, request)
        self._outbox.close()

    def expire(self) -> None:
        """Close the connection of an unauthenticated client."""
        if not self.authenticated and not self._closed:
            self.refuse("hello: not received with the token in time")

    def _hello(self, request: client_messages.HelloRequest) -> None:
        if not self.authenticated and not self._gateway.is_token(request.token):
            self.refuse("hello: no token, or a wrong one; ask the gateway's operator for it", request)
            return
        name = self._process_name(request.name) if request.name else self.source
        if not self.authenticated:
            self._gateway.admit(self)
            self.authenticated = True
        if self._session is None and name != self.source:
            self.source, self._defaults = name, MessageDefaults(name)
        answer: dict[str, Any] = {"op": "hello", "name": self.source, "run_id": None}
        with suppress(NoWorldError):
            run = self._gateway.run()
            info = run.info
            answer |= {
                "run_id": info.run_id,
                "federation": info.federation,
                "mode": info.mode,
                "gate_s": info.gate_ns / 1e9,
                "t_ns": run.now_ns,
                "drones": [drone.name for drone in info.drones],
                "clusters": [{"name": cluster.name, "drones": cluster.drones} for cluster in info.clusters],
            }
        self.send(answer, request)

    def _process_name(self, name: str) -> str:
        """Return a client's process name, with ROLE prepended if it has no role, or raise a DecodeError."""
        process = name if "." in name else f"{ROLE}.{name}"
        if not keys.PROCESS_NAME.fullmatch(process) or "." not in process.strip(".") or process == self._gateway.name:
            raise DecodeError(
                f"name is {name[:60]!r}; must be NAME or ROLE.NAME, at most 48 characters of a-z 0-9 _ -, "
                "e.g. myctrl or matlab.main, and not the gateway's"
            )
        return process

    def _latest(self, request: client_messages.LatestRequest) -> None:
        check_expression(request.key)
        values = self._gateway.run().values
        entries = [json_entry(key, payload, values.encoding(key)) for key, payload in values.matching(request.key)]
        self.send({"op": "latest", "values": entries}, request)

    def _put(self, request: client_messages.PutRequest) -> None:
        self._gateway.run().put(request.key, request.value, self._defaults)
        if keys.matches(keys.command("*", "*"), request.key):
            self.commanded.add((self.source, keys.thing(request.key)))
        if not request.quiet:
            self.send({"op": "put", "key": request.key}, request)

    def _ask(self, request: client_messages.AskRequest) -> None:
        if len(self._pending) >= PENDING_MAX:
            raise TooManyError(f"ask: {PENDING_MAX} requests of this client are already waiting for answers")
        task = asyncio.create_task(self._send_answer(request, self._gateway.run()))
        self._pending.add(task)
        task.add_done_callback(self._pending.discard)

    async def _send_answer(self, request: client_messages.AskRequest, run: RunAccess) -> None:
        """Wait for an answer while other requests are executed, since it may depend on the client's next `done`."""
        try:
            answer = await run.request(request.key, request.request, request.args, self.source, request.timeout_s)
        except ZsimError as error:
            self.refuse_line(str(error), request)
            return
        result = json_value(answer.result)
        self.send({"op": "answer", "ok": answer.ok, "error": answer.error, "result": result}, request)

    # Subscriptions

    def _subscribe(self, request: client_messages.SubscribeRequest) -> None:
        if request.key not in self._subscriptions:
            if len(self._subscriptions) >= SUBSCRIPTIONS_MAX:
                raise TooManyError(
                    f"subscribe: this client has {SUBSCRIPTIONS_MAX} subscriptions already; end some, or use wildcards"
                )
            self._subscriptions[request.key] = self._gateway.subscriptions.subscribe(request.key, self._on_value)
        self.send({"op": "subscribe", "key": request.key}, request)

    def _on_value(self, sample: RawSample) -> None:
        if line := value_line(sample):
            self._outbox.put(line, droppable=True)

    def _unsubscribe(self, request: client_messages.UnsubscribeRequest) -> None:
        if request.key not in self._subscriptions:
            raise DecodeError(f"unsubscribe: {request.key[:80]!r} is not subscribed to")
        self._subscriptions.pop(request.key)()
        self.send({"op": "unsubscribe", "key": request.key}, request)

    # Lockstep

    def _join(self, request: client_messages.JoinRequest) -> None:
        if self._session is not None:
            raise DecodeError(
                f"join: this client is already {self._session.name}; leave first, or use another connection"
            )
        name = self._process_name(request.name)
        session = LockstepSession(name, request, self._gateway.run(), self._gateway.loop, self._outbox.put)
        self._session, self.source, self._defaults = session, name, session.defaults
        self._gateway.start_lockstep(session, lambda reason: self._on_session_ended(session, reason))
        self.send({"op": "join", "name": name, "gates": session.gate_keys}, request)

    def _done(self, request: client_messages.DoneRequest) -> None:
        if self._session is None:
            raise DecodeError("done: this client has not joined; it must join first")
        self._session.answer_gate(request)

    def lose_lockstep(self, successor: LockstepSession, reason: str) -> None:
        """End the session if its name is now that of `successor`."""
        session = self._session
        if session is not None and session.name == successor.name and session is not successor:
            session.leave(connection_lost=True)
            self._on_session_ended(session, reason)

    def end_lockstep(self, run: RunAccess, reason: str) -> None:
        """End the session of a finished run, even with an unanswered gate."""
        session = self._session
        if session is not None and session.run is run:
            session.leave()
            self._on_session_ended(session, reason)

    def _on_session_ended(self, session: LockstepSession, reason: str) -> None:
        if self._session is session:
            self._session = None
            self.send({"op": "left", "reason": reason})

    def _leave(self, request: client_messages.LeaveRequest) -> None:
        if self._session is None:
            raise DecodeError("leave: this client has not joined; there is nothing to leave")
        self._session.leave()
        self._session = None
        self.send({"op": "leave"}, request)

    # Runs, and the end of the connection

    def notify_run(self, state: str, run_id: str) -> None:
        """Notify the client that a run has begun or ended, or that the link to its world is lost or restored."""
        if state == "begun":
            self._defaults = MessageDefaults(self.source)
            self.commanded.clear()
        if self.authenticated:
            self.send({"op": "run", "state": state, "run_id": run_id})

    def close(self, connection_lost: bool = True) -> None:
        """Release the client's resources; in the lockstep, a lost connection is treated as a dead process."""
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
