"""The processes and files that a run places on each host, and the leftovers of earlier runs there."""

import shlex
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from msgspec.structs import replace

from zsim.errors import HostsError, file_fault
from zsim.scenario import scenario_file
from zsim.scenario.roles import RECORDER, ROUTER, WORLD
from zsim.scenario.scenario import Scenario
from zsim.transport.tls import CERTIFICATES, KEY
from zsim_api.run_folder import JOURNAL
from zsim_deploy import certificates
from zsim_deploy import inventory as inv
from zsim_deploy.hosts.host_link import HostLink, json_answer, shell_line, shell_word
from zsim_deploy.inventory import MODULE, SSH_PORT, Host, InventoryFile, ProcessFiles
from zsim_deploy.roles.stop_channel import FOLDER

ACCESS = "access.json"
RECORD = "run.mcap"
RUNS = "runs"  # below the folder of zsim on a host: a folder per run
# A run whose processes are still running is not listed; without ps all are.
LIST_RUNS = f"""
alive=$(ps -A -ww -o args 2>/dev/null || ps -A -o args 2>/dev/null)
for run in *; do
  case "$alive" in *"--launched $run "*) continue;; esac
  [ -f "$run/{RECORD}" ] && echo "{RECORD} $run"
  [ -n "$(find "$run/{FOLDER}" -name {KEY} 2>/dev/null)" ] && echo "{KEY} $run"
done
true
"""
# Run by the host's Python: `- ADDRESS PORT...`. Other faults of a port are in the log of the process that uses it.
TRY_PORTS = """
import errno, json, socket, sys
address, taken = sys.argv[1], []
for port in map(int, sys.argv[2:]):
    family, kind, _, _, place = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            tried.bind(place)
            tried.listen()
        except OSError as error:
            taken += [port] if error.errno == errno.EADDRINUSE else []
print(json.dumps({"taken": taken}))
"""
TRY_PORTS_S = 20.0  # wall time to start Python on a small computer


class HostPlan:
    """The processes of one run that zsim starts, and their hosts; immutable. InventoryError if one has no place."""

    def __init__(self, placed: InventoryFile, scenario: Scenario, run_id: str, pace: Sequence[str] = ()) -> None:
        self.placed = placed
        self._scenario = scenario
        self._run_id = run_id  # names the run's folder on each host
        self._pace = pace  # options of the world
        in_order = sorted(inv.processes(placed, scenario, pace), key=lambda process: process.role != ROUTER)
        self.processes = {process.name: process for process in in_order}  # each after the one that it connects to
        self.programs = inv.programs_here(placed, scenario)  # the user's own, started on this machine
        # on the user's programs that are placed on a host: zsim does not start those
        self.remarks = [line for host in placed.inventory.hosts for line in inv.own_programs(placed, scenario, host)]

    def moved(self, name: str, host: str) -> "HostPlan":
        """Return a plan with another host for one process."""
        places = {**inv.placement(self.placed, self._scenario), name: host}
        placed = self.placed._replace(inventory=replace(self.placed.inventory, roles=places))
        return HostPlan(placed, self._scenario, self._run_id, self._pace)

    def hosts(self) -> list[str]:
        return sorted({process.host for process in self.processes.values()})

    def host(self, name: str) -> str:
        return self.processes[name].host

    def folder(self, host: str) -> str:
        return f"{runs_folder(self.placed.inventory.hosts[host])}/{self._run_id}"

    def keys(self, host: str) -> str:
        """Return the folder on a host that holds the private keys of this run's processes."""
        return f"{self.folder(host)}/{FOLDER}"

    def endpoint(self) -> str:
        """Return the endpoint to which programs on this machine connect."""
        return inv.endpoint(self.placed, inv.placement(self.placed, self._scenario), self.host(WORLD))

    def record(self) -> str:
        return f"{self.folder(self.host(RECORDER))}/{RECORD}"

    def way_to_record(self) -> str:
        """Return the location of the record, with the command that fetches it."""
        name = self.host(RECORDER)
        command = scp(self.placed.inventory.hosts[name], self.placed.folder, self.record())
        return f"{name}:{self.record()} (fetch it with `{command}`)"

    def ports(self, host: str) -> list[int]:
        return [process.port for process in self.processes.values() if process.host == host and process.port]

    def certificate_faults(self, now: datetime) -> list[str]:
        return certificates.certificate_faults(self.placed, {name: self.host(name) for name in self.processes}, now)

    def python(self, host: str) -> str:
        return inv.python(self.placed.inventory.hosts[host])

    def arguments(self, name: str) -> list[str]:
        """Return the arguments of `zsim` that start a process."""
        process, folder = self.processes[name], self.folder(self.host(name))
        identity = f"{self.keys(process.host)}/{name}"
        files = ProcessFiles(f"{folder}/scenario.yaml", identity, f"{identity}/{ACCESS}", folder)
        role, *options = inv.command(process, files)[len(MODULE) :]
        journal = ["--journal", f"{folder}/{JOURNAL}"] if name == WORLD else []
        return [role, "--launched", self._run_id, *journal, *options]

    def files(self, host: str) -> dict[str, bytes]:
        """Return the files that a host needs, by path below the run's folder; HostsError as in `identity`."""
        contents: dict[str, bytes] = {}
        for name, process in self.processes.items():
            if process.host == host:
                contents |= self.identity(name)
        if self.host(WORLD) == host:
            contents["scenario.yaml"] = scenario_file.to_text(self._scenario).encode()
        return contents

    def identity(self, name: str) -> dict[str, bytes]:
        """Return certificate, key and access control of a process, by path below the run's folder.

        HostsError if one is missing.
        """
        process = self.processes[name]
        if not process.secure:
            return {}
        source = certificates.folder_of(self.placed) / process.host
        paths = {file: source / name / file for file in CERTIFICATES}
        if process.port is not None:
            paths[ACCESS] = source / inv.access_file(process)
        init = certificates.init_command(self.placed)
        remedy = f"make certificates with `{init}`, or set security.insecure on a network of your own"
        contents = {}
        for file, path in paths.items():
            with file_fault(path, "cannot be read", remedy, HostsError):
                contents[f"{FOLDER}/{name}/{file}"] = path.read_bytes()
        return contents


def runs_folder(host: Host) -> str:
    """Return the folder of runs on a host, absolute or relative to the home (~/)."""
    return f"{inv.below_home(host.folder)}/{RUNS}"


async def leftovers(link: HostLink, base: Path) -> list[str]:
    """Describe the leftovers of earlier runs on a host: at most a line on records, and one on private keys.

    A greeting of the login shell is skipped. HostsError if the host cannot be asked.
    """
    name, folder = link.name, runs_folder(link.host)
    script = f"cd {shell_word(folder)} 2>/dev/null || exit 0{LIST_RUNS}"
    output = (await link.run(script, what=f"looking into {folder}")).decode(errors="replace")
    words = [line.split(" ", 1) for line in output.splitlines()]
    runs = {kind: [word[1] for word in words if word[0] == kind and len(word) > 1] for kind in (RECORD, KEY)}
    lines = []
    if records := [f"{folder}/{run}/{RECORD}" for run in runs[RECORD]]:
        lines.append(
            f"{name}: records of earlier runs were not fetched: {', '.join(f'{name}:{path}' for path in records)}; "
            f"fetch with `{scp(link.host, base, records[0])}`, then remove the folder of the run there"
        )
    if keys := [f"{folder}/{run}/{FOLDER}" for run in runs[KEY]]:
        lines.append(
            f"{name}: private keys of earlier runs remain: {', '.join(f'{name}:{path}' for path in keys)}; "
            f"remove them there with `rm -r {shell_line(keys)}`"
        )
    return lines


def scp(host: Host, base: Path, path: str) -> str:
    """Return the scp command that copies a file from a host to here, with the ssh settings of `zsim up`."""
    address = host.ssh or host.address
    shown = f"[{address}]" if ":" in address else address
    words = ["scp", *(["-P", str(host.port)] if host.port != SSH_PORT else [])]
    words += ["-i", str(base / Path(host.key).expanduser())] if host.key else []
    if host.known_hosts:
        words += ["-o", f"UserKnownHostsFile={base / Path(host.known_hosts).expanduser()}"]
    user = f"{host.user}@" if host.user else ""
    return shlex.join([*words, f"{user}{shown}:{path.removeprefix('~/')}", "."])


async def port_faults(link: HostLink, python: str, ports: Sequence[int]) -> list[str]:
    """Return a line for each port of a host that another program uses; HostsError if the host cannot be asked."""
    if not ports:
        return []
    command = f"{shell_word(python)} - {shell_line([link.host.address, *map(str, ports)])}"
    output = await link.run(command, TRY_PORTS.encode(), TRY_PORTS_S, "looking for free ports")
    taken = (json_answer(output.decode(errors="replace").splitlines()) or {}).get("taken", [])
    return [port_in_use(link.name, port) for port in taken]


def port_in_use(host: str, port: int) -> str:
    remedy = "end that (`ss -ltnp` there shows it), or give another port in the inventory"
    return f"{host}: port {port} is in use there, perhaps by another run; {remedy}"
