"""The ports of one drone, and the aircraft behind them."""

import errno
from collections.abc import Callable
from typing import Any

from zsim.errors import RunError
from zsim.scenario.scenario import Drone
from zsim_bridges.ardrone.aircraft.aircraft import Aircraft, Outlets
from zsim_bridges.ardrone.server import datagram_ports, file_server
from zsim_bridges.ardrone.server.addresses import AllowedHosts
from zsim_bridges.ardrone.server.datagram_ports import Address, DatagramPort, open_datagram_port
from zsim_bridges.ardrone.server.file_server import FileServer
from zsim_bridges.ardrone.server.stream_port import StreamPort, read_until_end
from zsim_bridges.ardrone.server.video_server import VideoServer
from zsim_bridges.ardrone.wire import at_commands, configuration_text, navdata, pave

NOT_PERMITTED = (errno.EACCES, errno.EPERM)  # of a port below 1024, where this process may not have it


class DroneServer:
    """One drone on its address.

    Args:
        drone: its name, limits and sensors.
        address: on which its ports are.
        peers: who is obeyed.
        source: process name under which commands are sent.
        gate_ns: of the run.
        put: publishes a message on a key.
        refuse: counts what is not obeyed, with the reason.
    """

    def __init__(
        self,
        drone: Drone,
        address: str,
        peers: AllowedHosts,
        source: str,
        gate_ns: int,
        put: Callable[[str, Any], None],
        refuse: Callable[[str], None],
    ) -> None:
        self.address = address
        self._name = drone.name
        self._refuse = lambda reason: refuse(f"{drone.name}: {reason}")
        self._navdata = DatagramPort(peers, self._on_navdata_request, self._refuse)
        self._commands = DatagramPort(peers, self._on_commands, self._refuse)
        self._authentication = DatagramPort(peers, self._on_question, self._refuse)
        self._control = StreamPort(peers, read_until_end, self._refuse)
        outlets = Outlets(put, self._navdata.send, self._control.broadcast, refuse)
        self.aircraft = Aircraft(drone, source, gate_ns, outlets)
        self.video = VideoServer(peers, self._refuse)
        self._version = FileServer(address, peers, file_server.VERSION_FILES, self._refuse)
        self._files = FileServer(address, peers, {}, self._refuse)
        self._streams = (self._control, self.video.port, self._version.port, self._files.port)

    async def open(self) -> list[str]:
        """Open all ports; return a line for each that could be done without and may not be had.

        Raises:
            RunError: a port is taken, or the address is not this host's.
        """
        for protocol, port in (
            (self._navdata, navdata.PORT),
            (self._commands, at_commands.PORT),
            (self._authentication, datagram_ports.AUTHENTICATION_PORT),
        ):
            try:
                await open_datagram_port(self.address, port, protocol)
            except OSError as error:
                raise self._not_had(port, "UDP", error) from error
        for stream, port in (
            (self._control, configuration_text.PORT),
            (self.video.port, pave.PORT),
            (self._version.port, file_server.VERSION_PORT),
        ):
            await self._listen(stream, port)
        return await self._open_files()

    async def _listen(self, stream: StreamPort, port: int) -> None:
        try:
            await stream.open(self.address, port)
        except OSError as error:
            raise self._not_had(port, "TCP", error) from error

    async def _open_files(self) -> list[str]:
        """Open port 21, which needs a privilege and few programs."""
        try:
            await self._files.port.open(self.address, file_server.FILES_PORT)
        except OSError as error:
            why = "needs a privilege" if error.errno in NOT_PERMITTED else error.strerror
            return [f"{self._name}: TCP port {file_server.FILES_PORT} is left out ({why}); ps_drone looks there"]
        return []

    def _not_had(self, port: int, kind: str, error: OSError) -> RunError:
        why = {
            errno.EADDRINUSE: "another program has it; end that, or give other --addresses",
            errno.EADDRNOTAVAIL: "the address is not this host's; give one that is, as --addresses",
        }.get(error.errno or 0, error.strerror or str(error))
        return RunError(f"{self._name}: {kind} port {port} of {self.address} cannot be had: {why}")

    async def close(self) -> None:
        """Close all ports."""
        for protocol in (self._navdata, self._commands, self._authentication):
            protocol.close()
        self.video.close()
        for stream in self._streams:
            await stream.close()

    def _on_navdata_request(self, datagram: bytes, address: Address) -> None:
        self.aircraft.on_navdata_request(datagram, address)

    def _on_commands(self, datagram: bytes, _: Address) -> None:
        self.aircraft.on_at(datagram)

    def _on_question(self, datagram: bytes, address: Address) -> None:
        if datagram.startswith(datagram_ports.QUESTION):
            self._authentication.send(datagram_ports.ANSWER, address)
        else:
            self._refuse("a datagram on the authentication port is no PARROT AUTH")
