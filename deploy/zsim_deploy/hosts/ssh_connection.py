"""Connections to the hosts of an inventory over ssh; every failure is one line: host, what failed, what to do.

Beside them the words of a command line for the shell over there, and the JSON line that a program of ours answers.
"""

import asyncio
import getpass
import json
import os
import shlex
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import asyncssh
from asyncssh.constants import OPEN_REQUEST_SESSION_FAILED

from zsim.errors import HostsError
from zsim_deploy.inventory.inventory import SSH_PORT, Host

CONNECT_S = 10.0  # wall time; a host on a poor link answers within a few round trips
KEEPALIVE_S = 15.0  # asked when nothing came for so long …
KEEPALIVE_COUNT = 4  # … and given up after a minute: a link that is cut for 20 s keeps its connection
NO_SFTP = "its sshd has no SFTP; set `Subsystem sftp internal-sftp` in sshd_config there and restart sshd"


async def connect(name: str, host: Host, base: Path) -> asyncssh.SSHClientConnection:
    """Connect to a host.

    Args:
        name: of the host in the inventory, for errors.
        host: its entry in the inventory; ~/.ssh/config fills in what that leaves open.
        base: folder of the inventory, from which relative paths of `key` and `known_hosts` count.

    Raises:
        HostsError: it cannot be reached, has another key than known_hosts, or refuses the user or key.
    """
    client = _Client()
    try:
        return await asyncio.wait_for(_open(host, base, client), CONNECT_S)
    except (asyncssh.Error, asyncssh.KeyImportError, OSError, ValueError, TimeoutError) as error:
        refused = client.refused or await _shown(host, error)
        reason = _changed(name, host, base, refused) or _reason(name, host, base, error)
        raise HostsError(f"{name}: {reason}") from error


async def start_sftp(name: str, connection: asyncssh.SSHClientConnection) -> asyncssh.SFTPClient:
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


def _open(host: Host, base: Path, client: _Client) -> Any:
    options: dict[str, Any] = {}
    if host.user is not None:
        options["username"] = host.user
    if host.key is not None:
        options["client_keys"] = [str(_path(base, host.key))]
    if host.known_hosts is not None:
        options["known_hosts"] = str(_path(base, host.known_hosts))
    return asyncssh.connect(
        host.ssh or host.address,
        host.port,
        client_factory=lambda: client,
        keepalive_interval=KEEPALIVE_S,
        keepalive_count_max=KEEPALIVE_COUNT,
        **options,
    )


def _path(base: Path, path: str) -> Path:
    return base / Path(path).expanduser()


def _known_hosts(host: Host, base: Path) -> Path:
    return _path(base, host.known_hosts) if host.known_hosts else Path("~/.ssh/known_hosts")


async def _shown(host: Host, error: Exception) -> Refused | None:
    """Return the host key of a host with which there was none to agree on: only known kinds are asked for."""
    if not isinstance(error, asyncssh.ConnectionLost | asyncssh.KeyExchangeFailed | ConnectionResetError):
        return None
    address = host.ssh or host.address
    try:
        key = await asyncio.wait_for(asyncssh.get_server_host_key(address, host.port), CONNECT_S)
    except (asyncssh.Error, OSError, ValueError, TimeoutError):
        return None
    return Refused(address, "", host.port, key) if key else None


def _changed(name: str, host: Host, base: Path, refused: Refused | None) -> str:
    """Return that a host shows another key than is known of it, where it does; empty otherwise."""
    known = _known_hosts(host, base)
    if refused is None or not _is_known_otherwise(known, refused):
        return ""
    at = f"{host.ssh or host.address} port {host.port}"
    entry = refused.host if host.port == SSH_PORT else f"[{refused.host}]:{host.port}"
    forget = shlex.join(["ssh-keygen", "-f", str(known.expanduser()), "-R", entry])
    return (
        f"the host key of {at} is not the one in {known} (it shows {refused.key.get_fingerprint()}); another machine "
        f"may pose as {name}; ask who runs it, and only if the key was changed there, remove the old one ({forget}) "
        "and add the new one"
    )


def _is_known_otherwise(known: Path, refused: Refused) -> bool:
    """Return whether there are keys of a host among the known ones, and not this one."""
    port = None if refused.port == SSH_PORT else refused.port
    try:
        keys = asyncssh.match_known_hosts(str(known.expanduser()), refused.host, refused.address, port)[0]
    except (OSError, ValueError):
        return False
    return bool(keys) and refused.key not in keys


def _reason(name: str, host: Host, base: Path, error: Exception) -> str:
    """Return what failed and what to do."""
    at = f"{host.ssh or host.address} port {host.port}"
    user = host.user or getpass.getuser()
    known = _known_hosts(host, base)
    key = f"key {_path(base, host.key)}" if host.key else "the keys of ~/.ssh and the agent"
    match error:
        case asyncssh.HostKeyNotVerifiable():
            scan = shlex.join(["ssh-keyscan", "-p", str(host.port), host.ssh or host.address])
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
            return f"address {host.ssh or host.address!r} is not known; correct hosts.{name}.address or ssh"
        case OSError():
            why = os.strerror(error.errno) if error.errno else error
            return f"ssh at {at} cannot be reached ({why}); is sshd on there, the port open?"
        case _:
            return f"ssh at {at} failed ({error}); try `ssh -p {host.port} {user}@{host.ssh or host.address}`"


def shell_word(path: str) -> str:
    """Return a path as one word of a shell; a leading ~/ stays the home of the user there."""
    return f"~/{shlex.quote(path[2:])}" if path.startswith("~/") else shlex.quote(path)


def shell_line(words: Iterable[str]) -> str:
    """Return a command line."""
    return " ".join(map(shell_word, words))


def json_answer(lines: Iterable[str]) -> dict[str, Any] | None:
    """Return the first JSON object among lines; None if there is none."""
    for line in lines:
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            return value
    return None
