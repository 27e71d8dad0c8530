"""A topic that we publish: each subscriber has a bounded queue of its own."""

import asyncio
import contextlib
from asyncio import StreamReader, StreamWriter
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from zsim_bridges.ros1.wire import message_types, tcpros, tcpros_streams


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
        with contextlib.suppress(*tcpros_streams.CONNECTION_ERRORS):
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
        framed = tcpros.frame(message_types.serialize(self.offer.type, make(self.sent)))
        self.sent += 1
        for outlet in self.links:
            outlet.put(framed)

    async def serve(self, reader: StreamReader, writer: StreamWriter, header: Mapping[str, str], caller: str) -> None:
        """Serve a subscriber whose header has come until it goes; `caller` is this node's name."""
        refusal = tcpros.mismatch(self.offer, header, caller)
        if refusal:
            await tcpros_streams.send_error(writer, refusal)
            return
        tcpros_streams.configure(writer, header.get("tcp_nodelay") == "1")
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
