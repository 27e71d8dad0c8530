"""Kubernetes: `zsim.yaml` with a Job per role and a Deployment per router, and what it needs beside it.

A run ends, so its roles are Jobs; a router does not. Zenoh's endpoints and the certificates name the hosts of the
inventory, so Pods use the network of their node, and the names of the hosts are those of the nodes.
"""

import re
from collections.abc import Sequence
from typing import Any

from zsim import RELEASE
from zsim.errors import InventoryError
from zsim.scenario import scenario_file
from zsim.scenario.roles import ROUTER, WORLD
from zsim.scenario.scenario import Scenario
from zsim_deploy import USER_FAULT
from zsim_deploy.inventory.inventory import InventoryFile
from zsim_deploy.inventory.processes import (
    PlannedProcess,
    Rendered,
    access_file,
    extras,
    own_programs,
    processes,
    used_hosts,
)
from zsim_deploy.launch.death_policy import RESTARTS_MAX, SUPERSEDED
from zsim_deploy.render.kubernetes_pod import (
    RECORDS,
    label,
    labels,
    locked,
    meta,
    mount,
    pod_template,
    secret_name,
    user,
)
from zsim_deploy.render.rendered_files import (
    RUNS,
    dockerfile,
    document,
    documents,
    unused,
)

IMAGE = f"zsim:{RELEASE}"
CONFIG_BYTES_MAX = 1_048_576  # of a ConfigMap; Kubernetes, "ConfigMaps"
RECORD_GIB = 10  # 186 runs of 330 s with three drones, 58 MB each

NAMESPACE_REMARKS = (
    "What stays when a run is deleted. Pods use the network of their node, which the Pod Security Standards allow",
    "under `privileged` alone; in everything else they keep to `restricted`.",
)


def render(placed: InventoryFile, scenario: Scenario, pace: Sequence[str] = (), image: str = IMAGE) -> Rendered:
    """Return `namespace.yaml`, `secrets.sh`, `zsim.yaml`, `records.yaml` and a Dockerfile.

    Args:
        placed: the inventory.
        scenario: what to fly.
        pace: options of the world: `--realtime`, `--rate R`.
        image: where the nodes find what the Dockerfile makes.

    Raises:
        InventoryError: a process has no place, a name is none that Kubernetes takes, or the scenario is too large.
    """
    planned = processes(placed, scenario, pace)
    text = scenario_file.to_text(scenario)
    _refuse(placed, planned, text)
    space = label(scenario.federation)
    texts = {
        "namespace.yaml": documents([_namespace(space), _records_claim(space)], NAMESPACE_REMARKS),
        "zsim.yaml": documents(_run(space, text, planned, image), _remarks(placed, scenario, planned)),
        "records.yaml": document(_records_pod(space, image), ["Mounts the records, for `kubectl cp`."]),
        "Dockerfile": dockerfile(extras([process.name for process in planned])),
    }
    if not placed.inventory.security.insecure:
        texts["secrets.sh"] = _secrets(space, planned)
    return texts


def _refuse(placed: InventoryFile, planned: Sequence[PlannedProcess], text: str) -> None:
    """Raise an error with a line for everything that Kubernetes cannot do."""
    lines = [
        f"hosts.{host} is no name of a node; must be letters, digits, - and ., as `kubectl get nodes` lists them"
        for host in used_hosts(planned)
        if not re.fullmatch(r"[a-z0-9]([a-z0-9.-]*[a-z0-9])?", host)
    ]
    first: dict[str, str] = {}
    for process in planned:
        other = first.setdefault(label(process.name), process.name)
        if other != process.name:
            lines.append(f"{process.name} and {other} have the same name in Kubernetes; rename a drone or cluster")
    if len(text.encode()) > CONFIG_BYTES_MAX:
        lines.append(f"the scenario has {len(text.encode())} bytes; a ConfigMap takes {CONFIG_BYTES_MAX}")
    if lines:
        raise InventoryError([f"{placed.source}: {line}" for line in lines])


def _remarks(placed: InventoryFile, scenario: Scenario, planned: Sequence[PlannedProcess]) -> list[str]:
    return [
        "Rendered by `zsim render kubernetes`; render again instead of editing.",
        "A Job starts a dead role again after 10 s, then after 20 s, and so on; `zsim run` does so at once.",
        *_service_remark(placed, planned),
        *(line for host in used_hosts(planned) for line in unused(placed, host)),
        *own_programs(placed, scenario),
    ]


def _service_remark(placed: InventoryFile, planned: Sequence[PlannedProcess]) -> list[str]:
    world = next(process for process in planned if process.name == WORLD)
    address = placed.inventory.hosts[world.host].address
    certified = f"The world's certificate is for {address}: over TLS that is its name, and not the Service's."
    return [certified] if world.secure else []


# What stays


def _namespace(space: str) -> dict[str, Any]:
    labels = {"pod-security.kubernetes.io/enforce": "privileged"}
    return {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": space, "labels": labels}}


def _records_claim(space: str) -> dict[str, Any]:
    return {
        "apiVersion": "v1",
        "kind": "PersistentVolumeClaim",
        "metadata": {"name": "records", "namespace": space},
        "spec": {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": f"{RECORD_GIB}Gi"}}},
    }


def _secrets(space: str, planned: Sequence[PlannedProcess]) -> str:
    """Return a script that puts certificates from where `zsim certs init` left them into the cluster."""
    lines = [
        "#!/bin/sh",
        "# sh secrets.sh CERTS: makes the Secrets from the folder of `zsim certs init`; none is in this file.",
        "set -eu",
        'certs=${1:?"usage: sh secrets.sh FOLDER, that of zsim certs init"}',
        "put() {",
        f'    kubectl -n {space} create secret generic "$@" --dry-run=client -o yaml | kubectl apply -f -',
        "}",
    ]
    for process in planned:
        files = [f'--from-file="$certs/{process.host}/{process.name}"']
        if process.port is not None:
            files.append(f'--from-file=access.json="$certs/{process.host}/{access_file(process)}"')
        lines.append(f"put {secret_name(process)} {' '.join(files)}")
    return "\n".join(lines) + "\n"


def _records_pod(space: str, image: str) -> dict[str, Any]:
    box = {
        "name": "records",
        "image": image,
        "command": ["sleep", "infinity"],
        "resources": {"requests": {"cpu": "10m", "memory": "16Mi"}, "limits": {"memory": "64Mi"}},
        "securityContext": locked(),
        "volumeMounts": [mount("runs", RUNS, read_only=True)],
    }
    spec = {
        "automountServiceAccountToken": False,
        "securityContext": user(),
        "terminationGracePeriodSeconds": 1,
        "containers": [box],
        "volumes": [{"name": "runs", **RECORDS}],
    }
    return {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "records", "namespace": space}, "spec": spec}


# A run


def _run(space: str, text: str, planned: Sequence[PlannedProcess], image: str) -> list[dict[str, Any]]:
    return [
        _config(space, text),
        *(_service(space, process) for process in planned if process.name == WORLD),
        *((_deployment if p.role == ROUTER else _job)(space, p, image) for p in planned),
    ]


def _config(space: str, text: str) -> dict[str, Any]:
    meta = {"name": "scenario", "namespace": space}
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": meta, "data": {"scenario.yaml": text}}


def _service(space: str, world: PlannedProcess) -> dict[str, Any]:
    """Return the world's name in the cluster, for `zsim echo` and programs in Pods of their own."""
    port = {"name": "zenoh", "port": world.port, "targetPort": "zenoh", "protocol": "TCP"}
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {"name": WORLD, "namespace": space},
        "spec": {"selector": labels(world), "ports": [port]},
    }


def _job(space: str, process: PlannedProcess, image: str) -> dict[str, Any]:
    """Return a Job: a fault of the call, and a name that another has taken, are not healed by a new Pod."""
    codes = {"operator": "In", "values": [USER_FAULT, SUPERSEDED]}
    spec = {
        "backoffLimit": RESTARTS_MAX if process.is_restarted else 0,
        "podFailurePolicy": {"rules": [{"action": "FailJob", "onExitCodes": codes}]},
        "podReplacementPolicy": "Failed",
        "template": pod_template(process, image, "Never"),
    }
    return {"apiVersion": "batch/v1", "kind": "Job", "metadata": meta(space, process), "spec": spec}


def _deployment(space: str, process: PlannedProcess, image: str) -> dict[str, Any]:
    """Return a Deployment; the old Pod goes before the new one comes, they have the same port."""
    spec = {
        "replicas": 1,
        "strategy": {"type": "Recreate"},
        "selector": {"matchLabels": labels(process)},
        "template": pod_template(process, image, "Always"),
    }
    return {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": meta(space, process), "spec": spec}
