"""ROS types: their classes, their CDR, and the hashes by which rmw_zenoh keeps different types of one name apart."""

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from zsim_bridges.ros2.definitions import MESSAGES, SERVICE_EVENT_INFO, SERVICES

MEMBERLESS = "structure_needs_at_least_one_member"  # what an empty message has in its place, a uint8


class RosTypes:
    """The types of one ROS distribution; those used here are the same from Iron to Lyrical."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)
        for name, text in MESSAGES.items():
            self._store.register(get_types_from_msg(text, name))
        for name, texts in SERVICES.items():
            for part, text in zip(service_parts(name), texts, strict=True):
                self._store.register(get_types_from_msg(text, part))
        self._hashes: dict[str, str] = {}

    def message_class(self, name: str) -> Any:
        """Return the class of a type, by a name such as `sensor_msgs/msg/Imu` or `std_srvs/srv/Trigger_Response`."""
        return self._store.types[_stored(name)]

    def encode(self, message: Any, name: str) -> bytes:
        """Return a message as CDR, little-endian."""
        return bytes(self._store.serialize_cdr(message, _stored(name), little_endian=True))

    def decode(self, payload: bytes, name: str) -> Any:
        """Return the message in a CDR.

        Raises:
            ValueError: it is no CDR of this type.
        """
        try:
            return self._store.deserialize_cdr(payload, _stored(name))
        except (SerdeError, ValueError, IndexError, MemoryError, OverflowError) as error:
            why = str(error) or type(error).__name__
            raise ValueError(f"{len(payload)} bytes are no CDR of {name} ({why})") from error

    def hash(self, name: str) -> str:
        """Return the hash of a message type, or of a service's, by REP-2011: `RIHS01_` and 64 digits."""
        if name not in self._hashes:
            store = _with_service(self._store, name) if name in SERVICES else self._store
            self._hashes[name] = store.hash_rihs01(name)
        return self._hashes[name]

    def definition(self, name: str) -> str:
        """Return the text of a message type, without those that it is made of."""
        return self._store.gendefhash(_stored(name), {}, 2)[0]


def service_parts(name: str) -> tuple[str, str]:
    """Return the names of a service's request and response."""
    return f"{name}_Request", f"{name}_Response"


@cache
def _stored(name: str) -> str:
    """Return rosbags' name of a type: it keeps requests and responses among the messages."""
    return name.replace("/srv/", "/srv/msg/")


def _with_service(known: Typestore, name: str) -> Typestore:
    """Return a store in which a service is a type: its request, its response, and the event that has both.

    So rosidl describes a service (rosidl_generator_type_description, `add_srv`); an event has one of each at most.
    """
    store = Typestore()
    store.fielddefs.update(known.fielddefs)
    store.fielddefs.update(get_types_from_msg(SERVICE_EVENT_INFO, "service_msgs/msg/ServiceEventInfo"))
    request, response = service_parts(name)
    for part in (request, response):
        store.fielddefs[part] = known.fielddefs[_stored(part)]
    event = f"{name}_Event"
    store.fielddefs[event] = (
        [],
        [
            ("info", _type_reference("service_msgs/msg/ServiceEventInfo")),
            ("request", (Nodetype.SEQUENCE, (_type_reference(request), 1))),
            ("response", (Nodetype.SEQUENCE, (_type_reference(response), 1))),
        ],
    )
    members = {"request_message": request, "response_message": response, "event_message": event}
    store.fielddefs[name] = [], [(member, _type_reference(kind)) for member, kind in members.items()]
    return store


def _type_reference(name: str) -> Any:
    return Nodetype.NAME, name
