"""`zsim push` installs zsim on hosts without internet over SSH: what their roles need, and only once."""

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import pytest
import sshd
from forked_commands import ZSIM
from lab import LAUNCHER, Lab
from refused import has_terms

from zsim import __version__
from zsim_deploy import inventory
from zsim_deploy.hosts import on_host
from zsim_deploy.hosts.host_link import HostLink, shell_line
from zsim_deploy.hosts.push import choose_interpreter, interpreter_query, open_installer, parse_interpreters
from zsim_deploy.hosts.wheelhouse import Wheelhouse, WheelSet, wheel_target

CACHE = Path(tempfile.gettempdir()) / "zsim-tests-cache"  # kept between test runs, like a user's cache
PUSH_S = 180.0  # wall time for two installations on a loaded machine
PUSH = (*ZSIM, "push")
WHERE = "import zsim_deploy; print(zsim_deploy.__file__)"
HAS = "from importlib.util import find_spec; print([n for n in ('cloudpickle', 'numba', 'mcap', 'scipy') if find_spec(n)])"
ROLES: dict[str, str | list[str]] = {"estimator.*": "h1", "world": "h3"}

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("push")]


@pytest.fixture
def hosts(lab: Lab) -> Path:
    """An inventory in which h1 has estimators, and h2 nothing that needs an extra."""
    return lab.inventory(ROLES, python=None)


def over_ssh(lab: Lab, hosts: Path, name: str, *command: str, given: str = "") -> str:
    """Run a command on a host from the launcher and return its output."""
    placed = inventory.load(hosts)

    async def work() -> bytes:
        link = HostLink(name, placed.inventory.hosts[name], placed.folder)
        try:
            return await link.run(shell_line(command), given.encode(), timeout_s=60.0)
        finally:
            await link.close()

    with lab.inside(LAUNCHER):
        return asyncio.run(work()).decode()


def look(lab: Lab, hosts: Path, name: str, python: str) -> dict[str, Any]:
    """Return a host's description of itself for an installation."""
    placed = inventory.load(hosts)

    async def work() -> dict[str, Any]:
        link = HostLink(name, placed.inventory.hosts[name], placed.folder)
        try:
            async with open_installer(link, python, str(lab.folder / "aside"), print) as program:
                return await program.ask("look", PUSH_S)
        finally:
            await link.close()

    with lab.inside(LAUNCHER):
        return asyncio.run(work())


def gather(lab: Lab, hosts: Path, *names: str) -> dict[str, WheelSet]:
    """Gather what `zsim push` needs in the lab from outside it, where there is a package index."""
    wanted = inventory.needed_extras(inventory.load(hosts).inventory)
    found = parse_interpreters(over_ssh(lab, hosts, names[0], "sh", "-c", interpreter_query()))
    python = choose_interpreter(names[0], found, sys.version_info[:2]).path
    printed = look(lab, hosts, names[0], python)
    wheelhouse = Wheelhouse(CACHE / "zsim", print)

    async def work() -> dict[str, WheelSet]:
        return {name: await wheelhouse.wheel_set(name, wheel_target(name, printed), wanted[name]) for name in names}

    return asyncio.run(work())


def push(lab: Lab, hosts: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run `zsim push` on the lab's launcher."""
    cache = {"XDG_CACHE_HOME": str(CACHE)}
    return lab.run(LAUNCHER, *PUSH, "--hosts", str(hosts), *options, env=cache, timeout=PUSH_S)


def test_offline_hosts_receive_what_their_roles_need_only_once(lab: Lab, hosts: Path) -> None:
    gather(lab, hosts, "h1", "h2")
    lab.environment("h1", NUMBA_DISABLE_JIT="1")  # compiling takes longer than everything else
    first = push(lab, hosts, "--host", "h1", "--host", "h2")
    assert first.returncode == 0, first.stderr
    assert "2 of 2" in first.stdout
    pythons = {name: str(lab.host_folder(name) / "venv/bin/python") for name in ("h1", "h2")}
    for name, python in pythons.items():
        assert over_ssh(lab, hosts, name, python, "-P", "-m", "zsim_deploy.cli", "--version") == f"zsim {__version__}\n"
        assert "zsim_deploy/__init__.py" in over_ssh(lab, hosts, name, python, "-P", "-c", WHERE)
    assert {name: over_ssh(lab, hosts, name, python, "-P", "-c", HAS) for name, python in pythons.items()} == {
        "h1": "['cloudpickle', 'numba', 'scipy']\n",
        "h2": "[]\n",
    }
    notes = [lab.host_folder(name) / "venv" / on_host.NOTE for name in pythons]
    before = [note.stat().st_mtime_ns for note in notes]
    second = push(lab, hosts, "--host", "h1", "--host", "h2")
    assert " of " not in second.stdout
    assert "copying" not in second.stderr
    assert [note.stat().st_mtime_ns for note in notes] == before


def test_each_unsuitable_host_is_reported(lab: Lab, hosts: Path, tmp_path: Path) -> None:
    programs = tmp_path / "programs"
    programs.mkdir()
    (programs / "sh").symlink_to("/bin/sh")
    (programs / "python3").write_text("#!/bin/sh\necho 3.9.2 /usr/bin/python3\n")
    (programs / "python3").chmod(0o755)
    lab.environment("h1", PATH=str(programs))
    known = lab.folder / "keys/known_hosts"
    known.write_text("".join(line for line in known.read_text().splitlines(True) if lab.address("h2") not in line))
    done = push(lab, hosts, "--host", "h1", "--host", "h2")
    assert done.returncode == 2
    h1, h2 = done.stderr.splitlines()[-2:]
    assert has_terms(h1, "h1: ", "python3 3.9.2", ".".join(map(str, sys.version_info[:2])))
    at = lab.address("h2")
    assert has_terms(h2, "h2: ", at, str(known), f"ssh-keyscan -p 22 {at} >> {known}")


def test_a_host_without_sftp_is_reported(lab: Lab, hosts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gather(lab, hosts, "h2")
    monkeypatch.setattr(sshd, "CONFIG", sshd.CONFIG.replace("sftp internal-sftp", "sftp /usr/lib/none"))
    lab.environment("h2")
    monkeypatch.setattr(sshd, "CONFIG", sshd.CONFIG.replace("Subsystem sftp /usr/lib/none\n", ""))
    lab.environment("h1")
    hosts.write_text(hosts.read_text().replace("estimator.*: h1\n", ""))
    done = push(lab, hosts, "--host", "h1", "--host", "h2")
    assert done.returncode == 2
    h1, h2 = done.stderr.splitlines()[-2:]
    assert has_terms(h1, "h1", "SFTP", "sshd_config")
    assert has_terms(h2, "h2", "SFTP", "sshd_config")


@pytest.mark.soak
def test_an_interrupted_push_does_not_disturb_the_next(lab: Lab, hosts: Path) -> None:
    gather(lab, hosts, "h2")
    command = (*PUSH, "--hosts", str(hosts), "--host", "h2")
    pipe = subprocess.PIPE
    with lab.popen(LAUNCHER, *command, env={"XDG_CACHE_HOME": str(CACHE)}, stdout=pipe, stderr=pipe) as first:
        assert first.stderr is not None
        assert any(line == "h2: installing\n" for line in first.stderr)
        first.send_signal(signal.SIGINT)
        printed = first.communicate(timeout=PUSH_S)[1]
    assert first.returncode == 130
    assert "Traceback" not in printed
    second = push(lab, hosts, "--host", "h2")
    assert second.returncode == 0, second.stderr
    assert "1 of 1" in second.stdout


@pytest.mark.soak
def test_simultaneous_pushes_wait_for_each_other(lab: Lab, hosts: Path) -> None:
    gather(lab, hosts, "h2")
    command = (*PUSH, "--hosts", str(hosts), "--host", "h2")
    options: dict[str, Any] = {
        "env": {"XDG_CACHE_HOME": str(CACHE)},
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
    }
    pushes = [lab.popen(LAUNCHER, *command, **options) for _ in range(2)]
    outputs = [each.communicate(timeout=PUSH_S) for each in pushes]
    assert [each.returncode for each in pushes] == [0, 0], outputs
    assert sorted("1 of 1" in output for output, _ in outputs) == [False, True]


def test_a_launcher_without_an_index_and_a_cache_is_reported(lab: Lab, hosts: Path, tmp_path: Path) -> None:
    nowhere = {
        "XDG_CACHE_HOME": str(tmp_path),
        "PIP_CONFIG_FILE": os.devnull,
        "PIP_FIND_LINKS": "",
        "PIP_INDEX_URL": "https://192.0.2.99/simple",
    }
    done = lab.run(LAUNCHER, *PUSH, "--hosts", str(hosts), env=nowhere, timeout=PUSH_S)
    assert done.returncode == 2
    assert "\nlauncher: " in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "first push" in line]
    assert line.startswith("launcher: ")


@pytest.mark.soak
def test_another_build_of_the_same_version_replaces_the_first(lab: Lab, hosts: Path, tmp_path: Path) -> None:
    pip = gather(lab, hosts, "h2")["h2"].pip.path
    for text in ("BUILD = 1", "BUILD = 2"):
        order = {"project": write_wheel(tmp_path / "wheels", text), "pip": pip.name, "wheels": [], "extras": []}
        shutil.copy(pip, tmp_path / "wheels")
        on_host.install(tmp_path, {**order, "modules": ["zsim"], "note": {"project": text}}, on_host.CommandRunner())
        printed = subprocess.run(
            [tmp_path / "venv/bin/python", "-c", "import zsim; print(zsim.__file__, zsim.BUILD)"],
            cwd=tmp_path, capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert printed.stdout.startswith(str(tmp_path / "venv"))
        assert printed.stdout.endswith(f"{text[-1]}\n")
    found = on_host.inspect_folder(tmp_path)
    assert found["installed"]["project"] == "BUILD = 2"
    assert found["wheels"] == {}


def test_an_incomplete_installation_counts_as_none(tmp_path: Path) -> None:
    assert on_host.inspect_folder(tmp_path)["installed"] is None
    (tmp_path / "venv/bin").mkdir(parents=True)
    (tmp_path / "venv/bin/python").symlink_to(sys.executable)
    assert on_host.inspect_folder(tmp_path)["installed"] is None
    note = tmp_path / "venv" / on_host.NOTE
    note.write_text(json.dumps({"python": [3, 10]}))
    assert on_host.inspect_folder(tmp_path)["installed"] is None
    note.write_text(json.dumps({"python": list(sys.version_info[:2])}))
    assert on_host.inspect_folder(tmp_path)["installed"] is not None


def write_wheel(folder: Path, text: str) -> str:
    """Write a wheel whose module `zsim` is the given line into a folder; return its name."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"zsim-{__version__}-py3-none-any.whl"
    with zipfile.ZipFile(folder / name, "w") as wheel:
        wheel.writestr("zsim.py", text)
        about = f"zsim-{__version__}.dist-info"
        wheel.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: zsim\nVersion: {__version__}\n")
        wheel.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{about}/RECORD", "zsim.py,,\n")
    return name
