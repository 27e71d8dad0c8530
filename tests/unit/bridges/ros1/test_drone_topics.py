"""What a cmd_vel means, by the rules of ardrone_autonomy's driver."""

import math
from typing import Any

import pytest
from refused import has_terms

from zsim.contract import flight_messages
from zsim_bridges.ros1 import tcpros
from zsim_bridges.ros1.drone_topics import REPEAT_NS, DriverCommands, TiltCommand, tilt_of

GATE_NS = 20_000_000
Vector3 = tcpros.message_class("geometry_msgs/Vector3")


def twist(*, x: float = 0.0, y: float = 0.0, z: float = 0.0, wx: float = 0.0, wy: float = 0.0, wz: float = 0.0) -> Any:
    return tcpros.message_class("geometry_msgs/Twist")(linear=Vector3(x, y, z), angular=Vector3(wx, wy, wz))


def status(state: Any, gate: int) -> flight_messages.Status:
    return flight_messages.Status(gate * GATE_NS, gate, state, 100.0, False, None, 1)


class Drone:
    """A pilot, and what it sends."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Any]] = []
        self.pilot = DriverCommands("drone1", "ros1.main", lambda key, message: self.sent.append((key, message)))

    def gates(self, state: Any, first: int, count: int) -> list[Any]:
        """Let some gates pass; return what is sent meanwhile."""
        self.sent.clear()
        for gate in range(first, first + count):
            self.pilot.on_status(status(state, gate))
        return [message for _, message in self.sent]


def test_forward_left_up_and_counter_clockwise_are_positive():
    assert tilt_of(twist(x=0.1, y=0.2, z=0.3, wz=0.4)) == TiltCommand(0.1, 0.2, 0.3, 0.4, False)


def test_shares_end_at_one():
    assert tilt_of(twist(x=3.0, y=-7.0, z=1.5, wz=-1.5)) == TiltCommand(1.0, -1.0, 1.0, -1.0, False)


def test_all_zero_is_hovering():
    assert tilt_of(twist()).hover
    assert tilt_of(twist(x=9e-7)).hover
    assert not tilt_of(twist(x=2e-6)).hover


@pytest.mark.parametrize("components", [{"wx": 1.0}, {"wy": -0.5}])
def test_a_tilt_rate_of_any_size_only_switches_hovering_off(components):
    assert tilt_of(twist(**components)) == TiltCommand(0.0, 0.0, 0.0, 0.0, False)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("component", ["x", "y", "z", "wx", "wy", "wz"])
def test_what_is_not_finite_is_refused(component, number):
    drone = Drone()
    drone.gates("flying", 0, 1)
    with pytest.raises(ValueError, match="cmd_vel"):
        drone.pilot.on_cmd_vel(twist(**{component: number}))
    assert drone.gates("flying", 1, 50) == []


def test_a_cmd_vel_holds_until_the_next():
    drone = Drone()
    drone.gates("flying", 0, 1)
    drone.pilot.on_cmd_vel(twist(x=0.5))
    sent = drone.gates("flying", 1, 101)
    every = REPEAT_NS // GATE_NS
    assert [m.t_ns // GATE_NS for m in sent] == list(range(1, 102, every))
    assert {(m.forward, m.hover) for m in sent} == {(0.5, False)}
    assert [m.seq for m in sent] == list(range(len(sent)))
    drone.pilot.on_cmd_vel(twist())
    assert {(m.forward, m.hover) for m in drone.gates("flying", 102, 20)} == {(0.0, True)}


def test_nobody_is_flown_before_somebody_asks():
    assert Drone().gates("hovering", 0, 100) == []


def test_a_fast_node_is_heard_once_a_gate():
    drone = Drone()
    drone.gates("flying", 0, 1)
    for n in range(10):
        drone.pilot.on_cmd_vel(twist(x=n / 10))
    assert [m.forward for m in drone.gates("flying", 1, 1)] == [0.9]


def test_what_is_asked_on_the_way_up_is_flown_when_it_hovers():
    drone = Drone()
    drone.gates("taking_off", 0, 1)
    drone.pilot.on_cmd_vel(twist(z=0.5))
    assert drone.gates("taking_off", 1, 10) == []
    assert [m.up for m in drone.gates("hovering", 11, 1)] == [0.5]


@pytest.mark.parametrize("state", ["landing", "landed", "emergency"])
def test_a_drone_that_came_down_does_not_go_on(state):
    drone = Drone()
    drone.gates("flying", 0, 1)
    drone.pilot.on_cmd_vel(twist(x=1.0))
    assert drone.gates("flying", 1, 1) != []
    assert drone.gates(state, 2, 10) == []
    drone.pilot.on_cmd_vel(twist(x=1.0))
    assert drone.gates("hovering", 12, 10) == []


def test_modes_are_asked_for_under_our_name():
    drone = Drone()
    drone.gates("landed", 7, 1)
    drone.pilot.take_off()
    drone.pilot.land()
    assert [(key, m.mode, m.seq, m.t_ns, m.source) for key, m in drone.sent] == [
        ("drone/drone1/cmd/mode", "takeoff", 0, 7 * GATE_NS, "ros1.main"),
        ("drone/drone1/cmd/mode", "land", 1, 7 * GATE_NS, "ros1.main"),
    ]


@pytest.mark.parametrize(("state", "mode"), [("flying", "emergency"), ("landed", "emergency"), ("emergency", "reset")])
def test_reset_toggles_the_emergency(state, mode):
    drone = Drone()
    drone.gates(state, 0, 1)
    drone.pilot.reset()
    assert drone.sent[-1][1].mode == mode


def test_only_a_drone_that_stands_is_trimmed():
    drone = Drone()
    assert "not there" in (drone.pilot.trim_refusal() or "")
    drone.gates("flying", 0, 1)
    assert has_terms(drone.pilot.trim_refusal() or "", "landed")
    drone.gates("landed", 1, 1)
    assert drone.pilot.trim_refusal() is None
