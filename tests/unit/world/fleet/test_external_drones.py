"""External drones in a fleet: they follow the poses and states of their drivers, extrapolated for a while."""

import math
from typing import Any

import numpy as np
import pytest
from continued import continue_from
from fleet_samples import samples_of
from refused import has_terms

from zsim.contract import keys
from zsim.contract.flight_messages import POSE_AGE_MAX_NS, Ardrone, Attitude, Mode, RotorSpeeds, Status, Truth, Velocity
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import ExternalDrones, Fleet
from zsim_world.fleet.publication import GatePublication

GATE_NS = 20_000_000
START = (4.0, 0.0, 0.0)
HALF_TURN = (0.0, 0.0, 0.0, 1.0)


def fleet_of(*bodies: str, **drone: Any) -> Fleet:
    drones = [{"name": f"d{i}", "position_m": [4.0 * i, 0, 0], "body": body} for i, body in enumerate(bodies)]
    return Fleet(resolve({"name": "t", "duration_s": 1, "drones": [{**each, **drone} for each in drones]}))


def truth(t_ns: int, p=(4.0, 1.0, 2.0), v=(1.0, -0.5, 0.25), q=(1.0, 0.0, 0.0, 0.0), rotors=(300.0,) * 4) -> Truth:
    return Truth(t_ns, t_ns // GATE_NS, p, v, q, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0), rotors)


def status(t_ns: int, state: Any = "flying") -> Status:
    return Status(t_ns, t_ns // GATE_NS, state, 70.0, False, None, 1)


@pytest.fixture
def fleet() -> Fleet:
    return fleet_of("simulated", "external")


@pytest.fixture
def drones(fleet: Fleet) -> ExternalDrones:
    return ExternalDrones(fleet)


def advance(fleet: Fleet, drones: ExternalDrones, gates: int = 1) -> None:
    for _ in range(gates):
        drones.lead()
        fleet.advance()


def test_before_its_first_pose_a_drone_stands_where_the_scenario_puts_it(fleet: Fleet, drones: ExternalDrones):
    standing = fleet.truth().position_m[1].copy()
    np.testing.assert_allclose(standing[:2], START[:2])
    advance(fleet, drones, 50)
    np.testing.assert_array_equal(fleet.truth().position_m[1], standing)
    assert drones.status(1) is None


def test_a_drone_follows_its_driver_and_moves_on_at_the_last_velocity(fleet: Fleet, drones: ExternalDrones):
    advance(fleet, drones, 10)
    assert drones.take("d1", truth(200_000_000, q=HALF_TURN), fleet.t_ns) is None
    for gate in range(1, 20):
        advance(fleet, drones)
        now = fleet.truth()
        wanted = np.array((4.0, 1.0, 2.0)) + gate * 0.02 * np.array((1.0, -0.5, 0.25))
        np.testing.assert_allclose(now.position_m[1], wanted, atol=1e-12)
        np.testing.assert_array_equal(now.velocity_m_s[1], (1.0, -0.5, 0.25))
        np.testing.assert_array_equal(now.orientation_wxyz[1], HALF_TURN)
        np.testing.assert_array_equal(now.rotor_rad_s[1], [300.0] * 4)


def test_a_pose_is_extrapolated_for_half_a_second_and_then_held(fleet: Fleet, drones: ExternalDrones):
    drones.take("d1", truth(0), 0)
    advance(fleet, drones, 60)
    held = np.array((4.0, 1.0, 2.0)) + POSE_AGE_MAX_NS * 1e-9 * np.array((1.0, -0.5, 0.25))
    np.testing.assert_allclose(fleet.truth().position_m[1], held, atol=1e-12)
    np.testing.assert_array_equal(fleet.truth().velocity_m_s[1], (0.0, 0.0, 0.0))


def test_simulated_drones_fly_bit_identically_beside_an_external_one():
    """Far away, external drones have no effect: the simulated drones fly as in a fleet without them."""
    plain, mixed = fleet_of("simulated", "simulated"), fleet_of("simulated", "external")
    led = ExternalDrones(mixed)
    for fleet in (plain, mixed):
        assert fleet.takeoff(0) is None
    for _ in range(300):
        plain.advance()
        led.take("d1", truth(mixed.t_ns, p=(300.0, 0.0, 5.0)), mixed.t_ns)
        advance(mixed, led)
    np.testing.assert_array_equal(plain.bodies.state[0], mixed.bodies.state[0])
    assert [s for s in samples_of(plain) if s.drone == 0] == samples_of(mixed)


def test_the_world_publishes_nothing_about_external_drones():
    for bodies in (("simulated", "external"), ("external", "simulated", "external", "simulated")):
        fleet = fleet_of(*bodies)
        publication, simulated = GatePublication(fleet), {f"d{i}" for i, b in enumerate(bodies) if b == "simulated"}
        for number in range(20):
            fleet.advance()
            gate = publication.gate([None] * fleet.count)
            assert gate.seq == number
            assert {keys.thing(key) for key, _ in gate.pairs} == simulated
            gate.check()
            assert {key for key, _ in gate.decoded() if key.endswith("status")} == {keys.status(d) for d in simulated}


def test_a_fleet_of_external_drones_alone_advances():
    fleet = fleet_of("external", "external")
    drones = ExternalDrones(fleet)
    GatePublication(fleet)
    drones.take("d0", truth(0, p=(0.0, 0.0, 3.0)), 0)
    advance(fleet, drones, 5)
    assert fleet.closest_m == pytest.approx(math.hypot(4.0 - 0.1, 0.05, 3.025 - 0.058), abs=0.01)


BAD: tuple[tuple[dict[str, Any], str], ...] = (
    ({"p": (2e5, 0.0, 0.0)}, "position_m"),
    ({"v": (0.0, -300.0, 0.0)}, "velocity_m_s"),
    ({"q": (0.5, 0.0, 0.0, 0.0)}, "orientation_wxyz"),
    ({"q": (0.0, 0.0, 0.0, 0.0)}, "orientation_wxyz"),
    ({"rotors": (300.0,) * 6}, "rotor_rad_s"),
)


@pytest.mark.parametrize(("fields", "name"), BAD)
def test_an_absurd_pose_is_refused_and_changes_nothing(
    fleet: Fleet, drones: ExternalDrones, fields: dict[str, Any], name: str
):
    drones.take("d1", truth(0), 0)
    assert has_terms(drones.take("d1", truth(0, **fields), 0) or "", name, "must")
    advance(fleet, drones)
    np.testing.assert_allclose(fleet.truth().position_m[1], (4.02, 0.99, 2.005), atol=1e-12)


def test_stale_and_future_poses_are_refused(drones: ExternalDrones):
    now_ns = 2_000_000_000
    assert has_terms(drones.take("d1", truth(now_ns + GATE_NS), now_ns) or "", "t_ns", "newest gate")
    assert has_terms(drones.take("d1", truth(now_ns - POSE_AGE_MAX_NS - GATE_NS), now_ns) or "", "t_ns", "0.5 s ago")
    assert drones.take("d1", truth(now_ns - GATE_NS), now_ns) is None
    assert has_terms(drones.take("d1", truth(now_ns - 2 * GATE_NS), now_ns) or "", "t_ns", "last one")
    assert drones.take("d1", status(now_ns), now_ns) is None
    assert has_terms(drones.take("d1", status(now_ns - GATE_NS), now_ns) or "", "t_ns", "last one")
    assert drones.status(1) == status(now_ns)


def test_rotor_speeds_are_clipped_to_the_limits_of_the_model(fleet: Fleet, drones: ExternalDrones):
    drones.take("d1", truth(0, rotors=(-5.0, 100.0, 503.0, 2000.0)), 0)
    advance(fleet, drones)
    np.testing.assert_array_equal(fleet.truth().rotor_rad_s[1], (0.0, 100.0, 503.0, 503.0))


def command_refusal(drones: ExternalDrones, kind: str) -> str | None:
    fields = {
        "velocity": lambda: Velocity(0, 0, "x", (0.0, 0.0, 0.0), 0.0),
        "ardrone": lambda: Ardrone(0, 0, "x", 0.0, 0.0, 0.0, 0.0),
        "attitude": lambda: Attitude(0, 0, "x", (1.0, 0.0, 0.0, 0.0), 4.0, 0.0),
        "rotors": lambda: RotorSpeeds(0, 0, "x", (300.0,) * 4),
    }
    message = fields[kind]() if kind in fields else Mode(0, 0, "x", kind)  # type: ignore[arg-type]
    return drones.command_refusal(1, kind if kind in fields else "mode", message)


ALLOWED = {
    "landed": {"takeoff"},
    "taking_off": {"land"},
    "hovering": {"land", "velocity", "ardrone", "attitude", "rotors"},
    "flying": {"land", "velocity", "ardrone", "attitude", "rotors"},
    "landing": {"land"},
    "emergency": {"reset"},
}
KINDS = ("takeoff", "land", "reset", "velocity", "ardrone", "attitude", "rotors")


@pytest.mark.parametrize("state", ALLOWED)
def test_the_state_a_driver_publishes_decides_which_commands_are_accepted(drones: ExternalDrones, state: str):
    drones.take("d1", status(0, state), 0)
    assert {kind for kind in KINDS if command_refusal(drones, kind) is None} == ALLOWED[state]
    assert command_refusal(drones, "emergency") is None


def test_without_a_state_only_an_emergency_stop_is_accepted(drones: ExternalDrones):
    for kind in KINDS:
        assert has_terms(command_refusal(drones, kind) or "", "d1", "driver.d1")
    assert command_refusal(drones, "emergency") is None


def test_a_setpoint_that_does_not_fit_the_drone_is_refused(drones: ExternalDrones):
    drones.take("d1", status(0), 0)
    six = RotorSpeeds(0, 0, "x", (300.0,) * 6)
    none = Attitude(0, 0, "x", (0.0, 0.0, 0.0, 0.0), 4.0, 0.0)
    assert has_terms(drones.command_refusal(1, "rotors", six) or "", "6", "4 rotors")
    assert has_terms(drones.command_refusal(1, "attitude", none) or "", "quaternion")


def test_a_restored_fleet_keeps_what_the_drivers_published(fleet: Fleet, drones: ExternalDrones):
    drones.take("d1", truth(0), 0)
    drones.take("d1", status(0), 0)
    advance(fleet, drones, 3)
    other = fleet_of("simulated", "external")
    successor = ExternalDrones(other)
    continue_from(fleet, other)
    continue_from(drones, successor)
    for each, led in ((fleet, drones), (other, successor)):
        advance(each, led, 5)
    np.testing.assert_array_equal(fleet.bodies.state, other.bodies.state)
    assert successor.status(1) == status(0)
