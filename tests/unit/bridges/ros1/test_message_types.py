"""Types, MD5 sums and bytes of ROS 1, against the sums that its distributions publish."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim_bridges.ros1 import tcpros

MD5 = {  # as `rosmsg md5` of Noetic prints them; of Navdata as ardrone_autonomy's generated code has it
    "std_msgs/String": "992ce8a1687cec8c8bd883ec73ca41d1",
    "std_msgs/Empty": "d41d8cd98f00b204e9800998ecf8427e",
    "geometry_msgs/Twist": "9f195f881246fdfa2798d1d3eebca84a",
    "geometry_msgs/Vector3Stamped": "7b324c7325e683bf02a9b14b01090ec7",
    "sensor_msgs/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "sensor_msgs/CameraInfo": "c9a58c1b0b154e0e6da7578cb991d214",
    "sensor_msgs/CompressedImage": "8f7a12909da2c9d3332d540a0977563f",
    "sensor_msgs/NavSatFix": "2d3a8cd499b9b4a0249fb98fd05cfa48",
    "nav_msgs/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "rosgraph_msgs/Clock": "a9c97c1d230cfc112e270351a944ee47",
    "tf2_msgs/TFMessage": "94810edda583a504dfda3829e70d7eec",
    "ardrone_autonomy/Navdata": "e1169f766234363125ac62c9a3f87eeb",
}


@pytest.mark.parametrize(("kind", "md5"), MD5.items())
def test_md5_sums_are_those_of_ros(kind, md5):
    assert tcpros.topic_type_of("/topic", kind)[2] == md5


def test_a_definition_brings_those_of_its_fields():
    definition = tcpros.topic_type_of("/topic", "ardrone_autonomy/Navdata").definition
    assert "float32 batteryPercent\n" in definition
    assert "MSG: std_msgs/Header" in definition


def test_a_twist_is_six_doubles():
    vector = tcpros.message_class("geometry_msgs/Vector3")
    twist = tcpros.message_class("geometry_msgs/Twist")(linear=vector(1.0, 0.0, 0.0), angular=vector(0.0, 0.0, -2.0))
    data = tcpros.serialize("geometry_msgs/Twist", twist)
    assert data == bytes.fromhex("000000000000f03f" + "00" * 32 + "00000000000000c0")
    assert tcpros.deserialize("geometry_msgs/Twist", data) == twist


def test_a_number_that_does_not_go_into_its_field_is_refused():
    point = tcpros.message_class("geometry_msgs/Point32")(x=1e300, y=0.0, z=0.0)
    with pytest.raises(ValueError, match="geometry_msgs/Point32"):
        tcpros.serialize("geometry_msgs/Point32", point)


def test_an_empty_message_has_no_bytes():
    empty = tcpros.message_class("std_msgs/Empty")()
    assert tcpros.serialize("std_msgs/Empty", empty) == b""
    tcpros.deserialize("std_msgs/Empty", b"")


@pytest.mark.parametrize("kind", ["geometry_msgs/Twist", "std_msgs/Empty", "std_msgs/String"])
@given(data=st.binary(min_size=1, max_size=60).filter(lambda data: len(data) != 48))
def test_other_bytes_are_refused(kind, data):
    if kind == "std_msgs/String" and len(data) - 4 == int.from_bytes(data[:4], "little"):
        return
    with pytest.raises(ValueError, match=kind):
        tcpros.deserialize(kind, data)
