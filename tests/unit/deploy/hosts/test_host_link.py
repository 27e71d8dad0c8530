"""The launcher's way to one host: how many channels a connection carries, and what is left of files cut short."""

import asyncio
import subprocess
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from refused import has_terms, refused

from zsim.errors import HostsError
from zsim_deploy.hosts import host_link
from zsim_deploy.hosts.host_link import CHANNELS, EventLoopThread, HostLink
from zsim_deploy.hosts.host_links import HostLinks
from zsim_deploy.inventory.inventory import Host, Inventory, InventoryFile

FILES = {"identity/world/key.pem": b"secret\n", "scenario.yaml": b"name: one\n" * 5000}


@pytest.fixture
def connections(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Let every link have connections that do nothing; return those that were opened."""
    opened: list[Any] = []

    async def connect(*_: Any) -> Any:
        opened.append(SimpleNamespace(closed=False))
        opened[-1].is_closed = lambda made=opened[-1]: made.closed
        return opened[-1]

    monkeypatch.setattr(host_link, "connect", connect)
    return opened


def link() -> HostLink:
    return HostLink("h1", Host(address="127.0.0.1"), Path())


def test_more_channels_than_sshd_allows_are_spread_over_connections(connections: list[Any]) -> None:
    async def lend(count: int) -> list[Any]:
        async with AsyncExitStack() as stack:
            host = link()
            return [await stack.enter_async_context(host.channel()) for _ in range(count)]

    used = asyncio.run(lend(2 * CHANNELS + 1))
    assert [used.count(connection) for connection in connections] == [CHANNELS, CHANNELS, 1]


def test_a_channel_that_was_given_back_is_used_again(connections: list[Any]) -> None:
    async def lend() -> None:
        host = link()
        for _ in range(3 * CHANNELS):
            async with host.channel():
                pass

    asyncio.run(lend())
    assert len(connections) == 1


def test_a_connection_that_is_lost_is_made_anew(connections: list[Any]) -> None:
    async def lose() -> bool:
        host = link()
        async with host.channel() as lost:
            connections[0].closed = True
            async with host.channel() as other:
                return other is lost

    assert not asyncio.run(lose())


class Local(HostLink):
    """A host that is this machine, and takes so many bytes only."""

    takes: int | None = None

    async def run(self, command: str, given: bytes = b"", *_: Any, what: str = "", **__: Any) -> bytes:
        done = subprocess.run(["sh", "-c", command], input=given[: self.takes], capture_output=True, check=False)
        if done.returncode:
            raise HostsError(f"{what}: {done.stderr.decode()}")
        return done.stdout


def local(takes: int | None = None) -> Local:
    made = Local("h1", Host(address="127.0.0.1"), Path())
    made.takes = takes
    return made


def test_files_come_below_a_folder_and_are_their_owners_alone(tmp_path: Path) -> None:
    asyncio.run(local().put_files(str(tmp_path / "a run"), FILES))
    found = {str(path.relative_to(tmp_path / "a run")): path for path in (tmp_path / "a run").rglob("*.*")}
    assert {name: path.read_bytes() for name, path in found.items() if path.is_file()} == FILES
    assert all(path.stat().st_mode & 0o077 == 0 for path in (tmp_path / "a run").rglob("*"))


@pytest.mark.parametrize("takes", [0, 600, 20_000])
def test_of_files_that_come_in_part_none_is_seen(tmp_path: Path, takes: int) -> None:
    with refused(HostsError, "writing", "in part"):
        asyncio.run(local(takes).put_files(str(tmp_path / "run"), FILES))
    assert [path.name for path in tmp_path.rglob("*")] == ["run"]


class Progress(HostLink):
    """A host that does nothing; it keeps the commands that it is given, each with its input."""

    async def run(self, command: str, given: bytes = b"", *_: Any, **__: Any) -> bytes:
        self.commands = [*getattr(self, "commands", []), (command, given)]
        return b""


def test_two_that_write_into_one_folder_do_not_disturb_each_other(tmp_path: Path) -> None:
    host = Progress("h1", Host(address="127.0.0.1"), Path())
    for name in ("one", "two"):
        asyncio.run(host.put_files(str(tmp_path / "run"), {name: name.encode() * 9000}))
    (one, first), (two, second) = host.commands
    with subprocess.Popen(["sh", "-c", one], stdin=subprocess.PIPE) as slow:
        assert slow.stdin is not None
        slow.stdin.write(first[:9000])
        slow.stdin.flush()
        subprocess.run(["sh", "-c", two], input=second, check=True)
        slow.communicate(first[9000:])
    assert slow.returncode == 0
    assert {path.name: path.read_text()[:3] for path in (tmp_path / "run").iterdir()} == {"one": "one", "two": "two"}


@pytest.fixture
def links() -> Any:
    hosts = {name: Host(address="127.0.0.1") for name in ("h1", "h2", "h3")}
    loop = EventLoopThread()
    yield HostLinks(InventoryFile(Inventory(hosts=hosts, roles={}), Path(), "hosts.yaml"), hosts, loop)
    loop.close()


def test_every_host_that_is_late_or_fails_is_named(links: HostLinks) -> None:
    async def work(host: HostLink) -> None:
        if host.name == "h1":
            await asyncio.Event().wait()
        if host.name == "h2":
            raise HostsError("h2: no certificate")

    with pytest.raises(HostsError) as error:
        links.on_all(work, 0.5)
    late, failed = str(error.value).splitlines()
    assert has_terms(late, "h1", "not done", "0.5 s")
    assert failed == "h2: no certificate"


def test_what_all_hosts_say_comes_back_by_name(links: HostLinks) -> None:
    async def name(host: HostLink) -> str:
        return host.name

    say: Callable[[HostLink], Any] = name
    assert links.on_all(say, 5.0) == {"h1": "h1", "h2": "h2", "h3": "h3"}
