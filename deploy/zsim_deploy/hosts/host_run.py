"""A run on several hosts: checked, prepared, started over ssh, watched, ended, and its record brought home."""

import contextlib
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from zsim.errors import HostsError, RunError, ZsimError
from zsim.record import repair
from zsim.scenario import scenario_file
from zsim.scenario.roles import RECORDER, WORLD
from zsim.scenario.scenario import Scenario
from zsim_deploy.arguments import changed_options, pace_options
from zsim_deploy.hosts.control_socket import ControlSocket
from zsim_deploy.hosts.doctor import compare_reports, host_report
from zsim_deploy.hosts.host_link import EventLoopThread, HostLink
from zsim_deploy.hosts.host_links import HostLinks, fetch
from zsim_deploy.hosts.host_plan import RECORD, HostPlan, leftovers, port_faults
from zsim_deploy.hosts.host_report import HostReport
from zsim_deploy.hosts.launcher_requests import LauncherRequests
from zsim_deploy.hosts.remote_process import ProcessLog, RemoteProcess
from zsim_deploy.hosts.ssh_connection import shell_word
from zsim_deploy.hosts.status_table import StatusTable
from zsim_deploy.inventory.enrolment import exposed_keys
from zsim_deploy.inventory.inventory import InventoryFile
from zsim_deploy.launch.end_signals import EndSignals
from zsim_deploy.launch.supervisor import Outcome, Supervisor

CONNECT_S = 30.0  # how long all hosts together may take to let us in, …
CHECK_S = 60.0  # … to be checked: a small computer takes 5 s to import numpy, a poor link adds a dozen round trips, …
PREPARE_S = 30.0  # … and to take their files
CLEAN_S = 5.0  # how long a host may take to remove the run's folder; one that was lost holds nobody up for longer


@dataclass
class HostRunOptions:
    """How to run a scenario, of whose file some fields were changed, on the hosts of an inventory."""

    scenario: Scenario
    placed: InventoryFile
    out: Path
    mode: str = "lockstep"
    rate: float = 0.0
    run_id: str = field(default_factory=lambda: uuid.uuid4().hex[:12])
    changed: Sequence[str] = ()

    def pace(self) -> list[str]:
        """Return mode, rate and changed fields as options of the world."""
        return [*pace_options(self.mode, self.rate), *changed_options(self.changed)]


class HostInspection(NamedTuple):
    """A host before the run: its report, ports that are taken, and what earlier runs have left."""

    report: HostReport
    taken: list[str]
    left: list[str]


class HostRun:
    """One run on several hosts.

    Args:
        options: what to run where.
        status: takes progress.

    Raises:
        InventoryError: a process has no place.
    """

    def __init__(self, options: HostRunOptions, status: StatusTable) -> None:
        self._options = options
        self._status = status
        self._logs = options.out / "logs"
        self._plan = HostPlan(options.placed, options.scenario, options.run_id, options.pace())
        self._supervisor = Supervisor(options.scenario.processes, status)
        self._loop = EventLoopThread()
        self._links = HostLinks(options.placed, self._plan.hosts(), self._loop)
        self._record_stays = False
        self._signals = EndSignals(options.out / "up.log", status.hang_up)

    def run(self) -> Outcome:
        """Run to the end; whatever happens, no process or key of it is left on any host that can be reached.

        Raises:
            RunError: the federation is up already on this machine.
            HostsError: with a line for every certificate that is missing, or every host that cannot take part.
        """
        try:
            with self._signals, self._control_socket():
                self._refuse_unless_certified()
                self._timed("connect", lambda: self._links.on_all(HostLink.open, CONNECT_S))
                self._timed("check", self._check)
                with self._cleaned():
                    self._timed("prepare", lambda: self._links.on_all(self._prepare, PREPARE_S))
                    return self._fly()
        finally:
            with contextlib.suppress(HostsError):
                self._links.close()
            self._loop.close()

    def _look(self) -> None:
        """End the run where nobody sees it any more; show which hosts are silent."""
        self._signals.look()
        if self._signals.reason:
            self._supervisor.interrupt(self._signals.reason)
        self._status.report_silent_hosts()

    def _refuse_unless_certified(self) -> None:
        if faults := self._plan.certificate_faults(datetime.now(UTC)):
            raise HostsError("\n".join(faults))
        if warning := exposed_keys(self._options.placed):
            self._status.say(f"warning: {warning}")

    def _control_socket(self) -> ControlSocket:
        requests = LauncherRequests(
            self._plan, self._links, self._loop, self._supervisor, self._status, self._options.out, self._remote
        )
        return ControlSocket(self._options.scenario.federation, requests.handlers())

    def _timed(self, what: str, act: Callable[[], Any]) -> None:
        start_s = time.monotonic()
        act()
        self._status.stages_s[what] = time.monotonic() - start_s

    def _check(self) -> None:
        looks = self._links.on_all(self._inspect, CHECK_S)
        faults, warnings = compare_reports({name: look.report for name, look in looks.items()})
        for warning in [*warnings, *(line for look in looks.values() for line in look.left)]:
            self._status.say(f"warning: {warning}")
        if faults := [*faults, *(line for look in looks.values() for line in look.taken)]:
            raise HostsError("\n".join(faults))

    async def _inspect(self, link: HostLink) -> HostInspection:
        python = self._plan.python(link.name)
        report = await host_report(link, python, self._options.placed.word)
        taken = await port_faults(link, python, self._plan.ports(link.name))
        return HostInspection(report, taken, await leftovers(link, self._options.placed.folder))

    async def _prepare(self, link: HostLink) -> None:
        """Put the scenario, and the certificates where there are any, on a host."""
        if files := self._plan.files(link.name):
            await link.put_files(self._plan.folder(link.name), files, PREPARE_S)

    def _fly(self) -> Outcome:
        self._make_logs()
        for remark in self._plan.remarks:
            self._status.say(remark)
        self._supervisor.members = [self._remote(self._plan, name) for name in self._plan.processes]
        self._status.members, self._status.links = self._supervisor.members, self._links.by_name
        self._links.listen()
        self._record_stays = True
        self._look()
        try:
            outcome = self._supervisor.run(self._look)
            fault = self._fetch()
        except KeyboardInterrupt:
            where = self._plan.way_to_record()
            self._status.say(f"the record was not fetched; what there is of it is at {where}")
            raise
        if fault and not outcome.failed and not outcome.interrupted:
            return replace(outcome, reason=fault, failed=True)
        if fault:
            self._status.say(fault)
        return outcome

    def _make_logs(self) -> None:
        out = self._options.out
        try:
            self._logs.mkdir(parents=True, exist_ok=True)
            (out / "scenario.yaml").write_text(scenario_file.to_text(self._options.scenario))
        except OSError as error:
            raise RunError(f"{out}: cannot be written ({error.strerror}); give --out another folder") from error

    def _remote(self, plan: HostPlan, name: str) -> RemoteProcess:
        host = plan.host(name)
        log = ProcessLog(self._logs / f"{name}.log", self._status.say)
        on_line = self._supervisor.handle_line if name == WORLD else None
        link = self._links.by_name[host]
        more = (on_line, plan.folder(host), plan.identity(name))
        return RemoteProcess(name, plan.arguments(name), link, plan.python(host), self._loop, log, *more)

    def _fetch(self) -> str:
        """Bring the record home; return why it is not here, empty if it is."""
        host, into = self._plan.host(RECORDER), self._options.out / RECORD
        self._status.say(f"fetching the record from {host}:{self._plan.record()} …")
        try:
            is_there = self._loop.call(fetch(self._links.by_name[host], self._plan.record(), into))
            if is_there:
                repair(into)
        except (ZsimError, OSError) as error:
            where = self._plan.way_to_record()
            return f"the record could not be fetched ({error}); what there is of it is at {where}"
        self._record_stays = False
        return "" if is_there else "nothing was recorded"

    @contextlib.contextmanager
    def _cleaned(self) -> Any:
        """Leave nothing of the run on the hosts in the end, but a record that could not be fetched."""
        try:
            yield
        finally:
            try:
                self._links.on_all(self._clean, 2 * CLEAN_S)
            except HostsError as error:
                self._status.say(f"{error}\nkeys of this run may be left there; remove its folder")
            except KeyboardInterrupt:
                self._status.say("keys of this run may be left on its hosts; `zsim up` or `zsim doctor` lists them")
                raise

    async def _clean(self, link: HostLink) -> None:
        folder, keys = shell_word(self._plan.folder(link.name)), shell_word(self._plan.keys(link.name))
        command = f"rm -rf {folder}"
        if self._record_stays and link.name == self._plan.host(RECORDER):
            command = f"rm -rf {keys}; [ -e {shell_word(self._plan.record())} ] || {command}"
        await link.run(command, timeout_s=CLEAN_S, what=f"removing {self._plan.folder(link.name)}")
