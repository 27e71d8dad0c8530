"""Kubernetes: the Pod of a process, whoever starts it: where it runs, as whom, and what it finds mounted."""

import re
from collections.abc import Sequence
from typing import Any

from zsim.scenario.rights import RECORDER, WORLD
from zsim.transport.tls import CERTIFICATES as IDENTITY_FILES
from zsim_deploy.inventory.processes import STOP_S, PlannedProcess, ProcessFiles, command
from zsim_deploy.render.rendered_files import ACCESS, CACHE, CERTIFICATES, ENVIRONMENT, RUNS, SCENARIO, USER

NAME_MAX = 63  # RFC 1123 label
CPU = "250m"  # to find a node by; in lockstep a role takes what there is
# Measured with three drones and all extras installed: world 227, estimator 252, controller 232, recorder 86 MiB.
MEMORY_MIB, MEMORY_MAX_MIB = 256, 1024


def label(name: str) -> str:
    """Return a name as Kubernetes takes it (RFC 1123 label)."""
    return re.sub(r"[^a-z0-9]+", "-", name).strip("-")[:NAME_MAX].rstrip("-") or "zsim"


def labels(process: PlannedProcess) -> dict[str, str]:
    return {
        "app.kubernetes.io/name": "zsim",
        "app.kubernetes.io/component": process.role,
        "app.kubernetes.io/instance": label(process.name),
    }


def secret(process: PlannedProcess) -> str:
    return f"certs-{label(process.name)}"


def template(process: PlannedProcess, image: str, restart: str) -> dict[str, Any]:
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
        "volumes": _volumes(process),
    }
    return {"metadata": {"labels": labels(process)}, "spec": spec}


def _box(process: PlannedProcess, image: str) -> dict[str, Any]:
    name = {"name": "POD_NAME", "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}}
    files = ProcessFiles(SCENARIO, CERTIFICATES, ACCESS, f"{RUNS}/$(POD_NAME)")
    box = {
        "name": process.role,
        "image": image,
        "args": command(process, files),
        "env": [name, *({"name": key, "value": value} for key, value in ENVIRONMENT.items())],
        "resources": {
            "requests": {"cpu": CPU, "memory": f"{MEMORY_MIB}Mi"},
            "limits": {"memory": f"{MEMORY_MAX_MIB}Mi"},
        },
        "securityContext": locked(),
        "volumeMounts": _mounts(process),
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


def _mounts(process: PlannedProcess) -> list[dict[str, Any]]:
    mounts: list[dict[str, Any]] = [{"name": "cache", "mountPath": CACHE}, {"name": "tmp", "mountPath": "/tmp"}]
    if process.name == WORLD:
        mounts.append({"name": "scenario", "mountPath": SCENARIO.rpartition("/")[0], "readOnly": True})
    if process.name == RECORDER:
        mounts.append({"name": "runs", "mountPath": RUNS})
    if process.secure:
        mounts.append({"name": "certs", "mountPath": CERTIFICATES, "readOnly": True})
    if process.secure and process.port is not None:
        mounts.append({"name": "access", "mountPath": ACCESS.rpartition("/")[0], "readOnly": True})
    return mounts


def _volumes(process: PlannedProcess) -> list[dict[str, Any]]:
    volumes: list[dict[str, Any]] = [{"name": "cache", "emptyDir": {}}, {"name": "tmp", "emptyDir": {}}]
    if process.name == WORLD:
        volumes.append({"name": "scenario", "configMap": {"name": "scenario"}})
    if process.name == RECORDER:
        volumes.append(runs_volume())
    if process.secure:
        volumes.append(_secret_volume("certs", process, IDENTITY_FILES))
    if process.secure and process.port is not None:
        volumes.append(_secret_volume("access", process, ("access.json",)))
    return volumes


def _secret_volume(name: str, process: PlannedProcess, keys: Sequence[str]) -> dict[str, Any]:
    items = [{"key": key, "path": key} for key in keys]
    return {"name": name, "secret": {"secretName": secret(process), "defaultMode": 0o440, "items": items}}


def runs_volume() -> dict[str, Any]:
    return {"name": "runs", "persistentVolumeClaim": {"claimName": "records"}}
