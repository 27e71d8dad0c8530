"""Faults against closed forms that follow from their definitions and the physics of the aircraft."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.scenario.faults import planned
from zsim.scenario.scenario_file import resolve
from zsim_world.fleet.fleet import Fleet

GATE_NS, STEP_NS = 20_000_000, 2_500_000
MASS_KG, GRAVITY, THRUST_N_S2 = 0.429, 9.80665, 8.048e-6
HOVER_RAD_S = math.sqrt(MASS_KG * GRAVITY / (4 * THRUST_N_S2))  # in still air, far from the ground
DRAG_1_S = 0.249 / MASS_KG


def hovering(**wind: Any) -> Fleet:
    """Return a drone that has climbed to 5 m and hovers, whose firmware has noiseless sensors."""
    quiet = {name: {field: {"noise": 0, "bias": 0, "quantum": 0}} for name, field in (
        ("mag", "field_ut"), ("baro", "altitude_m"), ("sonar", "range_m"), ("flow", "velocity_m_s"))}  # fmt: skip
    quiet["imu"] = {"accel_m_s2": {"noise": 0}, "gyro_deg_s": {"noise": 0}}
    drone = {"name": "d1", "position_m": [0, 0, 0], "takeoff_height_m": 5}
    document = {"name": "t", "duration_s": 1, "drones": [drone], "sensors": {"preset": "paper", **quiet}}
    fleet = Fleet(resolve({**document, "environment": {"wind": wind}}))
    assert fleet.takeoff(0) is None
    fly(fleet, 1200)
    assert fleet.status(0)[0] == "hovering"
    return fleet


def fly(fleet: Fleet, gates: int) -> np.ndarray:
    """Advance; return the true states as rows of position, velocity and rotor speeds."""
    rows = []
    for _ in range(gates):
        fleet.advance()
        truth = fleet.truth()
        rows.append(np.concatenate([truth.position_m[0], truth.velocity_m_s[0], truth.rotor_rad_s[0]]))
    return np.array(rows)


def strike(fleet: Fleet, kind: str, target: str = "d1", **parameters: Any) -> None:
    given = {"kind": kind, "target": target, **parameters}
    fleet.impairment.strike([planned(given, 1, "test", fleet.t_ns, GATE_NS)])


@pytest.mark.parametrize("share", [0.9, 0.7])
def test_the_firmware_compensates_for_lost_thrust(share: float):
    """All rotors lose thrust alike; for the same weight, each must turn as before, on a command 1/sqrt(share)."""
    fleet = hovering()
    before = fleet.truth().position_m[0, 2]
    strike(fleet, "rotor_efficiency", rotor="all", value=share)
    rows = fly(fleet, 600)
    assert rows[:5, 6:].max() < HOVER_RAD_S
    assert before - rows[:, 2].min() > 0.03 * (1 - share)
    assert rows[-100:, 6:].mean() == pytest.approx(HOVER_RAD_S, rel=0.005)
    assert rows[-1, 2] == pytest.approx(before, abs=0.05)


def test_a_drone_with_too_little_thrust_falls():
    """Rotors turn at 503 rad/s at most, and thrust grows with the square: below (hover / 503)^2 a drone falls."""
    least = (HOVER_RAD_S / 503.0) ** 2
    held, falls = hovering(), hovering()
    strike(held, "rotor_efficiency", rotor="all", value=1.15 * least)
    strike(falls, "rotor_efficiency", rotor="all", value=0.9 * least)
    assert fly(held, 500)[-1, 2] > 3.0
    last = fly(falls, 500)[-1]
    assert last[2] < 1.0


def test_a_gust_pushes_a_drone_as_its_drag_predicts():
    """A gust w pushes a hovering drone, relative to one without the gust, by dv/dt = c (w - v), c = drag / mass.

    This holds until the firmware leans into the gust, some gates later; three gates are compared. w is the gust at the
    middle of each gate, and a physics step uses the air of the step before. A loss of a twentieth of the force fails.
    """
    calm, fleet = hovering(), hovering()
    strike(fleet, "gust", "world", velocity_m_s=[20, 0, 0], for_s=1.0)
    gust, expected = 0.0, 0.0
    for gate in range(3):
        fleet.impairment.blow(fleet.t_ns, fleet.t_ns + GATE_NS)
        fleet.advance()
        calm.advance()
        for _ in range(GATE_NS // STEP_NS):
            expected += (gust - expected) * -math.expm1(-DRAG_1_S * STEP_NS / 1e9)
            gust = 10.0 * (1.0 - math.cos(2.0 * math.pi * (gate + 0.5) * GATE_NS / 1e9))
        pushed = fleet.truth().velocity_m_s[0, 0] - calm.truth().velocity_m_s[0, 0]
        assert pushed == pytest.approx(expected, rel=0.02)
