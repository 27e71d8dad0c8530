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
from zsim_bridges.gateway.client_limits import Bucket, Turnstile
from zsim_bridges.gateway.http.access_check import Guard, is_loopback
from zsim_bridges.gateway.http.http_errors import TooManyError
from zsim_bridges.gateway.http.json_tree import JsonTree
from zsim_bridges.gateway.http.routes import application
from zsim_bridges.gateway.http.zenoh_rest import RestTree
from zsim_bridges.gateway.lines.outbox import Outbox
from zsim_bridges.gateway.lines.stream_client import Client
from zsim_bridges.gateway.lines.tcp_lines import LINE_MAX, Lines
from zsim_bridges.gateway.lockstep_agent import Seat
from zsim_bridges.gateway.run_access import Flight
from zsim_bridges.gateway.subscriptions import Feed
from zsim_bridges.loop_thread import opened_on
from zsim_bridges.observer_process import Presence

CLIENTS_MAX = 500  # streams at once
STRANGERS_MAX = 100  # connections at once that have not shown the token yet
HELLO_S = 5.0  # how long one may take to show it
DRAIN_S = 2.0  # after the end of a run, how long seats may still answer their last gates
FAULTS_MAX = 100  # told
RELEASE_S = 1.0  # the world answers within milliseconds
STREAM_RATE_HZ = 5_000.0  # requests per wall second of one stream; a loop at the speed of the fastest run has 2 500
STREAM_BURST = 10_000.0
BYES_S = 2.0  # how long the end waits for the byes of the seats
_QUIET = logging.Logger("quiet", logging.CRITICAL + 1)  # what is no HTTP is answered, and nobody's business


class Doors(NamedTuple):
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
        doors: Doors,
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
        self.loop.set_exception_handler(self._on_fault)
        self._turnstile = Turnstile(CLIENTS_MAX, "clients")
        self._strangers = Turnstile(STRANGERS_MAX, "connections that have shown no token")
        self.feed = Feed(self.loop, self._turnstile)
        self._whole = Feed(self.loop, self._turnstile)
        self._doors = doors
        self._name = name
        self._guard = Guard(token, self.report)
        self._dial = dial
        self._secured = secured
        self._say = say
        self._flight: Flight | None = None
        self._faults: set[str] = set()
        self._clients: set[Client] = set()
        self._seats: set[threading.Thread] = set()

    # What clients need of it

    @property
    def name(self) -> str:
        """Its process name."""
        return self._name

    def flight(self) -> Flight:
        """Return the run that goes on.

        Raises:
            NoWorldError: there is none.
        """
        if self._flight is None:
            raise NoWorldError("there is no run now; the gateway waits for the next")
        return self._flight

    def knows(self, token: str) -> bool:
        """Tell whether a token is the right one."""
        return self._guard.knows(token)

    def sit(self, seat: Seat, lost: Callable[[str], None]) -> None:
        """Run a seat, on a session of its own, until it is left; tell why there is none any more."""
        for client in self._clients:
            client.lose_seat(seat.name, "another client took the name", but=seat)
        thread = threading.Thread(target=self._sit, args=(seat, lost), name=seat.name, daemon=True)
        self._seats.add(thread)
        thread.start()

    def report(self, text: str) -> None:
        """Tell a person of a fault of ours."""
        self._say(f"{self._name}: {text}")

    def part(self, client: Client) -> None:
        """Forget a client that is gone, and let others fly the drones that it flew."""
        if client not in self._clients:
            return
        self._clients.discard(client)
        (self._turnstile if client.trusted else self._strangers).leave()
        others = {other.source for other in self._clients}
        left = [(source, drone) for source, drone in client.flown if source not in others]
        if self._flight is not None and left:
            self.loop.run_in_executor(None, _release, self._flight.link, left)

    def trust(self, client: Client) -> None:
        """Count a client that has shown the token among those who have.

        Raises:
            TooManyError: there are as many of them as may be.
        """
        self._turnstile.enter()
        self._strangers.leave()

    def _sit(self, seat: Seat, lost: Callable[[str], None]) -> None:
        reason = "the gateway failed"
        try:
            with self._dial(seat.name) as (link, info):
                reason = Runner(link, info, seat, lambda: seat.gone, self._say, lambda: seat.deserted).run()
        except ZsimError as error:
            reason = str(error)
        except Exception as error:  # a fault of ours: the client is not to wait for ever
            self.report(f"{seat.name}: {error!r}")
        finally:
            self._say(f"{seat.name}: left, {'its client is gone' if seat.deserted else reason}")
            self._seats.discard(threading.current_thread())
            with suppress(RuntimeError):  # the gateway has ended
                self.loop.call_soon_threadsafe(lost, reason)

    # A run

    def serve(
        self,
        link: Session,
        info: Info,
        presence: Presence,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        """Serve a run until it is over, or somebody says stop."""
        flight = Flight(link, info, presence, self._secured)
        flight.enter()
        self._on_loop(self._begin, flight)
        say(f"{self._name}: clients are let into run {info.run_id}")
        link.on_link(_Link(lambda state: self.loop.call_soon_threadsafe(self._tell_of_link, state, flight)).note)
        try:
            flight.follow(stopped)
        finally:
            if not presence.over:
                self._release_all(link)
            self._on_loop(self._end, flight)
            flight.close()

    def _release_all(self, link: Session) -> None:
        """Let others fly what our clients fly: this gateway goes, and the run goes on."""
        for client in list(self._clients):
            _release(link, client.flown)

    def _begin(self, flight: Flight) -> None:
        self._flight = flight
        self.feed.attach(flight.link)
        self._whole.attach(flight.whole)
        self._tell("begun", flight)

    def _end(self, flight: Flight) -> None:
        self._flight = None
        self.feed.detach()
        self._whole.detach()
        self._tell("ended", flight)
        self.loop.call_later(DRAIN_S, self._end_seats, flight)

    def _end_seats(self, flight: Flight) -> None:
        """End the seats of a run that is over: the last gates of those that still answer are out by now."""
        for client in self._clients:
            client.end_seat(flight, "the run ended")

    def _on_fault(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Say what no client can be told, once: a flood of connections makes a flood of these."""
        text = f"{context.get('message')}: {context.get('exception')!r}"
        if text not in self._faults and len(self._faults) < FAULTS_MAX:
            self._faults.add(text)
            self.report(text)

    def _tell(self, state: str, flight: Flight) -> None:
        for client in self._clients:
            client.tell_of_run(state, flight.info.run_id)

    def _tell_of_link(self, state: str, flight: Flight) -> None:
        """Tell of a link that is lost or back, but not when its world goes after the end of its run."""
        if flight is self._flight:
            self._tell(state, flight)

    def _on_loop(self, do: Callable[..., None], *args: Any) -> None:
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
        host, http_port, lines_port = self._doors
        runner = web.AppRunner(self._application(), access_log=None, logger=_QUIET, shutdown_timeout=1.0)
        await runner.setup()
        door = Lines(self._meet, trusted=not self._guard.asks)
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
        await asyncio.to_thread(_await_all, list(self._seats), BYES_S)
        here = asyncio.current_task()
        tasks = [task for task in asyncio.all_tasks() if task is not here]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await runner.cleanup()

    def _application(self) -> web.Application:
        rest, tree = RestTree(self.flight, self._whole), JsonTree(self.flight, self.feed, self._name)
        return application(self._guard, rest, tree, self._meet)

    def _meet(self, outbox: Outbox, trusted: bool) -> Client:
        bucket = Bucket(STREAM_RATE_HZ, STREAM_BURST, time.monotonic)
        client = Client(self, outbox, f"client.{secrets.token_hex(3)}", trusted, bucket)
        try:
            (self._turnstile if trusted else self._strangers).enter()
        except TooManyError as error:
            client.refuse(str(error))
            return client
        self._clients.add(client)
        if not trusted:
            self.loop.call_later(HELLO_S, client.expire)
        return client


class _Link:
    """Tells of a link that is lost, and of one that is back; not of the first.

    Args:
        tell: told `lost` or `back`.
    """

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell = tell
        self._lost = False

    def note(self, up: bool) -> None:
        """Take what the session says of its link."""
        if up != self._lost:
            return
        self._lost = not up
        with suppress(RuntimeError):  # the gateway has ended
            self._tell("back" if up else "lost")


def _release(link: Session, flown: Iterable[tuple[str, str]]) -> None:
    """Let others fly drones, each given with its source; whether they were flown by it the world knows."""
    with suppress(ZsimError):
        for source, drone in flown:
            link.request(keys.CONTROL, "release", source, {"drone": drone}, RELEASE_S)


def _await_all(threads: list[threading.Thread], patience_s: float) -> None:
    end_s = time.monotonic() + patience_s
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))
