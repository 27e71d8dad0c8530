"""Headers, frames and messages of ROS 1: against bytes written by hand, published sums, and garbage."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim_bridges.ros1 import tcpros
from zsim_bridges.ros1.tcpros import HeaderError, TopicType

TWIST = TopicType("/drone1/cmd_vel", "geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a", "float64 x\n")
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


def test_a_header_is_its_length_and_fields_behind_their_lengths():
    encoded = tcpros.encode_header({"topic": "/chat", "md5sum": "*"})
    assert encoded == b"\x1b\0\0\0" + b"\x0b\0\0\0topic=/chat" + b"\x08\0\0\0md5sum=*"
    assert tcpros.decode_header(encoded[4:]) == {"topic": "/chat", "md5sum": "*"}


@pytest.mark.parametrize(
    "body", [b"\x05", b"\xff\xff\xff\xff", b"\x05\0\0\0abc", b"\x03\0\0\0abc", struct.pack("<I", 2**31) + b"a=b"]
)
def test_no_header_is_refused(body):
    with pytest.raises(HeaderError):
        tcpros.decode_header(body)


@given(st.binary(max_size=200))
def test_garbage_is_a_header_or_refused(body):
    try:
        fields = tcpros.decode_header(body)
    except HeaderError:
        return
    assert all(isinstance(key, str) and isinstance(value, str) for key, value in fields.items())


@given(st.dictionaries(st.text("abc_", min_size=1, max_size=8), st.text("=\nA#ä ", max_size=20), max_size=6))
def test_what_is_encoded_is_decoded(fields):
    assert tcpros.decode_header(tcpros.encode_header(fields)[4:]) == fields


@pytest.mark.parametrize(
    ("header", "terms"),
    [
        ({"callerid": "/me", "md5sum": "*"}, ()),
        ({"callerid": "/me", "md5sum": TWIST.md5}, ()),
        ({"callerid": "/me", "md5sum": "0" * 32, "type": "geometry_msgs/Pose"}, ("geometry_msgs/Pose", TWIST.type)),
        ({}, ("missing",)),
        ({"callerid": "/me"}, ("missing",)),
        ({"md5sum": "*"}, ("missing",)),
    ],
)
def test_the_type_of_a_header_fits_or_the_reason_names_both(header, terms):
    reason = tcpros.mismatch(TWIST, header, "/zsim")
    assert (reason is None) == (not terms)
    assert all(term in (reason or "") for term in terms)


def test_both_sides_of_our_own_connections_understand_each_other():
    subscriber = tcpros.subscriber_header(TWIST, "/a")
    publisher = tcpros.publisher_header(TWIST, "/b")
    assert tcpros.mismatch(TWIST, subscriber, "/b") is None
    assert tcpros.mismatch(TWIST, publisher, "/a") is None
    assert subscriber["tcp_nodelay"] == "1"
    assert publisher["latching"] == "0"


@pytest.mark.parametrize(("kind", "md5"), MD5.items())
def test_md5_sums_are_those_of_ros(kind, md5):
    assert tcpros.topic_type_of("/topic", kind).md5 == md5


def test_a_definition_brings_those_of_its_fields():
    definition = tcpros.topic_type_of("/topic", "ardrone_autonomy/Navdata").definition
    assert "float32 batteryPercent\n" in definition
    assert "MSG: std_msgs/Header" in definition


def test_a_number_that_does_not_go_into_its_field_is_refused():
    point = tcpros.message_class("geometry_msgs/Point32")(x=1e300, y=0.0, z=0.0)
    with pytest.raises(ValueError, match="geometry_msgs/Point32"):
        tcpros.serialize("geometry_msgs/Point32", point)


@pytest.mark.parametrize("kind", ["geometry_msgs/Twist", "std_msgs/Empty", "std_msgs/String"])
@given(data=st.binary(min_size=1, max_size=60).filter(lambda data: len(data) != 48))
def test_other_bytes_are_refused(kind, data):
    if kind == "std_msgs/String" and len(data) - 4 == int.from_bytes(data[:4], "little"):
        return
    with pytest.raises(ValueError, match=kind):
        tcpros.deserialize(kind, data)
