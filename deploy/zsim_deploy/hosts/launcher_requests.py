"""The requests of `zsim ps`, `logs`, `restart`, `move` and `down`, carried out by the `zsim up` that runs."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, wait
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zsim.errors import HostsError, RunError
from zsim.scenario.roles import RECORDER, ROUTER, WORLD
from zsim_deploy.hosts.doctor import compare_reports, host_report
from zsim_deploy.hosts.host_link import EventLoopThread, HostLink
from zsim_deploy.hosts.host_links import HostLinks
from zsim_deploy.hosts.host_plan import HostPlan
from zsim_deploy.hosts.remote_process import RemoteProcess
from zsim_deploy.hosts.ssh_connection import shell_word
from zsim_deploy.hosts.status_table import StatusTable
from zsim_deploy.inventory.processes import MODULES, extras
from zsim_deploy.launch.supervisor import Supervisor

JOIN_S = 60.0  # until a host that was not used so far is connected and checked
IMPORT_S = 20.0  # until a Python has shown that it can run a role; a small computer takes 5 s
BRING_S = 30.0  # until a certificate is on a host
LEAVE_S = 20.0  # until a process whose place was taken a moment ago has ended, which takes a second
LOOK_S = 0.1  # between two looks whether it has
ORDER_S = 5.0  # until the supervisor, which looks every 50 ms, carries out an order


class LauncherRequests:
    """Carries out requests, each in a thread of the control socket.

    Args:
        plan: at first; it changes with each move.
        links: to the hosts.
        loop: on which they live.
        supervisor: over the processes.
        status: with the rows of `ps`.
        out: folder of the run here.
        remote: makes a process of a plan.
    """

    def __init__(
        self,
        plan: HostPlan,
        links: HostLinks,
        loop: EventLoopThread,
        supervisor: Supervisor,
        status: StatusTable,
        out: Path,
        remote: Callable[[HostPlan, str], RemoteProcess],
    ) -> None:
        self._plan = plan
        self._links = links
        self._loop = loop
        self._supervisor = supervisor
        self._status = status
        self._out = out
        self._remote = remote
        self._one_at_a_time = threading.Lock()

    def handlers(self) -> dict[str, Callable[..., Any]]:
        """Return what can be asked, by name."""
        looks = {"ps": self._ps, "where": self._say_where}
        return {**looks, "down": self._down, "restart": self._restart, "move": self._move}

    def _ps(self) -> dict[str, Any]:
        return {"rows": self._status.rows(), "clock": self._status.clock_now(), **self._say_where()}

    def _say_where(self) -> dict[str, Any]:
        return {"out": str(self._out.absolute()), "roles": list(self._plan.processes)}

    def _down(self) -> None:
        self._supervisor.interrupt("ended by zsim down")

    def _restart(self, role: str) -> str:
        self._refuse_unless_runs(role)
        if role in (WORLD, RECORDER):
            raise RunError(f"{role} cannot be restarted: the run lives in it; end the run with `zsim down`")
        with self._one_at_a_time:
            self._bring(self._plan, role)
            return self._take_over(self._plan, role)

    def _move(self, role: str, host: str) -> str:
        self._refuse_unless_runs(role)
        if role in (WORLD, RECORDER) or role.startswith(f"{ROUTER}."):
            raise RunError(f"{role} cannot be moved while the run goes on; change the inventory and run again")
        if host not in (hosts := self._plan.placed.inventory.hosts):
            raise RunError(f"host is {host!r}; must be one of {', '.join(hosts)}")
        with self._one_at_a_time:
            plan = self._plan.moved(role, host)
            if faults := plan.certificate_faults(datetime.now(UTC)):
                raise HostsError("\n".join(faults))
            link = self._links.by_name.get(host) or self._join(host)
            self._loop.call(_refuse_unless_able(link, plan.python(host), role))
            self._bring(plan, role)
            return self._take_over(plan, role)

    def _bring(self, plan: HostPlan, role: str) -> None:
        """Put the certificate of a process on its host."""
        link = self._links.by_name[plan.host(role)]
        if files := plan.identity(role):
            self._loop.call(link.put_files(plan.folder(link.name), files, BRING_S))

    def _refuse_unless_runs(self, role: str) -> None:
        if not self._supervisor.members:
            raise RunError("the run has not started yet; try again when it flies")
        if role not in self._plan.processes:
            raise RunError(f"role is {role!r}; must be one of {', '.join(self._plan.processes)}")

    def _join(self, host: str) -> HostLink:
        """Return a link to a host that was not used so far, if it fits."""
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
        """Start a process that takes over the name of another, which leaves by itself, or is killed if it hangs."""
        until_s = time.monotonic() + LEAVE_S
        while self._supervisor.is_being_replaced(role) and time.monotonic() < until_s:
            time.sleep(LOOK_S)
        new = self._remote(plan, role)

        def take() -> None:
            self._supervisor.replace(new)
            self._plan = plan

        carried_out = self._supervisor.submit(take)
        wait([carried_out], ORDER_S)
        carried_out.cancel()  # changes nothing where it is being carried out
        try:
            carried_out.result()
        except CancelledError as error:
            raise RunError("the run is ending; nothing is started any more") from error
        return f"{role} on {plan.host(role)}"


async def _refuse_unless_able(link: HostLink, python: str, role: str) -> None:
    """Refuse a host whose Python cannot import what a role is made of.

    Raises:
        HostsError: with what it lacks.
    """
    for extra in extras([role]):
        code = f"import {MODULES[extra]}"
        command = f"{shell_word(python)} -c {shell_word(code)}"
        try:
            await link.run(command, timeout_s=IMPORT_S, what=code)
        except HostsError as error:
            remedy = f"install its extra {extra} there, as `zsim push --extra {extra}` does"
            raise HostsError(f"{error}; {role} cannot run on {link.name}; {remedy}") from error
