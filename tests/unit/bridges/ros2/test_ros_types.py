"""Type hashes against those of deployed ROS nodes; CDR against an encoder of the test's own."""

import math
import struct
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim_bridges.ros2 import ros_types
from zsim_bridges.ros2.ros_types import MESSAGES


@pytest.mark.parametrize(
    ("name", "digits"),
    [
        ("sensor_msgs/msg/Imu", "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"),
        ("geometry_msgs/msg/Twist", "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"),
        ("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        ("nav_msgs/msg/Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        ("tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
        ("std_srvs/srv/SetBool", "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a"),
        ("std_srvs/srv/Trigger", "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"),
    ],
)
def test_hashes_are_those_of_deployed_nodes(name: str, digits: str) -> None:
    assert ros_types.type_hash(name) == f"RIHS01_{digits}"


def test_hashes_of_our_own_messages_are_those_that_somebody_else_computes() -> None:
    """zenoh-ros2-sdk parses the texts itself."""
    utils = pytest.importorskip("zenoh_ros2_sdk.utils", reason="PyPI zenoh-ros2-sdk is not installed")
    header = {name: ros_types.definition(name) for name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")}
    for name, text in MESSAGES.items():
        assert ros_types.type_hash(name) == utils.get_type_hash(name, text, header)


class Cdr:
    """Plain CDR, little-endian, as OMG's DDSI-RTPS 9.3.1.2 and 10.2 describe it: each number at a multiple of its size."""

    def __init__(self) -> None:
        self.data = b""

    def put(self, code: str, *values: Any) -> "Cdr":
        size = struct.calcsize(code)
        for value in values:
            self.data += bytes(-len(self.data) % size) + struct.pack("<" + code, value)
        return self

    def text(self, text: str) -> "Cdr":
        raw = text.encode() + b"\0"
        self.put("I", len(raw)).data += raw
        return self

    def whole(self) -> bytes:
        return b"\x00\x01\x00\x00" + self.data


def of(name: str, *values: Any) -> Any:
    return ros_types.message_class(name)(*values)


def header(sec: int, nanosec: int, frame: str) -> Any:
    return of("std_msgs/msg/Header", of("builtin_interfaces/msg/Time", sec, nanosec), frame)


def test_cdr_of_our_cluster_state() -> None:
    numbers = np.array([1.0, 2.0])
    state = of(
        "zsim_msgs/msg/ClusterState", header(0, 20_000_000, "map"), "engaged", ["drone1", "d2"], ["x_c", "y_c"],
        numbers, numbers + 1, numbers + 2, math.inf, 0.5, "",
    )  # fmt: skip
    wanted = Cdr().put("i", 0).put("I", 20_000_000).text("map").text("engaged")
    wanted.put("I", 2).text("drone1").text("d2").put("I", 2).text("x_c").text("y_c")
    for k in range(3):
        wanted.put("I", 2).put("d", 1.0 + k, 2.0 + k)
    wanted.put("d", math.inf, 0.5).text("")
    assert ros_types.encode(state, "zsim_msgs/msg/ClusterState") == wanted.whole()


def test_what_is_empty_has_one_byte_on_the_wire() -> None:
    for name in ("std_msgs/msg/Empty", "std_srvs/srv/Trigger_Request"):
        assert ros_types.encode(ros_types.message_class(name)(), name) == bytes.fromhex("0001000000")


@pytest.mark.parametrize("name", ["geometry_msgs/msg/Twist", "std_msgs/msg/Empty", "std_srvs/srv/SetBool_Request"])
@given(data=st.binary(max_size=80), head=st.sampled_from([b"", b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"]))
def test_garbage_is_a_message_or_a_refusal(name: str, data: bytes, head: bytes) -> None:
    with suppress(ValueError):
        assert isinstance(ros_types.decode(head + data, name), ros_types.message_class(name))
