"""A record brought home: under its name only when it is whole, and nobody waits for a host that is gone."""

import asyncio
import errno
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import asyncssh
import pytest
from refused import refused

from zsim.errors import HostsError
from zsim_deploy.hosts import host_links as module
from zsim_deploy.hosts.host_links import fetch

Get = Callable[[Path, Callable[..., None]], Awaitable[None]]


class Link:
    """A link to a host whose sftp does what is given; None never lets us in."""

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
    assert asyncio.run(fetch(link, "~/.zsim/runs/1/run.mcap", into)) is there
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


async def none_there(into: Path, progress: Callable[..., None]) -> None:
    raise asyncssh.SFTPNoSuchFile("No such file")


async def not_readable(into: Path, progress: Callable[..., None]) -> None:
    raise asyncssh.SFTPPermissionDenied("Permission denied")


def test_a_file_comes_under_its_name(tmp_path: Path) -> None:
    assert fetched(whole, tmp_path / "run.mcap").asked == [".zsim/runs/1/run.mcap"]  # sftp starts at the home
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_host_from_which_nothing_comes_any_more_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STALL_S", 0.05)
    with refused(HostsError, "nothing", "0.05 s"):
        fetched(for_ever, tmp_path / "run.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]


def test_a_file_may_take_longer_than_a_stall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Something comes three times as often as it has to; all of it takes longer than one stall."""
    monkeypatch.setattr(module, "STALL_S", 0.8)
    fetched(slowly, tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap").read_bytes() == b"all of it"


def test_a_host_that_does_not_let_us_in_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "OPEN_S", 0.05)
    with refused(HostsError, "h2", "no answer", "0.05 s"):
        fetched(None, tmp_path / "run.mcap")


def test_a_file_that_is_not_there_is_told_from_one_that_cannot_be_read(tmp_path: Path) -> None:
    fetched(none_there, tmp_path / "run.mcap", there=False)
    with refused(HostsError, "h2", os.strerror(errno.EACCES)):
        fetched(not_readable, tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []
