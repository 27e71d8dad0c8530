"""A ROS 2 participant by rmw_zenoh's wire: nodes with publishers, subscriptions and services, over a Zenoh session."""

from collections.abc import Callable
from itertools import count
from typing import Any

from zsim.transport.session import Heard, Query, Session
from zsim_bridges.ros2 import rmw_zenoh
from zsim_bridges.ros2.rmw_zenoh import Attachment, Endpoint, NodeId, Qos
from zsim_bridges.ros2.ros_types import RosTypes, service_parts

CDR = "application/cdr"
OnRefused = Callable[[str, str], None]
"""Told (name, why) of what others sent in vain; called in threads of Zenoh's."""


class RosContext:
    """What ROS calls a context.

    Args:
        link: a session by whole keys, without a federation.
        domain: ROS_DOMAIN_ID.
        types: of messages and services.
        wall_ns: time since 1970.
        refuse: told of what is refused.
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
        """Return a node, which others see from now on."""
        return Ros2Node(self, NodeId(self.domain, self._zid, self.number(), namespace, name))

    def number(self) -> int:
        """Return the number of a new node or endpoint."""
        return next(self._numbers)

    def on_subscription(self, callback: Callable[[str, bool], None]) -> None:
        """Call back with (token, alive), in a thread of Zenoh's, for the subscriptions of all participants."""
        self.link.on_token(rmw_zenoh.subscription_tokens(self.domain), callback)


class Ros2Node:
    """A node of a participant."""

    def __init__(self, participant: RosContext, identity: NodeId) -> None:
        self._participant = participant
        self._identity = identity
        participant.link.declare_token(rmw_zenoh.node_token(identity))

    def publisher(self, topic: str, kind: str, qos: Qos) -> "Publisher":
        """Return a publisher of a topic, given by its whole name."""
        endpoint, token = self._endpoint("MP", topic, kind, qos)
        publisher = Publisher(self._participant, endpoint, kind, qos, rmw_zenoh.gid_of(token))
        self._declare(token)
        return publisher

    def subscription(self, topic: str, kind: str, qos: Qos, callback: Callable[[Any], None]) -> Callable[[], None]:
        """Call back with every message on a topic, in a thread of Zenoh's, until the returned function is called."""
        ours = self._participant
        endpoint, token = self._endpoint("MS", topic, kind, qos)

        def take(heard: Heard) -> None:
            try:
                rmw_zenoh.attachment_of(heard.attachment)
                callback(ours.types.decode(heard.payload, kind))
            except ValueError as error:
                ours.refuse(topic, str(error))

        end = ours.link.hear(endpoint.key(ours.domain), take)
        self._declare(token)
        return end

    def service(self, name: str, kind: str, answer: Callable[[Any], Any]) -> None:
        """Answer a service's requests, each with what `answer` returns, in a thread of Zenoh's."""
        ours = self._participant
        endpoint, token = self._endpoint("SS", name, kind, rmw_zenoh.DEFAULT)
        key, (request, response) = endpoint.key(ours.domain), service_parts(kind)

        def reply(query: Query) -> None:
            try:
                asked = rmw_zenoh.attachment_of(query.attachment)
                said = answer(ours.types.decode(query.payload, request))
            except ValueError as error:
                query.end()
                ours.refuse(name, str(error))
                return
            beside = Attachment(asked.sequence, ours.wall_ns(), asked.gid)
            query.reply_as(key, ours.types.encode(said, response), beside.packed())

        ours.link.answer(key, reply, complete=True)
        self._declare(token)

    def _endpoint(self, how: rmw_zenoh.Kind, name: str, kind: str, qos: Qos) -> tuple[Endpoint, str]:
        """Return a new endpoint and its token."""
        ours = self._participant
        endpoint = Endpoint(how, name, rmw_zenoh.dds_name(kind), ours.types.hash(kind))
        return endpoint, rmw_zenoh.endpoint_token(self._identity, ours.number(), endpoint, qos)

    def _declare(self, token: str) -> None:
        """Let others know of an endpoint, once it works: they may use it at once."""
        self._participant.link.declare_token(token)


class Publisher:
    """A publisher of a topic.

    Attributes:
        key: where its messages go.
    """

    def __init__(self, participant: RosContext, endpoint: Endpoint, kind: str, qos: Qos, gid: bytes) -> None:
        self._participant = participant
        self._kind = kind
        self._gid = gid
        self._sent = 0
        self.key = endpoint.key(participant.domain)
        kept = qos.transient_local
        self._write = _transient_writer(participant.link, self.key) if kept else participant.link.writer(self.key, CDR)

    def publish(self, message: Any) -> None:
        """Send a message; a subscriber that takes nothing loses it, nobody waits.

        Raises:
            ValueError: the message does not fit its type.
        """
        ours = self._participant
        payload = ours.types.encode(message, self._kind)
        self._sent += 1
        beside = Attachment(self._sent, ours.wall_ns(), self._gid).packed()
        self._write(payload, beside)


def _transient_writer(link: Session, key: str) -> Callable[[bytes, bytes], None]:
    """Return what publishes for those too who come later."""
    return lambda payload, attachment: link.put_kept(key, payload, CDR, attachment)
