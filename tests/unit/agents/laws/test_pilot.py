"""What a pilot of a formation law takes of what comes late."""

from typing import Any

from zsim.contract.flight_messages import Estimate
from zsim.scenario import scenario_file
from zsim_agents.laws.pilot import Motion
from zsim_agents.laws.shape import VirtualStructure

DRONES = [{"name": name, "position_m": [3 * k, 0, 0]} for k, name in enumerate(("d1", "d2"))]


def pilot() -> Any:
    made = type("Own", (VirtualStructure,), {"parameters": VirtualStructure.Parameters()})
    return made("d1", scenario_file.resolve({"name": "s", "duration_s": 9, "drones": DRONES}))


def motion(t_ns: int) -> Motion:
    return Motion(t_ns=t_ns, position_m=(t_ns, 0.0, 2.0), velocity_m_s=(0.0, 0.0, 0.0), is_engaged=True)


def estimate(t_ns: int) -> Estimate:
    four, three = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    return Estimate(t_ns, 0, (t_ns, 0.0, 2.0), three, four, 0.0, (0.0,) * 36, 0.0, three, {})


def test_an_older_message_that_comes_later_changes_nothing() -> None:
    """Jitter of a link lets one message overtake another."""
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
