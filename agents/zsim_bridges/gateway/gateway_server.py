"""The gateway's doors: HTTP, WebSocket and lines of JSON, in front of one run after the other."""

import asyncio
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, NamedTuple

from aiohttp import web

from zsim.contract import keys
from zsim.contract.messages import Info
from zsim.errors import NoWorldError, RunError, ZsimError
from zsim.runtime.runner import Runner
from zsim.transport.session import Session
from zsim_bridges.gateway.client_limits import TokenBucket, ConnectionLimit
from zsim_bridges.gateway.http.access_check import AccessCheck, is_loopback
from zsim_bridges.gateway.http.http_errors import TooManyError
from zsim_bridges.gateway.http.json_tree import JsonTree
from zsim_bridges.gateway.http.routes import application
from zsim_bridges.gateway.http.zenoh_rest import RestTree
from zsim_bridges.gateway.lines.outbox import Outbox
from zsim_bridges.gateway.lines.stream_client import Client
from zsim_bridges.gateway.lines.tcp_lines import LINE_MAX, LineServer
from zsim_bridges.gateway.lockstep_agent import LockstepAgent
from zsim_bridges.gateway.run_access import RunAccess
from zsim_bridges.gateway.subscriptions import SharedSubscriptions
from zsim_bridges.loop_thread import opened_on
from zsim_bridges.observer_process import ObserverProcess

CLIENTS_MAX = 500  # streams at once
UNAUTHENTICATED_MAX = 100  # connections at once that have not shown the token yet
HELLO_TIMEOUT_S = 5.0  # how long one may take to show it
DRAIN_S = 2.0  # after the end of a run, how long seats may still answer their last gates
FAULTS_REPORTED_MAX = 100  # told
RELEASE_TIMEOUT_S = 1.0  # the world answers within milliseconds
STREAM_RATE_HZ = 5_000.0  # requests per wall second of one stream; a loop at the speed of the fastest run has 2 500
STREAM_BURST = 10_000.0
BYE_TIMEOUT_S = 2.0  # how long the end waits for the byes of the seats
_QUIET = logging.Logger("quiet", logging.CRITICAL + 1)  # what is no HTTP is answered, and nobody's business


class GatewayPorts(NamedTuple):
    """Where clients come in."""

    host: str
    http_port: int
    lines_port: int


class Gateway:
    """One gateway.

    Args:
        doors: where clients come in.
        name: process name.
        token: that clients must show; None on this machine alone.
        dial: opens a session to the world for a process of a name.
        say: told what a person should know.
        secured: whether access control decides what it may do.

    Raises:
        RunError: others could reach it, and there is no token.
    """

    def __init__(
        self,
        doors: GatewayPorts,
        name: str,
        token: str | None,
        dial: Callable[[str], AbstractContextManager[tuple[Session, Info]]],
        say: Callable[[str], None],
        secured: bool = False,
    ) -> None:
        if token == "":
            raise RunError("gateway: the token is empty; give it one, or leave --token and ZSIM_TOKEN away")
        if token is None and not is_loopback(doors.host):
            raise RunError(f"gateway: {doors.host} can be reached by others; give it a --token, or --listen 127.0.0.1")
        self.loop = asyncio.new_event_loop()
        self.loop.set_exception_handler(self._on_loop_error)
        self._client_limit = ConnectionLimit(CLIENTS_MAX, "clients")
        self._unauthenticated_limit = ConnectionLimit(UNAUTHENTICATED_MAX, "connections that have shown no token")
        self.subscriptions = SharedSubscriptions(self.loop, self._client_limit)
        self._full_key_feed = SharedSubscriptions(self.loop, self._client_limit)
        self._ports = doors
        self._name = name
        self._access_check = AccessCheck(token, self.report)
        self._dial = dial
        self._secured = secured
        self._say = say
        self._run: RunAccess | None = None
        self._reported_faults: set[str] = set()
        self._clients: set[Client] = set()
        self._lockstep_threads: set[threading.Thread] = set()

    # What clients need of it

    @property
    def name(self) -> str:
        """Its process name."""
        return self._name

    def run(self) -> RunAccess:
        """Return the run that goes on.

        Raises:
            NoWorldError: there is none.
        """
        if self._run is None:
            raise NoWorldError("there is no run now; the gateway waits for the next")
        return self._run

    def is_token(self, token: str) -> bool:
        """Tell whether a token is the right one."""
        return self._access_check.is_token(token)

    def start_lockstep(self, seat: LockstepAgent, lost: Callable[[str], None]) -> None:
        """Run a seat, on a session of its own, until it is left; tell why there is none any more."""
        for client in self._clients:
            client.lose_lockstep(seat.name, "another client took the name", but=seat)
        thread = threading.Thread(target=self._run_lockstep, args=(seat, lost), name=seat.name, daemon=True)
        self._lockstep_threads.add(thread)
        thread.start()

    def report(self, text: str) -> None:
        """Tell a person of a fault of ours."""
        self._say(f"{self._name}: {text}")

    def remove(self, client: Client) -> None:
        """Forget a client that is gone, and let others fly the drones that it flew."""
        if client not in self._clients:
            return
        self._clients.discard(client)
        (self._client_limit if client.trusted else self._unauthenticated_limit).leave()
        others = {other.source for other in self._clients}
        left = [(source, drone) for source, drone in client.commanded if source not in others]
        if self._run is not None and left:
            self.loop.run_in_executor(None, _release_drones, self._run.link, left)

    def admit(self, client: Client) -> None:
        """Count a client that has shown the token among those who have.

        Raises:
            TooManyError: there are as many of them as may be.
        """
        self._client_limit.enter()
        self._unauthenticated_limit.leave()

    def _run_lockstep(self, seat: LockstepAgent, lost: Callable[[str], None]) -> None:
        reason = "the gateway failed"
        try:
            with self._dial(seat.name) as (link, info):
                reason = Runner(link, info, seat, lambda: seat.has_left, self._say, lambda: seat.deserted).run()
        except ZsimError as error:
            reason = str(error)
        except Exception as error:  # a fault of ours: the client is not to wait for ever
            self.report(f"{seat.name}: {error!r}")
        finally:
            self._say(f"{seat.name}: left, {'its client is gone' if seat.deserted else reason}")
            self._lockstep_threads.discard(threading.current_thread())
            with suppress(RuntimeError):  # the gateway has ended
                self.loop.call_soon_threadsafe(lost, reason)

    # A run

    def serve(
        self,
        link: Session,
        info: Info,
        presence: ObserverProcess,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """Serve a run until it is over, or somebody says stop."""
        flight = RunAccess(link, info, presence, self._secured)
        flight.open()
        self._call_on_loop(self._begin, flight)
        say(f"{self._name}: clients are let into run {info.run_id}")
        link.on_link(_LinkMonitor(lambda state: self.loop.call_soon_threadsafe(self._notify_link, state, flight)).on_link)
        try:
            flight.receive_until_end(stopped)
        finally:
            if not presence.end_reason:
                self._release_all(link)
            self._call_on_loop(self._end, flight)
            flight.close()

    def _release_all(self, link: Session) -> None:
        """Let others fly what our clients fly: this gateway goes, and the run goes on."""
        for client in list(self._clients):
            _release_drones(link, client.commanded)

    def _begin(self, flight: RunAccess) -> None:
        self._run = flight
        self.subscriptions.attach(flight.link)
        self._full_key_feed.attach(flight.bare_link)
        self._notify_clients("begun", flight)

    def _end(self, flight: RunAccess) -> None:
        self._run = None
        self.subscriptions.detach()
        self._full_key_feed.detach()
        self._notify_clients("ended", flight)
        self.loop.call_later(DRAIN_S, self._end_lockstep_sessions, flight)

    def _end_lockstep_sessions(self, flight: RunAccess) -> None:
        """End the seats of a run that is over: the last gates of those that still answer are out by now."""
        for client in self._clients:
            client.end_lockstep(flight, "the run ended")

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Say what no client can be told, once: a flood of connections makes a flood of these."""
        text = f"{context.get('message')}: {context.get('exception')!r}"
        if text not in self._reported_faults and len(self._reported_faults) < FAULTS_REPORTED_MAX:
            self._reported_faults.add(text)
            self.report(text)

    def _notify_clients(self, state: str, flight: RunAccess) -> None:
        for client in self._clients:
            client.notify_run(state, flight.info.run_id)

    def _notify_link(self, state: str, flight: RunAccess) -> None:
        """Tell of a link that is lost or back, but not when its world goes after the end of its run."""
        if flight is self._run:
            self._notify_clients(state, flight)

    def _call_on_loop(self, do: Callable[..., None], *args: Any) -> None:
        async def call() -> None:
            do(*args)

        asyncio.run_coroutine_threadsafe(call(), self.loop).result()

    # The doors

    @contextmanager
    def open(self) -> Iterator[None]:
        """Let clients in, on a thread of its own.

        Raises:
            RunError: a port is taken.
        """
        with opened_on(self.loop, "doors", self._open, lambda opened: self._close(*opened)):
            yield

    async def _open(self) -> tuple[web.AppRunner, asyncio.Server]:
        host, http_port, lines_port = self._ports
        runner = web.AppRunner(self._application(), access_log=None, logger=_QUIET, shutdown_timeout=1.0)
        await runner.setup()
        door = LineServer(self._new_client, trusted=not self._access_check.needs_token)
        try:
            await web.TCPSite(runner, host, http_port).start()
            lines = await asyncio.start_server(door.serve, host, lines_port, limit=LINE_MAX)
        except OSError as error:
            await runner.cleanup()
            ports = f"{host}, ports {http_port} and {lines_port}"
            raise RunError(f"gateway: cannot listen on {ports} ({error.strerror}); say --http and --lines") from error
        shown = f"[{host}]" if ":" in host else host
        self._say(f"{self._name}: HTTP and WebSocket on http://{shown}:{http_port}, lines on port {lines_port}")
        return runner, lines

    async def _close(self, runner: web.AppRunner, lines: asyncio.Server) -> None:
        lines.close()
        for client in list(self._clients):
            client.close(deserted=False)
        await asyncio.to_thread(_join_all, list(self._lockstep_threads), BYE_TIMEOUT_S)
        here = asyncio.current_task()
        tasks = [task for task in asyncio.all_tasks() if task is not here]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await runner.cleanup()

    def _application(self) -> web.Application:
        rest, tree = RestTree(self.run, self._full_key_feed), JsonTree(self.run, self.subscriptions, self._name)
        return application(self._access_check, rest, tree, self._new_client)

    def _new_client(self, outbox: Outbox, trusted: bool) -> Client:
        bucket = TokenBucket(STREAM_RATE_HZ, STREAM_BURST, time.monotonic)
        client = Client(self, outbox, f"client.{secrets.token_hex(3)}", trusted, bucket)
        try:
            (self._client_limit if trusted else self._unauthenticated_limit).enter()
        except TooManyError as error:
            client.refuse(str(error))
            return client
        self._clients.add(client)
        if not trusted:
            self.loop.call_later(HELLO_TIMEOUT_S, client.expire)
        return client


class _LinkMonitor:
    """Tells of a link that is lost, and of one that is back; not of the first.

    Args:
        tell: told `lost` or `back`.
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell = tell
        self._lost = False

    def on_link(self, up: bool) -> None:
        """Take what the session says of its link."""
        if up != self._lost:
            return
        self._lost = not up
        with suppress(RuntimeError):  # the gateway has ended
            self._tell("back" if up else "lost")


def _release_drones(link: Session, flown: Iterable[tuple[str, str]]) -> None:
    """Let others fly drones, each given with its source; whether they were flown by it the world knows."""
    with suppress(ZsimError):
        for source, drone in flown:
            link.request(keys.CONTROL, "release", source, {"drone": drone}, RELEASE_TIMEOUT_S)


def _join_all(threads: list[threading.Thread], patience_s: float) -> None:
    end_s = time.monotonic() + patience_s
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))
