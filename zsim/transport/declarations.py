"""What a session declares and hands out: subscriptions that are read, and queries that are answered."""

from collections.abc import Iterator

import zenoh

from zsim.contract import messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.errors import SessionError
from zsim.transport.samples import ReceivedSample

QUEUE_MAX = 1_000_000  # messages; a subscription that is not read blocks the whole link once it is full


class Subscription:
    """Everything that others publish on one expression, in the order of its arrival on this session.

    Args:
        raw: the session.
        prefix: of its keys.
        expression: what to take.
        without: beginnings of keys to leave out; then what this session itself publishes is left out too.
    """

    def __init__(self, raw: zenoh.Session, prefix: str, expression: str, without: tuple[str, ...] = ()) -> None:
        self._raw = raw
        self._without = without
        self._cut = len(prefix)
        self._key = None if "*" in expression else expression
        self.expression = expression
        self._wake_key = prefix + expression.replace("**", "wake").replace("*", "wake")
        origin = zenoh.Locality.REMOTE if without else zenoh.Locality.ANY
        channel = zenoh.handlers.FifoChannel(QUEUE_MAX)
        self._subscriber = raw.declare_subscriber(prefix + expression, channel, allowed_origin=origin)
        self._handler = self._subscriber.handler

    def receive(self) -> ReceivedSample | None:
        """Wait for one message; None when woken by `wake`.

        Raises:
            SessionError: the session, or the subscription, was closed meanwhile.
        """
        try:
            return self._take(self._handler.recv())
        except zenoh.ZError as error:
            raise SessionError(f"{self.expression}: is closed") from error

    def drain(self) -> Iterator[ReceivedSample]:
        """Yield what has arrived, without waiting."""
        while (raw := self._handler.try_recv()) is not None:
            sample = self._take(raw)
            if sample is not None:
                yield sample

    def wake(self) -> None:
        """Let a waiting `receive` return None; callable from any thread."""
        try:
            self._raw.put(self._wake_key, b"", allowed_destination=zenoh.Locality.SESSION_LOCAL)
        except zenoh.ZError:
            return  # closed: nobody waits any more

    def undeclare(self) -> None:
        """Take no more; a waiting `receive` raises SessionError."""
        self._subscriber.undeclare()

    def _take(self, raw: zenoh.Sample) -> ReceivedSample | None:
        key = self._key or str(raw.key_expr)[self._cut :]
        if self._without and key.startswith(self._without):
            return None
        payload = raw.payload.to_bytes()
        return ReceivedSample(key, payload) if payload else None  # empty: a wake, or a deletion; no message is


class Query:
    """A query to be answered once.

    Attributes:
        expression: the keys that are queried, without the prefix of the session.
        payload, attachment: as sent; empty where nothing was.
    """

    def __init__(self, raw: zenoh.Query, prefix: str) -> None:
        self._raw: zenoh.Query | None = raw
        self._prefix = prefix
        self.expression = str(raw.key_expr).removeprefix(prefix)
        self.payload = raw.payload.to_bytes() if raw.payload is not None else b""
        self.attachment = raw.attachment.to_bytes() if raw.attachment is not None else b""

    def request(self) -> ControlRequest:
        """Return the request in it; DecodeError if it is none."""
        return messages.decode_as(ControlRequest, self.payload, self.expression)

    def reply(self, key: str, payload: bytes) -> None:
        """Add one reply."""
        if self._raw is not None:
            self._raw.reply(self._prefix + key, payload, encoding=zenoh.Encoding(messages.encoding(key)))

    def reply_raw(self, key: str, payload: bytes, attachment: bytes) -> None:
        """Reply with a payload that is no message of the contract, and end the query."""
        if self._raw is not None:
            self._raw.reply(self._prefix + key, payload, attachment=attachment)
        self.end()

    def answer(self, answer: ControlAnswer) -> None:
        """Reply to a request and end it."""
        if self._raw is not None:
            encoding = zenoh.Encoding("application/msgpack;ControlAnswer")
            self._raw.reply(self._prefix + self.expression, messages.encode(answer), encoding=encoding)
        self.end()

    def end(self) -> None:
        """End the query; Zenoh lets its sender know when the last reference goes."""
        if self._raw is not None:
            self._raw.drop()
            self._raw = None
