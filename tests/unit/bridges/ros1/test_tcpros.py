"""Headers and frames of TCPROS, against bytes written down by hand, and against garbage."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim_bridges.ros1 import tcpros
from zsim_bridges.ros1.tcpros import HeaderError, TopicType

TWIST = TopicType("/drone1/cmd_vel", "geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a", "float64 x\n")


def test_a_header_is_its_length_and_fields_behind_their_lengths():
    encoded = tcpros.encode_header({"topic": "/chat", "md5sum": "*"})
    assert encoded == b"\x1b\0\0\0" + b"\x0b\0\0\0topic=/chat" + b"\x08\0\0\0md5sum=*"
    assert tcpros.decode_header(encoded[4:]) == {"topic": "/chat", "md5sum": "*"}


def test_a_value_may_have_what_parts_fields():
    fields = {"message_definition": "uint8 A=1\n# x=y\n", "empty": ""}
    assert tcpros.decode_header(tcpros.encode_header(fields)[4:]) == fields


def test_a_frame_is_a_length_and_as_many_bytes():
    assert tcpros.frame(b"abc") == b"\x03\0\0\0abc"
    assert tcpros.length(b"\x03\0\0\0") == 3


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


@given(st.dictionaries(st.text("abc_", min_size=1, max_size=8), st.text(max_size=20), max_size=6))
def test_what_is_encoded_is_decoded(fields):
    assert tcpros.decode_header(tcpros.encode_header(fields)[4:]) == fields


@pytest.mark.parametrize("md5", ["*", TWIST.md5])
def test_who_means_the_same_message_is_taken(md5):
    assert tcpros.mismatch(TWIST, {"callerid": "/me", "md5sum": md5}, "/zsim") is None


def test_who_means_another_message_is_told_both():
    header = {"callerid": "/me", "md5sum": "0" * 32, "type": "geometry_msgs/Pose"}
    error = tcpros.mismatch(TWIST, header, "/zsim")
    assert error is not None
    assert "geometry_msgs/Pose" in error
    assert "geometry_msgs/Twist" in error


@pytest.mark.parametrize("header", [{}, {"callerid": "/me"}, {"md5sum": "*"}])
def test_who_does_not_say_who_and_what_is_refused(header):
    assert "missing" in (tcpros.mismatch(TWIST, header, "/zsim") or "")


def test_both_sides_of_our_own_connections_understand_each_other():
    subscriber = tcpros.subscriber_header(TWIST, "/a")
    publisher = tcpros.publisher_header(TWIST, "/b")
    assert tcpros.mismatch(TWIST, subscriber, "/b") is None
    assert tcpros.mismatch(TWIST, publisher, "/a") is None
    assert subscriber["tcp_nodelay"] == "1"
    assert publisher["latching"] == "0"
