"""on_host.py as it runs on a host: asked over one ssh channel, it ends with all that it does when that closes."""

import asyncio
import contextlib
import getpass
import json
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import asyncssh

from zsim.errors import HostsError
from zsim_deploy.hosts.host_link import HostLink
from zsim_deploy.hosts.ssh_connection import json_answer, shell_line
from zsim_deploy.push import on_host

START_S = 30.0  # wall time to start a Python on a small computer, over a poor link
BEAT_S = 5.0  # how often the launcher shows that it lives
SILENT_S = 60.0  # wall time without that, after which the program ends by itself; a link may be cut for shorter
WAIT_S = 1800.0  # wall time for another push to end; as long as it may take to install and to compile


class Installer:
    """The program on a host.

    Args:
        name: of the host, for errors.
        python: that runs it, for errors.
        process: over there.
    """

    def __init__(self, name: str, python: str, process: "asyncssh.SSHClientProcess[str]") -> None:
        self._name, self._python, self._process = name, python, process

    async def lock(self, progress: Callable[[str], None]) -> None:
        """Wait until nobody else installs there.

        Args:
            progress: takes a line on who does.

        Raises:
            HostsError: the folder cannot be used, or somebody installs for too long.
        """
        message = await self._answer(START_S)
        if holder := message.get("waits"):
            progress(f"waiting for the push of {holder}")
            advice = f"{holder} is pushing to it; wait for that to end, or end it there"
            message = await self._answer(WAIT_S, advice)
        if why := message.get("unwritable"):
            raise HostsError(
                f"{self._name}: its folder cannot be used ({why}); correct hosts.{self._name}.folder, or make it there"
            )

    async def ask(self, act: str, timeout_s: float, **order: Any) -> dict[str, Any]:
        """Give an order and return the answer.

        Raises:
            HostsError: it failed, took longer, or the host is gone.
        """
        self._process.stdin.write(json.dumps({"act": act, **order}) + "\n")
        message = await self._answer(timeout_s, f"to {act} took longer than {timeout_s:g} s; is it busy?")
        if "error" in message:
            raise HostsError(f"{self._name}: {message['error'][:300]}")
        return message

    async def beat(self) -> None:
        """Show for ever that we live."""
        with contextlib.suppress(asyncssh.Error, OSError):
            while True:
                await asyncio.sleep(BEAT_S)
                self._process.stdin.write("\n")

    async def _answer(self, timeout_s: float, late: str = "") -> dict[str, Any]:
        try:
            async with asyncio.timeout(timeout_s):
                while line := await self._process.stdout.readline():  # a greeting of the login shell is passed over
                    if message := json_answer([line]):
                        return message
                lines = (await self._process.stderr.read()).strip().splitlines()
        except TimeoutError as error:
            raise HostsError(f"{self._name}: {late or f'no answer within {timeout_s:g} s; is it busy?'}") from error
        last = lines[-1] if lines else "printed nothing; does it run there?"
        raise HostsError(f"{self._name}: {self._python} {last[:200]}")


@contextlib.asynccontextmanager
async def open_installer(
    link: HostLink, python: str, folder: str, progress: Callable[[str], None]
) -> AsyncIterator[Installer]:
    """Let the program run on a host as long as the block lasts; it alone installs there.

    Args:
        python: that runs it.
        folder: of zsim over there.
        progress: takes a line on who is waited for.

    Raises:
        HostsError: the host cannot be reached, its folder not be used, or the connection breaks.
    """
    script = Path(on_host.__file__).read_bytes()
    start = f"import sys; exec(sys.stdin.buffer.read({len(script)}))"  # not to the end: that means to end
    who = f"{getpass.getuser()}@{socket.gethostname()}"
    command = shell_line([python, "-P", "-c", start, folder, who, f"{SILENT_S:g}"])
    try:
        async with link.channel() as connection:
            process = await connection.create_process(command, encoding="utf-8", errors="replace")
            try:
                process.stdin.write(script.decode())
                there = Installer(link.name, python, process)
                beats = asyncio.create_task(there.beat())
                try:
                    await there.lock(progress)
                    yield there
                finally:
                    beats.cancel()
            finally:
                process.close()  # not waited for: on a link that is cut it would take a minute
    except (asyncssh.Error, OSError) as error:
        raise HostsError(f"{link.name}: the connection broke ({error}); is the host up?") from error
