"""The wire format of rmw_zenoh against its sources, deployed nodes and xxHash; CDR against the test's own encoder."""

import math
import struct
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from zsim_bridges.ros2 import rmw_zenoh
from zsim_bridges.ros2.rmw_zenoh import MESSAGES, Attachment, Endpoint, NodeId, Qos, ros_name, ros_names


@pytest.mark.parametrize(
    ("name", "digits"),
    [
        ("sensor_msgs/msg/Imu", "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"),
        ("geometry_msgs/msg/Twist", "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"),
        ("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        ("nav_msgs/msg/Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        ("tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
        ("std_srvs/srv/Trigger", "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"),
    ],
)
def test_type_hashes_equal_those_of_deployed_nodes(name: str, digits: str) -> None:
    assert rmw_zenoh.type_hash(name) == f"RIHS01_{digits}"


def test_type_hashes_of_own_messages_equal_those_of_another_library() -> None:
    """zenoh-ros2-sdk parses the definitions on its own."""
    utils = pytest.importorskip("zenoh_ros2_sdk.utils", reason="PyPI zenoh-ros2-sdk is not installed")
    store, names = get_typestore(Stores.ROS2_JAZZY), ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    header = {name: store.gendefhash(name, {}, 2)[0] for name in names}
    for name, text in MESSAGES.items():
        assert rmw_zenoh.type_hash(name) == utils.get_type_hash(name, text, header)


class Cdr:
    """Plain little-endian CDR (OMG DDSI-RTPS, 9.3.1.2 and 10.2): each number is aligned to a multiple of its size."""

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
    return rmw_zenoh.message_class(name)(*values)


def header(sec: int, nanosec: int, frame: str) -> Any:
    return of("std_msgs/msg/Header", of("builtin_interfaces/msg/Time", sec, nanosec), frame)


def test_the_cdr_of_a_cluster_state_is_correct() -> None:
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
    assert rmw_zenoh.encode(state, "zsim_msgs/msg/ClusterState") == wanted.whole()


@pytest.mark.parametrize("sec", [2**40, "now"])
def test_a_value_that_does_not_fit_its_field_is_refused(sec: Any) -> None:
    with pytest.raises(ValueError, match=r"std_msgs/msg/Header"):
        rmw_zenoh.encode(header(sec, 0, "map"), "std_msgs/msg/Header")


def test_an_empty_message_has_one_byte_on_the_wire() -> None:
    for name in ("std_msgs/msg/Empty", "std_srvs/srv/Trigger_Request"):
        assert rmw_zenoh.encode(rmw_zenoh.message_class(name)(), name) == bytes.fromhex("0001000000")


@pytest.mark.parametrize("name", ["geometry_msgs/msg/Twist", "std_msgs/msg/Empty", "std_srvs/srv/Trigger_Response"])
@given(data=st.binary(max_size=80), head=st.sampled_from([b"", b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"]))
def test_garbage_is_decoded_or_refused(name: str, data: bytes, head: bytes) -> None:
    with suppress(ValueError):
        assert isinstance(rmw_zenoh.decode(head + data, name), rmw_zenoh.message_class(name))


ZID = "f4b2a1c09d8e7f60"
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
NODE = NodeId(0, ZID, 3, "/", "listener")


def test_the_token_of_a_subscription_equals_that_of_deployed_peers() -> None:
    endpoint = Endpoint("MS", "/tf", "tf2_msgs::msg::dds_::TFMessage_", TF_HASH)
    token = rmw_zenoh.endpoint_token(NODE, 7, endpoint, rmw_zenoh.TF)
    assert token == f"@ros2_lv/0/{ZID}/3/7/MS/%/%/listener/%tf/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}/::,100:,:,:,,"
    assert rmw_zenoh.endpoint_of(token) == endpoint


def test_the_token_of_a_node_has_its_number_twice_and_a_mangled_namespace() -> None:
    assert (
        rmw_zenoh.node_token(NODE._replace(namespace="/drone1", name="zsim"))
        == f"@ros2_lv/0/{ZID}/3/3/NN/%/%drone1/zsim"
    )


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (rmw_zenoh.DEFAULT, "::,10:,:,:,,"),
        (rmw_zenoh.SENSOR, "2::,5:,:,:,,"),
        (rmw_zenoh.CLOCK, "2::,1:,:,:,,"),
        (rmw_zenoh.TF, "::,100:,:,:,,"),
        (rmw_zenoh.TF_STATIC, ":1:,1:,:,:,,"),
        (Qos(depth=3, best_effort=True, transient_local=True), "2:1:,3:,:,:,,"),
    ],
)
def test_quality_of_service_is_encoded_as_in_rmw_zenoh(qos: Qos, text: str) -> None:
    assert qos.text() == text


def test_a_data_key_has_domain_topic_type_and_hash() -> None:
    name = rmw_zenoh.dds_name("sensor_msgs/msg/Imu")
    assert name == "sensor_msgs::msg::dds_::Imu_"
    assert (
        rmw_zenoh.data_key(0, "/drone1/imu", name, "RIHS01_7d") == "0/drone1/imu/sensor_msgs::msg::dds_::Imu_/RIHS01_7d"
    )
    assert rmw_zenoh.dds_name("std_srvs/srv/SetBool") == "std_srvs::srv::dds_::SetBool_"


def test_an_attachment_has_33_bytes() -> None:
    packed = Attachment(1, 0x0102030405060708, bytes(range(16))).packed()
    assert packed.hex() == "0100000000000000" + "0807060504030201" + "10" + "000102030405060708090a0b0c0d0e0f"
    assert packed == struct.pack("<qqB", 1, 0x0102030405060708, 16) + bytes(range(16))
    assert rmw_zenoh.attachment_of(packed) == Attachment(1, 0x0102030405060708, bytes(range(16)))


@pytest.mark.parametrize("data", [b"", bytes(32), bytes(34), bytes(33), b"\x0fsequence_number" + bytes(17)])
def test_invalid_attachments_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="33"):
        rmw_zenoh.attachment_of(data)


def test_a_gid_is_the_hash_with_its_low_half_first_each_little_endian() -> None:
    """The XXH3-128 hash of no bytes is 99aa06d3014798d8 6001c324468d497f (test vectors of xxHash)."""
    assert rmw_zenoh.gid_of("").hex() == "7f498d4624c30160" + "d8984701d306aa99"


@given(st.text(max_size=200))
def test_any_token_is_parsed_or_ignored(text: str) -> None:
    found = rmw_zenoh.endpoint_of(f"@ros2_lv/0/{text}")
    assert found is None or len(found) == 4


@pytest.mark.parametrize(
    ("name", "ros"),
    [("drone1", "drone1"), ("quad-1.a", "quad_1_a"), ("7", "drone_7"), ("a--b", "a_b"), ("a__b", "a_b"), ("-", "_")],
)
def test_names_are_made_valid_for_ros(name: str, ros: str) -> None:
    assert ros_name(name, "drone") == ros


def test_names_that_would_coincide_get_numbers() -> None:
    assert ros_names(["a-b", "a.b", "a_b", "a_b_2"], "drone") == {
        "a-b": "a_b",
        "a.b": "a_b_2",
        "a_b": "a_b_3",
        "a_b_2": "a_b_2_2",
    }


@given(st.lists(st.from_regex(r"[a-z0-9_.-]{1,32}", fullmatch=True), unique=True, max_size=8))
def test_every_name_of_the_contract_has_a_unique_valid_ros_name(names: list[str]) -> None:
    found = ros_names(names, "drone")
    assert len(set(found.values())) == len(names)
    assert all(ros.replace("_", "a").isalnum() and not ros[0].isdigit() and "__" not in ros for ros in found.values())
