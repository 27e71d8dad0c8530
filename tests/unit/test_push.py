"""What a push leaves alone, what it copies, and how the failures of several hosts are told."""

import asyncio
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from zsim.errors import HostsError, InventoryError
from zsim_deploy import inventory
from zsim_deploy.host_link import HostLink
from zsim_deploy.inventory import Host, Inventory, Placed
from zsim_deploy.push import There, is_there, missing, push
from zsim_deploy.wheelhouse import House, Wheel


def wheel(name: str, size_bytes: int = 1, sha256: str | None = None) -> Wheel:
    return Wheel(Path(f"/cache/{name}.whl"), sha256 or f"sha of {name}", size_bytes)


HOUSE = House(wheel("zsim-1"), wheel("pip-26"), (wheel("numpy-2", 9), wheel("scipy-1", 5)), ("agents",))
NOTE = HOUSE.note()


def test_what_was_installed_last_is_there() -> None:
    assert is_there(HOUSE, NOTE)
    assert not is_there(HOUSE, None)


def test_another_build_an_extra_or_another_version_of_a_package_is_not_there() -> None:
    assert not is_there(HOUSE._replace(project=wheel("zsim-1", sha256="changed")), NOTE)
    assert not is_there(HOUSE._replace(extras=("agents", "world")), NOTE)
    assert not is_there(HOUSE._replace(others=(wheel("numpy-3"), wheel("scipy-1"))), NOTE)


def test_more_than_is_needed_may_be_there() -> None:
    assert is_there(HOUSE._replace(extras=(), others=(wheel("numpy-2"),)), NOTE)
    assert is_there(HOUSE._replace(pip=wheel("pip-27")), NOTE)


def names(wheels: list[Wheel]) -> list[str]:
    return [each.path.stem for each in wheels]


def test_a_fresh_host_gets_everything_and_large_files_first() -> None:
    assert names(missing(HOUSE, {"installed": None, "wheels": {}})) == ["numpy-2", "scipy-1", "zsim-1", "pip-26"]


def test_what_is_installed_or_was_copied_before_is_not_copied_again() -> None:
    assert names(missing(HOUSE, {"installed": NOTE, "wheels": {}})) == ["zsim-1", "pip-26"]
    copied = {"numpy-2.whl": "sha of numpy-2", "scipy-1.whl": "cut short"}
    assert names(missing(HOUSE, {"installed": None, "wheels": copied})) == ["scipy-1", "zsim-1", "pip-26"]


class Greeting(HostLink):
    """This machine, as a host whose login shell greets; what is asked of Pythons can be answered otherwise."""

    def __init__(self, python: str | None = None) -> None:
        super().__init__("h1", Host(address="192.0.2.1"), Path())
        self._python = python

    async def run(self, command: str, given: bytes = b"", *_: Any, **__: Any) -> bytes:
        if self._python and not given:
            return self._python.encode()
        done = subprocess.run(["sh", "-c", command], input=given, capture_output=True, check=True)
        return b"Welcome to lab\n17\n" + done.stdout


def test_a_greeting_of_the_login_shell_is_passed_over(tmp_path: Path) -> None:
    there = There(Greeting(), str(tmp_path))
    asyncio.run(there.look())
    assert there.found["folder"] == str(tmp_path)


def test_a_python_that_says_nothing_is_a_line(tmp_path: Path) -> None:
    silent = Greeting(f"python3 3.11.2 {shutil.which('true')}\n")
    with pytest.raises(HostsError, match=r"^h1: /\S+/true says nothing; does it run there\?$"):
        asyncio.run(There(silent, str(tmp_path)).look())


def placed(**hosts: Host) -> Placed:
    return Placed(Inventory(hosts=dict(hosts), roles={}), Path("/nowhere"), "hosts.yaml")


def pushed(where: Placed, names: list[str], cache: Path) -> dict[str, bool]:
    return asyncio.run(push(where, names, [], lambda host, text: None, cache))


def test_a_host_with_an_interpreter_of_its_own_is_left_alone(tmp_path: Path) -> None:
    assert pushed(placed(a=Host(address="192.0.2.1", python="/opt/zsim/bin/python")), [], tmp_path) == {"a": False}


def test_a_host_that_is_not_in_the_inventory_is_a_line(tmp_path: Path) -> None:
    with pytest.raises(InventoryError, match=r"^--host c: must be one of a, b$"):
        pushed(placed(a=Host(address="192.0.2.1"), b=Host(address="192.0.2.2")), ["c"], tmp_path)


def test_every_host_that_fails_has_its_line(tmp_path: Path) -> None:
    port = inventory.SSH_PORT - 21  # tcpmux; nobody has it
    closed = Host(address="127.0.0.1", port=port)
    with pytest.raises(HostsError) as caught:
        pushed(placed(a=closed, b=closed, c=Host(address="127.0.0.1", python="/opt/python")), [], tmp_path)
    lines = str(caught.value).splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["a", "b"]
    assert all("cannot be reached (Connection refused)" in line for line in lines)
