"""The drone's FTP server, as far as programs of the SDK use it: anonymous, passive, one file `version.txt`.

Source: RFC 959; ARDroneLib, ardrone_ftp.c and its check of the firmware's version.
"""

import asyncio
from collections.abc import Callable

from zsim_bridges.ardrone.ports import AllowedHosts, StreamPort

VERSION_PORT, FILES_PORT = 5551, 21  # TCP (ARDroneLib, config.h): of the version, and of videos
VERSION_FILES = {"version.txt": b"2.4.8\r\n"}  # the newest firmware of an AR.Drone 2.0
DATA_WITHIN_S = 10.0  # s of wall time within which a client must open the data connection, chosen
IDLE_S = 300.0  # s of wall time without a command, chosen
_FIXED = {
    "USER": "230 logged in",
    "PASS": "230 logged in",
    "SYST": "215 UNIX Type: L8",
    "TYPE": "200 type set",
    "MODE": "200 mode set",
    "STRU": "200 structure set",
    "NOOP": "200 ok",
    "PWD": '257 "/" is the directory',
    "CWD": "250 ok",
    "CDUP": "250 ok",
}


class FileServer:
    """An FTP server.

    Args:
        address: on which it listens.
        peers: who may connect.
        files: contents by name.
        refuse: counts what is not served, with the reason.
    """

    def __init__(
        self, address: str, peers: AllowedHosts, files: dict[str, bytes], refuse: Callable[[str], None]
    ) -> None:
        self._address = address
        self._peers = peers
        self._files = files
        self._refuse = refuse
        self.port = StreamPort(peers, self._serve, refuse)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        data: StreamPort | None = None
        waiting: asyncio.Queue[bytes | None] = asyncio.Queue(1)
        _reply(writer, "220 AR.Drone")
        try:
            while line := await asyncio.wait_for(reader.readline(), IDLE_S):
                verb, _, argument = line.decode("ascii", "replace").strip().partition(" ")
                verb = verb.upper()
                if verb == "QUIT":
                    _reply(writer, "221 bye")
                    return
                if verb in ("PASV", "EPSV"):
                    if data is not None:
                        await data.close()
                    data, waiting = await self._open_data(writer, verb)
                elif verb in ("RETR", "LIST", "NLST"):
                    await self._transfer(writer, data, waiting, verb, argument)
                    data = None
                elif verb == "SIZE":
                    content = self._files.get(argument.lstrip("/"))
                    _reply(writer, "550 no such file" if content is None else f"213 {len(content)}")
                else:
                    _reply(writer, _FIXED.get(verb, "502 not implemented"))
                await writer.drain()
        finally:
            if data is not None:
                await data.close()

    async def _open_data(self, writer: asyncio.StreamWriter, verb: str) -> tuple[StreamPort, asyncio.Queue]:
        """Listen for a data connection, and reply with its address."""
        waiting: asyncio.Queue[bytes | None] = asyncio.Queue(1)

        async def send(_: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
            content = await asyncio.wait_for(waiting.get(), DATA_WITHIN_S)
            to.write(content or b"")
            await to.drain()
            waiting.task_done()

        data = StreamPort(self._peers, send, self._refuse)
        port = await data.open(self._address, 0)
        place = ",".join([*self._address.split("."), str(port >> 8), str(port & 0xFF)])
        _reply(writer, f"227 passive ({place})" if verb == "PASV" else f"229 passive (|||{port}|)")
        return data, waiting

    async def _transfer(
        self, writer: asyncio.StreamWriter, data: StreamPort | None, waiting: asyncio.Queue, verb: str, argument: str
    ) -> None:
        name = argument.lstrip("/")
        if data is None:
            _reply(writer, "425 use PASV first")
        elif verb == "RETR" and name not in self._files:
            _reply(writer, "550 no such file")
        else:
            listing = "".join(f"{each}\r\n" for each in self._files).encode("ascii")
            _reply(writer, "150 it comes")
            waiting.put_nowait(self._files[name] if verb == "RETR" else listing)
            await asyncio.wait_for(waiting.join(), DATA_WITHIN_S)
            _reply(writer, "226 done")
        if data is not None:
            await data.close()


def _reply(writer: asyncio.StreamWriter, text: str) -> None:
    writer.write(f"{text}\r\n".encode("ascii"))
