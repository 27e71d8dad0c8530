"""A run on several hosts: checks and prepares them, starts the processes over ssh, supervises them, fetches the record.

The requests of `zsim ps`, `logs`, `restart`, `move` and `down` are carried out here, each in a thread of the control
socket. A `HostPlan` determines the host, command line and files of each process.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, wait
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import asyncssh
from msgspec import structs

from zsim.errors import OTHER_OUT, HostsError, RunError, ZsimError, file_fault
from zsim.output_folder import RECORD
from zsim.record import repair
from zsim.scenario import scenario_file
from zsim.scenario.roles import RECORDER, ROUTER, WORLD
from zsim.scenario.scenario import Scenario
from zsim.transport.tls import CERTIFICATES
from zsim_api.run_folder import JOURNAL, Launch
from zsim_deploy import certificates
from zsim_deploy import inventory as inv
from zsim_deploy.arguments import changed_options, pace_options
from zsim_deploy.hosts.control_socket import ControlSocket
from zsim_deploy.hosts.doctor import (
    HostReport,
    compare_reports,
    host_report,
    leftovers,
    port_faults,
    runs_folder,
    scp,
)
from zsim_deploy.hosts.host_link import EventLoopThread, HostLink, HostLinks, fetch, shell_line, shell_word
from zsim_deploy.hosts.status_table import StatusTable
from zsim_deploy.inventory import MODULE, MODULES, InventoryFile, ProcessFiles, extras
from zsim_deploy.launch.role_launcher import SINGLE_THREADED, programs_of
from zsim_deploy.launch.supervisor import EndSignals, Outcome, Supervisor, end_text
from zsim_deploy.roles.stop_channel import FOLDER

# Wall times
CONNECT_S = 30.0  # time limit for logging in to all hosts
CHECK_S = 60.0  # for checking all hosts; a small computer imports numpy in 5 s, a poor link adds a dozen round trips
PREPARE_S = 30.0  # for copying files to all hosts
CLEAN_S = 5.0  # for a host to remove the run's folder; a lost host delays the end by at most twice this
JOIN_S = 60.0  # for connecting and checking a host that the run has not used so far
IMPORT_S = 20.0  # for a Python to import the modules of a role; a small computer takes 5 s
COPY_S = 30.0  # for copying a certificate to a host
LEAVE_S = 20.0  # for a process that was just replaced to end; normally it takes a second
LOOK_S = 0.1  # polling interval while waiting for that end
ORDER_S = 5.0  # time limit for the supervisor, which polls every 50 ms, to carry out an order
BEAT_S = 1.0  # interval of the launcher's heartbeat
ORPHAN_S = 60.0  # without a heartbeat for this long, a process ends itself; shorter link outages are survived
RECOPY_S = 60.0  # time limit for copying the files of a restarted process; as long as a link may be down
KILL_S = 5.0  # for a kill to reach the host, which takes a few round trips

LOST = -1000  # exit code of a process whose end is unknown
ACCESS = "access.json"  # file with the access control of a listening process
PID = "zsim-pid "  # prefix of the line with the process id; a login shell may print other lines before it


class HostRun:
    """One run on several hosts; raises InventoryError if a process has no host."""

    def __init__(
        self, scenario: Scenario, inventory_file: InventoryFile, out: Path, launch: Launch, status: StatusTable
    ) -> None:
        self._scenario, self._launch = scenario, launch
        self._inventory_file = inventory_file
        self._out = out
        self._status = status
        pace = [*pace_options(launch.mode, launch.rate), *changed_options(launch.changed)]
        self._plan = HostPlan(inventory_file, scenario, launch.run_id, pace)  # replaced after each move
        self._supervisor = Supervisor(scenario.processes, status)
        self._loop = EventLoopThread()
        self._links = HostLinks(inventory_file, self._plan.hosts(), self._loop)
        self._record_stays = False
        self._signals = EndSignals(out / "up.log", status.hang_up)
        self._replacing = threading.Lock()  # held by a request that replaces a process

    def run(self) -> Outcome:
        """Fly the run to its end; however it ends, no process or key of the run is left on a host that can be reached.

        Raise RunError if the federation is already running on this machine, and HostsError with a line for every fault
        of the certificates, or else for every host that cannot take part.
        """
        requests = {
            "ps": lambda: {"rows": self._status.rows(), "clock": self._status.clock_now, **self._where()},
            "where": self._where,
            "down": lambda: self._supervisor.interrupt("ended by zsim down"),
            "restart": self._restart,
            "move": self._move,
        }
        try:
            with self._signals, ControlSocket(self._scenario.federation, requests):
                if faults := self._plan.certificate_faults(datetime.now(UTC)):
                    raise HostsError("\n".join(faults))
                if warning := certificates.exposed_keys(self._inventory_file):
                    self._status.say(f"warning: {warning}")
                with self._timed("connect"):
                    self._links.on_all(HostLink.open, CONNECT_S)
                with self._timed("check"):
                    self._check()
                with self._cleaned():
                    with self._timed("prepare"):
                        self._links.on_all(self._prepare, PREPARE_S)
                    return self._fly()
        finally:
            with contextlib.suppress(HostsError):
                self._links.close()
            self._loop.close()

    @contextlib.contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        start_s = time.monotonic()
        yield
        self._status.stages_s[step] = time.monotonic() - start_s

    def _check(self) -> None:
        async def inspect(link: HostLink) -> tuple[HostReport, list[str], list[str]]:
            """Return the report of a host, faults of its ports, and lines about what earlier runs have left there."""
            python = self._plan.python(link.name)
            report = await host_report(link, python, self._inventory_file.shell_path)
            port_lines = await port_faults(link, python, self._plan.ports(link.name))
            return report, port_lines, await leftovers(link, self._inventory_file.folder)

        results = self._links.on_all(inspect, CHECK_S)
        faults, warnings = compare_reports({name: report for name, (report, _, _) in results.items()})
        for warning in [*warnings, *(line for _, _, leftover_lines in results.values() for line in leftover_lines)]:
            self._status.say(f"warning: {warning}")
        if faults := [*faults, *(line for _, port_lines, _ in results.values() for line in port_lines)]:
            raise HostsError("\n".join(faults))

    async def _prepare(self, link: HostLink) -> None:
        """Copy the scenario and any certificates to a host."""
        if files := self._plan.files(link.name):
            await link.put_files(self._plan.folder(link.name), files, PREPARE_S)

    def _fly(self) -> Outcome:
        with file_fault(self._out, "cannot be written", OTHER_OUT):
            (self._out / "logs").mkdir(parents=True, exist_ok=True)
            (self._out / "scenario.yaml").write_text(scenario_file.to_text(self._scenario))
        for remark in self._plan.remarks:
            self._status.say(remark)
        own_programs = programs_of(self._scenario, self._plan.programs, self._plan.endpoint(), self._out, self._launch)
        self._supervisor.members = [*(self._remote(self._plan, name) for name in self._plan.processes), *own_programs]
        self._status.members, self._status.links = self._supervisor.members, self._links.by_name
        self._links.listen()
        self._record_stays = True
        self._poll()
        try:
            outcome = self._supervisor.run(self._poll)
            fault = self._fetch()
        except KeyboardInterrupt:
            location = self._plan.record_location()
            self._status.say(f"the record was not fetched; what was recorded is at {location}")
            raise
        if fault and not outcome.failed and not outcome.interrupted:
            return replace(outcome, reason=fault, failed=True)
        if fault:
            self._status.say(fault)
        return outcome

    def _poll(self) -> None:
        """End the run if its output can no longer be seen; report hosts that have stopped answering."""
        if reason := self._signals.look():
            self._supervisor.interrupt(reason)
        self._status.report_silent_hosts()

    def _remote(self, plan: HostPlan, name: str) -> RemoteProcess:
        host = plan.host(name)
        log = ProcessLog(self._out / "logs" / f"{name}.log", self._status.say)
        on_line = self._supervisor.handle_line if name == WORLD else None
        command = [plan.python(host), *MODULE, *plan.arguments(name)]
        files = (plan.folder(host), plan.identity(name))
        return RemoteProcess(name, command, self._links.by_name[host], self._loop, log, on_line, files)

    def _fetch(self) -> str:
        """Fetch the record; return why that failed, empty if it did not."""
        host, target = self._plan.host(RECORDER), self._out / RECORD
        self._status.say(f"fetching the record from {host}:{self._plan.record()} …")
        try:
            exists = self._loop.call(fetch(self._links.by_name[host], self._plan.record(), target))
            if exists:
                repair(target)
        except (ZsimError, OSError) as error:
            location = self._plan.record_location()
            return f"the record could not be fetched ({error}); what was recorded is at {location}"
        self._record_stays = False
        return "" if exists else "nothing was recorded"

    @contextlib.contextmanager
    def _cleaned(self) -> Iterator[None]:
        """Remove the run's folder from the hosts after the block, except for a record that could not be fetched."""

        async def clean(link: HostLink) -> None:
            folder, keys = shell_word(self._plan.folder(link.name)), shell_word(self._plan.keys(link.name))
            command = f"rm -rf {folder}"
            if self._record_stays and link.name == self._plan.host(RECORDER):
                command = f"rm -rf {keys}; [ -e {shell_word(self._plan.record())} ] || {command}"
            await link.run(command, timeout_s=CLEAN_S, what=f"removing {self._plan.folder(link.name)}")

        try:
            yield
        finally:
            try:
                self._links.on_all(clean, 2 * CLEAN_S)
            except HostsError as error:
                self._status.say(f"{error}\nkeys of this run may be left there; remove the folder of the run")
            except KeyboardInterrupt:
                self._status.say("keys of this run may be left on its hosts; `zsim up` or `zsim doctor` lists them")
                raise

    # Requests

    def _where(self) -> dict[str, Any]:
        return {"out": str(self._out.absolute()), "roles": list(self._plan.processes)}

    def _restart(self, role: str) -> str:
        self._refuse_unless_runs(role)
        if role in (WORLD, RECORDER):
            raise RunError(f"{role} cannot be restarted: the run depends on it; end the run with `zsim down`")
        with self._replacing:
            return self._take_over(self._plan, role)

    def _move(self, role: str, host: str) -> str:
        self._refuse_unless_runs(role)
        if role in (WORLD, RECORDER) or role.startswith(f"{ROUTER}."):
            raise RunError(f"{role} cannot be moved while the run goes on; change the inventory and run again")
        if host not in (hosts := self._plan.inventory_file.inventory.hosts):
            raise RunError(f"host is {host!r}; must be one of {', '.join(hosts)}")
        with self._replacing:
            plan = self._plan.moved(role, host)
            if faults := plan.certificate_faults(datetime.now(UTC)):
                raise HostsError("\n".join(faults))
            link = self._links.by_name.get(host) or self._join(host)
            self._loop.call(_refuse_unless_able(link, plan.python(host), role))
            return self._take_over(plan, role)

    def _refuse_unless_runs(self, role: str) -> None:
        if not self._supervisor.members:
            raise RunError("the run has not started yet; try again later")
        if role not in self._plan.processes:
            raise RunError(f"role is {role!r}; must be one of {', '.join(self._plan.processes)}")

    def _join(self, host: str) -> HostLink:
        """Check a host that the run has not used so far; return a link to it."""
        link = self._links.to(host)
        try:
            report = self._loop.call(host_report(link, self._plan.python(host)), JOIN_S)
            faults, warnings = compare_reports({host: report})
            if faults:
                raise HostsError("\n".join(faults))
        except BaseException:
            self._loop.spawn(link.close())
            raise
        for warning in warnings:
            self._status.say(f"warning: {warning}")
        self._links.add(link)
        self._status.links = self._links.by_name
        return link

    def _take_over(self, plan: HostPlan, role: str) -> str:
        """Start the new process of a role; the old one leaves by itself, or is killed if it hangs."""
        host = plan.host(role)
        if files := plan.identity(role):
            self._loop.call(self._links.by_name[host].put_files(plan.folder(host), files, COPY_S))
        until_s = time.monotonic() + LEAVE_S
        while self._supervisor.is_being_replaced(role) and time.monotonic() < until_s:
            time.sleep(LOOK_S)
        new = self._remote(plan, role)

        def replace_process() -> None:
            self._supervisor.replace(new)
            self._plan = plan

        replacement = self._supervisor.submit(replace_process)
        wait([replacement], ORDER_S)
        replacement.cancel()  # has no effect once the order is being carried out
        try:
            replacement.result()
        except CancelledError as error:
            raise RunError("the run is ending; no more processes are started") from error
        return f"{role} on {host}"


async def _refuse_unless_able(link: HostLink, python: str, role: str) -> None:
    """Raise HostsError if the Python of a host cannot import what a role needs; the error names what is missing."""
    for extra in extras([role]):
        code = f"import {MODULES[extra]}"
        command = f"{shell_word(python)} -c {shell_word(code)}"
        try:
            await link.run(command, timeout_s=IMPORT_S, what=code)
        except HostsError as error:
            remedy = f"install its extra {extra} there, as `zsim push --extra {extra}` does"
            raise HostsError(f"{error}; {role} cannot run on {link.name}; {remedy}") from error


class HostPlan:
    """The processes that zsim starts in a run, and their hosts; immutable. Raises InventoryError if any has no host."""

    def __init__(
        self, inventory_file: InventoryFile, scenario: Scenario, run_id: str, pace: Sequence[str] = ()
    ) -> None:
        self.inventory_file = inventory_file
        self._scenario = scenario
        self._run_id = run_id  # names the run's folder on each host
        self._pace = pace  # command line options of the world
        ordered = sorted(inv.processes(inventory_file, scenario, pace), key=lambda process: process.role != ROUTER)
        self.processes = {process.name: process for process in ordered}  # each after the process that it connects to
        self.programs = inv.local_programs(inventory_file, scenario)  # the user's own programs, started on this machine
        # a line about each of the user's programs that is placed on a host; zsim does not start these
        self.remarks = [
            line for host in inventory_file.inventory.hosts for line in inv.own_programs(inventory_file, scenario, host)
        ]

    def moved(self, name: str, host: str) -> HostPlan:
        """Return a plan with another host for one process."""
        hosts_by_process = {**inv.placement(self.inventory_file, self._scenario), name: host}
        inventory_file = self.inventory_file._replace(
            inventory=structs.replace(self.inventory_file.inventory, roles=hosts_by_process)
        )
        return HostPlan(inventory_file, self._scenario, self._run_id, self._pace)

    def hosts(self) -> list[str]:
        return sorted({process.host for process in self.processes.values()})

    def host(self, name: str) -> str:
        return self.processes[name].host

    def folder(self, host: str) -> str:
        return f"{runs_folder(self.inventory_file.inventory.hosts[host])}/{self._run_id}"

    def keys(self, host: str) -> str:
        """Return the folder of the private keys of this run's processes on a host."""
        return f"{self.folder(host)}/{FOLDER}"

    def endpoint(self) -> str:
        """Return the endpoint to which programs on this machine connect."""
        return inv.endpoint(self.inventory_file, inv.placement(self.inventory_file, self._scenario), self.host(WORLD))

    def record(self) -> str:
        return f"{self.folder(self.host(RECORDER))}/{RECORD}"

    def record_location(self) -> str:
        """Return the host and path of the record, with the command that fetches it."""
        name = self.host(RECORDER)
        command = scp(self.inventory_file.inventory.hosts[name], self.inventory_file.folder, self.record())
        return f"{name}:{self.record()} (fetch it with `{command}`)"

    def ports(self, host: str) -> list[int]:
        return [process.port for process in self.processes.values() if process.host == host and process.port]

    def certificate_faults(self, now: datetime) -> list[str]:
        return certificates.certificate_faults(
            self.inventory_file, {name: self.host(name) for name in self.processes}, now
        )

    def python(self, host: str) -> str:
        return inv.python(self.inventory_file.inventory.hosts[host])

    def arguments(self, name: str) -> list[str]:
        """Return the arguments of `zsim` that start a process."""
        process, folder = self.processes[name], self.folder(self.host(name))
        identity = f"{self.keys(process.host)}/{name}"
        files = ProcessFiles(f"{folder}/scenario.yaml", identity, f"{identity}/{ACCESS}", folder)
        role, *options = inv.command(process, files)[len(MODULE) :]
        journal = ["--journal", f"{folder}/{JOURNAL}"] if name == WORLD else []
        return [role, "--launched", self._run_id, *journal, *options]

    def files(self, host: str) -> dict[str, bytes]:
        """Return the files that a host needs, by path below the run's folder; errors as in `identity`."""
        contents: dict[str, bytes] = {}
        for name, process in self.processes.items():
            if process.host == host:
                contents |= self.identity(name)
        if self.host(WORLD) == host:
            contents["scenario.yaml"] = scenario_file.to_text(self._scenario).encode()
        return contents

    def identity(self, name: str) -> dict[str, bytes]:
        """Return the certificates, key and access control of a process, by path below the run's folder.

        Raise HostsError if one cannot be read.
        """
        process = self.processes[name]
        if not process.secure:
            return {}
        source = certificates.folder_of(self.inventory_file) / process.host
        paths = {file: source / name / file for file in CERTIFICATES}
        if process.port is not None:
            paths[ACCESS] = source / inv.access_file(process)
        init = certificates.init_command(self.inventory_file)
        remedy = f"make certificates with `{init}`, or set security.insecure on a network of your own"
        contents = {}
        for file, path in paths.items():
            with file_fault(path, "cannot be read", remedy, HostsError):
                contents[f"{FOLDER}/{name}/{file}"] = path.read_bytes()
        return contents


class RemoteProcess:
    """A role on another host, started, watched and stopped over ssh; its output goes to a file on this machine.

    The standard input of the process is the ssh channel. The process ends when sshd closes the channel because the
    launcher has died, or when it has received nothing for ORPHAN_S, for instance because the launcher's host is down
    (roles/stop_channel.py).

    Args:
        on_line: called with each line of its standard output; None: standard output goes to the log too.
        files: a folder on the host, and the contents of the files that the process needs, by path below that folder.
            The process removes its key when it ends, so each restart copies the files again.
    """

    is_program = False

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        link: HostLink,
        loop: EventLoopThread,
        log: ProcessLog,
        on_line: Callable[[str], None] | None = None,
        files: tuple[str, Mapping[str, bytes]] = ("", {}),
    ) -> None:
        self.name = name
        self.role = name.split(".", 1)[0]
        self.host = link.name
        self.restarts = 0
        self.pid = 0
        self._command = command
        self._link = link
        self._loop = loop
        self._log = log
        self._on_line = on_line
        self._folder, self._files = files
        self._starts = 0
        self._process: asyncssh.SSHClientProcess[str] | None = None
        self._life: Future[None] | None = None
        self.code: int | None = None  # exit code, None while it starts or runs; negative for a signal
        self._fault = ""
        self._ended = threading.Event()
        self._stop: str | None = None

    @property
    def state(self) -> str:
        if self.code is not None:
            return "ended"
        return "running" if self.pid else "starting"

    def start(self) -> None:
        """Start or restart the process, without waiting."""
        self._starts += 1
        self.pid, self.code, self._process, self._stop, self._fault = 0, None, None, None, ""
        self._ended.clear()
        self._life = self._loop.spawn(self._live())

    async def _live(self) -> None:
        """Run the process to its end; set `code` however it ends."""
        code = LOST
        try:
            code = await self._run()
        except (asyncssh.Error, OSError, HostsError) as error:
            self._fault = f"the connection to {self.host} broke ({error})"
        except Exception as error:
            self._fault = f"the launcher could not watch it ({error!r})"
        finally:
            if self._fault:
                self._log.write(f"{self._fault}\n")
            self.code = code
            self._ended.set()

    async def _run(self) -> int:
        async def beat(process: asyncssh.SSHClientProcess[str]) -> None:
            with contextlib.suppress(OSError, asyncssh.Error):
                while True:
                    await asyncio.sleep(BEAT_S)
                    process.stdin.write("beat\n")

        async def read(stream: Any, on_line: Callable[[str], None]) -> None:
            async for line in stream:
                on_line(line)

        if self._starts > 1 and self._files:
            await self._link.put_files(self._folder, self._files, RECOPY_S, retry=True)
        settings = " ".join(f"{name}={value}" for name, value in SINGLE_THREADED.items())
        command = f"echo {PID}$$; exec env {settings} {shell_line(self._command)}"
        async with (
            self._link.channel(retry=True) as connection,
            connection.create_process(command, encoding="utf-8", errors="replace") as process,
        ):
            async for line in process.stdout:
                if line.startswith(PID):
                    self.pid = int(line.removeprefix(PID))
                    break
            self._process = process
            process.stdin.write(f"orphan-after {ORPHAN_S:g}\n")
            if self._stop is not None:
                self._send(f"stop {self._stop}\n")
            beats = asyncio.create_task(beat(process))
            try:
                log = self._log.write
                await asyncio.gather(read(process.stdout, self._on_line or log), read(process.stderr, log))
                done = await process.wait()
            finally:
                beats.cancel()
            if done.exit_signal:
                return -int(getattr(signal, f"SIG{done.exit_signal[0]}", signal.SIGKILL))
            return done.exit_status if done.exit_status is not None else LOST

    def outcome(self) -> str:
        if self.code == LOST:
            return self._fault or f"the connection to {self.host} broke"
        return end_text(self.code, self.last_log_line())

    def last_log_line(self) -> str:
        return self._log.last

    def request_stop(self, reason: str) -> None:
        """Ask the process to stop; the request is kept while it is starting, and has no effect once it has ended."""
        self._stop = reason
        self._loop.call_soon(self._send, f"stop {reason}\n")

    def _send(self, line: str) -> None:
        if self._process is not None:
            with contextlib.suppress(OSError, asyncssh.Error):
                self._process.stdin.write(line)

    def wait(self, timeout_s: float) -> bool:
        return self._ended.wait(max(0.0, timeout_s))

    def kill(self) -> None:
        """Send SIGKILL, or stop trying to start the process, without waiting."""
        if self.code is not None or self._life is None:
            return
        if not self.pid:
            self._life.cancel()
            return

        async def kill(command: str) -> None:
            with contextlib.suppress(HostsError):
                await self._link.run(command, timeout_s=KILL_S)

        self._loop.spawn(kill(f"kill -9 {self.pid}"))

    def close(self) -> None:
        """Kill the process; a process that cannot be reached ends by itself."""
        if self._life is not None:
            self.kill()
            self._ended.wait(KILL_S)


class ProcessLog:
    """The log file of a process; if it cannot be written, this is reported once, and only the last line is kept."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self.last = ""  # the last line that is not empty
        self._path = path
        self._say = say
        self._is_written = True

    def write(self, line: str) -> None:
        self.last = line.strip() or self.last
        try:
            with self._path.open("a", errors="replace") as file:
                file.write(line)
        except OSError as error:
            if self._is_written:
                self._is_written = False
                self._say(f"{self._path}: cannot be written ({error.strerror}); this process's output is lost")
