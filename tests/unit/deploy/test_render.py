"""Rendered systemd units, compose files and manifests: each process once, on its host, with exactly what it needs."""

import errno
import hashlib
import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from refused import has_terms, refused
from typer.testing import CliRunner

from zsim.errors import InventoryError, RunError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_deploy import inventory, render
from zsim_deploy.cli import hosts_commands
from zsim_deploy.cli.cli import app
from zsim_deploy.inventory import InventoryFile, own_programs
from zsim_deploy.render import compose, kubernetes, systemd, write

ROOT = Path(__file__).parents[3]
STEP = ROOT / "scenarios/step.yaml"
HOSTS = """
hosts:
  lab: {address: 192.168.1.10, user: lab, folder: /opt/zsim}
  one: {address: 192.168.1.21, user: pi}
  two: {address: 192.168.1.22, user: pi, python: /usr/bin/python3.12, router: yard}
roles: {world: lab, "controller.*": two, "estimator.*": [one, two]}
routers: {yard: {host: one}}
"""
PLACES = {
    "world": "lab",
    "recorder": "lab",
    "estimator.drone1": "one",
    "estimator.drone2": "two",
    "estimator.drone3": "one",
    "controller.main": "two",
    "router.yard": "one",
}
WORLD, YARD = "192.168.1.10:7447", "192.168.1.21:7448"
CONNECTS = {"recorder": WORLD, "estimator.drone1": WORLD, "estimator.drone2": YARD, "estimator.drone3": WORLD, "controller.main": YARD, "router.yard": WORLD}  # fmt: skip
LISTENS = {"world": WORLD, "router.yard": YARD}
TARGETS = {"systemd": systemd, "compose": compose, "kubernetes": kubernetes}
Words = dict[str, tuple[str, list[str]]]
Texts = dict[str, dict[str, str]]  # by target


def placed(folder: Path, text: str = HOSTS) -> InventoryFile:
    (folder / "hosts.yaml").write_text(text)
    return inventory.load(folder / "hosts.yaml")


@pytest.fixture(scope="module")
def step() -> Scenario:
    return scenario_file.load(STEP)


@pytest.fixture
def hosts(tmp_path: Path) -> InventoryFile:
    return placed(tmp_path)


@pytest.fixture(scope="module")
def usual(step: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Texts:
    """Return the texts of each target."""
    hosts = placed(tmp_path_factory.mktemp("usual"))
    return {name: target(hosts, step) for name, target in TARGETS.items()}


# What all targets share: {process: (host, arguments of its command after `python -m zsim_deploy.cli`)}


def of_systemd(texts: dict[str, str]) -> Words:
    units = {match: text for path, text in texts.items() if (match := re.fullmatch(r"(\w+)/zsim-(.+)\.service", path))}
    return {
        match[2]: (match[1], cli_words(shlex.split(options_of(text)["ExecStart"][0])[1:]))
        for match, text in units.items()
    }


def of_compose(texts: dict[str, str]) -> Words:
    return {
        name: (path.partition("/")[0], cli_words(service["command"]))
        for path, project in projects(texts).items()
        for name, service in project["services"].items()
    }


def of_kubernetes(texts: dict[str, str]) -> Words:
    found = {}
    for one in pods(texts):
        words = cli_words(one["containers"][0]["args"])
        name = {"world": "world", "record": "recorder"}.get(words[0], f"{words[0]}.{words[-1]}")
        assert name not in found
        found[name] = (one["nodeSelector"]["kubernetes.io/hostname"], words)
    return found


def cli_words(words: list[str]) -> list[str]:
    assert words[:3] == ["-P", "-m", "zsim_deploy.cli"]
    return words[3:]


def projects(texts: dict[str, str]) -> dict[str, Any]:
    return {path: yaml.safe_load(text) for path, text in texts.items() if path.endswith("compose.yaml")}


def manifests(texts: dict[str, str]) -> list[dict[str, Any]]:
    return [one for path in sorted(texts) if path.endswith(".yaml") for one in yaml.safe_load_all(texts[path])]


def pods(texts: dict[str, str]) -> list[dict[str, Any]]:
    """Return the specifications of the Pods that run a process."""
    return [one["spec"]["template"]["spec"] for one in manifests(texts) if one["kind"] in ("Job", "Deployment")]


READ = {"systemd": of_systemd, "compose": of_compose, "kubernetes": of_kubernetes}
ALL = pytest.mark.parametrize("target", TARGETS)


def option(words: list[str], name: str) -> str | None:
    assert words.count(name) <= 1
    return words[words.index(name) + 1] if name in words else None


@ALL
@pytest.mark.parametrize("insecure", [False, True])
def test_every_process_runs_once_on_its_host_with_what_it_needs(target: str, insecure: bool, tmp_path: Path) -> None:
    """Every process gets its certificate with TLS, listening processes their access control, and the world the rate."""
    hosts = placed(tmp_path, HOSTS + "security: {insecure: true}" if insecure else HOSTS)
    texts = TARGETS[target](hosts, scenario_file.load(STEP, ["federation=lab.2"]), ("--realtime", "--rate", "2.0"))
    found = READ[target](texts)

    def given(name: str) -> dict[str, str | None]:
        return {process: option(words, name) for process, (_, words) in found.items()}

    def told(name: str) -> set[str]:
        return {process for process, (_, words) in found.items() if name in words}

    assert {name: host for name, (host, _) in found.items()} == given("--host") == PLACES
    assert given("--federation") == {**dict.fromkeys(PLACES, "lab.2"), "world": None}
    scheme = "tcp" if insecure else "tls"
    assert given("--connect") == {"world": None, **{name: f"{scheme}/{at}" for name, at in CONNECTS.items()}}
    assert given("--listen") == {**dict.fromkeys(PLACES), **{name: f"{scheme}/{at}" for name, at in LISTENS.items()}}
    assert told("--realtime") == set(LISTENS)  # routers take it too, for a shorter lease
    assert given("--rate") == {**dict.fromkeys(PLACES), "world": "2.0"}
    assert (told("--tls"), told("--access")) == ((set(), set()) if insecure else (set(PLACES), set(LISTENS)))
    assert not insecure or not any("certs" in text or "secret" in text.lower() for text in texts.values())


@ALL
def test_names_that_begin_with_a_dash_are_not_read_as_options(target: str, tmp_path: Path) -> None:
    """The test parses the commands as `zsim` itself does."""
    text = STEP.read_text().replace("name: drone1", "name: -d1").replace("[drone1,", "[-d1,").replace("main", "-c")
    (tmp_path / "dashes.yaml").write_text(text)
    dashes = placed(tmp_path, HOSTS.replace("yard", "-r"))
    found = READ[target](TARGETS[target](dashes, scenario_file.load(tmp_path / "dashes.yaml")))
    assert {"estimator.-d1", "controller.-c", "router.-r"} <= set(found)
    commands: Any = typer.main.get_command(app)
    for name, (host, words) in found.items():
        read = commands.commands[words[0]].make_context(words[0], words[1:]).params
        assert read["host"] == host
        thing = name.partition(".")[2]
        assert not thing or thing in (*read.get("things", ()), read.get("thing"), read.get("name"))


@ALL
def test_the_world_has_the_scenario_and_waits_for_the_recorder(target: str, hosts: InventoryFile, usual: Texts) -> None:
    texts, step = usual[target], scenario_file.load(STEP)
    words = READ[target](texts)["world"][1]
    assert words[0] == "world"
    assert words[-2] == "--"
    assert words[-1].endswith("/scenario.yaml")
    assert option(words, "--expect") == "recorder"
    given = next(
        (one["data"]["scenario.yaml"] for one in manifests(texts) if one.get("kind") == "ConfigMap"),
        texts.get("lab/scenario.yaml"),
    )
    assert given == scenario_file.to_text(step)
    assert [path for path in texts if path.endswith("/scenario.yaml")] in ([], ["lab/scenario.yaml"])
    assert list(TARGETS[target](hosts, step).items()) == list(texts.items())  # deterministic


@ALL
def test_no_text_contains_keys_or_the_access_of_the_launcher(target: str, tmp_path: Path, step: Scenario) -> None:
    """The texts may be shared, so they hold neither private keys nor how the launcher logs in."""
    (tmp_path / "certs/lab/world").mkdir(parents=True)
    (tmp_path / "certs/lab/world/key.pem").write_text("-----BEGIN PRIVATE KEY-----\nMC4CAQ\n")
    text = HOSTS.replace("user: lab,", "user: lab, key: ~/.ssh/launcher, known_hosts: known, ssh: 10.0.0.1,")
    texts = TARGETS[target](placed(tmp_path, text), step)
    together = "\n".join(texts.values())
    assert not re.search(r"PRIVATE KEY|MC4CAQ|BEGIN|launcher|10\.0\.0\.1", together)
    assert not [one for one in manifests(texts) if one.get("kind") == "Secret"]


@ALL
def test_a_program_of_the_user_is_mentioned_but_not_started(target: str, tmp_path: Path) -> None:
    own = scenario_file.load(STEP, ["processes.expect=[my.drone1, controller.main]"])
    text = HOSTS.replace('"estimator.*": [one, two]', '"my.*": two')
    texts = TARGETS[target](placed(tmp_path, text), own)
    assert set(READ[target](texts)) == {"world", "recorder", "controller.main", "router.yard"}
    remark = "# my.drone1 on two is a program of your own: start it yourself; it connects to tls/192.168.1.21:7448"
    remarked = [path for path, text in texts.items() if remark in text.splitlines()]
    where = {"systemd": "two/zsim.target", "compose": "two/compose.yaml", "kubernetes": "zsim.yaml"}
    assert remarked == [where[target]]


def test_a_program_of_the_scenario_is_mentioned_with_its_command(tmp_path: Path) -> None:
    programs = (
        "{my.drone1: {command: [fly, '{endpoint}', '{name}']}, watch: {command: [look, '{folder}'], joins: false}}"
    )
    own = scenario_file.load(STEP, ["processes.expect=[my.drone1, controller.main]", f"programs={programs}"])
    there = placed(tmp_path, HOSTS.replace('"estimator.*": [one, two]', '"my.*": two'))
    joining, watching = own_programs(there, own)
    assert joining.endswith(": fly tls/192.168.1.21:7448 my.drone1")
    assert watching.startswith("watch ")
    assert watching.endswith(": look '{folder}'")
    assert own_programs(there, own, "two") == [joining]
    assert own_programs(there, own, "one") == []


@ALL
def test_a_process_without_a_host_is_refused(target: str, tmp_path: Path, step: Scenario) -> None:
    text = HOSTS.replace('"controller.*": two, ', "")
    with refused(InventoryError, "roles", "no host", "controller.main"):
        TARGETS[target](placed(tmp_path, text), step)


def options_of(text: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE):
        found.setdefault(name, []).append(value)
    return found


LOCKED_UNIT = {
    "ProtectSystem": ["strict"],
    "ProtectHome": ["read-only"],
    "NoNewPrivileges": ["yes"],
    "PrivateTmp": ["yes"],
    "CapabilityBoundingSet": [""],
    "StateDirectory": ["zsim"],
    "CacheDirectory": ["zsim"],
}


def test_units_run_python_of_the_host_as_its_user_and_are_locked_down(usual: Texts) -> None:
    texts = usual["systemd"]
    for path, user, python in [
        ("lab/zsim-world.service", "lab", "/opt/zsim/venv/bin/python"),
        ("one/zsim-estimator.drone1.service", "pi", "/home/pi/.zsim/venv/bin/python"),
        ("two/zsim-estimator.drone2.service", "pi", "/usr/bin/python3.12"),
    ]:
        options = options_of(texts[path])
        assert options["User"] == [user]
        assert options["ExecStart"][0].split()[0] == f":{python}"
    for text in (text for path, text in texts.items() if path.endswith(".service")):
        options = options_of(text)
        assert LOCKED_UNIT.items() <= options.items()
        assert "ReadWritePaths" not in options
    words = of_systemd(texts)
    assert option(words["world"][1], "--tls") == "/opt/zsim/certs/world"
    assert option(words["world"][1], "--access") == "/opt/zsim/certs/world.access.json"
    assert option(words["router.yard"][1], "--access") == "/home/pi/.zsim/certs/router.yard.access.json"


def test_a_restarted_recorder_uses_the_same_folder_of_the_run(usual: Texts) -> None:
    """The path contains nothing that changes with a restart, such as an invocation ID or the name of a Pod."""
    found = {target: option(READ[target](texts)["recorder"][1], "--out") for target, texts in usual.items()}
    assert found == {
        "systemd": "/var/lib/zsim/runs/step-{run}",
        "compose": "/runs/${ZSIM_RUN:-step}",
        "kubernetes": "/runs/{run}",
    }


def test_units_are_restarted_as_on_death_specifies(hosts: InventoryFile) -> None:
    lines = ["processes.on_death={estimator: wait, estimator.drone3: restart, controller: end}"]
    texts = systemd(hosts, scenario_file.load(STEP, lines))
    units = {path.split("zsim-")[1]: options_of(text) for path, text in texts.items() if "zsim-" in path}
    restarted = {name.removesuffix(".service") for name, unit in units.items() if unit["Restart"] == ["on-failure"]}
    assert restarted == {"recorder", "estimator.drone3", "router.yard"}
    assert {unit["Restart"][0] for unit in units.values()} == {"no", "on-failure"}
    assert has_terms(texts["one/zsim-estimator.drone1.service"], "# on_death", "wait")
    assert not has_terms(texts["one/zsim-estimator.drone3.service"], "# on_death", "wait")
    # A process does not restart to fight for a name that another process has taken.
    assert all(unit["RestartPreventExitStatus"] == ["2 3"] for unit in units.values())


def test_the_world_is_stopped_first_and_a_router_last(tmp_path: Path, step: Scenario) -> None:
    """systemd stops units in the reverse order of After=."""
    text = HOSTS.replace("host: one", "host: lab").replace("[one, two]", "lab")
    texts = systemd(placed(tmp_path, text), step)
    others = [f"zsim-estimator.drone{i}.service" for i in (1, 2, 3)]
    order = {
        path.split("/")[1]: options_of(text)["After"][0].split() for path, text in texts.items() if ".service" in path
    }
    assert order["zsim-router.yard.service"] == ["network-online.target"]
    assert all(order[name][1:] == ["zsim-router.yard.service"] for name in others)
    assert {*others, "zsim-recorder.service", "zsim-router.yard.service"} <= set(order["zsim-world.service"])


def test_the_target_starts_and_stops_every_unit_of_its_host(usual: Texts) -> None:
    texts = usual["systemd"]
    for host in ("lab", "one", "two"):
        units = {path.split("/")[1] for path in texts if path.startswith(f"{host}/") and path.endswith(".service")}
        assert set(options_of(texts[f"{host}/zsim.target"])["Wants"][0].split()) == units
        assert all(options_of(texts[f"{host}/{unit}"])["PartOf"] == ["zsim.target"] for unit in units)


def test_arguments_reach_the_process_unchanged(tmp_path: Path, step: Scenario) -> None:
    """systemd expands % and, unless a colon precedes the program, $; it splits at spaces."""
    text = HOSTS.replace("/opt/zsim}", '"/opt/my zsim/100%$A\'"}').replace("192.168.1.10", "fe80::1%eth0")
    texts = systemd(placed(tmp_path, text), step)
    (line,) = options_of(texts["lab/zsim-world.service"])["ExecStart"]
    assert line.startswith("""":/opt/my zsim/100%%$A'/venv/bin/python" -P -m """)
    assert "tls/[fe80::1%%eth0]:7447" in line


def test_everything_that_units_lack_in_the_inventory_is_reported_at_once(tmp_path: Path, step: Scenario) -> None:
    text = HOSTS.replace("user: lab, ", "").replace("22, user: pi", "22, user: 'pi\\nExecStart=/bin/sh'")
    with pytest.raises(InventoryError) as caught:
        systemd(placed(tmp_path, text.replace("/usr/bin/python3.12", "python3")), step)
    assert [line.split(" is ")[0] for line in caught.value.faults] == [
        "hosts.yaml: hosts.lab.user",
        "hosts.yaml: hosts.two.user",
        "hosts.yaml: hosts.two.python",
    ]


@pytest.mark.parametrize("field", ["folder", "python"])
def test_a_line_break_in_the_inventory_cannot_add_a_unit_option(field: str, tmp_path: Path, step: Scenario) -> None:
    text = HOSTS.replace("folder: /opt/zsim", f'{field}: "/opt/zsim\\nUser=root"')
    with refused(InventoryError, f"hosts.lab.{field}", "printable"):
        systemd(placed(tmp_path, text), step)
    with refused(InventoryError, f"hosts.lab.{field}", "4009 bytes", "4000"):
        systemd(placed(tmp_path, HOSTS.replace("folder: /opt/zsim", f"{field}: /opt/zsim{'/' + 3999 * 'n'}")), step)


LOCKED_SERVICE = {
    "read_only": True,
    "init": True,
    "cap_drop": ["ALL"],
    "security_opt": ["no-new-privileges:true"],
    "network_mode": "host",
    "stop_signal": "SIGTERM",
}


def test_containers_may_write_only_records_and_restart_like_their_roles(usual: Texts) -> None:
    for path, project in projects(usual["compose"]).items():
        for name, service in project["services"].items():
            binds = {v["target"]: v["read_only"] for v in service["volumes"] if v["type"] == "bind"}
            assert binds.pop("/certs") is True, (path, name)
            assert binds.pop("/runs", None) is (False if name == "recorder" else None)
            assert all(binds.values())
            assert set(binds) == {
                *(["/scenario/scenario.yaml"] if name == "world" else []),
                *(["/access/access.json"] if name in LISTENS else []),
            }
            restart = "no" if name == "world" else "on-failure:5"
            assert {**LOCKED_SERVICE, "restart": restart}.items() <= service.items()


def test_an_image_installs_the_extras_that_its_host_needs(usual: Texts, step: Scenario, tmp_path: Path) -> None:
    texts = usual["compose"]
    extras = {path.split("/")[0]: re.findall(r"whl\[(.*)\]", text) for path, text in texts.items() if "Docker" in path}
    assert extras == {"lab": ["record,world"], "one": ["agents"], "two": ["agents"]}
    wanted = ["agents", "record", "world"]
    assert re.findall(r"whl\[(.*)\]", usual["kubernetes"]["Dockerfile"]) == [",".join(wanted)]
    given = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(wanted) <= set(given)
    router_alone = compose(placed(tmp_path, HOSTS.replace("[one, two]", "two")), step)["one/Dockerfile"]
    assert "py3-none-any.whl\"" in router_alone  # fmt: skip


def test_inventory_fields_that_containers_ignore_are_mentioned(usual: Texts) -> None:
    texts = usual["compose"]
    assert has_terms(texts["two/compose.yaml"], "# hosts.two", "python", "not used")
    assert "not used" not in texts["one/compose.yaml"]


LOCKED_BOX = {
    "readOnlyRootFilesystem": True,
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
}


def test_pods_are_locked_down_and_mount_their_own_certificate_read_only(usual: Texts) -> None:
    texts = usual["kubernetes"]
    seen = []
    for one in pods(texts):
        (box,) = one["containers"]
        assert one["securityContext"]["runAsNonRoot"] is True
        assert one["securityContext"]["runAsUser"] != 0
        assert one["automountServiceAccountToken"] is False
        assert one["terminationGracePeriodSeconds"] >= 10
        assert LOCKED_BOX.items() <= box["securityContext"].items()
        assert {"requests", "limits"} == set(box["resources"])
        mounts = {m["name"]: m for m in box["volumeMounts"]}
        volumes = {v["name"]: v for v in one["volumes"]}
        assert set(mounts) == set(volumes)
        assert mounts["certs"]["readOnly"] is True
        assert set(mounts) - {"certs", "cache", "tmp"} <= {"access", "scenario", "runs"}
        assert all(mounts[name]["readOnly"] for name in ("access", "scenario") if name in mounts)
        secret = volumes["certs"]["secret"]
        assert [item["key"] for item in secret["items"]] == ["ca.pem", "certificate.pem", "key.pem"]
        seen.append(secret["secretName"])
    assert len(set(seen)) == len(PLACES)
    made = re.findall(r"^put (\S+) --from-file=\"\$certs/(\w+)/(\S+)\"", texts["secrets.sh"], re.MULTILINE)
    assert sorted(name for name, _, _ in made) == sorted(seen)
    assert {process: host for _, host, process in made} == PLACES


def test_roles_are_jobs_and_routers_deployments(usual: Texts) -> None:
    found = manifests(usual["kubernetes"])
    jobs = {one["metadata"]["name"]: one["spec"]["backoffLimit"] for one in found if one["kind"] == "Job"}
    restarted = [name.replace(".", "-") for name in PLACES if name not in ("world", "router.yard")]
    assert jobs == {"world": 0, **dict.fromkeys(restarted, 5)}
    assert [one["metadata"]["name"] for one in found if one["kind"] == "Deployment"] == ["router-yard"]


def test_the_service_selects_the_world_in_the_namespace_of_the_federation(hosts: InventoryFile) -> None:
    found = manifests(kubernetes(hosts, scenario_file.load(STEP, ["federation=lab_2"])))
    assert {one["metadata"]["namespace"] for one in found if one["kind"] != "Namespace"} == {"lab-2"}
    assert [one["metadata"]["name"] for one in found if one["kind"] == "Namespace"] == ["lab-2"]
    (service,) = [one for one in found if one["kind"] == "Service"]
    started = [one for one in found if one["kind"] in ("Job", "Deployment")]
    labels = {one["metadata"]["name"]: one["spec"]["template"]["metadata"]["labels"] for one in started}
    selector = service["spec"]["selector"].items()
    assert [name for name, given in labels.items() if selector <= given.items()] == ["world"]
    assert [port["port"] for port in service["spec"]["ports"]] == [7447]


def test_all_names_that_kubernetes_cannot_take_are_reported_at_once(tmp_path: Path) -> None:
    names = ["drone1", "drone_2", "drone.2"]
    drones = ", ".join(f"{{name: {name}, position_m: [{10 * i}, 0, 0]}}" for i, name in enumerate(names))
    bad = scenario_file.load(STEP, [f"drones=[{drones}]", "clusters=[]"])
    text = HOSTS.replace('"controller.*": two, ', "").replace("one", "site_one")
    with pytest.raises(InventoryError) as caught:
        kubernetes(placed(tmp_path, text), bad)
    node, clash = caught.value.faults
    assert has_terms(node, "hosts.yaml", "hosts.site_one", "node")
    assert has_terms(clash, "hosts.yaml", "estimator.drone.2", "estimator.drone_2", "same name")


def test_a_scenario_too_large_for_a_config_map_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert render.CONFIG_BYTES_MAX == 1 << 20  # the limit of Kubernetes, which 600 drones exceed
    monkeypatch.setattr(render, "CONFIG_BYTES_MAX", 100_000)
    drones = ", ".join(f"{{name: d{i}, position_m: [{2 * i}, 0, 0]}}" for i in range(60))
    large = scenario_file.load(STEP, [f"drones=[{drones}]", "clusters=[]"])
    text = HOSTS.replace('"controller.*": two, ', "")
    with refused(InventoryError, "scenario", "bytes", "ConfigMap", "100000"):
        kubernetes(placed(tmp_path, text), large)


def call(folder: Path, target: str, *options: str) -> Any:
    where = ["--hosts", str(folder / "hosts.yaml"), "--out", str(folder / "out")]
    return CliRunner().invoke(hosts_commands.rendering, [target, str(STEP), *where, *options])


@ALL
@pytest.mark.usefixtures("hosts")
def test_the_command_writes_the_rendered_files(target: str, usual: Texts, tmp_path: Path) -> None:
    done, out = call(tmp_path, target), tmp_path / "out"
    assert done.exit_code == 0, done.output
    assert files(out) == usual[target]
    assert done.stdout == f"{len(usual[target])} files in {out}\n"


def files(out: Path) -> dict[str, str]:
    """Return the files of a folder, except hidden ones."""
    found = [path for path in out.rglob("*") if path.is_file() and not path.name.startswith(".")]
    return {str(path.relative_to(out)): path.read_text() for path in found}


@pytest.mark.parametrize("target", ["systemd", "compose"])
def test_files_of_an_earlier_rendering_are_removed(
    target: str, hosts: InventoryFile, step: Scenario, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    call(tmp_path, target)
    former = set(files(out))
    moved = placed(tmp_path, HOSTS.replace("world: lab", "world: one").replace("{host: one}", "{host: two}"))
    done = call(tmp_path, target)
    assert done.exit_code == 0, done.output
    assert files(out) == TARGETS[target](moved, step)
    assert {path.name for path in out.iterdir() if path.is_dir()} == {"one", "two"}
    gone = done.stdout.strip().partition("; removed from an earlier rendering: ")[2].split(", ")
    assert set(gone) == former - set(files(out))
    assert any(name.startswith("lab/") for name in gone)


@pytest.mark.usefixtures("hosts")
def test_files_that_the_rendering_did_not_write_are_kept(usual: Texts, step: Scenario, tmp_path: Path) -> None:
    """These are a file beside the rendered ones, a copy of a rendered file, and the files of another target."""
    out = tmp_path / "out"
    call(tmp_path, "systemd")
    call(tmp_path, "kubernetes")
    (out / "lab/notes.txt").write_text("mine")
    (out / "copy").mkdir()
    (out / "copy/zsim-world.service").write_text((out / "lab/zsim-world.service").read_text())
    kept = {"lab/notes.txt", "copy/zsim-world.service", *usual["kubernetes"]}
    moved = placed(tmp_path, HOSTS.replace("world: lab", "world: one"))
    assert call(tmp_path, "systemd").exit_code == 0
    assert set(files(out)) == kept | set(systemd(moved, step))


def test_a_changed_file_is_not_removed(hosts: InventoryFile, tmp_path: Path) -> None:
    out = tmp_path / "out"
    call(tmp_path, "systemd")
    (out / "lab/zsim-world.service").write_text("mine now")
    former = files(out)
    placed(tmp_path, HOSTS.replace("world: lab", "world: one"))
    done = call(tmp_path, "systemd")
    assert isinstance(done.exception, RunError)
    assert has_terms(str(done.exception), f"{out}/lab/zsim-world.service", "changed", "remove it", "--out")
    assert files(out) == former
    (out / "lab/zsim-world.service").unlink()
    assert call(tmp_path, "systemd").exit_code == 0


@pytest.mark.parametrize("changed", ["before", "since"])
def test_a_foreign_or_changed_file_is_overwritten_only_by_force(tmp_path: Path, changed: str) -> None:
    out = tmp_path / "out"
    if changed == "since":
        write(out, "compose", {"one/compose.yaml": "a: 1"})
    out.joinpath("one").mkdir(parents=True, exist_ok=True)
    (out / "one/compose.yaml").write_text("mine")
    with refused(RunError, f"{out}/one/compose.yaml", "--force"):
        write(out, "compose", {"one/compose.yaml": "a: 2"})
    assert (out / "one/compose.yaml").read_text() == "mine"
    write(out, "compose", {"one/compose.yaml": "a: 2"}, force=True)
    assert (out / "one/compose.yaml").read_text() == "a: 2"
    write(out, "compose", {"one/compose.yaml": "a: 3"})
    assert (out / "one/compose.yaml").read_text() == "a: 3"


def test_nothing_outside_the_folder_is_written_or_removed(hosts: InventoryFile, tmp_path: Path) -> None:
    with refused(RunError, "../two/compose.yaml", "out"):
        write(tmp_path / "out", "compose", {"one/compose.yaml": "", "../two/compose.yaml": ""})
    assert [path.name for path in tmp_path.iterdir()] == ["hosts.yaml"]
    (tmp_path / "mine.txt").write_text("mine")
    call(tmp_path, "systemd")
    (record,) = [path for path in (tmp_path / "out").iterdir() if path.is_file()]
    digest = hashlib.sha256(b"mine").hexdigest()
    record.write_text(f"{record.read_text()}{digest}  ../mine.txt\n{digest}  {tmp_path / 'mine.txt'}\nnonsense\n")
    assert call(tmp_path, "systemd").exit_code == 0
    assert (tmp_path / "mine.txt").exists()


def test_the_command_takes_the_options_of_a_run(hosts: InventoryFile, tmp_path: Path) -> None:
    options = ["--realtime", "--rate", "0.5", "--seed", "7", "--duration", "30", "--set", "federation=lab2"]
    done = call(tmp_path, "kubernetes", *options, "--image", "registry.example.org/zsim:7")
    assert done.exit_code == 0, done.output
    texts = files(tmp_path / "out")
    (config,) = [one for one in manifests(texts) if one["kind"] == "ConfigMap"]
    given = yaml.safe_load(config["data"]["scenario.yaml"])
    assert (given["seed"], given["duration_s"], given["federation"]) == (7, 30, "lab2")
    words = of_kubernetes(texts)["world"][1]
    assert "--realtime" in words
    assert option(words, "--rate") == "0.5"
    assert {one["containers"][0]["image"] for one in pods(texts)} == {"registry.example.org/zsim:7"}


def test_an_invalid_rate_and_an_unwritable_folder_are_refused(hosts: InventoryFile, tmp_path: Path) -> None:
    done = call(tmp_path, "systemd", "--rate", "0")
    assert done.exit_code == 2
    assert has_terms(done.output, ">", "0", "<=", "1000")
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").write_text("a file")
    done = call(tmp_path, "compose")
    assert has_terms(str(done.exception), "written", os.strerror(errno.ENOTDIR), "--out", "another")
