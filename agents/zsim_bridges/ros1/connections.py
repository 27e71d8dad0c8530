"""TCPROS connections of a node: topics that it publishes, topics that it subscribes to, and services."""

import asyncio
import contextlib
from asyncio import StreamReader, StreamWriter, Task
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from typing import Any

from zsim.errors import ZsimError
from zsim_bridges.ros1 import master_api, tcpros


class SubscriberLink:
    """The connection of one subscriber; a full queue loses the oldest message.

    Attributes:
        caller: name of the subscriber's node.
        sent: bytes.
        lost: messages.
    """

    def __init__(self, writer: StreamWriter, caller: str, queue_size: int) -> None:
        self._writer = writer
        self._queue: deque[bytes] = deque(maxlen=queue_size)
        self._news = asyncio.Event()
        self.caller = caller
        self.sent = 0
        self.lost = 0

    def put(self, framed: bytes) -> None:
        """Queue a message; never waits."""
        self.lost += len(self._queue) == self._queue.maxlen
        self._queue.append(framed)
        self._news.set()

    async def run(self) -> None:
        """Send queued messages, until the connection ends."""
        with contextlib.suppress(*tcpros.CONNECTION_ERRORS):
            while True:
                await self._news.wait()
                self._news.clear()
                while self._queue:
                    framed = self._queue.popleft()
                    self._writer.write(framed)
                    await self._writer.drain()
                    self.sent += len(framed)


class PublishedTopic:
    """A topic that the node publishes.

    Args:
        topic_type: name, type and definition.
        queue_size: messages that a slow subscriber may be behind.

    Attributes:
        links: its subscribers.
        sent: messages published.
    """

    def __init__(self, topic_type: tcpros.TopicType, queue_size: int) -> None:
        self.topic_type = topic_type
        self._queue_size = queue_size
        self.links: list[SubscriberLink] = []
        self.sent = 0

    def publish(self, make: Callable[[int], Any]) -> None:
        """Send the message that `make` returns for a sequence number; it is called only where there are subscribers."""
        if not self.links:
            return
        framed = tcpros.frame(tcpros.serialize(self.topic_type.type, make(self.sent)))
        self.sent += 1
        for link in self.links:
            link.put(framed)

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a subscriber whose header has come until it goes; `caller` is this node's name."""
        refusal = tcpros.mismatch(self.topic_type, header, caller)
        if refusal:
            await tcpros.send_error(writer, refusal)
            return
        tcpros.configure(writer, header.get("tcp_nodelay") == "1")
        writer.write(tcpros.encode_header(tcpros.publisher_header(self.topic_type, caller)))
        link = SubscriberLink(writer, header["callerid"], self._queue_size)
        sender = asyncio.create_task(link.run())
        self.links.append(link)
        try:
            while await reader.read(4096):
                pass  # a subscriber sends nothing more
        finally:
            self.links.remove(link)
            sender.cancel()


RETRY_S, RETRY_MAX_S = 0.5, 8.0  # wall time between attempts, doubling


class RefusedError(ValueError):
    """A publisher of another type."""


class SubscribedTopic:
    """A topic that the node subscribes to: a connection to each publisher, made again when it breaks.

    Args:
        topic_type: name, type and definition.
        caller: this node's name.
        callback: called with each message; raises ValueError for one that it refuses.
        say: prints once for each publisher that it is refused.

    Attributes:
        connected: names of connected publishers, by their slave API's URI.
        refused: messages.
    """

    def __init__(
        self, topic_type: tcpros.TopicType, caller: str, callback: Callable[[Any], None], say: Callable[[str], None]
    ) -> None:
        self.topic_type = topic_type
        self._caller = caller
        self._callback = callback
        self._say = say
        self._wanted: set[str] = set()
        self._tasks: dict[str, Task[None]] = {}
        self._reported: set[str] = set()
        self.connected: dict[str, str] = {}
        self.refused = 0

    def update(self, publishers: Iterable[str], only: bool = True) -> None:
        """Follow these publishers, given by the URIs of their slave APIs; `only` them, or these too.

        A publisher's messages from before it left the graph may still be on their way, so its connection is read to the
        end.
        """
        self._wanted = set(publishers) | (set() if only else self._wanted)
        for uri in self._wanted - set(self._tasks):
            self._tasks[uri] = asyncio.create_task(self._follow(uri))
        for uri in set(self._tasks) - self._wanted - set(self.connected):
            self._tasks.pop(uri).cancel()

    async def close(self) -> None:
        """Close all connections."""
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
            except (*tcpros.CONNECTION_ERRORS, *master_api.CALL_ERRORS):
                if uri in self._wanted:
                    await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, RETRY_MAX_S)
        del self._tasks[uri]

    @contextlib.asynccontextmanager
    async def _connection(self, uri: str) -> AsyncIterator[StreamReader]:
        """Yield the stream of a publisher after its header."""
        arguments = [self._caller, self.topic_type.name, [["TCPROS"]]]
        answer = await asyncio.to_thread(master_api.call_api, uri, "requestTopic", *arguments)
        protocol, host, port = answer
        if protocol != "TCPROS":
            raise RefusedError(f"protocol is {str(protocol)[:20]!r}; must be TCPROS")
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), tcpros.HANDSHAKE_S)
        try:
            self.connected[uri] = await self._shake_hands(reader, writer)
            yield reader
        finally:
            self.connected.pop(uri, None)
            writer.transport.abort()

    async def _shake_hands(self, reader: StreamReader, writer: StreamWriter) -> str:
        """Exchange headers; return the publisher's name."""
        tcpros.configure(writer, True)
        writer.write(tcpros.encode_header(tcpros.subscriber_header(self.topic_type, self._caller)))
        header = await tcpros.read_header(reader)
        error = header.get("error") or tcpros.mismatch(self.topic_type, {"callerid": "?", **header}, self._caller)
        if error:
            raise RefusedError(error[:300])
        return header.get("callerid", "?")

    async def _receive(self, reader: StreamReader, uri: str) -> None:
        while True:
            data = await tcpros.read_frame(reader)
            try:
                self._callback(tcpros.deserialize(self.topic_type.type, data))
            except (ValueError, ZsimError) as error:
                self.refused += 1
                self._report_once(uri, str(error))

    def _report_once(self, uri: str, reason: str) -> None:
        if uri not in self._reported:
            self._reported.add(uri)
            self._say(f"{self.topic_type.name}: what {self.connected.get(uri, uri)} sends is refused: {reason}")


DONE, FAILED = b"\x01", b"\x00"


class EmptyService:
    """A service of the node of type std_srvs/Empty.

    Args:
        topic_type: name and type.
        act: executes a request; returns why it failed, None where it did not.
    """

    def __init__(self, topic_type: tcpros.TopicType, act: Callable[[], str | None]) -> None:
        self.topic_type = topic_type
        self._act = act

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a client whose header has come until it goes; `caller` is this node's name."""
        refusal = tcpros.mismatch(self.topic_type, header, caller)
        if refusal:
            await tcpros.send_error(writer, refusal)
            return
        tcpros.configure(writer, True)
        writer.write(tcpros.encode_header(tcpros.service_header(self.topic_type, caller)))
        await writer.drain()
        expects_request = header.get("probe") != "1"
        while expects_request:
            request = await tcpros.read_frame(reader)
            writer.write(self._answer(request))
            await writer.drain()
            expects_request = header.get("persistent") == "1"

    def _answer(self, request: bytes) -> bytes:
        reason = f"the request has {len(request)} bytes; must have none" if request else self._act()
        return FAILED + tcpros.frame(reason.encode()) if reason else DONE + tcpros.frame(b"")
