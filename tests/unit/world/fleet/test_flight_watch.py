"""Incidents of drones become events with their data; a normal flight with a landing has none."""

from typing import Any, Literal

import pytest
from continued import continue_from

from zsim.contract import flight_messages, keys
from zsim.contract.run_messages import Event
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE
from zsim_world.run.world import World


def scenario(count: int = 2, drone: Any = None, **top: Any):
    drones = [{"name": f"d{k}", "position_m": [3.0 * k, 0, 0], **(drone or {})} for k in range(count)]
    return resolve({"name": "t", "duration_s": 60, "drones": drones, "sensors": {"preset": "paper"}, **top})


def incidents_of(fleet: Fleet, seconds: float) -> list[tuple[str, int, dict[str, Any]]]:
    """Advance; return kind, drone and data of all incidents."""
    found = []
    until_ns = fleet.t_ns + round(seconds * 1e9)
    while fleet.t_ns < until_ns:
        fleet.advance()
        found += [(each.kind, each.drone, each.data) for each in fleet.incidents()]
    return found


def airborne(drone: Any = None, **top: Any) -> Fleet:
    """Return two drones that hover."""
    fleet = Fleet(scenario(drone=drone, **top))
    for i in range(fleet.count):
        assert fleet.takeoff(i) is None
    assert incidents_of(fleet, 6.0) == []
    return fleet


def test_a_normal_flight_with_a_landing_has_no_incident():
    fleet = airborne()
    for i in range(fleet.count):
        assert fleet.land(i) is None
    assert incidents_of(fleet, 8.0) == []
    assert fleet.status(0)[0] == "landed"


def test_a_fall_is_a_single_impact_at_the_speed_before_it():
    fleet = airborne()
    fleet.emergency(1)
    fastest, found = 0.0, []
    for _ in range(50):
        fastest = max(fastest, float(-fleet.truth().velocity_m_s[1, 2]))
        fleet.advance()
        found += [(each.kind, each.drone, each.data) for each in fleet.incidents()]
    ((kind, drone, data),) = found
    assert (kind, drone, data["other"]) == ("impact", 1, "the ground")
    assert data["speed_m_s"] == pytest.approx(fastest, rel=0.1)


@pytest.mark.parametrize("gate_ms", [5, 100, 500])
def test_an_impact_is_detected_whatever_the_length_of_a_gate(gate_ms: int):
    """A gate of 500 ms spans the fall, the impact and its bounces, so the mean acceleration reveals none of them."""
    found = {}
    for gate in (20, gate_ms):
        fleet = airborne(time={"gate_ms": gate})
        fleet.emergency(1)
        found[gate] = incidents_of(fleet, 1.0)
    ((kind, drone, data),) = found[gate_ms]
    assert (kind, drone, data["other"]) == ("impact", 1, "the ground")
    assert data["speed_m_s"] == pytest.approx(found[20][0][2]["speed_m_s"], rel=0.05)


def descend(fleet: Fleet, seconds: float) -> list[tuple[str, int, dict[str, Any]]]:
    """Fly drone 0 down at 0.3 m/s, even onto the ground; return the incidents."""
    found = []
    for _ in range(round(seconds)):
        assert fleet.set_velocity(0, (0.0, 0.0, -0.3)) is None
        found += incidents_of(fleet, 1.0)
    return found


def test_a_touchdown_in_flight_is_reported_once_until_the_drone_climbs():
    fleet = airborne()
    assert descend(fleet, 6.0) == [("touchdown", 0, {"other": "the ground"})]
    assert fleet.status(0)[0] == "hovering"  # its commander is silent
    assert fleet.set_velocity(0, (0.0, 0.0, 0.5)) is None
    assert incidents_of(fleet, 1.5) == []
    assert descend(fleet, 6.0) == [("touchdown", 0, {"other": "the ground"})]
    assert fleet.land(0) is None
    assert incidents_of(fleet, 4.0) == []


BOX = {"obstacles": [{"name": "box", "shape": "box", "position_m": [10, 0, 0], "size_m": [2, 2, 0.5]}]}


def test_a_touchdown_on_an_obstacle_is_reported():
    fleet = airborne(environment=BOX)
    fleet.bodies.state[0, STATE.p_WB : STATE.p_WB + 3] = 10.0, 0.0, 1.5
    assert ("touchdown", 0, {"other": "box"}) in descend(fleet, 8.0)


def test_an_impact_on_an_obstacle_names_the_obstacle():
    fleet = airborne(environment=BOX)
    fleet.bodies.state[0, STATE.p_WB : STATE.p_WB + 3] = 10.0, 0.0, 2.0
    fleet.emergency(0)
    ((kind, drone, data),) = incidents_of(fleet, 1.0)
    assert (kind, drone, data["other"]) == ("impact", 0, "box")


def test_two_drones_that_hit_each_other_are_both_named():
    fleet = airborne()
    fleet.bodies.state[0, STATE.p_WB : STATE.p_WB + 3] = fleet.truth().position_m[1] + (0.0, 0.0, 2.0)
    fleet.emergency(0)
    hits = {drone: data["other"] for kind, drone, data in incidents_of(fleet, 0.7) if kind == "impact"}
    assert hits == {0: "d1", 1: "d0"}


def test_an_overturned_drone_is_reported_as_a_flip_and_an_emergency():
    fleet = airborne()
    fleet.bodies.state[0, STATE.w_WB_B] = 20.0  # rad/s, about its x axis
    found = incidents_of(fleet, 0.5)
    assert {"flip", "emergency"} <= {kind for kind, _, _ in found}
    assert {drone for _, drone, _ in found} == {0}
    (emergency,) = [data for kind, _, data in found if kind == "emergency"]
    assert emergency["cause"] == "tilt"


def test_an_empty_battery_and_the_landing_before_it_are_reported():
    fleet = airborne()
    fleet.bodies.energy[0] = 1.0  # J, which lasts for a few gates
    found = incidents_of(fleet, 0.2)
    assert ("landing", 0) in [(kind, drone) for kind, drone, _ in found]
    (data,) = [data for kind, _, data in found if kind == "landing"]
    assert data["cause"] == "battery"
    assert [(kind, drone) for kind, drone, _ in found if kind == "battery"] == [("battery", 0)]


def test_the_landing_after_a_commander_falls_silent_gives_its_cause():
    fleet = airborne()
    fleet.set_velocity(1, (0.0, 0.0, 0.0))
    ((kind, drone, data),) = incidents_of(fleet, 3.0)
    assert (kind, drone, data["cause"]) == ("landing", 1, "silence")


def test_the_watch_continues_from_its_snapshot():
    fleet, other = airborne(), Fleet(scenario())
    fleet.emergency(0)
    continue_from(fleet, other)
    assert incidents_of(other, 1.0) == incidents_of(fleet, 1.0) != []


def ask(world: World, drone: str, mode: Literal["takeoff", "emergency"]) -> None:
    command = flight_messages.Mode(world.now_ns, world.now_ns, "console.1", mode)
    world.handle(keys.command(drone, "mode"), command, 0)


def test_an_operator_s_emergency_in_the_air_is_an_event_with_its_source():
    world = World(scenario(processes={"expect": []}))
    events: list[Event] = []
    for k in range(150):
        world.advance(0)
        if k == 1:  # d1 still stands on the ground
            ask(world, "d1", "emergency")
            ask(world, "d0", "takeoff")
        elif k == 100:
            ask(world, "d0", "emergency")
        events += [m for _, m in world.take_outbox() if isinstance(m, Event) and m.kind == "emergency"]
    (event,) = events
    assert (event.subject, event.source, event.data) == ("d0", "console.1", {"cause": "command"})
