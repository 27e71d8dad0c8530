"""A ROS 2 context on rmw_zenoh's wire: nodes with publishers, subscriptions and services, over a Zenoh session."""

from collections.abc import Callable
from itertools import count
from typing import Any

from zsim.transport.declarations import Query
from zsim.transport.samples import RawSample
from zsim.transport.session import Session
from zsim_bridges.ros2 import rmw_zenoh
from zsim_bridges.ros2.rmw_zenoh import Attachment, Endpoint, NodeId, Qos
from zsim_bridges.ros2.ros_types import RosTypes, service_parts

CDR = "application/cdr"
OnRefused = Callable[[str, str], None]
"""Called with (name, reason) of a message that is refused, in threads of Zenoh's."""


class RosContext:
    """A context in the sense of ROS: the nodes of one process.

    Args:
        link: a session by full keys, without a federation.
        domain: ROS_DOMAIN_ID.
        types: of messages and services.
        wall_ns: time since 1970.
        refuse: see OnRefused.
    """

    def __init__(
        self, link: Session, domain: int, types: RosTypes, wall_ns: Callable[[], int], refuse: OnRefused
    ) -> None:
        self.link = link
        self.domain = domain
        self.types = types
        self.wall_ns = wall_ns
        self.refuse = refuse
        self._numbers = count()
        self._zid = link.zid()

    def node(self, namespace: str, name: str) -> "Ros2Node":
        """Return a new node, which other nodes see from now on."""
        return Ros2Node(self, NodeId(self.domain, self._zid, self.number(), namespace, name))

    def number(self) -> int:
        """Return the number of a new node or endpoint."""
        return next(self._numbers)

    def on_subscription(self, callback: Callable[[str, bool], None]) -> None:
        """Call back with (token, alive), in a thread of Zenoh's, for the subscriptions of all contexts."""
        self.link.on_token(rmw_zenoh.subscription_tokens(self.domain), callback)


class Ros2Node:
    """A node of a context."""

    def __init__(self, context: RosContext, identity: NodeId) -> None:
        self._context = context
        self._identity = identity
        context.link.declare_token(rmw_zenoh.node_token(identity))

    def publisher(self, topic: str, kind: str, qos: Qos) -> "Publisher":
        """Return a publisher of a topic, given by its full name."""
        endpoint, token = self._endpoint("MP", topic, kind, qos)
        publisher = Publisher(self._context, endpoint, kind, qos, rmw_zenoh.gid_of(token))
        self._declare(token)
        return publisher

    def subscription(self, topic: str, kind: str, qos: Qos, callback: Callable[[Any], None]) -> Callable[[], None]:
        """Call back with every message on a topic, in a thread of Zenoh's, until the returned function is called."""
        context = self._context
        endpoint, token = self._endpoint("MS", topic, kind, qos)

        def on_publication(sample: RawSample) -> None:
            try:
                rmw_zenoh.attachment_of(sample.attachment)
                callback(context.types.decode(sample.payload, kind))
            except ValueError as error:
                context.refuse(topic, str(error))

        undeclare = context.link.declare_subscriber(endpoint.key(context.domain), on_publication)
        self._declare(token)
        return undeclare

    def service(self, name: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Answer a service's requests, each with what `answer` returns, in a thread of Zenoh's."""
        context = self._context
        endpoint, token = self._endpoint("SS", name, kind, rmw_zenoh.DEFAULT)
        key, (request_type, response_type) = endpoint.key(context.domain), service_parts(kind)

        def reply(query: Query) -> None:
            try:
                received = rmw_zenoh.attachment_of(query.attachment)
                response = answer(context.types.decode(query.payload, request_type))
            except ValueError as error:
                query.end()
                context.refuse(name, str(error))
                return
            attachment = Attachment(received.sequence, context.wall_ns(), received.gid)
            query.reply_raw(key, context.types.encode(response, response_type), attachment.packed())

        context.link.declare_queryable(key, reply, complete=True)
        self._declare(token)

    def _endpoint(self, how: rmw_zenoh.Kind, name: str, kind: str, qos: Qos) -> tuple[Endpoint, str]:
        """Return a new endpoint and its token."""
        context = self._context
        endpoint = Endpoint(how, name, rmw_zenoh.dds_name(kind), context.types.hash(kind))
        return endpoint, rmw_zenoh.endpoint_token(self._identity, context.number(), endpoint, qos)

    def _declare(self, token: str) -> None:
        """Declare an endpoint once it works: others may use it at once."""
        self._context.link.declare_token(token)


class Publisher:
    """A publisher of a topic.

    Attributes:
        key: where its messages go.
    """

    def __init__(self, context: RosContext, endpoint: Endpoint, kind: str, qos: Qos, gid: bytes) -> None:
        self._context = context
        self._kind = kind
        self._gid = gid
        self._sent = 0
        self.key = endpoint.key(context.domain)
        kept = qos.transient_local
        self._write = (
            _transient_publisher(context.link, self.key) if kept else context.link.declare_publisher(self.key, CDR)
        )

    def publish(self, message: Any) -> None:
        """Send a message; a subscriber that is too slow loses it, the publisher never waits.

        Raises:
            ValueError: the message does not fit its type.
        """
        context = self._context
        payload = context.types.encode(message, self._kind)
        self._sent += 1
        attachment = Attachment(self._sent, context.wall_ns(), self._gid).packed()
        self._write(payload, attachment)


def _transient_publisher(link: Session, key: str) -> Callable[[bytes, bytes], None]:
    """Return what publishes on a key, so that later subscribers receive the last message, too."""
    return lambda payload, attachment: link.put_cached(key, payload, CDR, attachment)
