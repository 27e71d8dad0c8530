"""Docker Compose: a folder per host with `compose.yaml`, a Dockerfile, and the scenario for the world's host.

Zenoh's endpoints and the certificates name the hosts of the inventory, so containers use the host's network.
"""

from collections.abc import Sequence
from typing import Any

from zsim import RELEASE
from zsim.scenario import scenario_file
from zsim.scenario.roles import RECORDER, WORLD
from zsim.scenario.scenario import Scenario
from zsim_deploy.inventory.inventory import InventoryFile
from zsim_deploy.inventory.processes import (
    STOP_S,
    PlannedProcess,
    ProcessFiles,
    Rendered,
    access_file,
    command,
    extras,
    on_host,
    own_programs,
    processes,
    used_hosts,
)
from zsim_deploy.launch.death_policy import RESTARTS_MAX
from zsim_deploy.render.rendered_files import (
    ACCESS,
    CACHE,
    CERTIFICATES,
    ENVIRONMENT,
    RUNS,
    SCENARIO,
    USER,
    dockerfile,
    document,
    unused,
)

CACHE_VOLUME = "cache"


def render(placed: InventoryFile, scenario: Scenario, pace: Sequence[str] = ()) -> Rendered:
    """Return `HOST/compose.yaml`, `HOST/Dockerfile`, and the scenario for the world's host.

    Args:
        placed: the inventory.
        scenario: what to fly.
        pace: options of the world: `--realtime`, `--rate R`.

    Raises:
        InventoryError: a process has no place, or nothing matches a pattern.
    """
    planned = processes(placed, scenario, pace)
    texts: Rendered = {}
    for host in used_hosts(planned):
        here = on_host(planned, host)
        texts[f"{host}/compose.yaml"] = document(_project(scenario, here), _remarks(placed, scenario, host))
        texts[f"{host}/Dockerfile"] = dockerfile(extras([process.name for process in here]))
        if any(process.name == WORLD for process in here):
            texts[f"{host}/scenario.yaml"] = scenario_file.to_text(scenario)
    return texts


def _remarks(placed: InventoryFile, scenario: Scenario, host: str) -> list[str]:
    return [
        "Rendered by `zsim render compose`; render again instead of editing.",
        "ZSIM_USER: user:group that owns the files beside this one. ZSIM_RUN: folder of the next record below runs/,",
        "a new name each time, as a record is never overwritten.",
        "Compose does not distinguish exit codes: a role whose name another process took is started again too,",
        f"{RESTARTS_MAX} times.",
        *unused(placed, host),
        *own_programs(placed, scenario, host),
    ]


def _project(scenario: Scenario, here: Sequence[PlannedProcess]) -> dict[str, Any]:
    return {
        "name": scenario.federation.replace(".", "-").lstrip("-_") or "zsim",  # Compose takes a-z, 0-9, - and _
        "services": {process.name: _service(scenario, process) for process in here},
        "volumes": {CACHE_VOLUME: {}},
    }


def _service(scenario: Scenario, process: PlannedProcess) -> dict[str, Any]:
    return {
        "image": f"zsim:{RELEASE}-{process.host}",
        "build": ".",
        "command": _words(scenario, process),
        "environment": dict(ENVIRONMENT),
        "network_mode": "host",
        "user": f"${{ZSIM_USER:-{USER}:{USER}}}",
        "init": True,
        "read_only": True,
        "tmpfs": ["/tmp"],
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        "volumes": _volumes(process),
        "restart": f"on-failure:{RESTARTS_MAX}" if process.is_restarted else "no",
        "stop_signal": "SIGTERM",
        "stop_grace_period": f"{STOP_S}s",
        "logging": {"driver": "local"},  # the one that rotates
    }


def _words(scenario: Scenario, process: PlannedProcess) -> list[str]:
    """Return the command, `$` doubled where Compose is to leave it alone."""
    out = f"{RUNS}/${{ZSIM_RUN:-{scenario.name}}}"
    words = command(process, ProcessFiles(SCENARIO, CERTIFICATES, ACCESS, out))
    return [word if word == out else word.replace("$", "$$") for word in words]


def _volumes(process: PlannedProcess) -> list[dict[str, Any]]:
    volumes: list[dict[str, Any]] = [{"type": "volume", "source": CACHE_VOLUME, "target": CACHE}]
    if process.name == WORLD:
        volumes.append(_bind("./scenario.yaml", SCENARIO))
    if process.name == RECORDER:
        volumes.append(_bind("./runs", RUNS, read_only=False))
    if process.secure:
        volumes.append(_bind(f"./certs/{process.name}", CERTIFICATES))
    if process.secure and process.port is not None:
        volumes.append(_bind(f"./certs/{access_file(process)}", ACCESS))
    return volumes


def _bind(source: str, target: str, read_only: bool = True) -> dict[str, Any]:
    """Return a mount of something that must be there; Docker would make a missing folder root's."""
    bind = {"create_host_path": False}
    return {"type": "bind", "source": source, "target": target, "read_only": read_only, "bind": bind}
