"""A run on several hosts: checked, prepared, started over ssh, watched, ended, and its record brought home."""

import asyncio
import contextlib
import time
import uuid
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import asyncssh

from zsim import scenario_file
from zsim.errors import HostsError, RunError, ZsimError
from zsim.record import repair
from zsim.scenario import Scenario
from zsim_deploy import inventory as inv
from zsim_deploy import shell
from zsim_deploy.board import Board
from zsim_deploy.host_link import HostLink, Loop
from zsim_deploy.intercom import Intercom
from zsim_deploy.inventory import RECORDER, WORLD, Placed
from zsim_deploy.remote import Remote
from zsim_deploy.watch import Outcome, Watch

IDENTITY_FILES = ("ca.pem", "certificate.pem", "key.pem")
ROUTER = "router"
CHECK_S = 30.0  # how long all hosts together may take to be checked
PREPARE_S = 30.0
FETCH_S = 600.0  # a record of an hour over a slow link


@dataclass
class Options:
    """How to run a scenario on the hosts of an inventory."""

    scenario: Scenario
    placed: Placed
    out: Path
    mode: str = "lockstep"
    rate: float = 0.0
    run_id: str = field(default_factory=lambda: uuid.uuid4().hex[:12])


class Up:
    """One run on several hosts.

    Args:
        options: what to run where.
        board: takes progress.

    Raises:
        InventoryError: a process has no place.
    """

    def __init__(self, options: Options, board: Board) -> None:
        self._options = options
        self._board = board
        self._placed = options.placed
        self._places = inv.placement(options.placed, options.scenario)
        self._logs = options.out / "logs"
        self._watch = Watch(options.scenario.processes.on_death, board)
        self._loop = Loop()
        hosts = options.placed.inventory.hosts
        routers = options.placed.inventory.routers.values()
        used = sorted({*self._places.values(), *(router.host for router in routers)})
        self._links = {name: HostLink(name, hosts[name], options.placed.folder) for name in used}

    def go(self) -> Outcome:
        """Run to the end; whatever happens, nothing of it is left on any host that can be reached.

        Raises:
            HostsError: with a line for every host that cannot take part.
        """
        try:
            self._timed("connect", lambda: self._on_all(lambda link: link.open(), CHECK_S))
            self._timed("check", self._check)
            self._timed("prepare", self._prepare)
            return self._fly()
        finally:
            for link in self._links.values():
                with contextlib.suppress(TimeoutError):
                    self._loop.call(link.close(), 3.0)
            self._loop.close()

    def _timed(self, what: str, act: Callable[[], Any]) -> None:
        start_s = time.monotonic()
        act()
        self._board.stages_s[what] = time.monotonic() - start_s

    def _on_all(self, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> dict[str, Any]:
        """Do the same on all hosts at once; all faults are told, a line each."""

        async def gathered() -> list[Any]:
            return await asyncio.gather(*(work(link) for link in self._links.values()), return_exceptions=True)

        results = self._loop.call(gathered(), within_s)
        faults = [str(result) for result in results if isinstance(result, ZsimError)]
        if faults:
            raise HostsError("\n".join(faults))
        for result in results:
            if isinstance(result, BaseException):
                raise result
        return dict(zip(self._links, results, strict=True))

    def _check(self) -> None:
        from zsim_deploy.doctor import about, compared

        reports = self._on_all(lambda link: about(link, self.python(link.name)), CHECK_S)
        faults, warnings = compared(reports)
        for warning in warnings:
            self._board.say(f"warning: {warning}")
        if faults:
            raise HostsError("\n".join(faults))

    def _prepare(self) -> None:
        """Put the scenario, and the certificates where there are any, on the hosts."""
        text = scenario_file.to_text(self._options.scenario)
        (self._options.out / "scenario.yaml").write_text(text)

        async def prepare(link: HostLink) -> None:
            for name in self._roles_on(link.name):
                await self._bring_identity(link, name)
            if link.name == self._places[WORLD]:
                await link.put_file(f"{self._folder(link.name)}/scenario.yaml", text.encode())

        self._on_all(prepare, PREPARE_S)

    async def _bring_identity(self, link: HostLink, name: str) -> None:
        if self._placed.inventory.security.insecure:
            return
        source = self.certificates() / link.name / name
        for file in IDENTITY_FILES:
            content = _content(source / file, self._placed)
            await link.put_file(f"{self._identity(link.name, name)}/{file}", content, 0o600)
        if self._listens(name):
            access = _content(self.certificates() / link.name / f"{name}.access.json", self._placed)
            await link.put_file(f"{self._identity(link.name, name)}/access.json", access, 0o600)

    def certificates(self) -> Path:
        """Return the folder that `zsim certs init` filled."""
        return self._placed.folder / Path(self._placed.inventory.security.certificates).expanduser()

    def _roles_on(self, host: str) -> list[str]:
        routers = self._placed.inventory.routers
        return [
            *(name for name, at in self._places.items() if at == host),
            *(f"{ROUTER}.{name}" for name, router in routers.items() if router.host == host),
        ]

    @staticmethod
    def _listens(name: str) -> bool:
        return name == WORLD or name.startswith(f"{ROUTER}.")

    def _folder(self, host: str) -> str:
        """Return the folder of this run on a host."""
        folder = self._placed.inventory.hosts[host].folder
        home = "" if folder.startswith(("/", "~/")) else "~/"
        return f"{home}{folder}/runs/{self._options.run_id}"

    def _identity(self, host: str, name: str) -> str:
        return f"{self._folder(host)}/identity/{name}"

    def python(self, host: str) -> str:
        """Return the interpreter of a host that has zsim."""
        return inv.python(self._placed.inventory.hosts[host])

    # Flying

    def _fly(self) -> Outcome:
        self._logs.mkdir(parents=True)
        names = [*(f"{ROUTER}.{name}" for name in inv.routers_in_order(self._placed.inventory)), *self._places]
        self._watch.members = [self._remote(name, self._host_of(name)) for name in names]
        self._board.members, self._board.links = self._watch.members, self._links
        acts = {"ps": self._ps, "restart": self._restart, "move": self._move, "down": self._down, "out": self._out}
        intercom = Intercom(self._options.scenario.federation, acts)
        for link in self._links.values():
            self._loop.spawn(link.echo())
        try:
            outcome = self._watch.go(self._board.look)
        finally:
            intercom.close()
        self._fetch()
        return outcome

    def _host_of(self, name: str) -> str:
        role, _, thing = name.partition(".")
        return self._placed.inventory.routers[thing].host if role == ROUTER else self._places[name]

    def _remote(self, name: str, host: str) -> Remote:
        command, named = self._arguments(name, host)
        arguments = [*command, "--launched", self._options.run_id, "--host", host]
        if not self._placed.inventory.security.insecure:
            arguments += ["--tls", self._identity(host, name)]
            if self._listens(name):
                arguments += ["--access", f"{self._identity(host, name)}/access.json"]
        on_line = self._watch.take_line if name == WORLD else None
        arguments += ["--", named] if named else []  # a name may begin with a dash
        return Remote(name, arguments, self._links[host], self.python(host), self._loop, self._logs, on_line)

    def _arguments(self, name: str, host: str) -> tuple[list[str], str]:
        """Return the command of a process with its options, and the name that it is given."""
        role, _, thing = name.partition(".")
        inventory, federation = self._placed.inventory, self._options.scenario.federation
        if role == WORLD:
            pace = ["--realtime"] if self._options.mode == "realtime" else []
            pace += ["--rate", str(self._options.rate)] if self._options.rate else []
            listen = inv.listening(self._placed, host, inventory.port)
            return [WORLD, "--listen", listen, "--expect", RECORDER, *pace], f"{self._folder(host)}/scenario.yaml"
        if role == ROUTER:
            listen = inv.listening(self._placed, host, inventory.routers[thing].port)
            above = inv.upstream(self._placed, self._places, thing)
            mode = ["--realtime"] if self._options.mode == "realtime" else []
            return [ROUTER, "--listen", listen, "--connect", above, "--federation", federation, *mode], thing
        reach = ["--connect", inv.endpoint(self._placed, self._places, host), "--federation", federation]
        if role == RECORDER:
            return ["record", "--out", self._folder(host), *reach], ""
        return [role, *reach], thing

    # What others ask of it

    def _ps(self) -> dict[str, Any]:
        return {"rows": self._board.rows(), "clock": self._board.clock_now(), "out": str(self._options.out)}

    def _out(self) -> str:
        return str(self._options.out)

    def _down(self) -> None:
        self._watch.interrupt("ended by zsim down")

    def _member(self, name: str) -> Remote:
        for member in self._watch.members:
            if isinstance(member, Remote) and member.name == name:
                return member
        known = ", ".join(member.name for member in self._watch.members)
        raise RunError(f"role is {name!r}; must be one of {known}")

    def _restart(self, role: str) -> str:
        old = self._member(role)
        if role in (WORLD, RECORDER):
            raise RunError(f"{role} cannot be restarted: the run lives in it; end the run with `zsim down`")
        return self._take_over(old, old.host)

    def _move(self, role: str, host: str) -> str:
        old = self._member(role)
        if role in (WORLD, RECORDER) or old.role == ROUTER:
            raise RunError(f"{role} cannot be moved while the run goes on; change the inventory and run again")
        if host not in self._links:
            raise RunError(f"host is {host!r}; must be one of {', '.join(self._links)}")
        self._loop.call(self._bring_identity(self._links[host], role), PREPARE_S)
        return self._take_over(old, host)

    def _take_over(self, old: Remote, host: str) -> str:
        """Start a process that takes over the name of another, which then ends by itself, or is killed if it hangs."""
        new = self._remote(old.name, host)
        self._places[old.name] = host
        self._watch.order(lambda: self._watch.replace(old, new))
        return f"{old.name} on {host}"

    def _fetch(self) -> None:
        """Bring the record home, and leave nothing of the run on the hosts."""
        host = self._places[RECORDER]

        async def fetch() -> None:
            connection = await self._links[host].open()
            async with connection.start_sftp_client() as sftp:
                source = await _absolute(sftp, f"{self._folder(host)}/run.mcap")
                await sftp.get(source, str(self._options.out / "run.mcap"))

        try:
            self._loop.call(fetch(), FETCH_S)
            repair(self._options.out / "run.mcap")
        except (ZsimError, TimeoutError, asyncssh.Error, OSError) as error:
            where = f"{host}:{self._folder(host)}/run.mcap"
            self._board.say(f"the record could not be fetched ({error}); it is at {where}")
            return
        with contextlib.suppress(HostsError, TimeoutError):
            self._on_all(lambda link: link.run(f"rm -rf {shell.word(self._folder(link.name))}"), PREPARE_S)


async def _absolute(sftp: asyncssh.SFTPClient, path: str) -> str:
    """Return a path that may begin with ~/ as sftp takes it: relative to the home."""
    return path[2:] if path.startswith("~/") else path


def _content(path: Path, placed: Placed) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise HostsError(
            f"{path}: cannot be read ({error.strerror}); make certificates with "
            f"`zsim certs init {placed.source}`, or set security.insecure on a network of your own"
        ) from error
