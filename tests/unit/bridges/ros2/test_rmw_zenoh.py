"""rmw_zenoh's wire against literal vectors: of its sources, of a deployed peer's token, of xxHash's specification."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsim_bridges.ros2 import rmw_zenoh
from zsim_bridges.ros2.rmw_zenoh import Attachment, Endpoint, NodeId, Qos, ros_name, ros_names

ZID = "f4b2a1c09d8e7f60"
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
NODE = NodeId(0, ZID, 3, "/", "listener")


def test_token_of_a_subscription_is_as_deployed_peers_write_it() -> None:
    endpoint = Endpoint("MS", "/tf", "tf2_msgs::msg::dds_::TFMessage_", TF_HASH)
    token = rmw_zenoh.endpoint_token(NODE, 7, endpoint, rmw_zenoh.TF)
    assert token == f"@ros2_lv/0/{ZID}/3/7/MS/%/%/listener/%tf/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}/::,100:,:,:,,"
    assert rmw_zenoh.endpoint_of(token) == endpoint


def test_token_of_a_node_has_its_number_twice_and_its_namespace_mangled() -> None:
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
def test_quality_of_service(qos: Qos, text: str) -> None:
    assert qos.text() == text


def test_data_key() -> None:
    name = rmw_zenoh.dds_name("sensor_msgs/msg/Imu")
    assert name == "sensor_msgs::msg::dds_::Imu_"
    assert (
        rmw_zenoh.data_key(0, "/drone1/imu", name, "RIHS01_7d") == "0/drone1/imu/sensor_msgs::msg::dds_::Imu_/RIHS01_7d"
    )
    assert rmw_zenoh.dds_name("std_srvs/srv/SetBool") == "std_srvs::srv::dds_::SetBool_"


def test_attachment_is_33_bytes() -> None:
    packed = Attachment(1, 0x0102030405060708, bytes(range(16))).packed()
    assert packed.hex() == "0100000000000000" + "0807060504030201" + "10" + "000102030405060708090a0b0c0d0e0f"
    assert packed == struct.pack("<qqB", 1, 0x0102030405060708, 16) + bytes(range(16))
    assert rmw_zenoh.attachment_of(packed) == Attachment(1, 0x0102030405060708, bytes(range(16)))


@pytest.mark.parametrize("data", [b"", bytes(32), bytes(34), bytes(33), b"\x0fsequence_number" + bytes(17)])
def test_other_attachments_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="33"):
        rmw_zenoh.attachment_of(data)


def test_gid_is_low_half_first_each_little_endian() -> None:
    """XXH3-128 of nothing is 99aa06d3014798d8 6001c324468d497f (xxHash's own test vectors)."""
    assert rmw_zenoh.gid_of("").hex() == "7f498d4624c30160" + "d8984701d306aa99"


@given(st.text(max_size=200))
def test_whatever_stands_in_a_token_is_taken_or_left(text: str) -> None:
    found = rmw_zenoh.endpoint_of(f"@ros2_lv/0/{text}")
    assert found is None or len(found) == 4


@pytest.mark.parametrize(
    ("name", "ros"),
    [("drone1", "drone1"), ("quad-1.a", "quad_1_a"), ("7", "drone_7"), ("a--b", "a_b"), ("a__b", "a_b"), ("-", "_")],
)
def test_ros_names(name: str, ros: str) -> None:
    assert ros_name(name, "drone") == ros


def test_names_that_would_be_the_same_get_numbers() -> None:
    assert ros_names(["a-b", "a.b", "a_b", "a_b_2"], "drone") == {
        "a-b": "a_b",
        "a.b": "a_b_2",
        "a_b": "a_b_3",
        "a_b_2": "a_b_2_2",
    }


@given(st.lists(st.from_regex(r"[a-z0-9_.-]{1,32}", fullmatch=True), unique=True, max_size=8))
def test_every_name_of_the_contract_has_one_of_its_own_that_ros_takes(names: list[str]) -> None:
    found = ros_names(names, "drone")
    assert len(set(found.values())) == len(names)
    assert all(ros.replace("_", "a").isalnum() and not ros[0].isdigit() and "__" not in ros for ros in found.values())
