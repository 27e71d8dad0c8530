import numpy as np
import pytest
from msgspec.structs import replace

from zsim.contract.flight_messages import Truth
from zsim.scenario.scenario_file import resolve
from zsim_agents.cameras.camera_process import PENDING_MAX, TruthHistory, standing

GATE_NS = 20_000_000


def truth(gate: int, x: float = 0.0, rotor: float = 100.0) -> Truth:
    """A drone that flies east at 2 m/s and turns its rotors faster and faster."""
    at = (x + 2.0 * gate * GATE_NS / 1e9, 0.0, 1.0)
    return Truth(
        gate * GATE_NS,
        gate,
        at,
        (2.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.1 * gate),
        (0.0, 0.0, 0.0),
        (rotor + gate,) * 4,
    )


PLACED = resolve({"name": "t", "duration_s": 1, "drones": [{"name": "d2", "position_m": [7, 0, 0], "yaw_deg": 90}]})
STANDING = standing(PLACED.drones[0], 4)


def history(gates: int, span_gates: int = 5) -> TruthHistory:
    kept = TruthHistory(2, GATE_NS, span_gates * GATE_NS)
    for gate in range(gates):
        kept.add(1, truth(gate, 10.0))
        kept.add(0, truth(gate))
    return kept


def test_bodies_are_interpolated_between_two_gates() -> None:
    bodies = history(6).bodies(4 * GATE_NS + GATE_NS // 4)
    assert bodies is not None
    assert bodies.p_WB[:, 0] == pytest.approx([0.17, 10.17])
    assert bodies.w_WB_B[:, 2] == pytest.approx([0.425, 0.425])
    assert bodies.rotors[1] == pytest.approx([104.25] * 4)


def test_a_gate_itself_needs_no_other() -> None:
    bodies = history(6).bodies(5 * GATE_NS)
    assert bodies is not None
    assert bodies.p_WB[0, 0] == pytest.approx(0.2)


def test_what_is_too_new_too_old_or_lacks_a_drone_is_not_there() -> None:
    kept = history(30)
    kept.add(0, truth(30))
    assert kept.newest_ns == 29 * GATE_NS
    assert kept.bodies(29 * GATE_NS + 1) is None
    assert kept.bodies(GATE_NS) is None
    assert kept.bodies(26 * GATE_NS) is not None


def test_a_gate_that_stays_incomplete_is_passed_over_and_forgotten() -> None:
    kept = history(2)
    kept.add(0, truth(2))
    for gate in range(3, 3 + 2 * PENDING_MAX):
        kept.add(0, truth(gate))
    last = 3 + 2 * PENDING_MAX
    for gate in (last, last + 1):
        kept.add(0, truth(gate))
        kept.add(1, truth(gate))
    assert kept.newest_ns == (last + 1) * GATE_NS
    assert kept.bodies(2 * GATE_NS) is None
    assert np.isfinite(kept.bodies(last * GATE_NS + 1).p_WB).all()  # type: ignore[union-attr]


def test_an_external_drone_is_drawn_where_its_last_pose_leads_to() -> None:
    """Its driver may skip gates, and be away; nothing waits for it."""
    kept = TruthHistory(2, GATE_NS, 50 * GATE_NS, {1: STANDING})
    for gate in range(5):
        kept.add(0, truth(gate))
    assert kept.newest_ns == 4 * GATE_NS
    standing = kept.bodies(4 * GATE_NS)
    assert standing is not None
    assert standing.p_WB[:, 0] == pytest.approx([0.16, 7.0])
    kept.add(1, truth(5, 10.0))
    kept.add(1, replace(truth(5, 30.0), rotor_rad_s=(1.0,) * 6))
    kept.add(1, replace(truth(5, 30.0), orientation_wxyz=(0.0,) * 4))
    kept.add(0, truth(5))
    for gate in range(6, 46):
        kept.add(0, truth(gate))
    for gate, x in ((5, 10.2), (15, 10.6), (30, 11.2), (45, 11.2)):
        bodies = kept.bodies(gate * GATE_NS)
        assert bodies is not None
        assert bodies.p_WB[1, 0] == pytest.approx(x)


def test_external_drones_alone_are_drawn_at_the_gates_of_their_drivers() -> None:
    kept = TruthHistory(2, GATE_NS, 5 * GATE_NS, {0: STANDING, 1: STANDING})
    kept.add(1, truth(3, 10.0))
    bodies = kept.bodies(3 * GATE_NS)
    assert bodies is not None
    assert bodies.p_WB[:, 0] == pytest.approx([7.0, 10.12])
