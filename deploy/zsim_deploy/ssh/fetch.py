"""A file brought home from a host, for as long as something comes."""

import asyncio
from pathlib import Path

import asyncssh

from zsim.errors import HostsError
from zsim_deploy.ssh.host_link import HostLink

OPEN_S = 10.0  # until the host lets us read; a few round trips of a poor link
STALL_S = 20.0  # without anything more the host is taken for lost; TCP repeats within that what a poor link loses
BLOCK_BYTES = 32_768  # asked for at once; even at 100 kbit/s one comes within 3 s


async def fetch(link: HostLink, source: str, into: Path) -> bool:
    """Copy a file from a host, under its name only when it is whole; return False if there is none.

    Args:
        link: to the host.
        source: path there; a leading ~/ is the home.
        into: path here; beside it lies what has come, with .part at the end.

    Raises:
        HostsError: it cannot be read, the host does not answer, or nothing came any more.
        OSError: it cannot be written here.
    """
    part = into.with_name(f"{into.name}.part")
    try:
        async with link.channel() as connection:
            sftp = await asyncio.wait_for(connection.start_sftp_client(), OPEN_S)
            try:
                await _copy(sftp, source.removeprefix("~/"), part)
            finally:
                sftp.exit()  # not waited for: a link that is cut does not say that it has closed
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
    copy.add_done_callback(lambda task: task.cancelled() or task.exception())  # nobody else may ask for it
    try:
        while not (await asyncio.wait([copy], timeout=STALL_S))[0]:
            if not moved.is_set():
                raise HostsError(f"nothing came for {STALL_S:g} s; what did is {into}")
            moved.clear()
    finally:
        copy.cancel()
    copy.result()
