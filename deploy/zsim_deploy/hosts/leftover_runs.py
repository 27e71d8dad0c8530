"""What runs whose launcher was killed, or could not fetch their record, have left on a host."""

import shlex
from collections.abc import Iterable
from pathlib import Path

from zsim.transport.tls import KEY
from zsim_deploy.inventory.inventory import SSH_PORT, Host
from zsim_deploy.security.key_lease import FOLDER
from zsim_deploy.ssh import shell
from zsim_deploy.ssh.host_link import HostLink

RECORD = "run.mcap"
RUNS = "runs"  # below the folder of zsim on a host: a folder per run
# Whose processes still run is no earlier run; where there is no ps, nobody is known to.
LOOK = f"""
alive=$(ps -A -ww -o args 2>/dev/null || ps -A -o args 2>/dev/null)
for run in *; do
  case "$alive" in *"--launched $run "*) continue;; esac
  [ -f "$run/{RECORD}" ] && echo "{RECORD} $run"
  [ -n "$(find "$run/{FOLDER}" -name {KEY} 2>/dev/null)" ] && echo "{KEY} $run"
done
true
"""


def runs_folder(host: Host) -> str:
    """Return the folder of runs on a host, from its root or as ~/ from the home."""
    home = "" if host.folder.startswith(("/", "~/")) else "~/"
    return f"{home}{host.folder}/{RUNS}"


async def earlier(link: HostLink, base: Path) -> list[str]:
    """Return what earlier runs have left on a host: at most a line on records, and one on private keys.

    Args:
        link: to the host.
        base: folder of the inventory.

    Raises:
        HostsError: it could not be asked.
    """
    folder = runs_folder(link.host)
    script = f"cd {shell.word(folder)} 2>/dev/null || exit 0{LOOK}"
    said = (await link.run(script, what=f"looking into {folder}")).decode(errors="replace")
    return told(link.name, link.host, base, said.splitlines())


def told(name: str, host: Host, base: Path, said: Iterable[str]) -> list[str]:
    """Return lines for a person from what LOOK says; a greeting of the login shell is passed over."""
    folder = runs_folder(host)
    words = [line.split(" ", 1) for line in said]
    found = {kind: [word[1] for word in words if word[0] == kind and len(word) > 1] for kind in (RECORD, KEY)}
    lines = []
    if records := [f"{folder}/{run}/{RECORD}" for run in found[RECORD]]:
        lines.append(
            f"{name}: records of earlier runs were not fetched: {', '.join(f'{name}:{path}' for path in records)}; "
            f"fetch with `{scp(host, base, records[0])}`, then remove the folder of the run there"
        )
    if keys := [f"{folder}/{run}/{FOLDER}" for run in found[KEY]]:
        lines.append(
            f"{name}: private keys of earlier runs were left: {', '.join(f'{name}:{path}' for path in keys)}; "
            f"remove them there with `rm -r {shell.line(keys)}`"
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
