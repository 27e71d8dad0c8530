"""A service without arguments that we offer."""

from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Mapping

from zsim_bridges.ros1.wire import tcpros, tcpros_streams

DONE, FAILED = b"\x01", b"\x00"


class EmptyService:
    """One service of type std_srvs/Empty.

    Args:
        offer: name and type.
        act: does what is asked for; returns why not, None where it is done.
    """

    def __init__(self, offer: tcpros.TopicType, act: Callable[[], str | None]) -> None:
        self.offer = offer
        self._act = act

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a client whose header has come until it goes; `caller` is this node's name."""
        refusal = tcpros.mismatch(self.offer, header, caller)
        if refusal:
            await tcpros_streams.send_error(writer, refusal)
            return
        tcpros_streams.configure(writer, True)
        writer.write(tcpros.encode_header(tcpros.service_header(self.offer, caller)))
        await writer.drain()
        asks = header.get("probe") != "1"
        while asks:
            request = await tcpros_streams.read_frame(reader)
            writer.write(self._answer(request))
            await writer.drain()
            asks = header.get("persistent") == "1"

    def _answer(self, request: bytes) -> bytes:
        reason = f"the request has {len(request)} bytes; must have none" if request else self._act()
        return FAILED + tcpros.frame(reason.encode()) if reason else DONE + tcpros.frame(b"")
