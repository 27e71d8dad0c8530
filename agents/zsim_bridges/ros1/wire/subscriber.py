"""A topic that we take: a connection to every node that publishes it, made again when it breaks."""

import asyncio
import contextlib
from asyncio import StreamReader, StreamWriter, Task
from collections.abc import AsyncIterator, Callable, Iterable
from typing import Any

from zsim.errors import ZsimError
from zsim_bridges.ros1.wire import message_types, tcpros, tcpros_streams, xmlrpc

RETRY_S, RETRY_MAX_S = 0.5, 8.0  # wall time between attempts, doubling


class RefusedError(ValueError):
    """A publisher that speaks of something else."""


class SubscribedTopic:
    """One topic.

    Args:
        offer: name, type and definition.
        caller: this node's name.
        take: takes each message; raises ValueError for one that it refuses.
        say: told of every publisher once that it is refused.

    Attributes:
        connected: callers that publish, by their slave API's URI.
        refused: messages.
    """

    def __init__(
        self, offer: tcpros.TopicType, caller: str, take: Callable[[Any], None], say: Callable[[str], None]
    ) -> None:
        self.offer = offer
        self._caller = caller
        self._callback = take
        self._say = say
        self._wanted: set[str] = set()
        self._tasks: dict[str, Task[None]] = {}
        self._reported: set[str] = set()
        self.connected: dict[str, str] = {}
        self.refused = 0

    def update(self, publishers: Iterable[str], only: bool = True) -> None:
        """Follow these publishers, given by the URIs of their slave APIs; `only` them, or these too.

        What a publisher said before it left the graph may still be on its way, so its connection is read to the end.
        """
        self._wanted = set(publishers) | (set() if only else self._wanted)
        for uri in self._wanted - set(self._tasks):
            self._tasks[uri] = asyncio.create_task(self._follow(uri))
        for uri in set(self._tasks) - self._wanted - set(self.connected):
            self._tasks.pop(uri).cancel()

    async def close(self) -> None:
        """Follow nobody any more."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _follow(self, uri: str) -> None:
        pause_s = RETRY_S
        while uri in self._wanted:
            try:
                async with self._connection(uri) as reader:
                    pause_s = RETRY_S
                    await self._receive(reader, uri)
            except RefusedError as error:
                self._report_once(uri, str(error))
                return
            except (*tcpros_streams.CONNECTION_ERRORS, *xmlrpc.CALL_ERRORS):
                if uri in self._wanted:
                    await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, RETRY_MAX_S)
        del self._tasks[uri]

    @contextlib.asynccontextmanager
    async def _connection(self, uri: str) -> AsyncIterator[StreamReader]:
        """Yield what a publisher sends after its header."""
        ask = [self._caller, self.offer.name, [["TCPROS"]]]
        answer = await asyncio.to_thread(xmlrpc.call_api, uri, "requestTopic", *ask)
        protocol, host, port = answer
        if protocol != "TCPROS":
            raise RefusedError(f"speaks {str(protocol)[:20]!r}; must be TCPROS")
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), tcpros_streams.HANDSHAKE_S)
        try:
            self.connected[uri] = await self._shake_hands(reader, writer)
            yield reader
        finally:
            self.connected.pop(uri, None)
            writer.transport.abort()

    async def _shake_hands(self, reader: StreamReader, writer: StreamWriter) -> str:
        """Exchange headers; return the publisher's name."""
        tcpros_streams.configure(writer, True)
        writer.write(tcpros.encode_header(tcpros.subscriber_header(self.offer, self._caller)))
        header = await tcpros_streams.read_header(reader)
        error = header.get("error") or tcpros.mismatch(self.offer, {"callerid": "?", **header}, self._caller)
        if error:
            raise RefusedError(error[:300])
        return header.get("callerid", "?")

    async def _receive(self, reader: StreamReader, uri: str) -> None:
        while True:
            data = await tcpros_streams.read_frame(reader)
            try:
                self._callback(message_types.deserialize(self.offer.type, data))
            except (ValueError, ZsimError) as error:
                self.refused += 1
                self._report_once(uri, str(error))

    def _report_once(self, uri: str, what: str) -> None:
        if uri not in self._reported:
            self._reported.add(uri)
            self._say(f"{self.offer.name}: what {self.connected.get(uri, uri)} sends is refused: {what}")
