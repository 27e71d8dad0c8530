"""Substitutes for ssh: this machine as a host of an inventory, and the text streams of a process as in asyncssh."""

import asyncio
import subprocess
from pathlib import Path
from typing import Any

from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.inventory import Host


class Text:
    """A text stream over a stream of bytes."""

    def __init__(self, stream: asyncio.StreamReader | None) -> None:
        assert stream is not None
        self._stream = stream

    async def readline(self) -> str:
        return (await self._stream.readline()).decode()

    async def read(self) -> str:
        return (await self._stream.read()).decode()


class LocalHost(HostLink):
    """This machine, which prints a greeting, records its commands, and accepts at most `takes` bytes of their input."""

    def __init__(self, takes: int | None = None, base: Path = Path(), **host: Any) -> None:
        super().__init__("h1", Host(**{"address": "127.0.0.1", **host}), base)
        self._takes = takes
        self.commands: list[tuple[str, bytes]] = []

    async def run(self, command: str, given: bytes = b"", *_: Any, what: str = "", **__: Any) -> bytes:
        self.commands.append((command, given))
        done = subprocess.run(["sh", "-c", command], input=given[: self._takes], capture_output=True, timeout=60.0)
        if done.returncode:
            raise HostsError(f"{self.name}: {what} failed: {done.stderr.decode().splitlines()[-1]}")
        return b"Welcome to run.mcap\n" + done.stdout
