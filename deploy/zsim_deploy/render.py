"""`zsim render`: the processes of a run, from inventory and scenario, as systemd, Compose or Kubernetes files.

The templates in templates/ have `$name` in place of values. YAML templates are filled in as data and dumped again, so
that every value is quoted correctly. Restart limits and exit codes are those of the supervisor, so that a role other
than the world is restarted in the same cases as under `zsim run`.

Zenoh's endpoints and the certificates name the hosts of the inventory, so containers and Pods use their host's network.
"""

import contextlib
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

import yaml

from zsim import RELEASE
from zsim.errors import OTHER_OUT, InventoryError, RunError, file_fault
from zsim.scenario import scenario_file
from zsim.scenario.roles import RECORDER, ROUTER, WORLD
from zsim.scenario.scenario import Scenario
from zsim.schema.checker import show
from zsim_deploy import USER_FAULT
from zsim_deploy import inventory as inv
from zsim_deploy.arguments import RUN_ID
from zsim_deploy.inventory import Host, InventoryFile, PlannedProcess, ProcessFiles
from zsim_deploy.launch.role_launcher import SINGLE_THREADED
from zsim_deploy.launch.supervisor import RESTART_WINDOW_S, RESTARTS_MAX, SUPERSEDED

Rendered = dict[str, str]
"""Text of each file, by path in the output folder."""
TEMPLATES = Path(__file__).with_name("templates")

STATE = "/var/lib/zsim"  # folder that StateDirectory=zsim creates
CACHE = "/var/cache/zsim"  # folder that CacheDirectory=zsim creates
PATH_MAX = 4000  # maximum length of a folder's path, bytes; Linux allows 4095, file names included
STOP_S = 15  # time to stop before SIGKILL; the world waits 5 s for bye messages, and the recorder may wait for its disk
BASE = "python:3.11-slim"  # base image, with the oldest Python that zsim runs on
WHEEL = f"zsim-{RELEASE}-py3-none-any.whl"
IMAGE = f"zsim:{RELEASE}"
USER = 1000  # user and group id in images; those of Debian's first ordinary user
CERTIFICATES, ACCESS, SCENARIO, RUNS = "/certs", "/access/access.json", "/scenario/scenario.yaml", "/runs"
ENVIRONMENT = {**SINGLE_THREADED, "NUMBA_CACHE_DIR": CACHE}
IN_A_CONTAINER = {
    "cache": CACHE, "scenario": SCENARIO, "runs": RUNS, "certificates": CERTIFICATES, "access": ACCESS, "user": USER,
    "stop_s": STOP_S,
}  # fmt: skip
NAME_MAX = 63  # maximum length of a label; RFC 1123
CONFIG_BYTES_MAX = 1_048_576  # maximum size of a ConfigMap; Kubernetes documentation, "ConfigMaps"
FINAL_CODES = [USER_FAULT, SUPERSEDED]  # exit codes after which no restart helps: a user's mistake, a name taken over


# systemd: a folder per host with a unit per process, and `zsim.target`, which starts and stops them together


def systemd(inventory_file: InventoryFile, scenario: Scenario, pace: Sequence[str] = ()) -> Rendered:
    """Return the files `HOST/zsim-PROCESS.service` and `HOST/zsim.target`, and the scenario for the world's host.

    The options are those of systemd.exec(5) and systemd.service(5), without MemoryDenyWriteExecute (numba compiles) and
    ProcSubset (libraries read /proc/cpuinfo). `pace`: command-line options that set the world's pace. Raises
    InventoryError if a process has no host, or if the user, folder or interpreter of a host cannot be used.
    """
    planned, hosts = inv.processes(inventory_file, scenario, pace), inventory_file.inventory.hosts
    _refuse(
        inventory_file,
        [f"hosts.{name}.{text}" for name in inv.used_hosts(planned) for text in _host_faults(hosts[name])],
    )
    texts: Rendered = {}
    for name in inv.used_hosts(planned):
        local_processes = inv.on_host(planned, name)
        texts |= {
            f"{name}/{process.unit}": _service(scenario, process, hosts[name], local_processes)
            for process in local_processes
        }
        values = {
            "scenario": scenario.name,
            "host": name,
            "units": " ".join(process.unit for process in local_processes),
        }
        texts[f"{name}/zsim.target"] = _text("zsim.target", values, inv.own_programs(inventory_file, scenario, name))
        if any(process.name == WORLD for process in local_processes):
            texts[f"{name}/scenario.yaml"] = scenario_file.to_text(scenario)
    return texts


def _host_faults(host: Host) -> Iterator[str]:
    if host.user is None:
        yield "user is missing; must be the user that the units run as; add it"
    elif not _home(host.user):
        yield f"user is {show(host.user)}; must consist of at most 31 letters, digits, `_`, `-` and `.`"
    for name, path in (("folder", host.folder), ("python", host.python or "/")):
        if not path.isprintable():
            yield f"{name} is {show(path)}; must be printable, because each line of a unit is an option"
        if (size := len(path.encode(errors="replace"))) > PATH_MAX:
            yield f"{name} has {size} bytes; must have at most {PATH_MAX}"
    if host.python is not None and not host.python.startswith("/"):
        yield f"python is {show(host.python)}; must be an absolute path in a unit, or left out"


def _home(user: str | None) -> str | None:
    """Return a user's usual home folder; None for an invalid name (systemd, "User/Group Name Syntax", relaxed mode)."""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]{0,30}", user or ""):
        return None
    return "/root" if user == "root" else f"/home/{user}"


def _absolute(host: Host, path: str) -> str:
    return path if path.startswith("/") else f"{_home(host.user)}/{path.removeprefix('~/')}"


def _service(scenario: Scenario, process: PlannedProcess, host: Host, local_processes: Sequence[PlannedProcess]) -> str:
    """Return the unit of a process; units stop in reverse of their start order: the world first, to end the run."""
    rank = {ROUTER: 0, WORLD: 2}
    earlier = [each.unit for each in local_processes if rank.get(each.role, 1) < rank.get(process.role, 1)]
    folder = _absolute(host, host.folder)
    files = ProcessFiles(
        scenario=f"{folder}/scenario.yaml",
        identity=f"{folder}/certs/{process.name}",
        access=f"{folder}/certs/{inv.access_file(process)}",
        out=f"{STATE}/runs/{scenario.name}-{RUN_ID}",
    )
    # The ":" disables variable substitution; doubling "$" would not help, since it stays doubled in the program's path.
    words = (f":{_absolute(host, inv.python(host))}", *inv.command(process, files))
    remarks = []
    if not host.folder.startswith("/"):
        remarks.append(f"folder {host.folder} is assumed to be in {_home(host.user)}; otherwise give an absolute path")
    if process.on_death == "wait":
        remarks.append("on_death is wait: systemd does not restart it; time stops until it is started by hand")
    values = {
        "process": process.name,
        "scenario": scenario.name,
        "after": " ".join(["network-online.target", *earlier]),
        "restart_window_s": f"{RESTART_WINDOW_S:g}",
        "starts_max": RESTARTS_MAX + 1,
        "user": host.user,
        "state": STATE,
        "environment": "\n".join(f"Environment={name}={value}" for name, value in ENVIRONMENT.items()),
        "command": " ".join(map(_systemd_word, words)),
        "restart": "on-failure" if process.is_restarted else "no",
        "final_codes": " ".join(map(str, FINAL_CODES)),
        "stop_s": STOP_S,
    }
    return _text("process.service", values, remarks)


def _systemd_word(text: str) -> str:
    """Quote a word for ExecStart=; systemd.service(5)."""
    text = text.replace("%", "%%")
    if re.fullmatch(r"[^\s\"'\\;]+", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


# Docker Compose: a folder per host


def compose(inventory_file: InventoryFile, scenario: Scenario, pace: Sequence[str] = ()) -> Rendered:
    """Return the files `HOST/compose.yaml` and `HOST/Dockerfile`, and the scenario for the world's host.

    `pace`: command-line options that set the world's pace. Raises InventoryError if a process has no host.
    """
    planned = inv.processes(inventory_file, scenario, pace)
    head, (project,) = _yaml_template("compose.yaml")
    service = project["services"]["process"]
    texts: Rendered = {}
    for host in inv.used_hosts(planned):
        local_processes = inv.on_host(planned, host)
        values = {"project": scenario.federation.replace(".", "-").lstrip("-_") or "zsim"}  # allowed: a-z, 0-9, - and _
        services = {process.name: _compose_service(service, scenario, process) for process in local_processes}
        remarks = [*_filled(head, {"restarts_max": RESTARTS_MAX}), *_unused(inventory_file, host)]
        remarks += [f"# {line}" for line in inv.own_programs(inventory_file, scenario, host)]
        filled = {**_filled({**project, "services": {}}, values), "services": services}
        texts[f"{host}/compose.yaml"] = _dump(remarks, [filled])
        texts[f"{host}/Dockerfile"] = _dockerfile(local_processes)
        if any(process.name == WORLD for process in local_processes):
            texts[f"{host}/scenario.yaml"] = scenario_file.to_text(scenario)
    return texts


def _compose_service(template: Any, scenario: Scenario, process: PlannedProcess) -> dict[str, Any]:
    out = f"{RUNS}/${{ZSIM_RUN:-{scenario.name}}}"
    words = inv.command(process, ProcessFiles(SCENARIO, CERTIFICATES, ACCESS, out))
    values = {
        **IN_A_CONTAINER,
        "release": RELEASE,
        "host": process.host,
        "words": [word if word == out else word.replace("$", "$$") for word in words],  # Compose reads $$ as $
        "environment": ENVIRONMENT,
        "process": process.name,
        "access_file": inv.access_file(process),
        "restart": f"on-failure:{RESTARTS_MAX}" if process.is_restarted else "no",
    }
    service, mounted = _filled(template, values), _mounted(process)
    paths = {"cache": CACHE, "scenario": SCENARIO, "runs": RUNS, "certs": CERTIFICATES, "access": ACCESS}
    used = [path for name, path in paths.items() if name in mounted]
    service["volumes"] = [volume for volume in service["volumes"] if volume["target"] in used]
    return service


def _mounted(process: PlannedProcess) -> set[str]:
    uses = {
        "cache": True,
        "tmp": True,
        "scenario": process.name == WORLD,
        "runs": process.name == RECORDER,
        "certs": process.secure,
        "access": process.secure and process.port is not None,
    }
    return {name for name, is_used in uses.items() if is_used}


def _unused(inventory_file: InventoryFile, host: str) -> list[str]:
    described = inventory_file.inventory.hosts[host]
    defaults = Host(address=described.address)
    names = [name for name in ("folder", "python") if getattr(described, name) != getattr(defaults, name)]
    return [f"# hosts.{host}: {', '.join(names)} not used; the image has its own"] if names else []


def _dockerfile(planned: Sequence[PlannedProcess]) -> str:
    """Return the Dockerfile of an image with the extras that processes need; zsim's wheel must lie beside it."""
    extras = inv.extras([process.name for process in planned])
    extras_text = f"[{','.join(extras)}]" if extras else ""
    return _text("Dockerfile", {**IN_A_CONTAINER, "wheel": WHEEL, "base": BASE, "extras": extras_text})


# Kubernetes: roles end with the run, so they are Jobs; a router does not, so it is a Deployment


def kubernetes(
    inventory_file: InventoryFile, scenario: Scenario, pace: Sequence[str] = (), image: str = IMAGE
) -> Rendered:
    """Return the files `namespace.yaml`, `zsim.yaml`, `records.yaml`, a Dockerfile, and with TLS also `secrets.sh`.

    The hosts must be named like the Kubernetes nodes, which must find the Dockerfile's image under the name `image`.
    `pace`: command-line options that set the world's pace. Raises InventoryError if a process has no host, Kubernetes
    does not allow a name, or the scenario is too large.
    """
    planned, text = inv.processes(inventory_file, scenario, pace), scenario_file.to_text(scenario)
    _refuse(inventory_file, _kubernetes_faults(planned, text))
    shared = {**IN_A_CONTAINER, "space": label(scenario.federation), "image": image}
    head, manifests = _yaml_template("kubernetes/zsim.yaml")
    by_kind = {manifest["kind"]: manifest for manifest in manifests}
    world = next(process for process in planned if process.name == WORLD)
    objects = [
        _filled(by_kind["ConfigMap"], {**shared, "scenario": text}),
        _filled(by_kind["Service"], {**shared, "labels": _labels(world), "port": world.port}),
        *(_role_manifest(by_kind, shared, process) for process in planned),
    ]
    address = inventory_file.inventory.hosts[world.host].address
    certified = f"# The world's certificate is for {address}: over TLS use that address, not the name of the Service."
    remarks = [*head, *([certified] if world.secure else [])]
    remarks += [line for host in inv.used_hosts(planned) for line in _unused(inventory_file, host)]
    remarks += [f"# {line}" for line in inv.own_programs(inventory_file, scenario)]
    texts = {"namespace.yaml": "", "zsim.yaml": _dump(remarks, objects), "records.yaml": ""}
    for name in ("namespace.yaml", "records.yaml"):
        head, documents = _yaml_template(f"kubernetes/{name}")
        texts[name] = _dump(head, _filled(documents, shared))
    texts["Dockerfile"] = _dockerfile(planned)
    if not inventory_file.inventory.security.insecure:
        commands = []  # lines that copy the certificates of `zsim certs init` into Kubernetes
        for process in planned:
            files = [f'--from-file="$certs/{process.host}/{process.name}"']
            if process.port is not None:
                files.append(f'--from-file=access.json="$certs/{process.host}/{inv.access_file(process)}"')
            commands.append(f"put certs-{label(process.name)} {' '.join(files)}")
        texts["secrets.sh"] = _text("kubernetes/secrets.sh", {**shared, "puts": "\n".join(commands)})
    return texts


def _kubernetes_faults(planned: Sequence[PlannedProcess], text: str) -> list[str]:
    lines = [
        f"hosts.{host} is not the name of a node; must consist of a-z, 0-9, - and ., as `kubectl get nodes` lists it"
        for host in inv.used_hosts(planned)
        if not re.fullmatch(r"[a-z0-9]([a-z0-9.-]*[a-z0-9])?", host)
    ]
    first: dict[str, str] = {}
    for process in planned:
        other = first.setdefault(label(process.name), process.name)
        if other != process.name:
            lines.append(f"{process.name} and {other} have the same name in Kubernetes; rename a drone or cluster")
    if len(text.encode()) > CONFIG_BYTES_MAX:
        lines.append(f"the scenario has {len(text.encode())} bytes; a ConfigMap must have at most {CONFIG_BYTES_MAX}")
    return lines


def label(name: str) -> str:
    """Convert a name to an RFC 1123 label, as Kubernetes requires."""
    return re.sub(r"[^a-z0-9]+", "-", name).strip("-")[:NAME_MAX].rstrip("-") or "zsim"


def _labels(process: PlannedProcess) -> dict[str, str]:
    values_by_key = {"name": "zsim", "component": process.role, "instance": label(process.name)}
    return {f"app.kubernetes.io/{key}": value for key, value in values_by_key.items()}


def _role_manifest(by_kind: Mapping[str, Any], shared: Mapping[str, Any], process: PlannedProcess) -> Any:
    kind, restart = ("Deployment", "Always") if process.role == ROUTER else ("Job", "Never")
    words = inv.command(process, ProcessFiles(SCENARIO, CERTIFICATES, ACCESS, f"{RUNS}/{RUN_ID}"))
    values = {
        **shared,
        "name": label(process.name),
        "labels": _labels(process),
        "restarts": RESTARTS_MAX if process.is_restarted else 0,
        "final_codes": FINAL_CODES,
        "restart": restart,
        "host": process.host,
        "role": process.role,
        "words": words,
        "environment": [{"name": key, "value": value} for key, value in ENVIRONMENT.items()],
        "port": process.port,
        "secret": f"certs-{label(process.name)}",
    }
    _, (template,) = _yaml_template("kubernetes/pod.yaml")
    pod, mounted = _filled(template, values), _mounted(process)
    (container,) = pod["spec"]["containers"]
    for part, key in ((container, "volumeMounts"), (pod["spec"], "volumes")):
        part[key] = [entry for entry in part[key] if entry["name"] in mounted]
    if process.port is None:
        del container["ports"]
    return _filled(by_kind[kind], {**values, "pod": pod})


def _refuse(inventory_file: InventoryFile, lines: Sequence[str]) -> None:
    if lines:
        raise InventoryError([f"{inventory_file.source}: {line}" for line in lines])


def _template(name: str) -> tuple[list[str], str]:
    """Return the comment lines at the top of a template, and the rest of it."""
    lines = (TEMPLATES / name).read_text(encoding="utf-8").splitlines(keepends=True)
    count = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    return [line.rstrip("\n") for line in lines[:count]], "".join(lines[count:])


def _text(name: str, values: Mapping[str, Any], remarks: Sequence[str] = ()) -> str:
    head, body = _template(name)
    lines = [*_filled(head, values), *(f"# {line}" for line in remarks)]
    return "\n".join(lines) + "\n" + Template(body).substitute(values)


def _yaml_template(name: str) -> tuple[list[str], list[Any]]:
    head, body = _template(name)
    return head, list(yaml.safe_load_all(body))


def _filled(node: Any, values: Mapping[str, Any]) -> Any:
    """Return a part of a template with its values filled in; a text that is just `$name` becomes the value itself."""
    if isinstance(node, dict):
        return {key: _filled(value, values) for key, value in node.items()}
    if isinstance(node, list):
        return [_filled(each, values) for each in node]
    if not isinstance(node, str):
        return node
    return values[node[1:]] if re.fullmatch(r"\$\w+", node) else Template(node).substitute(values)


def _dump(remarks: Sequence[str], documents: Sequence[Any]) -> str:
    """Return YAML documents as one text, with remarks at the top; the same input gives the same text."""
    options: dict[str, Any] = {"sort_keys": False, "default_flow_style": False, "width": 1000}
    texts = [yaml.dump(plain, Dumper=_Dumper, **options) for plain in documents]
    return "".join(f"{line}\n" for line in remarks) + "---\n".join(texts)


class _Dumper(yaml.SafeDumper):
    """Writes multi-line texts as block scalars, and never writes aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)

    def represent_text(self, text: str) -> yaml.ScalarNode:
        return self.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)


_Dumper.add_representer(str, _Dumper.represent_text)


def write(out: Path, target: str, texts: Mapping[str, str], force: bool = False) -> list[str]:
    """Write texts into a folder; return the removed files, which an earlier rendering for this target had written.

    A list beside the files contains their digests, in the format of `sha256sum`, so that a later rendering for the same
    target can remove the files of an earlier one. Raises RunError if a file cannot be written, a path leads out of the
    folder, a file to be removed was changed since its rendering, or, without `force`, a file to be replaced was not
    rendered or was changed since.
    """
    root, record = out.resolve(), out / f".zsim-render-{target}.sha256"

    def is_inside(name: str) -> bool:
        path = (root / name).resolve()
        return root in (path.parent, path.parent.parent)

    def digest(content: bytes) -> str:
        return hashlib.sha256(content).hexdigest()

    def has_digest(path: Path, known: Sequence[str]) -> bool:
        try:
            return digest(path.read_bytes()) in known
        except OSError:
            return False

    for name in texts:
        if not is_inside(name):
            raise RunError(f"{name}: leads out of {out}; rename that host in the inventory")
    lines: list[str] = []
    with file_fault(out, "cannot be written", OTHER_OUT), contextlib.suppress(FileNotFoundError):
        lines = record.read_text(encoding="utf-8", errors="replace").splitlines()
    previous = {name: known for known, _, name in (line.partition("  ") for line in lines) if name}  # digests, by path
    if not force:
        for name, text in texts.items():
            path, known = root / name, (previous.get(name, ""), digest(text.encode()))
            if path.exists() and not has_digest(path, known):
                reason = "was not rendered, or was changed since"
                raise RunError(f"{path}: {reason}; give --out another folder, or --force to replace it")
    stale = [name for name in previous if name not in texts and is_inside(name) and (root / name).is_file()]
    for name in stale:
        if not has_digest(root / name, (previous[name],)):
            reason = "was rendered earlier, and changed since"
            raise RunError(f"{root / name}: {reason}; remove it, or give --out another folder")
    for path in (root / name for name in stale):
        with file_fault(path, "cannot be removed", OTHER_OUT):
            path.unlink(missing_ok=True)
        if path.parent != root:
            with contextlib.suppress(OSError):  # it is not empty
                path.parent.rmdir()
    digests = "".join(f"{digest(text.encode())}  {name}\n" for name, text in texts.items())
    for path, text in {record: digests, **{root / name: text for name, text in texts.items()}}.items():
        with file_fault(path, "cannot be written", OTHER_OUT):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    return stale
