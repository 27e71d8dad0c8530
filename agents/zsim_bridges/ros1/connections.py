"""A topic that we publish: each subscriber has a bounded queue of its own.

A topic that we take: a connection to every node that publishes it, made again when it breaks.

A service without arguments that we offer.
"""

import asyncio
import contextlib
from asyncio import StreamReader, StreamWriter, Task
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from typing import Any

from zsim.errors import ZsimError
from zsim_bridges.ros1 import master_api, tcpros


class SubscriberLink:
    """One subscriber's connection; a full queue loses the oldest.

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
        """Take a message; never waits."""
        self.lost += len(self._queue) == self._queue.maxlen
        self._queue.append(framed)
        self._news.set()

    async def run(self) -> None:
        """Send what is put, until the connection ends."""
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
    """One topic.

    Args:
        offer: name, type and definition.
        queue_size: messages that a slow subscriber may be behind.

    Attributes:
        outlets: who subscribes.
        count: messages published.
    """

    def __init__(self, offer: tcpros.TopicType, queue_size: int) -> None:
        self.offer = offer
        self._queue_size = queue_size
        self.links: list[SubscriberLink] = []
        self.sent = 0

    def publish(self, make: Callable[[int], Any]) -> None:
        """Send the message that `make` returns for a sequence number; it is asked only where somebody listens."""
        if not self.links:
            return
        framed = tcpros.frame(tcpros.serialize(self.offer.type, make(self.sent)))
        self.sent += 1
        for outlet in self.links:
            outlet.put(framed)

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a subscriber whose header has come until it goes; `caller` is this node's name."""
        refusal = tcpros.mismatch(self.offer, header, caller)
        if refusal:
            await tcpros.send_error(writer, refusal)
            return
        tcpros.configure(writer, header.get("tcp_nodelay") == "1")
        writer.write(tcpros.encode_header(tcpros.publisher_header(self.offer, caller)))
        outlet = SubscriberLink(writer, header["callerid"], self._queue_size)
        sender = asyncio.create_task(outlet.run())
        self.links.append(outlet)
        try:
            while await reader.read(4096):
                pass  # a subscriber has nothing more to say
        finally:
            self.links.remove(outlet)
            sender.cancel()


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
            except (*tcpros.CONNECTION_ERRORS, *master_api.CALL_ERRORS):
                if uri in self._wanted:
                    await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, RETRY_MAX_S)
        del self._tasks[uri]

    @contextlib.asynccontextmanager
    async def _connection(self, uri: str) -> AsyncIterator[StreamReader]:
        """Yield what a publisher sends after its header."""
        ask = [self._caller, self.offer.name, [["TCPROS"]]]
        answer = await asyncio.to_thread(master_api.call_api, uri, "requestTopic", *ask)
        protocol, host, port = answer
        if protocol != "TCPROS":
            raise RefusedError(f"speaks {str(protocol)[:20]!r}; must be TCPROS")
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
        writer.write(tcpros.encode_header(tcpros.subscriber_header(self.offer, self._caller)))
        header = await tcpros.read_header(reader)
        error = header.get("error") or tcpros.mismatch(self.offer, {"callerid": "?", **header}, self._caller)
        if error:
            raise RefusedError(error[:300])
        return header.get("callerid", "?")

    async def _receive(self, reader: StreamReader, uri: str) -> None:
        while True:
            data = await tcpros.read_frame(reader)
            try:
                self._callback(tcpros.deserialize(self.offer.type, data))
            except (ValueError, ZsimError) as error:
                self.refused += 1
                self._report_once(uri, str(error))

    def _report_once(self, uri: str, what: str) -> None:
        if uri not in self._reported:
            self._reported.add(uri)
            self._say(f"{self.offer.name}: what {self.connected.get(uri, uri)} sends is refused: {what}")


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
            await tcpros.send_error(writer, refusal)
            return
        tcpros.configure(writer, True)
        writer.write(tcpros.encode_header(tcpros.service_header(self.offer, caller)))
        await writer.drain()
        asks = header.get("probe") != "1"
        while asks:
            request = await tcpros.read_frame(reader)
            writer.write(self._answer(request))
            await writer.drain()
            asks = header.get("persistent") == "1"

    def _answer(self, request: bytes) -> bytes:
        reason = f"the request has {len(request)} bytes; must have none" if request else self._act()
        return FAILED + tcpros.frame(reason.encode()) if reason else DONE + tcpros.frame(b"")
