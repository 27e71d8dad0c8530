"""systemd: a folder per host with a unit per process, and `zsim.target`, which starts and stops them together.

Options are those of systemd.exec(5) and systemd.service(5). Limits of restarts and exit codes are those of
zsim_deploy.launch.supervisor: a role is started again under systemd where it would be under `zsim run`.
"""

import re
from collections.abc import Iterable, Iterator, Sequence

from zsim.errors import InventoryError
from zsim.scenario import scenario_file
from zsim.scenario.roles import ROUTER, WORLD
from zsim.scenario.scenario import Scenario
from zsim.schema.checker import show
from zsim_deploy import USER_FAULT
from zsim_deploy.arguments import RUN_ID
from zsim_deploy.inventory import inventory as inv
from zsim_deploy.inventory.inventory import Host, InventoryFile
from zsim_deploy.inventory.processes import (
    STOP_S,
    PlannedProcess,
    ProcessFiles,
    Rendered,
    access_file,
    command,
    on_host,
    own_programs,
    processes,
    used_hosts,
)
from zsim_deploy.launch.death_policy import RESTART_WINDOW_S, RESTARTS_MAX, SUPERSEDED
from zsim_deploy.launch.role_launcher import SINGLE_THREADED

TARGET = "zsim.target"
STATE = "/var/lib/zsim"  # StateDirectory=zsim
CACHE = "/var/cache/zsim"  # CacheDirectory=zsim
PATH_MAX = 4000  # bytes; Linux takes 4095, and what is in the folder has names too

# Not among them: MemoryDenyWriteExecute (numba compiles) and ProcSubset (the fingerprint reads /proc/cpuinfo).
HARDENING = (
    "NoNewPrivileges=yes",
    "CapabilityBoundingSet=",
    "ProtectSystem=strict",
    "ProtectHome=read-only",
    "PrivateTmp=yes",
    "PrivateDevices=yes",
    "ProtectProc=invisible",
    "ProtectClock=yes",
    "ProtectHostname=yes",
    "ProtectControlGroups=yes",
    "ProtectKernelLogs=yes",
    "ProtectKernelModules=yes",
    "ProtectKernelTunables=yes",
    "RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK",
    "RestrictNamespaces=yes",
    "RestrictRealtime=yes",
    "RestrictSUIDSGID=yes",
    "LockPersonality=yes",
    "SystemCallArchitectures=native",
    "SystemCallFilter=@system-service",
    "UMask=0027",
)


def render(placed: InventoryFile, scenario: Scenario, pace: Sequence[str] = ()) -> Rendered:
    """Return `HOST/zsim-PROCESS.service`, `HOST/zsim.target`, and the scenario for the world's host.

    Args:
        placed: the inventory.
        scenario: what to fly.
        pace: options of the world: `--realtime`, `--rate R`.

    Raises:
        InventoryError: a process has no place, or a host has no user or no absolute path to its interpreter.
    """
    planned = processes(placed, scenario, pace)
    _refuse(placed, used_hosts(planned))
    texts: Rendered = {}
    for host in used_hosts(planned):
        here = on_host(planned, host)
        for process in here:
            texts[f"{host}/{unit_name(process.name)}"] = _service(placed, scenario, process, here)
        texts[f"{host}/{TARGET}"] = _target(scenario, here, own_programs(placed, scenario, host))
        if any(process.name == WORLD for process in here):
            texts[f"{host}/scenario.yaml"] = scenario_file.to_text(scenario)
    return texts


def _refuse(placed: InventoryFile, hosts: Iterable[str]) -> None:
    """Raise an error with a line for everything that a unit needs and the inventory lacks."""
    lines = [f"{placed.source}: hosts.{name}.{text}" for name in hosts for text in _lacks(placed.inventory.hosts[name])]
    if lines:
        raise InventoryError(lines)


def _lacks(host: Host) -> Iterator[str]:
    if host.user is None:
        yield "user is missing; a unit needs the user under which it runs; add it"
    elif not _home(host.user):
        yield f"user is {show(host.user)}; must be letters, digits, `_`, `-` and `.`, at most 31"
    for name, path in (("folder", host.folder), ("python", host.python or "/")):
        if not path.isprintable():
            yield f"{name} is {show(path)}; must be of printable characters, in a unit a line is an option"
        if len(path.encode(errors="replace")) > PATH_MAX:
            yield f"{name} has {len(path.encode(errors='replace'))} bytes; must have at most {PATH_MAX}"
    if host.python is not None and not host.python.startswith("/"):
        yield f"python is {show(host.python)}; a unit needs an absolute path, or none given"


def _home(user: str) -> str | None:
    """Return the usual home of a user, None if it is no user's name."""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]{0,30}", user):  # systemd: "User/Group Name Syntax", relaxed
        return None
    return "/root" if user == "root" else f"/home/{user}"


def folder(host: Host) -> str:
    """Return the absolute path of zsim's folder on a host; relative ones are in the user's usual home."""
    return _absolute(host, host.folder)


def _absolute(host: Host, path: str) -> str:
    return path if path.startswith("/") else f"{_home(host.user or '')}/{path.removeprefix('~/')}"


def unit_name(process: str) -> str:
    """Return the name of a process's unit."""
    return f"zsim-{process}.service"


def _service(placed: InventoryFile, scenario: Scenario, process: PlannedProcess, here: Sequence[PlannedProcess]) -> str:
    host = placed.inventory.hosts[process.host]
    return _text(
        {
            "Unit": _unit(scenario, process, here),
            "Service": [*_run(scenario, process, host), *_life(process), *HARDENING],
            "Install": [f"WantedBy={TARGET}"],
        },
        _remarks(process, host),
    )


def _unit(scenario: Scenario, process: PlannedProcess, here: Sequence[PlannedProcess]) -> list[str]:
    """Return the order: what is started later is stopped first, so the world ends the run for all, routers go last."""
    order = ["network-online.target", *(unit_name(other.name) for other in here if _rank(other) < _rank(process))]
    return [
        f"Description=zsim {process.name} of {scenario.name}",
        f"PartOf={TARGET}",
        "Wants=network-online.target",
        f"After={' '.join(order)}",
        f"StartLimitIntervalSec={RESTART_WINDOW_S:g}",
        f"StartLimitBurst={RESTARTS_MAX + 1}",
    ]


def _rank(process: PlannedProcess) -> int:
    return {ROUTER: 0, WORLD: 2}.get(process.role, 1)


def _run(scenario: Scenario, process: PlannedProcess, host: Host) -> list[str]:
    here = folder(host)
    files = ProcessFiles(
        scenario=f"{here}/scenario.yaml",
        identity=f"{here}/certs/{process.name}",
        access=f"{here}/certs/{access_file(process)}",
        out=f"{STATE}/runs/{scenario.name}-{RUN_ID}",
    )
    python = _absolute(host, inv.python(host))
    # ":": no variables are put in. Doubled, a $ would stay one in the arguments and be two in the path of the program
    words = map(_word, (f":{python}", *command(process, files)))
    settings = {**SINGLE_THREADED, "NUMBA_CACHE_DIR": CACHE}
    return [
        "Type=exec",
        f"User={host.user}",
        "StateDirectory=zsim",
        "CacheDirectory=zsim",
        f"WorkingDirectory={STATE}",
        *(f"Environment={name}={value}" for name, value in settings.items()),
        f"ExecStart={' '.join(words)}",
    ]


def _word(text: str) -> str:
    """Return a word as ExecStart= takes it literally."""
    text = text.replace("%", "%%")
    if re.fullmatch(r"[^\s\"'\\;]+", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _life(process: PlannedProcess) -> list[str]:
    """Return when a process is started again, and how it is ended."""
    restart = "on-failure" if process.is_restarted else "no"
    return [
        f"Restart={restart}",
        f"RestartPreventExitStatus={USER_FAULT} {SUPERSEDED}",
        "KillSignal=SIGTERM",
        f"TimeoutStopSec={STOP_S}",
    ]


def _target(scenario: Scenario, here: Sequence[PlannedProcess], remarks: Sequence[str]) -> str:
    return _text(
        {
            "Unit": [
                f"Description=zsim: {scenario.name} on {here[0].host}",
                f"Wants={' '.join(unit_name(process.name) for process in here)}",
            ],
            "Install": ["WantedBy=multi-user.target"],
        },
        remarks,
    )


def _remarks(process: PlannedProcess, host: Host) -> list[str]:
    """Return what a reader has to know that the options do not show."""
    remarks = []
    if not host.folder.startswith("/"):
        remarks.append(f"folder {host.folder} is taken to be in {_home(host.user or '')}; else give an absolute folder")
    if process.on_death == "wait":
        remarks.append("on_death is wait: systemd does not start it again, time stands still until somebody does")
    return remarks


def _text(sections: dict[str, list[str]], remarks: Sequence[str]) -> str:
    head = [f"# {line}" for line in ("Rendered by `zsim render systemd`; render again instead of editing.", *remarks)]
    parts = ["\n".join([f"[{name}]", *lines]) for name, lines in sections.items()]
    return "\n".join(head) + "\n" + "\n\n".join(parts) + "\n"
