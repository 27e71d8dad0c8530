"""The pilot of a formation law: late messages, obstacles and surfaces."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.contract.flight_messages import Estimate
from zsim.scenario import scenario_file
from zsim.scenario.surroundings import packed
from zsim_agents.laws.pilot import Motion
from zsim_agents.laws.virtual_structure import VirtualStructure

DRONES = [{"name": name, "position_m": [3 * k, 0, 0]} for k, name in enumerate(("d1", "d2"))]


def pilot(**environment: Any) -> Any:
    made = type("Own", (VirtualStructure,), {"parameters": VirtualStructure.Parameters()})
    document = {"name": "s", "duration_s": 9, "drones": DRONES, "environment": environment}
    return made("d1", scenario_file.resolve(document))


def motion(t_ns: int) -> Motion:
    return Motion(t_ns=t_ns, position_m=(t_ns, 0.0, 2.0), velocity_m_s=(0.0, 0.0, 0.0), is_engaged=True)


def estimate(t_ns: int, y_m: float = 0.0, z_m: float = 2.0) -> Estimate:
    four, three = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    return Estimate(t_ns, 0, (t_ns, y_m, z_m), three, four, 0.0, (0.0,) * 36, 0.0, three, {})


def test_a_message_overtaken_by_a_newer_one_is_ignored() -> None:
    """With jitter, one message can overtake another."""
    first = pilot()
    for t_ns in (1, 3, 2):
        first.receive(Motion.of("d2"), motion(t_ns))
        first.receive("drone/d1/estimate", estimate(t_ns))
    state = first.snapshot()
    assert state["heard"]["d2"][0] == state["p_W"][0] == 3
    again = pilot()
    again.restore(state)
    again.receive(Motion.of("d2"), motion(2))
    again.receive("drone/d1/estimate", estimate(2))
    assert again.snapshot()["heard"] == state["heard"]
    assert again.snapshot()["p_W"].tolist() == state["p_W"].tolist()


def sheet(name: str, *corners: tuple[float, float, float]) -> dict[str, Any]:
    """Return the surface of a quadrilateral."""
    a, b, c, d = corners
    return {"name": name, "triangles": packed(np.array([[*a, *b, *c], [*a, *c, *d]]))}


def test_a_wall_of_triangles_is_avoided_like_a_solid_wall() -> None:
    """The wall is along y = 5, as a box 2 m thick and as a sheet at the box's face."""
    solid = pilot(obstacles=[{"name": "wall", "shape": "box", "position_m": [0, 6, 0], "size_m": [40, 2, 8]}])
    face = pilot(surfaces=[sheet("wall", (-20, 5, 0), (20, 5, 0), (20, 5, 8), (-20, 5, 8))])
    for x, y in ((0, 4.2), (1, 3.6), (2, 3.4), (21, 4.5)):
        felt = []
        for each in (solid, face):
            each.receive("drone/d1/estimate", estimate(x, y))
            felt.append(each.avoidance(np.array([x, y], dtype=float), []))
        assert felt[1] == pytest.approx(felt[0], rel=1e-6), (x, y)
        assert (felt[1][1] < 0) == (y > 3.5), (x, y)  # within avoid_m


def test_slopes_count_at_their_level_distance_and_flat_ground_is_ignored() -> None:
    rise = math.tan(math.radians(30))
    slope = sheet("slope", (4, -30, 0), (34, -30, 30 * rise), (34, 30, 30 * rise), (4, 30, 0))
    flown = pilot(surfaces=[slope, sheet("floor", (-30, -30, 1), (4, -30, 1), (4, 30, 1), (-30, 30, 1))])
    flown.receive("drone/d1/estimate", estimate(4, 0.0, 2.0))
    ahead_m = 2.0 / rise
    assert flown.obstacles_near(np.array([4.0, 0.0]), 0.95 * ahead_m) == []  # the floor is 1 m below
    ((distance, away),) = flown.obstacles_near(np.array([4.0, 0.0]), 1.05 * ahead_m)
    assert distance == pytest.approx(ahead_m, rel=1e-6)
    assert away == pytest.approx([-1.0, 0.0], abs=1e-6)
