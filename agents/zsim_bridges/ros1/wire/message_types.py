"""The messages of ROS 1 that we speak: their classes, definitions, MD5 sums and bytes."""

from collections.abc import Callable
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from zsim_bridges.ros1.wire.tcpros import TopicType

NAVDATA = """
Header header
float32 batteryPercent  # 0 to 100
uint32 state            # 0 unknown, 1 init, 2 landed, 3 and 7 flying, 4 hovering, 5 test, 6 taking off, 8 landing
int32 magX
int32 magY
int32 magZ
int32 pressure          # Pa
int32 temp              # 0.1 deg C
float32 wind_speed      # m/s
float32 wind_angle
float32 wind_comp_angle
float32 rotX            # deg, to the right positive
float32 rotY            # deg, nose down positive
float32 rotZ            # deg, counter-clockwise positive
int32 altd              # mm
float32 vx              # mm/s
float32 vy
float32 vz
float32 ax              # g
float32 ay
float32 az
uint8 motor1
uint8 motor2
uint8 motor3
uint8 motor4
uint32 tags_count
uint32[] tags_type
uint32[] tags_xc
uint32[] tags_yc
uint32[] tags_width
uint32[] tags_height
float32[] tags_orientation
float32[] tags_distance
float32 tm              # us
"""  # fields of ardrone_autonomy 1.4.1, msg/Navdata.msg; the MD5 sum leaves comments out
DEFINITIONS = {
    "ardrone_autonomy/msg/Navdata": NAVDATA,
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
EMPTY_SERVICE = TopicType("", "std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e", "")  # MD5 of no text at all

_store = get_typestore(Stores.ROS1_NOETIC)
for _name, _text in DEFINITIONS.items():
    _store.register(get_types_from_msg(_text, _name))


def topic_type(topic: str, kind: str) -> TopicType:
    """Return a topic of a type such as "sensor_msgs/Imu"."""
    definition, md5 = _store.generate_msgdef(_full_name(kind), ros_version=1)
    return TopicType(topic, kind, md5, definition)


def message_class(kind: str) -> Callable[..., Any]:
    """Return the class of a type's messages."""
    return _store.types[_full_name(kind)]


def serialize(kind: str, what: Any) -> bytes:
    """Return the bytes of a message.

    Raises:
        ValueError: a number does not go into its field.
    """
    try:
        return bytes(_store.serialize_ros1(what, _full_name(kind)))
    except Exception as error:  # whatever the generated writer meets in numbers of somebody else's
        raise ValueError(f"is no {kind}: {error}") from error


def deserialize(kind: str, data: bytes) -> Any:
    """Return the message in bytes.

    Raises:
        ValueError: they are no such message.
    """
    try:
        return _store.deserialize_ros1(data, _full_name(kind))
    except Exception as error:  # whatever the generated reader meets in bytes of somebody else's
        raise ValueError(f"{len(data)} bytes are no {kind}") from error


def _full_name(kind: str) -> str:
    return kind.replace("/", "/msg/")
