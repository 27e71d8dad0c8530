"""Access to the hosts of an inventory over ssh: connections, commands, long-running programs, and file transfer.

Every failure is one line: the host, what failed, and what to do. All connections belong to one event loop in its own
thread (`EventLoopThread`), so that the supervisor of a run remains a plain loop.
"""

import asyncio
import contextlib
import getpass
import io
import json
import os
import shlex
import socket
import tarfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import asyncssh
from asyncssh.constants import OPEN_REQUEST_SESSION_FAILED

from zsim.errors import HostsError, ZsimError
from zsim_deploy.inventory import SSH_PORT, Host, InventoryFile

# Wall times; a host on a poor link answers within a few round trips
CONNECT_S = 10.0  # time limit for logging in
KEEPALIVE_S = 15.0  # time without data after which a keepalive is sent
KEEPALIVE_COUNT = 4  # unanswered keepalives before the connection is given up; one minute, to survive outages of 20 s
ECHO_S = 0.5  # interval at which the host echoes a line
RETRY_S = 0.5  # interval between attempts to reconnect
CLOSE_S = 1.0  # time limit for closing a connection; a cut one never closes
ANSWER_S = 10.0  # time limit for a short command
OPEN_S = 10.0  # time limit for opening SFTP
STALL_S = 20.0  # time without data after which the host is considered lost; TCP retransmits well within that

CHANNELS = 8  # channels per connection; sshd allows 10 (sshd_config(5), MaxSessions) and counts closed ones for a while
BLOCK_BYTES = 32_768  # size of an SFTP request; even at 100 kbit/s one is answered within 3 s

Result = TypeVar("Result")
Connection = asyncssh.SSHClientConnection


class EventLoopThread:
    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="ssh", daemon=True)
        self._thread.start()

    def call(self, work: Coroutine[Any, Any, Result], timeout_s: float | None = None) -> Result:
        """Run a coroutine and return its result; if it exceeds the timeout, cancel it and raise TimeoutError."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout_s)
        except BaseException:
            future.cancel()  # also on Ctrl-C
            raise

    def spawn(self, work: Coroutine[Any, Any, None]) -> Future[None]:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call_soon(self, callback: Any, *args: Any) -> None:
        self._loop.call_soon_threadsafe(callback, *args)

    def close(self) -> None:
        """Cancel the running tasks and end the thread."""

        async def cancel_all() -> None:
            tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks, timeout=CLOSE_S / 2) if tasks else None

        self.call(cancel_all(), CLOSE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._loop.close()


class HostLink:
    """Access to one host; when all channels of a connection are in use, another connection is opened."""

    def __init__(self, name: str, host: Host, base: Path) -> None:
        self.name = name
        self.host = host
        self.round_trip_s = 0.0  # round trip of the last echoed line, wall time
        self.answered_s = 0.0  # monotonic time at which that line arrived; 0 before the first one
        self._base = base  # folder of the inventory, to which its relative paths refer
        self._channels: dict[Connection, int] = {}  # number of channels in use, by connection
        self._lock = asyncio.Lock()

    async def open(self) -> Connection:
        """Return a connection with a free channel; raise HostsError if logging in to the host fails."""
        async with self._lock:
            for connection, channels in list(self._channels.items()):
                if connection.is_closed():
                    del self._channels[connection]
                elif channels < CHANNELS:
                    return connection
            connection = await connect(self.name, self.host, self._base)
            self._channels[connection] = 0
            return connection

    @contextlib.asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Connection]:
        """Yield a connection for one channel; `retry`: try until the host is reached; otherwise errors as in `open`."""
        while True:
            try:
                connection = await self.open()
                self._channels[connection] += 1
                break
            except HostsError:
                if not retry:
                    raise
            await asyncio.sleep(RETRY_S)
        try:
            yield connection
        finally:
            if connection in self._channels:
                self._channels[connection] -= 1

    async def run(
        self, command: str, stdin: bytes = b"", timeout_s: float = ANSWER_S, what: str = "", retry: bool = False
    ) -> bytes:
        """Run a POSIX shell command and return its output; raise HostsError if it fails or takes too long.

        `what`: what the command does, for errors; `retry`: try until the host is reached; the timeout counts from then.
        """
        async with self.channel(retry) as connection:
            try:
                async with asyncio.timeout(timeout_s):
                    done = await connection.run(command, input=stdin, encoding=None)
            except TimeoutError as error:
                description = what or repr(command[:60])
                raise HostsError(f"{self.name}: no answer within {timeout_s:g} s ({description})") from error
            except (asyncssh.Error, OSError) as error:
                raise _broken(self.name, error) from error
        if done.exit_status != 0:
            text = done.stderr.decode(errors="replace") if isinstance(done.stderr, bytes) else str(done.stderr or "")
            lines = text.strip().splitlines() or ["it printed nothing"]
            what = what or command.split(" ", 1)[0]
            raise HostsError(f"{self.name}: {what} failed ({done.exit_status}): {lines[-1][:200]}")
        return done.stdout if isinstance(done.stdout, bytes) else b""

    async def put_files(
        self, folder: str, files: Mapping[str, bytes], timeout_s: float = ANSWER_S, retry: bool = False
    ) -> None:
        """Write files, given by path below a folder, readable only by their owner.

        Raise HostsError if they cannot be written; if the link breaks, no file is written.
        """
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for path, content in files.items():
                entry = tarfile.TarInfo(path)
                entry.size, entry.mode, entry.mtime = len(content), 0o600, int(time.time())
                tar.addfile(entry, io.BytesIO(content))
        archive, into = packed.getvalue(), shell_word(folder)
        part = f"{into}/.part.$$"  # another command may be writing there at the same time
        is_complete = f"[ $(wc -c < {part}) -eq {len(archive)} ] || {{ echo it arrived only in part >&2; false; }}"
        unpack = f"cat > {part} && {{ {is_complete}; }} && tar -xof {part} -C {into}"
        script = f"umask 077; mkdir -p {into} && {{ {unpack}; code=$?; rm -f {part}; exit $code; }}"
        await self.run(script, archive, timeout_s, what=f"writing into {folder}", retry=retry)

    async def measure_round_trips(self) -> None:
        """Have the host echo a line every ECHO_S, so that a lost host is noticed within a second; never returns."""
        while True:
            with contextlib.suppress(HostsError, asyncssh.Error, OSError):
                async with self.channel() as connection, connection.create_process("cat", encoding="utf-8") as echo:
                    sent_s = time.monotonic()
                    echo.stdin.write(".\n")
                    while await echo.stdout.readline():
                        self.answered_s = time.monotonic()
                        self.round_trip_s = self.answered_s - sent_s
                        await asyncio.sleep(ECHO_S)
                        sent_s = time.monotonic()
                        echo.stdin.write(".\n")
            await asyncio.sleep(RETRY_S)

    def silent_s(self) -> float:
        return max(0.0, time.monotonic() - self.answered_s - ECHO_S) if self.answered_s else 0.0

    async def close(self) -> None:
        """Close all connections; programs that still read from them end by themselves."""
        for connection in self._channels:
            connection.close()
        closed = asyncio.gather(*(each.wait_closed() for each in self._channels), return_exceptions=True)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await closed


def _broken(name: str, error: Exception) -> HostsError:
    return HostsError(f"{name}: the connection broke ({error}); is the host up?")


class HostLinks:
    """A link to each host of a run."""

    def __init__(self, inventory_file: InventoryFile, names: Iterable[str], loop: EventLoopThread) -> None:
        self._inventory_file = inventory_file
        self._loop = loop
        # replaced, never modified, because other threads read it
        self.by_name = {name: self.to(name) for name in names}

    def to(self, name: str) -> HostLink:
        """Return a new link to a host of the inventory, without adding it."""
        return HostLink(name, self._inventory_file.inventory.hosts[name], self._inventory_file.folder)

    def add(self, link: HostLink) -> None:
        self.by_name = {**self.by_name, link.name: link}
        self._loop.spawn(link.measure_round_trips())

    def listen(self) -> None:
        """Start to measure the round trips to all hosts."""
        for link in self.by_name.values():
            self._loop.spawn(link.measure_round_trips())

    def on_all(self, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> dict[str, Any]:
        """Run a coroutine for all hosts concurrently; return the results by host.

        Raise HostsError with a line for each host for which the coroutine failed or took longer than `within_s`.
        """

        async def bounded(link: HostLink) -> Any:
            try:
                async with asyncio.timeout(within_s):
                    return await work(link)
            except TimeoutError as error:
                reason = f"not done within {within_s:g} s; is the link slow or the host busy?"
                raise HostsError(f"{link.name}: {reason}") from error

        async def gathered() -> list[Any]:
            return await asyncio.gather(*map(bounded, self.by_name.values()), return_exceptions=True)

        return dict(zip(self.by_name, raise_faults(self._loop.call(gathered())), strict=True))

    def close(self) -> None:
        self.on_all(HostLink.close, 2 * CLOSE_S)


def raise_faults(results: list[Any]) -> list[Any]:
    """Return gathered results if no exception is among them.

    Raise HostsError with a line for each ZsimError; raise any other exception as it is.
    """
    for result in results:
        if isinstance(result, BaseException) and not isinstance(result, ZsimError):
            raise result
    if lines := list(dict.fromkeys(str(result) for result in results if isinstance(result, ZsimError))):
        raise HostsError("\n".join(lines))
    return results


class ProgramEndedError(HostsError):
    """A program on a host ended without an answer; `status`: its exit code; `last`: its last line on standard error."""

    def __init__(self, name: str, status: int | None, last: str) -> None:
        super().__init__(f"{name}: the program ended with code {status} ({last or 'it printed nothing'})")
        self.status, self.last = status, last


class RemoteProgram:
    """A program on a host that answers each line that it reads with a line of JSON."""

    def __init__(self, host: str, process: "asyncssh.SSHClientProcess[str]") -> None:
        self._host = host
        self._process = process

    def send(self, text: str) -> None:
        self._process.stdin.write(text)

    async def answer(self, within_s: float, late: str = "") -> dict[str, Any]:
        """Return the program's next answer, skipping any greeting of the login shell.

        Raise ProgramEndedError if it has ended, and HostsError (with the text `late`, if given) if it takes too long.
        """
        try:
            async with asyncio.timeout(within_s):
                while line := await self._process.stdout.readline():
                    if message := json_answer([line]):
                        return message
                lines = (await self._process.stderr.read()).strip().splitlines()
                await self._process.wait_closed()
        except TimeoutError as error:
            slow = f"no answer within {within_s:g} s; is the link slow or the host busy?"
            raise HostsError(f"{self._host}: {late or slow}") from error
        raise ProgramEndedError(self._host, self._process.exit_status, lines[-1][:200] if lines else "")


@contextlib.asynccontextmanager
async def open_program(link: HostLink, command: str) -> AsyncIterator[RemoteProgram]:
    """Run a program on a host for the duration of the block; raise HostsError if the connection fails or breaks."""
    try:
        async with link.channel() as connection:
            process = await connection.create_process(command, encoding="utf-8", errors="replace")
            try:
                yield RemoteProgram(link.name, process)
            finally:
                process.close()  # not awaited: on a cut link that would take a minute
    except (asyncssh.Error, OSError) as error:
        raise _broken(link.name, error) from error


async def fetch(link: HostLink, source: str, into: Path) -> bool:
    """Copy a file from a host; return False if it does not exist there.

    An incomplete copy has .part appended to its name. Raise HostsError if the file cannot be read or the transfer
    stalls, and OSError if it cannot be written here.
    """
    part, moved = into.with_name(f"{into.name}.part"), asyncio.Event()
    try:
        async with link.channel() as connection:
            async with asyncio.timeout(OPEN_S):
                sftp = await start_sftp(link.name, connection)
            copy = asyncio.create_task(
                sftp.get(
                    source.removeprefix("~/"), part, block_size=BLOCK_BYTES, progress_handler=lambda *_: moved.set()
                )
            )
            copy.add_done_callback(lambda task: task.cancelled() or task.exception())  # otherwise asyncio reports it
            try:
                while not (await asyncio.wait([copy], timeout=STALL_S))[0]:
                    if not moved.is_set():
                        raise HostsError(f"{link.name}: no data for {STALL_S:g} s; what was received is in {part}")
                    moved.clear()
            finally:
                copy.cancel()
                sftp.exit()  # not awaited: on a cut link that would never return
            copy.result()
    except TimeoutError as error:
        raise HostsError(f"{link.name}: no answer within {OPEN_S:g} s") from error
    except asyncssh.SFTPNoSuchFile:
        return False
    except asyncssh.Error as error:
        raise HostsError(f"{link.name}: {error}") from error
    part.replace(into)
    return True


async def start_sftp(name: str, connection: Connection) -> asyncssh.SFTPClient:
    """Open SFTP on a connection; raise HostsError if the host does not offer it."""
    try:
        return await connection.start_sftp_client()
    except (asyncssh.ChannelOpenError, asyncssh.SFTPConnectionLost, asyncssh.SFTPEOFError) as error:
        is_refused = isinstance(error, asyncssh.ChannelOpenError) and error.code == OPEN_REQUEST_SESSION_FAILED
        if not is_refused and (isinstance(error, asyncssh.ChannelOpenError) or connection.is_closed()):
            raise
        remedy = "set `Subsystem sftp internal-sftp` in sshd_config there and restart sshd"
        raise HostsError(f"{name}: its sshd offers no SFTP; {remedy}") from error


def shell_word(path: str) -> str:
    """Quote a path as one word for a host's shell, which still expands a leading ~/ to the user's home folder."""
    return f"~/{shlex.quote(path[2:])}" if path.startswith("~/") else shlex.quote(path)


def shell_line(words: Iterable[str]) -> str:
    return " ".join(map(shell_word, words))


def json_answer(lines: Iterable[str]) -> dict[str, Any] | None:
    """Return the first JSON object among lines; None if there is none."""
    for line in lines:
        with contextlib.suppress(ValueError):
            value = json.loads(line)
            if isinstance(value, dict):
                return value
    return None


class _Client(asyncssh.SSHClient):
    """ssh client that remembers a refused host key, with the host name, address and port for which it was looked up."""

    refused: tuple[str, str, int, asyncssh.SSHKey] | None = None

    def validate_host_public_key(self, host: str, addr: str, port: int, key: asyncssh.SSHKey) -> bool:
        self.refused = (host, addr, port, key)
        return False


async def connect(name: str, host: Host, base: Path) -> Connection:
    """Connect to a host; ~/.ssh/config fills in what its inventory entry leaves out.

    Relative paths of `key` and `known_hosts` refer to `base`, the folder of the inventory. Raise HostsError if the host
    cannot be reached, shows a host key that is not in known_hosts, or refuses the user or key.
    """
    client, address = _Client(), host.ssh or host.address
    options: dict[str, Any] = {"keepalive_interval": KEEPALIVE_S, "keepalive_count_max": KEEPALIVE_COUNT}
    known_hosts = Path("~/.ssh/known_hosts")
    try:
        if host.user is not None:
            options["username"] = host.user
        if host.key is not None:
            options["client_keys"] = [str(base / Path(host.key).expanduser())]
        if host.known_hosts is not None:
            known_hosts = base / Path(host.known_hosts).expanduser()
            options["known_hosts"] = str(known_hosts)
        opening = asyncssh.connect(address, host.port, client_factory=lambda: client, **options)
        async with asyncio.timeout(CONNECT_S):
            return await opening
    except (asyncssh.Error, asyncssh.KeyImportError, OSError, ValueError, TimeoutError) as error:
        refused = client.refused
        if refused is None and isinstance(
            error, asyncssh.ConnectionLost | asyncssh.KeyExchangeFailed | ConnectionResetError
        ):  # perhaps no host key algorithm was agreed on: only those in known_hosts are offered
            with contextlib.suppress(asyncssh.Error, OSError, ValueError, TimeoutError):
                async with asyncio.timeout(CONNECT_S):
                    key = await asyncssh.get_server_host_key(address, host.port)
                refused = (address, "", host.port, key) if key else None
        reason = _changed_key(name, host, known_hosts, *refused) if refused else ""
        raise HostsError(f"{name}: {reason or _reason(name, host, base, known_hosts, error)}") from error


def _changed_key(
    name: str, host: Host, known_hosts: Path, searched_name: str, address: str, port: int, host_key: asyncssh.SSHKey
) -> str:
    """Return a text about a host key that differs from the known one; empty if it does not, or none is known."""
    path = str(known_hosts.expanduser())
    try:
        keys = asyncssh.match_known_hosts(path, searched_name, address, None if port == SSH_PORT else port)[0]
    except (OSError, ValueError):
        return ""
    if not keys or host_key in keys:
        return ""
    entry = searched_name if host.port == SSH_PORT else f"[{searched_name}]:{host.port}"
    return (
        f"the host key of {host.ssh or host.address} port {host.port} is not the one in {known_hosts} (it shows "
        f"{host_key.get_fingerprint()}); another machine may pose as {name}; ask who runs it, and only if the key was "
        f"changed there, remove the old one ({shlex.join(['ssh-keygen', '-f', path, '-R', entry])}) and add the new one"
    )


def _reason(name: str, host: Host, base: Path, known_hosts: Path, error: Exception) -> str:
    """Return why a connection failed, and what to do."""
    address = host.ssh or host.address
    at = f"{address} port {host.port}"
    user = host.user or getpass.getuser()
    key = f"key {base / Path(host.key).expanduser()}" if host.key else "the keys of ~/.ssh and the agent"
    match error:
        case asyncssh.HostKeyNotVerifiable():
            scan = shlex.join(["ssh-keyscan", "-p", str(host.port), address])
            return f"the host key of {at} is not in {known_hosts}; check it and add it: {scan} >> {known_hosts}"
        case asyncssh.PermissionDenied():
            return f"ssh at {at} refuses user {user} with {key}; correct hosts.{name}.user or key, or run ssh-copy-id"
        case asyncssh.KeyImportError() if "Passphrase" in str(error):
            return f"{key} has a passphrase; add it to the agent with ssh-add and leave hosts.{name}.key out"
        case asyncssh.KeyImportError():
            return f"{key} is not a private key ({error}); correct hosts.{name}.key"
        case OSError() if error.filename:
            return f"{error.filename} cannot be read ({error.strerror}); correct hosts.{name}.key or known_hosts"
        case TimeoutError() if error.errno is None:
            return f"ssh at {at} did not answer within {CONNECT_S:g} s; is it on, the address right, and the port open?"
        case socket.gaierror():
            return f"address {address!r} cannot be resolved; correct hosts.{name}.address or ssh"
        case OSError():
            cause = os.strerror(error.errno) if error.errno else error
            return f"ssh at {at} cannot be reached ({cause}); is sshd running there and the port open?"
        case _:
            return f"ssh at {at} failed ({error}); try `ssh -p {host.port} {user}@{address}`"
