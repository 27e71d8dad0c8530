"""systemd, Compose and Kubernetes accept what `zsim render` writes, and its commands complete a run.

Validators: `systemd-analyze verify`, the schema of the Compose specification (from check-jsonschema) and the schemas
of the Kubernetes API (from kubernetes-validate) in strict mode, which refuses unknown fields.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import kubernetes_validate
import pytest
import yaml
from federation import PAIR, PAIR_ROLES, Role, free_port
from forked_commands import ZSIM, run_here
from wire import PATIENCE_S

from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim_deploy import inventory
from zsim_deploy.render import STATE, STOP_S, compose, kubernetes, systemd

ROOT = Path(__file__).parents[2]
STEP = ROOT / "scenarios/step.yaml"
OLDEST, NEWEST = "1.31", "1.37"  # podFailurePolicy is stable since 1.31; 1.37 is the validator's newest

Started = Callable[[Role], Role]

HOSTS = f"""
hosts:
  lab: {{address: 192.168.1.10, user: lab, python: {sys.executable}}}
  one: {{address: 192.168.1.21, user: pi, python: {sys.executable}, folder: "/srv/of drones/100%$A"}}
  two: {{address: lab.example.org, user: root, python: {sys.executable}, router: yard}}
roles: {{world: lab, "controller.*": two, "estimator.*": [one, two]}}
routers: {{yard: {{host: one}}, site: {{host: two, upstream: yard, port: 7500}}}}
"""

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing; on Debian: apt-get install systemd"
)
SECURITY = pytest.mark.parametrize("insecure", [False, True], ids=["tls", "insecure"])


def rendered(folder: Path, target: str, insecure: bool = False, text: str = HOSTS, scenario: Path = STEP) -> Path:
    """Render the files of a target into a subfolder and return it."""
    hosts = folder / "hosts.yaml"
    hosts.write_text(text + f"security: {{insecure: {str(insecure).lower()}}}\n")
    render = {"systemd": systemd, "compose": compose, "kubernetes": kubernetes}[target]
    out = folder / target
    for name, content in render(inventory.load(hosts), scenario_file.load(scenario)).items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(content)
    return out


# systemd


def verify(folder: Path) -> str:
    """Return the complaints of systemd-analyze about the units of a host."""
    units = [str(path) for path in sorted([*folder.glob("*.service"), *folder.glob("*.target")])]
    done = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True, timeout=PATIENCE_S)
    return done.stderr + (f"exit code {done.returncode}" if done.returncode else "")


@needs_systemd
@SECURITY
@pytest.mark.parametrize("host", ["lab", "one", "two"])
def test_systemd_verifies_the_units(tmp_path: Path, host: str, insecure: bool) -> None:
    assert verify(rendered(tmp_path, "systemd", insecure) / host) == ""


@needs_systemd
@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("ProtectSystem=strict", "ProtectSystem=strickt", "Failed to parse"),
        ("Restart=on-failure", "Restrat=on-failure", "Unknown key"),
        (f"ExecStart=:{sys.executable}", "ExecStart=python", "python"),
    ],
)
def test_a_fault_in_a_unit_is_found(tmp_path: Path, right: str, wrong: str, message: str) -> None:
    host = rendered(tmp_path, "systemd") / "two"
    unit = host / "zsim-controller.main.service"
    assert right in unit.read_text()
    unit.write_text(unit.read_text().replace(right, wrong).replace("ExecStart=python ", "ExecStart=/no/such/python "))
    assert message in verify(host)


# Compose and Kubernetes


def judged(*paths: Path) -> str:
    """Return how files violate the Compose specification."""
    files = map(str, paths)
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def test_compose_files_conform_to_the_specification(tmp_path: Path) -> None:
    files = []
    for insecure in (False, True):
        (tmp_path / str(insecure)).mkdir()
        files += rendered(tmp_path / str(insecure), "compose", insecure).glob("*/compose.yaml")
    assert len(files) == 2 * 3
    assert judged(*files, ROOT / "deploy/container/compose.yaml") == ""


def test_a_fault_in_a_compose_file_is_found(tmp_path: Path) -> None:
    path = rendered(tmp_path, "compose") / "lab/compose.yaml"
    path.write_text(path.read_text().replace("init: true", "initt: true"))
    assert "initt" in judged(path)


def documents(out: Path) -> list[dict]:
    return [one for path in sorted(out.glob("*.yaml")) for one in yaml.safe_load_all(path.read_text())]


@SECURITY
@pytest.mark.parametrize("version", [OLDEST, NEWEST])
def test_manifests_conform_to_the_kubernetes_api(tmp_path: Path, version: str, insecure: bool) -> None:
    found = documents(rendered(tmp_path, "kubernetes", insecure))
    assert len(found) == 4 + 1 + 6 + 2  # Namespace, volume claim, Pod and ConfigMap; Service; roles; routers
    assert {kubernetes_validate.validate(one, version, strict=True) for one in found} == {version}


def test_a_fault_in_a_manifest_is_found(tmp_path: Path) -> None:
    job = next(one for one in documents(rendered(tmp_path, "kubernetes")) if one["kind"] == "Job")
    job["spec"]["template"]["spec"]["hostNetwrok"] = True
    with pytest.raises(kubernetes_validate.ValidationError, match="hostNetwrok"):
        kubernetes_validate.validate(job, NEWEST, strict=True)


def test_the_secrets_are_created_from_the_files_of_certs_init(tmp_path: Path) -> None:
    """The script runs with a stub of kubectl that reports whether each file exists."""
    out = rendered(tmp_path, "kubernetes")
    certs(tmp_path, STEP)
    (tmp_path / "kubectl").write_text(f"""#!{sys.executable}
import pathlib, sys
files = [word.split("=")[-1] for word in sys.argv if word.startswith("--from-file")]
assert files or sys.argv[1:] == ["apply", "-f", "-"], sys.argv
for path in map(pathlib.Path, files):
    sys.stderr.write(f"{{path}}: {{path.exists()}}\\n")
""")
    (tmp_path / "kubectl").chmod(0o755)
    done = subprocess.run(
        ["sh", str(out / "secrets.sh"), str(tmp_path / "certs")],
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr
    looked = done.stderr.splitlines()
    assert len(looked) == 8 + 3  # each process's certificate, and the access control of the world and two routers
    assert all(line.endswith(": True") for line in looked)


def certs(folder: Path, scenario: Path) -> None:
    """Create the certificates of the inventory in a folder."""
    made = run_here("certs", "init", str(folder / "hosts.yaml"), "--scenario", str(scenario))
    assert made.code == 0, made


# Commands of units


class Unit(NamedTuple):
    """The command of a rendered unit, as systemd would run it."""

    name: str
    words: list[str]

    def __call__(self, *more: str, prefix: tuple[str, ...] = ()) -> Role:
        """Start the command with more options, which go before any double dash and the name after it."""
        at = self.words.index("--") if "--" in self.words else len(self.words)
        python, *arguments = [*self.words[:at], *more, *self.words[at:]]
        assert (python, *arguments[:3]) == (sys.executable, "-P", *ZSIM[1:])
        return Role(arguments[3:], prefix)


def units(out: Path, state: Path) -> Iterator[Unit]:
    """Yield the units of all hosts, with `state` as their StateDirectory=."""
    for path in sorted(out.glob("*/*.service")):
        (line,) = re.findall(r"^ExecStart=(.*)$", path.read_text(), re.MULTILINE)
        line = line.replace(STATE, str(state))
        words = [word.replace("%%", "%") for word in shlex.split(line.replace(":", "", 1))]
        yield Unit(path.stem.removeprefix("zsim-"), words)


def here(folder: Path, ports: Sequence[int]) -> str:
    """Return an inventory of three hosts, all on this machine, with drone2's behind a router."""
    world, router = ports
    host = f"address: 127.0.0.1, user: me, python: {sys.executable}, folder: {folder}"
    return f"""
hosts: {{lab: {{{host}/lab}}, one: {{{host}/one}}, two: {{{host}/two, router: yard}}}}
roles: {{world: lab, "controller.*": one, "estimator.*": [one, two]}}
routers: {{yard: {{host: one, port: {router}}}}}
port: {world}
"""


def laid_out(folder: Path, scenario: str, insecure: bool) -> dict[str, Unit]:
    """Render units for this machine and copy each host's files to its folder; return the units by process."""
    own = folder / "own.yaml"
    own.write_text(scenario)
    text = here(folder, [free_port(), free_port()])
    out = rendered(folder, "systemd", insecure, text, own)
    if not insecure:
        certs(folder, own)
    for host in ("lab", "one", "two"):
        shutil.copytree(out / host, folder / host)
        if not insecure:
            shutil.copytree(folder / "certs" / host, folder / host / "certs")
    return {unit.name: unit for unit in units(out, folder / "state")}


@pytest.fixture
def started() -> Iterator[Started]:
    """A function that registers a role, which is killed at the end of the test if it is still running."""
    with ExitStack() as stack:

        def note(role: Role) -> Role:
            stack.callback(role.close)
            return role

        yield note


@pytest.mark.parametrize(
    ("name", "insecure"), [("estimator.drone1", False), ("controller.main", True), ("recorder", False)]
)
def test_roles_accept_the_commands_of_their_units(tmp_path: Path, started: Started, name: str, insecure: bool) -> None:
    """The role reports that no world listens, which it does only after accepting its options."""
    unit = laid_out(tmp_path, PAIR, insecure)[name]
    role = started(unit("--wait", "0.1"))
    role.ends(with_code=2)
    endpoint = unit.words[unit.words.index("--connect") + 1]
    expected = f"no world of federation 'zsim' on {endpoint} within 0.1 s; start one with `zsim world`"
    assert role.text().splitlines()[-1] == expected


def test_a_missing_key_is_reported(tmp_path: Path, started: Started) -> None:
    unit = laid_out(tmp_path, PAIR, insecure=False)["estimator.drone1"]
    (tmp_path / "one/certs/estimator.drone1/key.pem").unlink()
    role = started(unit("--wait", "0.1"))
    role.ends(with_code=2)
    assert "key.pem" in role.text()
    assert "Traceback" not in role.text()


@pytest.mark.parametrize("insecure", [False, pytest.param(True, marks=pytest.mark.soak)], ids=["tls", "insecure"])
@pytest.mark.usefixtures("compiled")
def test_the_units_of_three_hosts_complete_a_run(tmp_path: Path, started: Started, insecure: bool) -> None:
    """All units start together and run until the world ends the run; the recorder is killed and restarted once."""
    found = laid_out(tmp_path, PAIR.replace("duration_s: 12", "duration_s: 6"), insecure)
    assert set(found) == {"world", "recorder", *PAIR_ROLES, "router.yard"}
    roles = {name: started(unit()) for name, unit in sorted(found.items())}
    roles["recorder"].line("pair-")
    roles["recorder"].signal(signal.SIGKILL)
    roles["recorder"] = started(found["recorder"]())
    for name in found:
        if name != "router.yard":
            roles[name].ends(with_code=0)
    roles["router.yard"].signal(signal.SIGTERM)
    roles["router.yard"].ends(with_code=0)
    (folder,) = (tmp_path / "state/runs").iterdir()
    assert folder.name.startswith("pair-")
    with RecordReader(folder / "run.mcap") as record:
        assert record.complete
        assert record.topics()["drone/drone2/estimate"] >= 300


@pytest.mark.usefixtures("compiled")
def test_a_world_ends_on_the_kill_signal_of_its_unit(tmp_path: Path, started: Started) -> None:
    found = laid_out(tmp_path, PAIR, insecure=True)
    text = (tmp_path / "systemd/lab/zsim-world.service").read_text()
    assert "KillSignal=SIGTERM" in text
    world = started(found["world"](prefix=("env",)))  # a new program, as systemd starts it
    world.line("tcp/127.0.0.1:")
    world.signal(signal.SIGTERM)
    world.ends(with_code=0, within_s=STOP_S)
    assert "ended: terminated" in world.text()
