"""What earlier runs have left on a host, here on this machine: records, keys, and how they are fetched."""

import asyncio
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from refused import has_terms

from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.host_plan import leftover_lines, leftovers, port_faults, scp
from zsim_deploy.hosts.launcher_requests import _refuse_unless_able
from zsim_deploy.inventory.inventory import Host

WAITS = "import sys; print('there', flush=True); sys.stdin.read()"


class Local(HostLink):
    """A host that is this machine."""

    async def run(self, command: str, given: bytes = b"", *_: Any, what: str = "", **__: Any) -> bytes:
        done = subprocess.run(["sh", "-c", command], input=given, capture_output=True, timeout=60.0, check=False)
        if done.returncode:
            raise HostsError(f"{self.name}: {what} failed: {done.stderr.decode().splitlines()[-1]}")
        return b"Welcome to run.mcap\n" + done.stdout


def local(folder: Path) -> Local:
    return Local("h1", Host(address="127.0.0.1", folder=str(folder), user="pi", port=2222), Path("/inventory"))


def run_of(folder: Path, run: str, *files: str) -> None:
    for file in files:
        path = folder / "runs" / run / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_a_host_on_which_nothing_ever_ran_has_nothing(tmp_path: Path) -> None:
    assert asyncio.run(leftovers(local(tmp_path / "not there"), tmp_path)) == []
    run_of(tmp_path, "abc", "scenario.yaml", "identity/world/ca.pem")
    assert asyncio.run(leftovers(local(tmp_path), tmp_path)) == []


def test_records_and_keys_are_told_in_a_line_each(tmp_path: Path) -> None:
    folder = tmp_path / "our zsim"
    run_of(folder, "abc", "run.mcap")
    run_of(folder, "def", "run.mcap", "identity/world/key.pem")
    records, keys = asyncio.run(leftovers(local(folder), Path("/inventory")))
    assert f"h1:{folder}/runs/abc/run.mcap, h1:{folder}/runs/def/run.mcap;" in records
    assert f"`scp -P 2222 'pi@127.0.0.1:{folder}/runs/abc/run.mcap' .`" in records
    assert f"`rm -r '{folder}/runs/def/identity'`" in keys


@pytest.mark.skipif(shutil.which("ps") is None, reason="needs ps (apt-get install procps)")
def test_a_run_that_goes_on_is_no_earlier_one(tmp_path: Path) -> None:
    run_of(tmp_path, "abcdef", "run.mcap", "identity/world/key.pem")
    words = [sys.executable, "-c", WAITS, "world", "--launched", "abcdef", "--host", "h1"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout
        process.stdout.readline()
        assert asyncio.run(leftovers(local(tmp_path), tmp_path)) == []
        process.communicate()
    assert len(asyncio.run(leftovers(local(tmp_path), tmp_path))) == 2


def test_the_way_of_a_copy_is_that_of_the_launcher() -> None:
    host = Host(address="::1", ssh="fe80::1", key="keys/a b", known_hosts="/etc/known")
    command = "scp -i '/lab/keys/a b' -o UserKnownHostsFile=/etc/known '[fe80::1]:.zsim/runs/1/run.mcap' ."
    assert scp(host, Path("/lab"), "~/.zsim/runs/1/run.mcap") == command
    (line,) = leftover_lines("h1", Host(address="h1"), Path(), ["run.mcap 1"])
    assert has_terms(line, "h1:~/.zsim/runs/1/run.mcap", "scp h1:.zsim/runs/1/run.mcap")


def test_a_port_on_which_somebody_listens_is_a_line(free_ports: list[Any]) -> None:
    taken, free = free_ports
    link = local(Path("/z"))
    numbers = [found.getsockname()[1] for found in (taken, free)]
    free.close()
    (line,) = asyncio.run(port_faults(link, sys.executable, numbers))
    assert has_terms(line, "h1", f"port {numbers[0]}", "in use")
    assert asyncio.run(port_faults(link, sys.executable, numbers[1:])) == []
    assert asyncio.run(port_faults(link, "/no/python", [])) == []


@pytest.fixture
def free_ports() -> Any:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as free:
        yield [taken, free]


def test_a_host_whose_python_lacks_the_agents_takes_no_role(tmp_path: Path) -> None:
    bare = tmp_path / "python"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    bare.chmod(0o755)
    link = local(tmp_path)
    says = r"^h1: import zsim_agents.estimation.estimator failed: ModuleNotFoundError.*; controller.main cannot run on h1; install"
    with pytest.raises(HostsError, match=says):
        asyncio.run(_refuse_unless_able(link, str(bare), "controller.main"))
    asyncio.run(_refuse_unless_able(link, sys.executable, "controller.main"))
