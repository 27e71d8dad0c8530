"""ROS 2 types: classes, CDR, definitions that rosbags lacks, and the hashes of REP-2011 in rmw_zenoh's keys.

They are those of one distribution; the ones used here are the same from Iron to Lyrical.
"""

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

CLUSTER_STATE = """\
# Where a formation is, by the estimates of its drones, and where it is to be.
# names are the 4n cluster variables of n drones, in the order of value and desired [m, rad] and of desired_rate
# [m/s, rad/s].
std_msgs/Header header
# idle, taking_off, assembling, engaged, landing, held
string phase
string[] drones
string[] names
float64[] value
float64[] desired
float64[] desired_rate
# the trajectory's own time [s], NaN where none runs
float64 trajectory_time
# distance to a singularity, in the measure of the cluster space
float64 margin
# why it waits or is held
string reason
"""

NAVDATA = """\
# The fields of ardrone_autonomy's Navdata, in its units and signs (x forward, y left, z up), with names as ROS 2 wants
# them. Fields without a sample yet are NaN, or 0 in integers.
std_msgs/Header header
# [%]
float32 battery_percent
# 2 landed, 3 flying, 4 hovering, 6 taking off, 8 landing, 0 emergency
uint32 state
# in the axes of the magnetometer [uT]
float32 mag_x
float32 mag_y
float32 mag_z
# [Pa]
int32 pressure
# roll, pitch (nose down), yaw (counter-clockwise, from east) by the estimate [deg]
float32 rot_x
float32 rot_y
float32 rot_z
# by sonar [mm]
int32 altd
# by optical flow [mm/s]
float32 vx
float32 vy
float32 vz
# [g]
float32 ax
float32 ay
float32 az
# since the start [us]
float32 tm
"""

MESSAGES = {"zsim_msgs/msg/ClusterState": CLUSTER_STATE, "zsim_msgs/msg/Navdata": NAVDATA}
SERVICES = {  # requests and responses
    "std_srvs/srv/Trigger": ("", "bool success\nstring message\n"),
    "std_srvs/srv/SetBool": ("bool data\n", "bool success\nstring message\n"),
}
SERVICE_EVENT_INFO = """\
uint8 event_type
builtin_interfaces/Time stamp
uint8[16] client_gid
int64 sequence_number
"""
"""Of service_msgs; its `char[16]` counts as uint8 in type hashes."""

PACKAGE = {  # a ROS 2 package that makes ROS know MESSAGES
    "package.xml": """\
<?xml version="1.0"?>
<package format="3">
  <name>zsim_msgs</name>
  <version>1.0.0</version>
  <description>Messages of zsim's ROS 2 side</description>
  <maintainer email="nobody@example.org">zsim</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>std_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
""",
    "CMakeLists.txt": """\
cmake_minimum_required(VERSION 3.8)
project(zsim_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/ClusterState.msg" "msg/Navdata.msg" DEPENDENCIES std_msgs)
ament_package()
""",
    "msg/ClusterState.msg": CLUSTER_STATE,
    "msg/Navdata.msg": NAVDATA,
}


_store = get_typestore(Stores.ROS2_JAZZY)
for _name, _text in MESSAGES.items():
    _store.register(get_types_from_msg(_text, _name))
for _name, _texts in SERVICES.items():
    for _part, _text in zip(("Request", "Response"), _texts, strict=True):
        _store.register(get_types_from_msg(_text, f"{_name}_{_part}"))


def message_class(name: str) -> Any:
    """Return the class of a type, by a name such as `sensor_msgs/msg/Imu` or `std_srvs/srv/Trigger_Response`."""
    return _store.types[_stored(name)]


def encode(message: Any, name: str) -> bytes:
    """Return a message as CDR, little-endian."""
    return bytes(_store.serialize_cdr(message, _stored(name), little_endian=True))


def decode(payload: bytes, name: str) -> Any:
    """Return the message in a CDR.

    Raises:
        ValueError: it is no CDR of this type.
    """
    try:
        return _store.deserialize_cdr(payload, _stored(name))
    except (SerdeError, ValueError, IndexError, MemoryError, OverflowError) as error:
        why = str(error) or type(error).__name__
        raise ValueError(f"{len(payload)} bytes are no CDR of {name} ({why})") from error


@cache
def type_hash(name: str) -> str:
    """Return the hash of a message type, or of a service's, by REP-2011: `RIHS01_` and 64 digits.

    A service is described by its request, its response, and an event that has one of each at most, as rosidl does it
    (rosidl_generator_type_description, `add_srv`).
    """
    if name not in SERVICES:
        return _store.hash_rihs01(name)

    def reference(kind: str) -> Any:
        return Nodetype.NAME, kind

    store = Typestore()
    store.fielddefs.update(_store.fielddefs)
    store.fielddefs.update(get_types_from_msg(SERVICE_EVENT_INFO, "service_msgs/msg/ServiceEventInfo"))
    request, response, event = f"{name}_Request", f"{name}_Response", f"{name}_Event"
    for part in (request, response):
        store.fielddefs[part] = _store.fielddefs[_stored(part)]
    event_fields = [
        ("info", reference("service_msgs/msg/ServiceEventInfo")),
        ("request", (Nodetype.SEQUENCE, (reference(request), 1))),
        ("response", (Nodetype.SEQUENCE, (reference(response), 1))),
    ]
    store.fielddefs[event] = [], event_fields
    members = {"request_message": request, "response_message": response, "event_message": event}
    store.fielddefs[name] = [], [(member, reference(kind)) for member, kind in members.items()]
    return store.hash_rihs01(name)


def definition(name: str) -> str:
    """Return the text of a message type, without those that it is made of."""
    return _store.gendefhash(_stored(name), {}, 2)[0]


@cache
def _stored(name: str) -> str:
    """Return rosbags' name of a type: it keeps requests and responses among the messages."""
    return name.replace("/srv/", "/srv/msg/")
