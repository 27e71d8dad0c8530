"""The launcher's link to a host: channels per connection, and files that are sent or fetched only in part."""

import asyncio
import errno
import os
import shutil
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import asyncssh
import pytest
from jumping_time import run_jumping
from local_host import LocalHost
from refused import has_terms, refused

from zsim.errors import HostsError
from zsim_deploy.hosts import host_link
from zsim_deploy.hosts.host_link import CHANNELS, EventLoopThread, HostLink, HostLinks, fetch
from zsim_deploy.inventory import Host, Inventory, InventoryFile

FILES = {"identity/world/key.pem": b"secret\n", "scenario.yaml": b"name: one\n" * 5000}


@pytest.fixture
def connections(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Give every link connections that do nothing; return those that are opened."""
    opened: list[Any] = []

    class Connection:
        closed = False

        def is_closed(self) -> bool:
            return self.closed

    async def connect(*_: Any) -> Any:
        opened.append(Connection())
        return opened[-1]

    monkeypatch.setattr(host_link, "connect", connect)
    return opened


def link() -> HostLink:
    return HostLink("h1", Host(address="127.0.0.1"), Path())


@pytest.mark.parametrize("turns", range(6))  # of the loop, between the answer and the cancellation
def test_a_cancellation_counts_even_while_a_command_ends(connections: list[Any], turns: int) -> None:
    async def cancel_near_the_end() -> bool:
        host, started, ended = link(), asyncio.Event(), asyncio.Event()

        async def command(*_: Any, **__: Any) -> SimpleNamespace:
            started.set()
            await ended.wait()
            return SimpleNamespace(exit_status=0, stdout=b"")

        connection: Any = await host.open()
        connection.run = command
        running = asyncio.create_task(host.run("true"))
        await started.wait()
        ended.set()
        for _ in range(turns):
            await asyncio.sleep(0)
        was_running = running.cancel()
        await asyncio.wait([running])
        return running.cancelled() == was_running

    assert asyncio.run(cancel_near_the_end())


def test_channels_are_spread_over_connections_and_reused(connections: list[Any]) -> None:
    async def lend(count: int) -> list[Any]:
        host = link()
        for _ in range(3 * CHANNELS):  # one after the other
            async with host.channel():
                pass
        async with AsyncExitStack() as stack:
            return [await stack.enter_async_context(host.channel()) for _ in range(count)]

    used = asyncio.run(lend(2 * CHANNELS + 1))
    assert [used.count(connection) for connection in connections] == [CHANNELS, CHANNELS, 1]


def test_a_lost_connection_is_replaced(connections: list[Any]) -> None:
    async def lose() -> bool:
        host = link()
        async with host.channel() as lost:
            connections[0].closed = True
            async with host.channel() as other:
                return other is lost

    assert not asyncio.run(lose())


def test_files_are_put_into_a_folder_readable_by_their_owner_alone(tmp_path: Path) -> None:
    asyncio.run(LocalHost().put_files(str(tmp_path / "a run"), FILES))
    found = {str(path.relative_to(tmp_path / "a run")): path for path in (tmp_path / "a run").rglob("*.*")}
    assert {name: path.read_bytes() for name, path in found.items() if path.is_file()} == FILES
    assert all(path.stat().st_mode & 0o077 == 0 for path in (tmp_path / "a run").rglob("*"))


@pytest.mark.parametrize("takes", [0, 600, 20_000])
def test_files_sent_only_in_part_do_not_appear(tmp_path: Path, takes: int) -> None:
    with refused(HostsError, "writing", "in part"):
        asyncio.run(LocalHost(takes).put_files(str(tmp_path / "run"), FILES))
    assert [path.name for path in tmp_path.rglob("*")] == ["run"]


def test_two_transfers_into_one_folder_do_not_disturb_each_other(tmp_path: Path) -> None:
    host = LocalHost()
    for name in ("one", "two"):
        asyncio.run(host.put_files(str(tmp_path / "run"), {name: name.encode() * 9000}))
    shutil.rmtree(tmp_path / "run")
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


def test_results_are_returned_by_host_and_late_or_failed_hosts_named(links: HostLinks) -> None:
    async def name(host: HostLink) -> str:
        return host.name

    async def work(host: HostLink) -> None:
        if host.name == "h1":
            await asyncio.Event().wait()
        if host.name == "h2":
            raise HostsError("h2: no certificate")

    assert links.on_all(name, 5.0) == {"h1": "h1", "h2": "h2", "h3": "h3"}
    with pytest.raises(HostsError) as error:
        links.on_all(work, 0.5)
    late, failed = str(error.value).splitlines()
    assert has_terms(late, "h1", "not done", "0.5 s")
    assert failed == "h2: no certificate"


Get = Callable[[Path, Callable[..., None]], Awaitable[None]]


class Link:
    """A link to a host whose SFTP behaves as given; with None, no session is ever opened."""

    name = "h2"

    def __init__(self, get: Get | None) -> None:
        self._get = get
        self.asked: list[str] = []

    @asynccontextmanager
    async def channel(self) -> AsyncIterator["Link"]:
        yield self

    async def start_sftp_client(self) -> "Link":
        if self._get is None:
            await asyncio.Event().wait()
        return self

    async def get(self, source: str, into: Path, block_size: int, progress_handler: Callable[..., None]) -> None:
        assert self._get is not None
        self.asked.append(source)
        await self._get(into, progress_handler)

    def exit(self) -> None: ...


def fetched(get: Get | None, into: Path, there: bool = True) -> Link:
    link: Any = Link(get)
    assert run_jumping(fetch(link, "~/.zsim/runs/1/run.mcap", into)) is there
    return link


async def whole(into: Path, progress: Callable[..., None]) -> None:
    into.write_bytes(b"all of it")


async def for_ever(into: Path, progress: Callable[..., None]) -> None:
    into.write_bytes(b"some")
    await asyncio.Event().wait()


async def slowly(into: Path, progress: Callable[..., None]) -> None:
    for _ in range(3):
        await asyncio.sleep(0.3)
        progress()
    into.write_bytes(b"all of it")


def raising(error: Exception) -> Get:
    async def get(into: Path, progress: Callable[..., None]) -> None:
        raise error

    return get


def test_a_fetched_file_may_take_longer_than_the_stall_timeout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow transfer makes progress well within every stall timeout, but takes longer than one in total."""
    monkeypatch.setattr(host_link, "STALL_S", 0.8)
    for get in (whole, slowly):
        assert fetched(get, tmp_path / "run.mcap").asked == [".zsim/runs/1/run.mcap"]  # SFTP starts in the home folder
        assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"all of it"]
    (tmp_path / "run.mcap").unlink()
    fetched(raising(asyncssh.SFTPNoSuchFile("No such file")), tmp_path / "run.mcap", there=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("get", "terms", "left"),
    [
        (for_ever, ("h2", "no data", "0.05 s"), ["run.mcap.part"]),
        (None, ("h2", "no answer", "0.05 s"), []),
        (raising(asyncssh.SFTPPermissionDenied("Permission denied")), ("h2", os.strerror(errno.EACCES)), []),
    ],
)
def test_a_failed_fetch_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, get: Get | None, terms: tuple[str, ...], left: list[str]
) -> None:
    monkeypatch.setattr(host_link, "STALL_S", 0.05)
    monkeypatch.setattr(host_link, "OPEN_S", 0.05)
    with refused(HostsError, *terms):
        fetched(get, tmp_path / "run.mcap")
    assert [path.name for path in tmp_path.iterdir()] == left
