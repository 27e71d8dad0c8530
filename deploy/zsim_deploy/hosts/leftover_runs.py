"""What other runs have left on a host: records and keys of runs that were cut short, and ports still in use."""

import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

from zsim.transport.tls import KEY
from zsim_deploy.hosts.doctor import NetworkPath, path_faults
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.ssh_connection import json_answer, shell_line, shell_word
from zsim_deploy.inventory.inventory import SSH_PORT, Host
from zsim_deploy.roles.stop_channel import FOLDER

RECORD = "run.mcap"
RUNS = "runs"  # below the folder of zsim on a host: a folder per run
# Whose processes still run is no earlier run; where there is no ps, nobody is known to.
LIST_RUNS = f"""
alive=$(ps -A -ww -o args 2>/dev/null || ps -A -o args 2>/dev/null)
for run in *; do
  case "$alive" in *"--launched $run "*) continue;; esac
  [ -f "$run/{RECORD}" ] && echo "{RECORD} $run"
  [ -n "$(find "$run/{FOLDER}" -name {KEY} 2>/dev/null)" ] && echo "{KEY} $run"
done
true
"""
# Run there by its Python: `- ADDRESS PORT...`. What else may be wrong with a port is in the log of its process.
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


def runs_folder(host: Host) -> str:
    """Return the folder of runs on a host, from its root or as ~/ from the home."""
    home = "" if host.folder.startswith(("/", "~/")) else "~/"
    return f"{home}{host.folder}/{RUNS}"


async def leftovers(link: HostLink, base: Path) -> list[str]:
    """Return what earlier runs have left on a host: at most a line on records, and one on private keys.

    Args:
        link: to the host.
        base: folder of the inventory.

    Raises:
        HostsError: it could not be asked.
    """
    folder = runs_folder(link.host)
    script = f"cd {shell_word(folder)} 2>/dev/null || exit 0{LIST_RUNS}"
    output = (await link.run(script, what=f"looking into {folder}")).decode(errors="replace")
    return leftover_lines(link.name, link.host, base, output.splitlines())


def leftover_lines(name: str, host: Host, base: Path, output: Iterable[str]) -> list[str]:
    """Return lines for a person from what LIST_RUNS prints; a greeting of the login shell is passed over."""
    folder = runs_folder(host)
    words = [line.split(" ", 1) for line in output]
    runs = {kind: [word[1] for word in words if word[0] == kind and len(word) > 1] for kind in (RECORD, KEY)}
    lines = []
    if records := [f"{folder}/{run}/{RECORD}" for run in runs[RECORD]]:
        lines.append(
            f"{name}: records of earlier runs were not fetched: {', '.join(f'{name}:{path}' for path in records)}; "
            f"fetch with `{scp(host, base, records[0])}`, then remove the folder of the run there"
        )
    if keys := [f"{folder}/{run}/{FOLDER}" for run in runs[KEY]]:
        lines.append(
            f"{name}: private keys of earlier runs were left: {', '.join(f'{name}:{path}' for path in keys)}; "
            f"remove them there with `rm -r {shell_line(keys)}`"
        )
    return lines


def scp(host: Host, base: Path, path: str) -> str:
    """Return the command that copies a file from a host to here, as `zsim up` reaches the host."""
    address = host.ssh or host.address
    shown = f"[{address}]" if ":" in address else address
    known = f"UserKnownHostsFile={base / Path(host.known_hosts).expanduser()}" if host.known_hosts else None
    words = ["scp", *(["-P", str(host.port)] if host.port != SSH_PORT else [])]
    words += ["-i", str(base / Path(host.key).expanduser())] if host.key else []
    words += ["-o", known] if known else []
    user = f"{host.user}@" if host.user else ""
    return shlex.join([*words, f"{user}{shown}:{path.removeprefix('~/')}", "."])


async def port_faults(link: HostLink, python: str, ports: Sequence[int]) -> list[str]:
    """Return a line for each port of a host on which somebody else listens.

    Raises:
        HostsError: it could not be asked.
    """
    if not ports:
        return []
    command = f"{shell_word(python)} - {shell_line([link.host.address, *map(str, ports)])}"
    output = await link.run(command, TRY_PORTS.encode(), TRY_PORTS_S, "looking for free ports")
    taken = (json_answer(output.decode(errors="replace").splitlines()) or {}).get("taken", [])
    return path_faults([NetworkPath(link.name, link.name, port, {"error": "", "taken": True}) for port in taken])[0]
