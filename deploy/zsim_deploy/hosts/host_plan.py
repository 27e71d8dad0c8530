"""What a run puts on each host: the processes with their command lines, and the files that they need there."""

import shlex
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import msgspec

from zsim.errors import HostsError
from zsim.scenario import scenario_file
from zsim.scenario.rights import RECORDER, ROUTER, WORLD
from zsim.scenario.scenario import Scenario
from zsim.transport.tls import CERTIFICATES
from zsim_deploy.hosts.leftover_runs import RECORD, runs_folder, scp
from zsim_deploy.inventory import enrolment
from zsim_deploy.inventory import inventory as inv
from zsim_deploy.inventory.enrolment import folder_of, init_command
from zsim_deploy.inventory.inventory import InventoryFile
from zsim_deploy.inventory.processes import MODULE, ProcessFiles, access_file, command, own_programs, processes
from zsim_deploy.roles.stop_channel import FOLDER

ACCESS = "access.json"


class HostPlan:
    """The processes of one run that zsim starts, and where; it does not change.

    Args:
        placed: the inventory.
        scenario: what is flown.
        run_id: names the run's folder on each host.
        pace: options of the world: `--realtime`, `--rate R`.

    Attributes:
        processes: by name, the routers first, each after the one that it connects to.
        remarks: on programs of the user's own, which are not started.

    Raises:
        InventoryError: a process has no place.
    """

    def __init__(self, placed: InventoryFile, scenario: Scenario, run_id: str, pace: Sequence[str] = ()) -> None:
        self._placed = placed
        self._scenario = scenario
        self._run_id = run_id
        self._pace = pace
        in_order = sorted(processes(placed, scenario, pace), key=lambda process: process.role != ROUTER)
        self.processes = {process.name: process for process in in_order}
        self.remarks = own_programs(placed, scenario)

    def moved(self, name: str, host: str) -> "HostPlan":
        """Return the same plan but for the host of one process."""
        places = {**inv.placement(self._placed, self._scenario), name: host}
        placed = self._placed._replace(inventory=msgspec.structs.replace(self._placed.inventory, roles=places))
        return HostPlan(placed, self._scenario, self._run_id, self._pace)

    def known_hosts(self) -> list[str]:
        """Return the hosts of the inventory."""
        return list(self._placed.inventory.hosts)

    def hosts(self) -> list[str]:
        """Return the hosts on which something runs."""
        return sorted({process.host for process in self.processes.values()})

    def host(self, name: str) -> str:
        """Return where a process runs."""
        return self.processes[name].host

    def folder(self, host: str) -> str:
        """Return the folder of this run on a host."""
        return f"{runs_folder(self._placed.inventory.hosts[host])}/{self._run_id}"

    def keys(self, host: str) -> str:
        """Return the folder in which the keys of this run's processes are on a host."""
        return f"{self.folder(host)}/{FOLDER}"

    def record(self) -> str:
        """Return where the record is written, on the recorder's host."""
        return f"{self.folder(self.host(RECORDER))}/{RECORD}"

    def way_to_record(self) -> str:
        """Return where the record is, and the command that fetches it."""
        name = self.host(RECORDER)
        command = scp(self._placed.inventory.hosts[name], self._placed.folder, self.record())
        return f"{name}:{self.record()} (fetch it with `{command}`)"

    def source(self) -> str:
        """Return the inventory's file as a word of a command."""
        return shlex.quote(str(self._placed.folder / self._placed.source))

    def base(self) -> Path:
        """Return the folder of the inventory."""
        return self._placed.folder

    def ports(self, host: str) -> list[int]:
        """Return the ports of a host on which processes of the run will listen."""
        return [process.port for process in self.processes.values() if process.host == host and process.port]

    def certificate_faults(self, now: datetime) -> list[str]:
        """Return what of the certificates is missing or of no use at a time, a line for each fault."""
        return enrolment.certificate_faults(self._placed, {name: self.host(name) for name in self.processes}, now)

    def exposed_keys(self) -> str | None:
        """Return a warning of private keys here that others can read, if there are any."""
        return enrolment.exposed_keys(self._placed)

    def python(self, host: str) -> str:
        """Return the interpreter of a host that has zsim."""
        return inv.python(self._placed.inventory.hosts[host])

    def arguments(self, name: str) -> list[str]:
        """Return the arguments of `zsim` that start a process."""
        process, folder = self.processes[name], self.folder(self.host(name))
        identity = f"{self.keys(process.host)}/{name}"
        files = ProcessFiles(f"{folder}/scenario.yaml", identity, f"{identity}/{ACCESS}", folder)
        role, *options = command(process, files)[len(MODULE) :]
        return [role, "--launched", self._run_id, *options]

    def files(self, host: str) -> dict[str, bytes]:
        """Return what the processes of a host need in the run's folder, by path below it.

        Raises:
            HostsError: a certificate is not there.
        """
        contents: dict[str, bytes] = {}
        for name, process in self.processes.items():
            if process.host == host:
                contents |= self.identity(name)
        if self.host(WORLD) == host:
            contents["scenario.yaml"] = scenario_file.to_text(self._scenario).encode()
        return contents

    def identity(self, name: str) -> dict[str, bytes]:
        """Return certificate, key and access control of a process, by path below the run's folder."""
        process = self.processes[name]
        if not process.secure:
            return {}
        source = folder_of(self._placed) / process.host
        paths = {file: source / name / file for file in CERTIFICATES}
        if process.port is not None:
            paths[ACCESS] = source / access_file(process)
        return {f"{FOLDER}/{name}/{file}": self._read(path) for file, path in paths.items()}

    def _read(self, path: Path) -> bytes:
        try:
            return path.read_bytes()
        except OSError as error:
            raise HostsError(
                f"{path}: cannot be read ({error.strerror}); make certificates with "
                f"`{init_command(self._placed)}`, or set security.insecure on a network of your own"
            ) from error
