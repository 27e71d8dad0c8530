"""The Pod of a process of a run: names and labels of what belongs to it, its container, and what is mounted there."""

import re
from collections.abc import Iterator, Sequence
from typing import Any

from zsim.scenario.roles import RECORDER, WORLD
from zsim.transport.tls import CERTIFICATES as IDENTITY_FILES
from zsim_deploy.arguments import RUN_ID
from zsim_deploy.inventory.processes import STOP_S, PlannedProcess, ProcessFiles, command
from zsim_deploy.render.rendered_files import ACCESS, CACHE, CERTIFICATES, ENVIRONMENT, RUNS, SCENARIO, USER

NAME_MAX = 63  # RFC 1123 label
CPU = "250m"  # to find a node by; in lockstep a role takes what there is
# Measured with three drones and all extras installed: world 227, estimator 252, controller 232, recorder 86 MiB.
MEMORY_MIB, MEMORY_MAX_MIB = 256, 1024
RECORDS = {"persistentVolumeClaim": {"claimName": "records"}}


def meta(space: str, process: PlannedProcess) -> dict[str, Any]:
    return {"name": label(process.name), "namespace": space, "labels": labels(process)}


def label(name: str) -> str:
    """Return a name as Kubernetes takes it (RFC 1123 label)."""
    return re.sub(r"[^a-z0-9]+", "-", name).strip("-")[:NAME_MAX].rstrip("-") or "zsim"


def labels(process: PlannedProcess) -> dict[str, str]:
    return {
        "app.kubernetes.io/name": "zsim",
        "app.kubernetes.io/component": process.role,
        "app.kubernetes.io/instance": label(process.name),
    }


def secret_name(process: PlannedProcess) -> str:
    return f"certs-{label(process.name)}"


def pod_template(process: PlannedProcess, image: str, restart: str) -> dict[str, Any]:
    spec = {
        "nodeSelector": {"kubernetes.io/hostname": process.host},
        "hostNetwork": True,
        "dnsPolicy": "ClusterFirstWithHostNet",
        "restartPolicy": restart,
        "terminationGracePeriodSeconds": STOP_S,
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "securityContext": user(),
        "containers": [_box(process, image)],
        "volumes": [{"name": name, **source} for name, _, _, source in _mounted(process)],
    }
    return {"metadata": {"labels": labels(process)}, "spec": spec}


def _box(process: PlannedProcess, image: str) -> dict[str, Any]:
    files = ProcessFiles(SCENARIO, CERTIFICATES, ACCESS, f"{RUNS}/{RUN_ID}")
    box = {
        "name": process.role,
        "image": image,
        "args": command(process, files),
        "env": [{"name": key, "value": value} for key, value in ENVIRONMENT.items()],
        "resources": {
            "requests": {"cpu": CPU, "memory": f"{MEMORY_MIB}Mi"},
            "limits": {"memory": f"{MEMORY_MAX_MIB}Mi"},
        },
        "securityContext": locked(),
        "volumeMounts": [mount(*mounted[:3]) for mounted in _mounted(process)],
    }
    if process.port is not None:
        box["ports"] = [{"name": "zenoh", "containerPort": process.port, "hostPort": process.port, "protocol": "TCP"}]
    return box


def user() -> dict[str, Any]:
    profile = {"type": "RuntimeDefault"}
    return {"runAsNonRoot": True, "runAsUser": USER, "runAsGroup": USER, "fsGroup": USER, "seccompProfile": profile}


def locked() -> dict[str, Any]:
    return {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }


def _mounted(process: PlannedProcess) -> Iterator[tuple[str, str, bool, dict[str, Any]]]:
    """Yield name, path, whether it is read only, and source of each volume of a process."""
    yield "cache", CACHE, False, {"emptyDir": {}}
    yield "tmp", "/tmp", False, {"emptyDir": {}}
    if process.name == WORLD:
        yield "scenario", SCENARIO.rpartition("/")[0], True, {"configMap": {"name": "scenario"}}
    if process.name == RECORDER:
        yield "runs", RUNS, False, RECORDS
    if process.secure:
        yield "certs", CERTIFICATES, True, _secret(process, IDENTITY_FILES)
    if process.secure and process.port is not None:
        yield "access", ACCESS.rpartition("/")[0], True, _secret(process, ("access.json",))


def mount(name: str, path: str, read_only: bool) -> dict[str, Any]:
    return {"name": name, "mountPath": path, **({"readOnly": True} if read_only else {})}


def _secret(process: PlannedProcess, keys: Sequence[str]) -> dict[str, Any]:
    items = [{"key": key, "path": key} for key in keys]
    return {"secret": {"secretName": secret_name(process), "defaultMode": 0o440, "items": items}}
