"""An FMU as an agent, in this process: what it takes and gives, and what is refused in one line."""

from pathlib import Path
from typing import Any

import fmus
import pytest
from fmpy.validation import validate_fmu

import zsim
from zsim.contract import keys
from zsim.contract.flight_messages import Velocity
from zsim.errors import RunError, UserCodeError
from zsim_bridges.fmu.agent import Fmu
from zsim_bridges.fmu.model import FmuModel

GATE_S = 0.02
SCENARIO = {
    "name": "one",
    "seed": 3,
    "duration_s": 8,
    "sensors": {"preset": "paper"},
    "drones": [{"name": "drone1", "position_m": [0, 0, 0], "yaw_deg": 90}],
    "processes": {"expect": ["estimator.drone1"]},
}
EVERYTHING = """
variable("x", 0.0, I)
variable("p[0]", 0.0, I)
variable("p[1]", 0.0, I)
variable("p[2]", 0.0, I)
variable("crash", False, I, Boolean)
variable("state", "", I, String)
variable("gain", 0.5, P)
variable("vx", 0.0, O)
variable("yaw_rate", 0.0, O)
variable("up", False, O, Boolean)
variable("count", 0, O, Whole)
"""
LAW = """
self.vx = self.gain * (1.0 - self.x)
self.count += 1
self.up = self.count > 50
if self.count == 200 and self.gain == 9.0:
    raise ValueError("no more")
if self.count == 200 and self.gain == 8.0:
    self.yaw_rate = float("nan")
"""
MAP = {"x": "estimate.position_m.0", "vx": "velocity_m_s.0", "up": "mode.takeoff"}


@pytest.fixture(scope="module", params=[2, 3])
def everything(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FMU with variables of all types, of FMI 2 and of FMI 3."""
    version = request.param
    return fmus.build(tmp_path_factory.mktemp("fmu"), f"Everything{version}", version, EVERYTHING, LAW)


@pytest.fixture(scope="module")
def waypoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fmus.example(tmp_path_factory.mktemp("fmu"))


def flight(fmu: Fmu, **changed: Any) -> zsim.Simulation:
    return zsim.Simulation(SCENARIO | changed, agents=[fmu])


def commands_of(sim: zsim.Simulation) -> list[Velocity]:
    """Fly to the end; return the velocity commands of the FMU."""
    sent: list[Velocity] = []
    add_message = sim._flight.bus._sink

    def listen(key: str, message: Any) -> None:
        if key == keys.command("drone1", "velocity"):
            sent.append(message)
        add_message(key, message)

    sim._flight.bus._sink = listen
    sim.run()
    return sent


def test_fmpy_finds_no_fault_in_the_fmus_of_these_tests(everything: Path, waypoint: Path) -> None:
    assert validate_fmu(str(waypoint)) == []
    assert validate_fmu(str(everything)) == []


def test_a_flag_takes_off_and_numbers_fly(everything: Path) -> None:
    sim = flight(Fmu(everything, "drone1", MAP, param={"gain": "0.8"}, frame="world"))
    sent = commands_of(sim)
    assert abs(sim.truth.position_m[0, 0] - 1.0) < 0.5
    assert {(command.source, command.frame) for command in sent} == {("fmu.drone1", "world")}
    assert sent[0].velocity_m_s[1:] == (0.0, 0.0)


def test_the_state_is_given_and_taken_back_to_the_same_bits(everything: Path) -> None:
    sim = flight(Fmu(everything, "drone1", MAP))
    sim.run(5.0)
    snapshot = sim.snapshot()
    sim.run(7.0)
    first = sim.truth.position_m.tobytes()
    sim.restore(snapshot)
    sim.run(7.0)
    assert sim.truth.position_m.tobytes() == first
    sim.reset()
    sim.run(7.0)
    assert sim.truth.position_m.tobytes() == first


def test_an_fmu_without_states_says_so_and_cannot_be_restored(tmp_path: Path) -> None:
    said: list[str] = []
    path = fmus.build(tmp_path, "Stateless", 3, EVERYTHING, LAW, restores=False)
    sim = flight(Fmu(path, "drone1", MAP, say=said.append))
    assert said == ["fmu.drone1: Stateless.fmu cannot give its state: started again, it begins afresh"]
    with pytest.raises(RunError, match=r"fmu\.drone1 has no snapshot"):
        sim.snapshot()


def test_elements_of_an_array_of_fmi_2_are_mapped_as_one(everything: Path) -> None:
    sim = flight(Fmu(everything, "drone1", {**MAP, "p": "truth.position_m"}))
    sim.run(5.0)
    agent = next(agent for agent in sim._flight.agents if agent.name == "fmu.drone1")
    read = agent._unit.read([FmuModel(everything).variable("p")])[0]  # type: ignore[attr-defined]
    assert read == list(agent._latest[keys.truth("drone1")].position_m)  # type: ignore[attr-defined]


def test_its_step_is_a_multiple_of_the_gate(everything: Path) -> None:
    sent = commands_of(flight(Fmu(everything, "drone1", MAP, period_s=0.1)))
    assert sent
    assert {command.t_ns % 100_000_000 for command in sent} == {0}


@pytest.mark.parametrize(
    ("gain", "reason"),
    [
        (9.0, r"DoStep returns (error|fatal).*ValueError.*no more"),
        (8.0, "output yaw_rate is nan; must be finite"),
    ],
)
def test_what_a_running_fmu_does_amiss_ends_the_flight_with_its_name_and_the_gate(
    everything: Path, gain: float, reason: str
) -> None:
    fmu = Fmu(everything, "drone1", {**MAP, "yaw_rate": "yaw_rate_rad_s"}, param={"gain": gain}, say=lambda line: None)
    sim = flight(fmu)
    with pytest.raises(UserCodeError, match=rf"^fmu\.drone1 at 3\.98 s: .*Everything[23]\.fmu: .*{reason}"):
        sim.run()


REFUSALS = [
    ({"vx": "velocity_m_s.0", "y": "estimate.yaw_rad"}, {}, "has no variable 'y'; must be one of .*vx"),
    ({"yawrate": "velocity_m_s.0"}, {}, r"has no variable 'yawrate'; did you mean yaw_rate\?"),
    ({"gain": "estimate.yaw_rad"}, {}, "gain is a parameter; must be an input or an output; give a value of its own"),
    ({"vx": "velocity_m_s.3"}, {}, "'3' is no part of velocity_m_s; must be 0 to 2"),
    ({"vx": "velocity_m_s"}, {}, "vx has 1 values and velocity_m_s 3; must be as many"),
    ({"vx": "velocity.speed_m_s.0"}, {}, r"has no field 'speed_m_s'; .*must be one of velocity_m_s"),
    ({"vx": "truth.position_m.0"}, {}, "is no key of an agent's outputs"),
    ({"vx": "mode.fly"}, {}, "mode is 'fly'; must be one of takeoff, land, emergency, reset"),
    ({"vx": "drone7/velocity_m_s.0"}, {}, "is no key of"),
    ({"x": "drone/drone7/estimate.yaw_rad"}, {}, r"no drone 'drone7'; did you mean drone1\?"),
    ({"x": "estimate.sensors"}, {}, "holds neither numbers nor flags nor texts"),
    ({"x": "status.state"}, {}, "a text is no number"),
    ({"crash": "estimate.yaw_rad"}, {}, "a number is no flag"),
    ({"state": "estimate.yaw_rad"}, {}, "a number is no text"),
    ({"x": "estimate.yaw_rad"}, {}, "none of its outputs is mapped; must map one of vx, yaw_rate, up, count"),
    (["vx"], {}, "must be NAME=PLACE"),
    (["vx=velocity_m_s.0", "yaw_rate=velocity_m_s.0"], {}, "vx gives that already"),
    ({"vx": "attitude.orientation_wxyz.0"}, {}, "0 of 1 values of thrust_n are mapped; must be all"),
    ({"vx": "estimate.position_m.0"}, {}, "1 of 3 values of position_m are mapped; must be all"),
    (MAP, {"period_s": 0.03}, "--period is 0.03 s; must be a multiple of the gate, 0.02 s"),
    (MAP, {"param": {"gain": "high"}}, "--param gain is 'high'; must be a number"),
    (MAP, {"param": {"vx": "1"}}, "--param vx: is a output; must be a parameter or an input"),
    (MAP, {"drone": "drone2"}, "--drone is 'drone2'; must be one of drone1"),
]


@pytest.mark.parametrize(("mapping", "more", "reason"), REFUSALS, ids=[reason[:40] for _, _, reason in REFUSALS])
def test_refuses_in_one_line(everything: Path, mapping: Any, more: dict[str, Any], reason: str) -> None:
    with pytest.raises(RunError, match=reason) as refused:
        flight(Fmu(everything, **{"drone": "drone1", "map": mapping, **more}))
    assert "\n" not in str(refused.value)
