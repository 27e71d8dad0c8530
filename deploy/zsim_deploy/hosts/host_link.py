"""The launcher's way to the hosts of an inventory: ssh connections, commands and programs on them, files both ways.

Every failure is one line: host, what failed, what to do. All connections live on one event loop in a thread of its own
(`EventLoopThread`), so that the supervisor of a run stays a plain loop.
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
from typing import Any, NamedTuple, TypeVar

import asyncssh
from asyncssh.constants import OPEN_REQUEST_SESSION_FAILED

from zsim.errors import HostsError, ZsimError
from zsim_deploy.inventory import SSH_PORT, Host, InventoryFile

CONNECT_S = 10.0  # wall time; a host on a poor link answers within a few round trips
KEEPALIVE_S = 15.0  # asked when nothing came for so long …
KEEPALIVE_COUNT = 4  # … and given up after a minute: a link that is cut for 20 s keeps its connection
NO_SFTP = "its sshd has no SFTP; set `Subsystem sftp internal-sftp` in sshd_config there and restart sshd"
ECHO_S = 0.5  # how often a line goes to the host and back
RETRY_S = 0.5  # between two attempts to connect again
CLOSE_S = 1.0  # how long a connection may take to close; a cut one never does
ANSWER_S = 10.0  # how long a short command may take; a host on a poor link answers within a few round trips
CHANNELS = 8  # kept open on one connection; sshd allows 10 (MaxSessions of sshd_config(5)), and a closed one goes later
OPEN_S = 10.0  # until the host lets us read; a few round trips of a poor link
STALL_S = 20.0  # without anything more the host is taken for lost; TCP repeats within that what a poor link loses
BLOCK_BYTES = 32_768  # asked for at once; even at 100 kbit/s one comes within 3 s

Result = TypeVar("Result")
Connection = asyncssh.SSHClientConnection


class EventLoopThread:
    """An event loop in a thread."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="ssh", daemon=True)
        self._thread.start()

    def call(self, work: Coroutine[Any, Any, Result], timeout_s: float | None = None) -> Result:
        """Run a coroutine to its end and return its result.

        Raises:
            TimeoutError: it took longer; it is cancelled.
        """
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout_s)
        except BaseException:
            future.cancel()  # Ctrl-C, too
            raise

    def spawn(self, work: Coroutine[Any, Any, None]) -> Future[None]:
        """Start a coroutine without waiting for it; it can be cancelled."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def call_soon(self, act: Any, *args: Any) -> None:
        """Call a plain function on the loop's thread."""
        self._loop.call_soon_threadsafe(act, *args)

    def close(self) -> None:
        """Cancel what runs, and end the thread."""

        async def cancel_all() -> None:
            others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            for task in others:
                task.cancel()
            await asyncio.wait(others, timeout=CLOSE_S / 2) if others else None

        self.call(cancel_all(), CLOSE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_S)
        if not self._thread.is_alive():
            self._loop.close()


class HostLink:
    """One host; more connections are opened to it as one has no room for another channel.

    Args:
        base: folder of the inventory, from which relative paths count.

    Attributes:
        round_trip_s: of the last line that came back.
        answered_s: monotonic time of it; 0 before the first.
    """

    def __init__(self, name: str, host: Host, base: Path) -> None:
        self.name = name
        self.host = host
        self.round_trip_s = 0.0
        self.answered_s = 0.0
        self._base = base
        self._channels: dict[Connection, int] = {}  # in use, by connection
        self._lock = asyncio.Lock()

    async def open(self) -> Connection:
        """Return a connection on which there is room for a short use, made anew where it is lost.

        Raises:
            HostsError: the host cannot be reached, or does not let us in.
        """
        async with self._lock:
            return await self._with_room()

    @contextlib.asynccontextmanager
    async def channel(self, retry: bool = False) -> AsyncIterator[Connection]:
        """Yield a connection for one channel.

        Args:
            retry: try until the host is there.

        Raises:
            HostsError: as `open`, if not retry.
        """
        connection = await self._reserved(retry)
        try:
            yield connection
        finally:
            if connection in self._channels:
                self._channels[connection] -= 1

    async def _reserved(self, retry: bool) -> Connection:
        while True:
            try:
                async with self._lock:
                    connection = await self._with_room()
                    self._channels[connection] += 1
                    return connection
            except HostsError:
                if not retry:
                    raise
            await asyncio.sleep(RETRY_S)

    async def _with_room(self) -> Connection:
        for connection, channels in list(self._channels.items()):
            if connection.is_closed():
                del self._channels[connection]
            elif channels < CHANNELS:
                return connection
        connection = await connect(self.name, self.host, self._base)
        self._channels[connection] = 0
        return connection

    async def run(
        self, command: str, stdin: bytes = b"", timeout_s: float = ANSWER_S, what: str = "", retry: bool = False
    ) -> bytes:
        """Return what a command prints.

        Args:
            command: line of a POSIX shell.
            what: it does, for errors; its first word if not given.
            retry: try until the host is there; the time counts from then.

        Raises:
            HostsError: it failed, or took too long; with the last line that it printed.
        """
        async with self.channel(retry) as connection:
            try:
                done = await asyncio.wait_for(connection.run(command, input=stdin, encoding=None), timeout_s)
            except TimeoutError as error:
                act = what or repr(command[:60])
                raise HostsError(f"{self.name}: no answer within {timeout_s:g} s to {act}") from error
            except (asyncssh.Error, OSError) as error:
                raise _broke(self.name, error) from error
        if done.exit_status != 0:
            said = done.stderr.decode(errors="replace") if isinstance(done.stderr, bytes) else str(done.stderr or "")
            lines = said.strip().splitlines() or ["it printed nothing"]
            what = what or command.split(" ", 1)[0]
            raise HostsError(f"{self.name}: {what} failed ({done.exit_status}): {lines[-1][:200]}")
        return done.stdout if isinstance(done.stdout, bytes) else b""

    async def put_files(
        self, folder: str, files: Mapping[str, bytes], timeout_s: float = ANSWER_S, retry: bool = False
    ) -> None:
        """Write files below a folder of the host, readable by their owner alone: all, or none where the link breaks.

        Args:
            folder: made if it is not there.
            files: path below the folder to content.
            retry: as `run`.

        Raises:
            HostsError: they could not be written.
        """
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for path, content in files.items():
                entry = tarfile.TarInfo(path)
                entry.size, entry.mode, entry.mtime = len(content), 0o600, int(time.time())
                tar.addfile(entry, io.BytesIO(content))
        archive, into = packed.getvalue(), shell_word(folder)
        part = f"{into}/.part.$$"  # others may be writing there at the same time
        is_whole = f"[ $(wc -c < {part}) -eq {len(archive)} ] || {{ echo it came in part >&2; false; }}"
        unpack = f"cat > {part} && {{ {is_whole}; }} && tar -xof {part} -C {into}"
        script = f"umask 077; mkdir -p {into} && {{ {unpack}; code=$?; rm -f {part}; exit $code; }}"
        await self.run(script, archive, timeout_s, what=f"writing into {folder}", retry=retry)

    async def measure_round_trips(self) -> None:
        """Send a line there and back indefinitely, so that a lost host is noticed within a second."""
        while True:
            with contextlib.suppress(HostsError, asyncssh.Error, OSError):
                async with self.channel() as connection, connection.create_process("cat", encoding="utf-8") as mirror:
                    sent_s = time.monotonic()
                    mirror.stdin.write(".\n")
                    while await mirror.stdout.readline():
                        self.answered_s = time.monotonic()
                        self.round_trip_s = self.answered_s - sent_s
                        await asyncio.sleep(ECHO_S)
                        sent_s = time.monotonic()
                        mirror.stdin.write(".\n")
            await asyncio.sleep(RETRY_S)

    def silent_s(self) -> float:
        """Return for how long the host has not answered."""
        return max(0.0, time.monotonic() - self.answered_s - ECHO_S) if self.answered_s else 0.0

    async def close(self) -> None:
        """Close all connections; what still runs there on their pipes ends by itself."""
        for connection in self._channels:
            connection.close()
        closed = asyncio.gather(*(each.wait_closed() for each in self._channels), return_exceptions=True)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(closed, CLOSE_S)


def _broke(name: str, error: Exception) -> HostsError:
    return HostsError(f"{name}: the connection broke ({error}); is the host up?")


class HostLinks:
    """A link to each host that takes part.

    Attributes:
        by_name: the links; a new dictionary when there is one more, for others look at it meanwhile.
    """

    def __init__(self, placed: InventoryFile, names: Iterable[str], loop: EventLoopThread) -> None:
        self._placed = placed
        self._loop = loop
        self.by_name = {name: self.to(name) for name in names}

    def to(self, name: str) -> HostLink:
        """Return a new link to a host of the inventory, which is not kept."""
        return HostLink(name, self._placed.inventory.hosts[name], self._placed.folder)

    def add(self, link: HostLink) -> None:
        self.by_name = {**self.by_name, link.name: link}
        self._loop.spawn(link.measure_round_trips())

    def listen(self) -> None:
        """Measure from now on whether each host answers."""
        for link in self.by_name.values():
            self._loop.spawn(link.measure_round_trips())

    def on_all(self, work: Callable[[HostLink], Coroutine[Any, Any, Any]], within_s: float) -> dict[str, Any]:
        """Run the same coroutine for all hosts at once; return the results by name.

        Raises:
            HostsError: it failed, or took longer, with a line for every such host.
        """

        async def bounded(link: HostLink) -> Any:
            try:
                return await asyncio.wait_for(work(link), within_s)
            except TimeoutError as error:
                why = f"not done within {within_s:g} s; is the link slow, the host busy?"
                raise HostsError(f"{link.name}: {why}") from error

        async def gathered() -> list[Any]:
            return await asyncio.gather(*map(bounded, self.by_name.values()), return_exceptions=True)

        return dict(zip(self.by_name, raise_faults(self._loop.call(gathered())), strict=True))

    def close(self) -> None:
        """Close all of them at once."""
        self.on_all(HostLink.close, 2 * CLOSE_S)


def raise_faults(results: list[Any]) -> list[Any]:
    """Return results that were gathered with exceptions; raise those of hosts as lines of one error, others as is."""
    for result in results:
        if isinstance(result, BaseException) and not isinstance(result, ZsimError):
            raise result
    if lines := list(dict.fromkeys(str(result) for result in results if isinstance(result, ZsimError))):
        raise HostsError("\n".join(lines))
    return results


# Programs on a host, and files from there


class ProgramEndedError(HostsError):
    """A program on a host has ended without an answer.

    Attributes:
        status: exit code.
        last: line that it printed on standard error; empty if it printed nothing.
    """

    def __init__(self, name: str, status: int | None, last: str) -> None:
        super().__init__(f"{name}: it ended with code {status} ({last or 'it printed nothing'})")
        self.status, self.last = status, last


class RemoteProgram:
    """A program on a host that answers each line that it reads with a line of JSON."""

    def __init__(self, host: str, process: "asyncssh.SSHClientProcess[str]") -> None:
        self._host = host
        self._process = process

    def send(self, text: str) -> None:
        self._process.stdin.write(text)

    async def answer(self, within_s: float, late: str = "") -> dict[str, Any]:
        """Return its next answer; a greeting of the login shell is skipped.

        Args:
            late: text of the error if it takes longer; empty for the usual one.

        Raises:
            ProgramEndedError: it has ended.
            HostsError: it took longer.
        """
        try:
            async with asyncio.timeout(within_s):
                while line := await self._process.stdout.readline():
                    if message := json_answer([line]):
                        return message
                lines = (await self._process.stderr.read()).strip().splitlines()
                await self._process.wait_closed()
        except TimeoutError as error:
            slow = f"no answer within {within_s:g} s; is the link slow, the host busy?"
            raise HostsError(f"{self._host}: {late or slow}") from error
        raise ProgramEndedError(self._host, self._process.exit_status, lines[-1][:200] if lines else "")


@contextlib.asynccontextmanager
async def open_program(link: HostLink, command: str) -> AsyncIterator[RemoteProgram]:
    """Run a program on a host as long as the block lasts.

    Raises:
        HostsError: the host cannot be reached, or the connection breaks.
    """
    try:
        async with link.channel() as connection:
            process = await connection.create_process(command, encoding="utf-8", errors="replace")
            try:
                yield RemoteProgram(link.name, process)
            finally:
                process.close()  # not waited for: on a link that is cut it would take a minute
    except (asyncssh.Error, OSError) as error:
        raise _broke(link.name, error) from error


async def fetch(link: HostLink, source: str, into: Path) -> bool:
    """Copy a file from a host, under its name only when it is whole; return False if there is none.

    Args:
        source: path there; a leading ~/ is the home.
        into: path here; what has come so far lies beside it, with .part at the end.

    Raises:
        HostsError: it cannot be read, the host has no SFTP or does not answer, or nothing came any more.
        OSError: it cannot be written here.
    """
    part = into.with_name(f"{into.name}.part")
    try:
        async with link.channel() as connection:
            sftp = await asyncio.wait_for(start_sftp(link.name, connection), OPEN_S)
            try:
                await _copy(sftp, source.removeprefix("~/"), part)
            finally:
                sftp.exit()  # not waited for: a link that is cut does not report that it has closed
    except TimeoutError as error:
        raise HostsError(f"{link.name}: no answer within {OPEN_S:g} s") from error
    except asyncssh.SFTPNoSuchFile:
        return False
    except asyncssh.Error as error:
        raise HostsError(f"{link.name}: {error}") from error
    part.replace(into)
    return True


async def _copy(sftp: asyncssh.SFTPClient, source: str, into: Path) -> None:
    moved = asyncio.Event()
    copy = asyncio.create_task(
        sftp.get(source, into, block_size=BLOCK_BYTES, progress_handler=lambda *_: moved.set()),
    )
    copy.add_done_callback(
        lambda task: task.cancelled() or task.exception()
    )  # else asyncio reports one that nobody retrieved
    try:
        while not (await asyncio.wait([copy], timeout=STALL_S))[0]:
            if not moved.is_set():
                raise HostsError(f"nothing came for {STALL_S:g} s; what did is {into}")
            moved.clear()
    finally:
        copy.cancel()
    copy.result()


async def start_sftp(name: str, connection: Connection) -> asyncssh.SFTPClient:
    """Return a way to copy files over a connection.

    Raises:
        HostsError: the host has no SFTP.
        asyncssh.Error: the connection broke.
    """
    try:
        return await connection.start_sftp_client()
    except asyncssh.ChannelOpenError as error:
        if error.code != OPEN_REQUEST_SESSION_FAILED:
            raise
        raise HostsError(f"{name}: {NO_SFTP}") from error
    except (asyncssh.SFTPConnectionLost, asyncssh.SFTPEOFError) as error:
        if connection.is_closed():
            raise
        raise HostsError(f"{name}: {NO_SFTP}") from error


def shell_word(path: str) -> str:
    """Return a path as one word of a shell; a leading ~/ stays the home of the user there."""
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


# Connecting


class Refused(NamedTuple):
    """A host key that is not trusted, and under which name, address and port it was looked for."""

    host: str
    address: str
    port: int
    key: asyncssh.SSHKey


class _Client(asyncssh.SSHClient):
    """Notes the host key that is refused."""

    refused: Refused | None = None

    def validate_host_public_key(self, host: str, addr: str, port: int, key: asyncssh.SSHKey) -> bool:
        self.refused = Refused(host, addr, port, key)
        return False


async def connect(name: str, host: Host, base: Path) -> Connection:
    """Connect to a host.

    Args:
        name: of the host in the inventory, for errors.
        host: its entry in the inventory; ~/.ssh/config fills in what that leaves open.
        base: folder of the inventory, from which relative paths of `key` and `known_hosts` count.

    Raises:
        HostsError: it cannot be reached, has another key than known_hosts, or refuses the user or key.
    """
    client = _Client()
    options: dict[str, Any] = {"keepalive_interval": KEEPALIVE_S, "keepalive_count_max": KEEPALIVE_COUNT}
    if host.user is not None:
        options["username"] = host.user
    try:
        if host.key is not None:
            options["client_keys"] = [str(_path(base, host.key))]
        if host.known_hosts is not None:
            options["known_hosts"] = str(_path(base, host.known_hosts))
        opening = asyncssh.connect(host.ssh or host.address, host.port, client_factory=lambda: client, **options)
        return await asyncio.wait_for(opening, CONNECT_S)
    except (asyncssh.Error, asyncssh.KeyImportError, OSError, ValueError, TimeoutError) as error:
        refused = client.refused or await _shown_key(host, error)
        reason = _changed_key(name, host, base, refused) or _reason(name, host, base, error)
        raise HostsError(f"{name}: {reason}") from error


def _path(base: Path, path: str) -> Path:
    return base / Path(path).expanduser()


def _known_hosts(host: Host, base: Path) -> Path:
    return _path(base, host.known_hosts) if host.known_hosts else Path("~/.ssh/known_hosts")


async def _shown_key(host: Host, error: Exception) -> Refused | None:
    """Return the host key of a host with which there was none to agree on: only known kinds are asked for."""
    if not isinstance(error, asyncssh.ConnectionLost | asyncssh.KeyExchangeFailed | ConnectionResetError):
        return None
    address = host.ssh or host.address
    try:
        key = await asyncio.wait_for(asyncssh.get_server_host_key(address, host.port), CONNECT_S)
    except (asyncssh.Error, OSError, ValueError, TimeoutError):
        return None
    return Refused(address, "", host.port, key) if key else None


def _changed_key(name: str, host: Host, base: Path, refused: Refused | None) -> str:
    """Return that a host shows another key than is known of it, where it does; empty otherwise."""
    if refused is None:
        return ""
    known, port = _known_hosts(host, base), None if refused.port == SSH_PORT else refused.port
    try:
        keys = asyncssh.match_known_hosts(str(known.expanduser()), refused.host, refused.address, port)[0]
    except (OSError, ValueError):
        return ""
    if not keys or refused.key in keys:
        return ""
    at = f"{host.ssh or host.address} port {host.port}"
    entry = refused.host if host.port == SSH_PORT else f"[{refused.host}]:{host.port}"
    forget = shlex.join(["ssh-keygen", "-f", str(known.expanduser()), "-R", entry])
    return (
        f"the host key of {at} is not the one in {known} (it shows {refused.key.get_fingerprint()}); another machine "
        f"may pose as {name}; ask who runs it, and only if the key was changed there, remove the old one ({forget}) "
        "and add the new one"
    )


def _reason(name: str, host: Host, base: Path, error: Exception) -> str:
    """Describe what failed and what to do."""
    address = host.ssh or host.address
    at = f"{address} port {host.port}"
    user = host.user or getpass.getuser()
    known = _known_hosts(host, base)
    key = f"key {_path(base, host.key)}" if host.key else "the keys of ~/.ssh and the agent"
    match error:
        case asyncssh.HostKeyNotVerifiable():
            scan = shlex.join(["ssh-keyscan", "-p", str(host.port), address])
            return f"the host key of {at} is not in {known}; check it and add it: {scan} >> {known}"
        case asyncssh.PermissionDenied():
            return f"ssh at {at} refuses user {user} with {key}; correct hosts.{name}.user or key, or run ssh-copy-id"
        case asyncssh.KeyImportError() if "Passphrase" in str(error):
            return f"{key} has a passphrase; add it to the agent with ssh-add and leave hosts.{name}.key out"
        case asyncssh.KeyImportError():
            return f"{key} is no private key ({error}); correct hosts.{name}.key"
        case OSError() if error.filename:
            return f"{error.filename} cannot be read ({error.strerror}); correct hosts.{name}.key or known_hosts"
        case TimeoutError() if error.errno is None:
            return f"ssh at {at} did not answer within {CONNECT_S:g} s; is it on, is the address right, the port open?"
        case socket.gaierror():
            return f"address {address!r} is not known; correct hosts.{name}.address or ssh"
        case OSError():
            why = os.strerror(error.errno) if error.errno else error
            return f"ssh at {at} cannot be reached ({why}); is sshd on there, the port open?"
        case _:
            return f"ssh at {at} failed ({error}); try `ssh -p {host.port} {user}@{address}`"
