"""Readings become messages of a gate: counted, numbered, stamped, and closed by a status."""

import random
from typing import Any

import pytest

from zsim.contract import keys, messages
from zsim_bridges.vehicle_links.aircraft_state import AircraftPose, AircraftState, Reading
from zsim_bridges.vehicle_links.external_drone import ExternalDrone
from zsim_bridges.vehicle_links.stream_loss import StreamLoss

MS = 1_000_000
BEGUN_NS = 5_000 * MS  # by the driver's clock


def external() -> ExternalDrone:
    return ExternalDrone("drone2", lambda now_ns: now_ns - BEGUN_NS)


def imu(t_ms: float) -> Reading:
    return Reading("imu", BEGUN_NS + round(t_ms * MS), ((0.0, 0.0, 9.8), (0.0, 0.0, 0.1)))


def vehicle(t_ms: float) -> AircraftState:
    pose = AircraftPose(BEGUN_NS + round(t_ms * MS), (1.0, 2.0, 3.0), (1.0, 0.0, -1.0))
    return AircraftState("flying", 80.0, pose, pose.taken_ns)


def test_a_gate_of_messages():
    drone = external()
    drone.add([imu(18), imu(8), Reading("sonar", BEGUN_NS + 11 * MS, (1.5, True))])
    *samples, (truth_key, truth), (status_key, status) = drone.gate(20 * MS, vehicle(10), "controller.main")
    assert [keys.leaf(key) for key, _ in samples] == ["imu", "sonar", "imu"]
    assert [sample.t_sample_ns for _, sample in samples] == [8 * MS, 11 * MS, 18 * MS]
    assert {sample.t_ns for _, sample in samples} == {20 * MS}
    assert [sample.seq for key, sample in samples if key.endswith("imu")] == [0, 1]
    assert (truth_key, status_key) == (keys.truth("drone2"), keys.status("drone2"))
    assert truth.position_m == pytest.approx((1.01, 2.0, 2.99))
    assert (status.count, status.state, status.commander) == (4, "flying", "controller.main")


def test_every_message_passes_the_contract():
    drone = external()
    values = {
        "imu": ((0.0, 0.0, 9.8), (0.0, 0.0, 0.0)),
        "gps": (-34.0, -58.0, 30.0, (0.0, 0.0, 5.0), (0.0, 0.0, 0.0), 2.0, 3, 9),
        "mag": ((1.0, 2.0, 3.0),),
        "baro": (101_325.0, 3.0),
        "sonar": (2.0, True),
        "flow": ((0.0, 0.0, 0.0), 1.0),
    }
    drone.add(Reading(sensor, BEGUN_NS, fields) for sensor, fields in values.items())
    gate = drone.gate(20 * MS, vehicle(0), None)
    assert len(gate) == len(values) + 2
    for key, message in gate:
        assert messages.decode(key, messages.encode(message)) == message


def test_none_is_of_the_future_nor_of_before_the_run():
    drone = external()
    drone.add([imu(-50), imu(25)])
    (_, first), (_, second), *_ = drone.gate(20 * MS, vehicle(0), None)
    assert (first.t_sample_ns, second.t_sample_ns) == (0, 20 * MS)


def test_a_gate_is_published_once_and_none_without_a_pose():
    drone = external()
    assert drone.gate(20 * MS, AircraftState(), None) == []
    assert drone.gate(40 * MS, vehicle(0), None)
    assert drone.gate(40 * MS, vehicle(0), None) == []
    assert drone.gate(20 * MS, vehicle(0), None) == []


@pytest.mark.parametrize(
    ("state", "turns"), [("landed", 0.0), ("taking_off", 400.0), ("flying", 400.0), ("emergency", 0.0)]
)
def test_rotors_turn_as_in_hover_while_it_is_in_the_air(state: Any, turns: float):
    drone = ExternalDrone("drone2", lambda now_ns: now_ns - BEGUN_NS, (400.0,) * 6)
    (_, truth), _ = drone.gate(20 * MS, vehicle(0)._replace(state=state), None)
    assert truth.rotor_rad_s == (turns,) * 6


def test_an_old_pose_is_carried_on_for_half_a_second():
    (_, truth), _ = external().gate(10_000 * MS, vehicle(0), None)
    assert truth.position_m == pytest.approx((1.5, 2.0, 2.5))


def test_the_share_that_is_lost_is_counted_over_the_wrap():
    draw, loss = random.Random(3), StreamLoss(256)
    for number in range(4000):
        if draw.random() > 0.1:
            loss.add(number % 256)
    assert loss.percent == pytest.approx(10, abs=2.5)
    assert not loss.add(3999 % 256)
