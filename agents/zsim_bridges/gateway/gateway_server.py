"""The gateway: serves HTTP, WebSocket and lines of JSON, for one run after the other."""

import asyncio
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.contract.run_messages import RUN_ENDED
from zsim.errors import NoWorldError, RunError, ZsimError
from zsim.runtime.participant import ANOTHER_RUN, Participant
from zsim.runtime.rate_limit import RateLimit
from zsim.runtime.runner import Runner
from zsim.transport.session import Session
from zsim_bridges.gateway.access_check import AccessCheck, ConnectionLimit
from zsim_bridges.gateway.client_messages import TooManyError
from zsim_bridges.gateway.client_streams import LINE_MAX, LineServer, Outbox
from zsim_bridges.gateway.http_routes import application
from zsim_bridges.gateway.http_trees import CameraTree, JsonTree, RestTree
from zsim_bridges.gateway.lockstep_session import LockstepSession
from zsim_bridges.gateway.publications import SharedSubscriptions
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.gateway.stream_client import Client
from zsim_bridges.web.picture_streams import PictureFeeds
from zsim_bridges.web.web_server import (
    ServedSite,
    cancel_other_tasks,
    check_token,
    open_on_thread,
    start_site,
    url_host,
)

CLIENTS_MAX = 500  # streams at once
UNAUTHENTICATED_MAX = 100  # connections at once that have not shown the token yet
HELLO_TIMEOUT_S = 5.0  # how long a client may take to show it
DRAIN_S = 2.0  # after the end of a run, how long agents may still answer their last gates
FAULTS_REPORTED_MAX = 100
PICTURES_WAITING_MAX = 4  # of a camera that wait for the loop; each may have megabytes
RELEASE_TIMEOUT_S = 1.0  # the world answers within milliseconds
STREAM_RATE_HZ = 5_000.0  # requests per wall second of one stream; a loop at the speed of the fastest run has 2 500
STREAM_BURST = 10_000.0
BYE_TIMEOUT_S = 2.0  # how long the end waits for the byes of the agents


class GatewayPorts(NamedTuple):
    """Where the gateway listens."""

    host: str
    http_port: int
    lines_port: int


class Gateway:
    """One gateway.

    Args:
        ports: where it listens.
        name: process name.
        token: that clients must show; None on this machine alone.
        dial: opens a session to the world for a process of a name.
        say: prints a line.
        secured: whether access control decides where it may publish.

    Raises:
        RunError: others could reach it, and there is no token.
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
        self._client_limit = ConnectionLimit(CLIENTS_MAX, "clients")
        self.subscriptions = SharedSubscriptions(self.loop, self._client_limit)
        self._full_key_subscriptions = SharedSubscriptions(self.loop, self._client_limit)
        self._picture_subscriptions = SharedSubscriptions(self.loop, self._client_limit, PICTURES_WAITING_MAX)
        self._pictures = PictureFeeds(self._picture_subscriptions.subscribe, self._refuse_picture)
        self._ports = ports
        self.name = name
        self._access_check = AccessCheck(token, self.report)
        self._dial = dial
        self._secured = secured
        self._say = say
        self._run: RunAccess | None = None
        self._link_lost = False
        self._reported_faults: set[str] = set()
        self._clients: set[Client] = set()
        self._unauthenticated: dict[Client, None] = {}  # those of them that have shown no token yet, in order
        self._lockstep_threads: set[threading.Thread] = set()

    # For clients

    def run(self) -> RunAccess:
        """Return the current run.

        Raises:
            NoWorldError: there is none.
        """
        if self._run is None:
            raise NoWorldError("there is no run now; the gateway waits for the next")
        return self._run

    def is_token(self, token: str) -> bool:
        """Return whether a token is the right one."""
        return self._access_check.is_token(token)

    def start_lockstep(self, session: LockstepSession, ended: Callable[[str], None]) -> None:
        """Run a client's agent, on a link of its own, until it leaves; `ended` is called with the reason."""
        for client in self._clients:
            client.lose_lockstep(session, "another client took the name")
        thread = threading.Thread(target=self._run_lockstep, args=(session, ended), name=session.name, daemon=True)
        self._lockstep_threads.add(thread)
        thread.start()

    def report(self, text: str) -> None:
        """Print a fault of the gateway itself."""
        self._say(f"{self.name}: {text}")

    def remove(self, client: Client) -> None:
        """Forget a client that is gone, and release the drones that it commanded."""
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

    def admit(self, client: Client) -> None:
        """Count a client that has shown the token among those that have.

        Raises:
            TooManyError: the limit of clients is reached, or it had to make room for others.
        """
        if client not in self._unauthenticated:
            raise TooManyError("the connection has waited too long for its token; connect again")
        self._client_limit.enter()
        del self._unauthenticated[client]

    def _run_lockstep(self, session: LockstepSession, ended: Callable[[str], None]) -> None:
        reason = "the gateway failed"
        try:
            with self._dial(session.name) as (link, info):
                left, lost = (lambda: session.has_left), (lambda: session.connection_lost)
                reason = Runner(link, info, session, left, self._say, lost).run()
        except ZsimError as error:
            reason = str(error)
        except Exception as error:  # a fault of the gateway: the client is not to wait for ever
            self.report(f"{session.name}: {error!r}")
        finally:
            self._say(f"{session.name}: left, {'its client is gone' if session.connection_lost else reason}")
            self._lockstep_threads.discard(threading.current_thread())
            with suppress(RuntimeError):  # the gateway has ended
                self.loop.call_soon_threadsafe(ended, reason)

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
        say(f"{self.name}: clients are let into run {info.run_id}")
        try:
            run.receive_until_end(stopped)
        finally:
            if not observer.end_reason:  # the gateway goes, and the run goes on
                for client in list(self._clients):
                    _release_drones(link, client.commanded)
            self._call_on_loop(self._end, run, observer.end_reason == ANOTHER_RUN)
            run.close()

    def _begin(self, run: RunAccess) -> None:
        self._run, self._link_lost = run, False
        self.subscriptions.attach(run.link)
        self._full_key_subscriptions.attach(run.bare_link)
        self._picture_subscriptions.attach(run.link)
        self._pictures.forget()
        self._notify_clients("begun", run)

    def _end(self, run: RunAccess, another: bool = False) -> None:
        """End a run for the clients; where the world has begun another one, the link is back, whoever reports it."""
        if another:
            self._notify_link(run, True)
        self._run = None
        self.subscriptions.detach()
        self._full_key_subscriptions.detach()
        self._picture_subscriptions.detach()
        self._notify_clients("ended", run)
        self.loop.call_later(DRAIN_S, self._end_lockstep_sessions, run)

    def _end_lockstep_sessions(self, run: RunAccess) -> None:
        for client in self._clients:
            client.end_lockstep(run, RUN_ENDED)

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Print what reaches no client, each text once: a flood of connections makes a flood of these."""
        self._report_once(f"{context.get('message')}: {context.get('exception')!r}")

    def _report_once(self, text: str) -> None:
        if text not in self._reported_faults and len(self._reported_faults) < FAULTS_REPORTED_MAX:
            self._reported_faults.add(text)
            self.report(text)

    def _refuse_picture(self, reason: str) -> None:
        """Count what is no picture, and print each text once."""
        if self._run is not None:
            self._run.count_refused()
        self._report_once(reason)

    def _notify_clients(self, state: str, run: RunAccess) -> None:
        for client in self._clients:
            client.notify_run(state, run.info.run_id)

    def _observe_link(self, run: RunAccess) -> None:
        run.link.on_link(partial(self._on_link, run))
        if not run.link.links():  # lost before anything was observed, so that no event follows
            self._on_link(run, False)

    def _on_link(self, run: RunAccess, up: bool) -> None:
        """Take the state of a run's link, in a thread of Zenoh's."""
        with suppress(RuntimeError):  # the gateway has ended
            self.loop.call_soon_threadsafe(self._notify_link, run, up)

    def _notify_link(self, run: RunAccess, up: bool) -> None:
        """Notify clients of a link that is lost or back, but not when the world goes after the end of its run."""
        if run is self._run and up == self._link_lost:
            self._link_lost = not up
            self._notify_clients("back" if up else "lost", run)

    def _call_on_loop(self, act: Callable[..., None], *args: Any) -> None:
        async def call() -> None:
            act(*args)

        asyncio.run_coroutine_threadsafe(call(), self.loop).result()

    # Servers

    @contextmanager
    def open(self) -> Iterator[None]:
        """Serve clients, on a thread of its own.

        Raises:
            RunError: a port is taken.
        """
        with open_on_thread(self.loop, "gateway servers", self._open, lambda servers: self._close(*servers)):
            yield

    async def _open(self) -> tuple[ServedSite, asyncio.Server]:
        host, http_port, lines_port = self._ports
        line_server = LineServer(self._new_client, authenticated=not self._access_check.needs_token)
        rest = RestTree(self.run, self._full_key_subscriptions)
        tree = JsonTree(self.run, self.subscriptions, self.name)
        cameras = CameraTree(self.run, self._pictures, self._client_limit)
        app = application(self._access_check, rest, tree, cameras, self._new_client)
        try:
            site = await start_site(app, host, (http_port,), shutdown_s=1.0)
            try:
                lines = await asyncio.start_server(line_server.serve, host, lines_port, limit=LINE_MAX)
            except OSError:
                await site.cleanup()
                raise
        except OSError as error:
            ports = f"{host}, ports {http_port} and {lines_port}"
            raise RunError(f"gateway: cannot listen on {ports} ({error.strerror}); say --http and --lines") from error
        address = f"http://{url_host(host)}:{http_port}"
        self._say(f"{self.name}: HTTP and WebSocket on {address}, lines on port {lines_port}")
        return site, lines

    async def _close(self, site: ServedSite, lines: asyncio.Server) -> None:
        lines.close()
        for client in list(self._clients):
            client.close(connection_lost=False)
        await asyncio.to_thread(_join_all, list(self._lockstep_threads), BYE_TIMEOUT_S)
        await cancel_other_tasks()
        await site.cleanup()

    def _new_client(self, outbox: Outbox, authenticated: bool) -> Client:
        limit = RateLimit(1 / STREAM_RATE_HZ, STREAM_BURST)
        client = Client(self, outbox, f"client.{secrets.token_hex(3)}", authenticated, limit)
        if not authenticated:
            self._make_room()
        try:
            if authenticated:
                self._client_limit.enter()
        except TooManyError as error:
            client.refuse(str(error))
            return client
        self._clients.add(client)
        if not authenticated:
            self._unauthenticated[client] = None
            self.loop.call_later(HELLO_TIMEOUT_S, client.expire)
        return client

    def _make_room(self) -> None:
        """Let go of the client that has waited longest with its token, where there are too many of them."""
        if len(self._unauthenticated) >= UNAUTHENTICATED_MAX:
            client = next(iter(self._unauthenticated))
            client.expire()
            self.remove(client)


def _release_drones(link: Session, commanded: Iterable[tuple[str, str]]) -> None:
    """Let others command drones, each with the source that did; the world knows whether it holds them still."""
    with suppress(ZsimError):
        for source, drone in commanded:
            link.request(keys.CONTROL, "release", source, {"drone": drone}, RELEASE_TIMEOUT_S)


def _join_all(threads: list[threading.Thread], timeout_s: float) -> None:
    end_s = time.monotonic() + timeout_s
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))
