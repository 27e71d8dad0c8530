"""An FMU as an agent in this process: its inputs and outputs, and what is refused in one line."""

import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import fmus
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from refused import has_terms, refused

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
    """Return an FMU with variables of all types, for FMI 2 and FMI 3."""
    version = request.param
    return fmus.build(tmp_path_factory.mktemp("fmu"), f"Everything{version}", version, EVERYTHING, LAW)


@pytest.fixture(scope="module")
def waypoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fmus.example(tmp_path_factory.mktemp("fmu"))


def flight(fmu: Fmu, **changed: Any) -> zsim.Simulation:
    return zsim.Simulation(SCENARIO | changed, agents=[fmu])


def commands_of(sim: zsim.Simulation) -> list[Velocity]:
    """Fly to the end and return the velocity commands of the FMU."""
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


def test_a_boolean_output_takes_off_and_numbers_command_the_velocity(everything: Path) -> None:
    sim = flight(Fmu(everything, "drone1", MAP, param={"gain": "0.8"}, frame="world"))
    sent = commands_of(sim)
    assert abs(sim.truth.position_m[0, 0] - 1.0) < 0.5
    assert {(command.source, command.frame) for command in sent} == {("fmu.drone1", "world")}
    assert sent[0].velocity_m_s[1:] == (0.0, 0.0)


def test_restoring_or_resetting_the_state_repeats_a_flight_bit_for_bit(everything: Path) -> None:
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


def test_an_fmu_without_state_access_reports_it_and_has_no_snapshot(tmp_path: Path) -> None:
    said: list[str] = []
    path = fmus.build(tmp_path, "Stateless", 3, EVERYTHING, LAW, restores=False)
    sim = flight(Fmu(path, "drone1", MAP, say=said.append))
    assert has_terms("\n".join(said), "fmu.drone1:", "Stateless.fmu")
    with refused(RunError, "fmu.drone1", "snapshot()"):
        sim.snapshot()


def test_elements_of_an_array_of_fmi_2_are_mapped_together(everything: Path) -> None:
    sim = flight(Fmu(everything, "drone1", {**MAP, "p": "truth.position_m"}))
    sim.run(5.0)
    agent = next(agent for agent in sim._flight.agents if agent.name == "fmu.drone1")
    read = agent._instance.read([FmuModel(everything).variable("p")])[0]  # type: ignore[attr-defined]
    assert read == list(agent._latest[keys.truth("drone1")].position_m)  # type: ignore[attr-defined]


def test_units_of_one_quantity_are_converted_and_reported(tmp_path: Path) -> None:
    variables = """
variable("yaw", 0.0, I, unit="deg")
variable("height", 0.0, I, unit="K")
variable("vx", 0.0, O, unit="km/h")
"""
    said: list[str] = []
    path = fmus.build(tmp_path, "Units", 3, variables, "self.vx = 3.6")
    places = {"yaw": "estimate.yaw_rad", "height": "estimate.position_m.2", "vx": "velocity_m_s.0"}
    sim = flight(Fmu(path, "drone1", places, takeoff_s=0.5, say=said.append))
    sent = commands_of(sim)
    assert {round(command.velocity_m_s[0], 12) for command in sent} == {1.0}
    agent = next(agent for agent in sim._flight.agents if agent.name == "fmu.drone1")
    variables_of = FmuModel(path).variables
    unit: Any = agent._instance  # type: ignore[attr-defined]
    (yaw,), (height,) = unit.read([variables_of["yaw"], variables_of["height"]])
    estimate: Any = agent._latest[keys.estimate("drone1")]  # type: ignore[attr-defined]
    assert abs(math.radians(yaw) - estimate.yaw_rad) < 1e-12
    assert height == estimate.position_m[2]
    text = "\n".join(said)
    assert has_terms(text, "yaw=estimate.yaw_rad:", "deg", "rad", "converted")
    assert has_terms(text, "height=estimate.position_m.2:", "K", "m")
    assert has_terms(text, "vx=velocity_m_s.0:", "km/h", "m/s", "converted")


def test_an_fmu_replaces_the_stock_estimator(tmp_path: Path) -> None:
    variables = """
variable("p", [0.0] * 3, I)
variable("v", [0.0] * 3, I)
variable("p_est", [0.0] * 3, O)
variable("v_est", [0.0] * 3, O)
variable("yaw", 0.0, O)
"""
    law = "self.p_est, self.v_est, self.yaw = [x + 0.25 for x in self.p], self.v, 1.0"
    path = fmus.build(tmp_path, "Estimator", 3, variables, law)
    places = {"p": "truth.position_m", "v": "truth.velocity_m_s"}
    places |= {"p_est": "estimate.position_m", "v_est": "estimate.velocity_m_s", "yaw": "estimate.yaw_rad"}
    sim = flight(Fmu(path, "drone1", places, name="estimator.drone1"))
    sim.run(1.0)
    assert [agent.name for agent in sim._flight.agents] == ["estimator.drone1", "python.main"]
    assert np.array_equal(sim.estimates.position_m, sim.truth.position_m + 0.25)
    assert np.allclose(sim.estimates.orientation_wxyz[0], (math.cos(0.5), 0.0, 0.0, math.sin(0.5)), atol=1e-15)


def test_the_step_of_an_fmu_may_be_a_multiple_of_the_gate(everything: Path) -> None:
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
def test_a_fault_of_a_running_fmu_ends_the_flight_with_name_and_time(
    everything: Path, gain: float, reason: str
) -> None:
    fmu = Fmu(everything, "drone1", {**MAP, "yaw_rate": "yaw_rate_rad_s"}, param={"gain": gain}, say=lambda line: None)
    sim = flight(fmu)
    with pytest.raises(UserCodeError, match=rf"^fmu\.drone1 at 3\.98 s: .*Everything[23]\.fmu: .*{reason}"):
        sim.run()


REFUSALS: list[tuple[Any, dict[str, Any], tuple[str, ...]]] = [
    ({"vx": "velocity_m_s.0", "y": "estimate.yaw_rad"}, {}, ("'y'", "x", "vx")),
    ({"yawrate": "velocity_m_s.0"}, {}, ("'yawrate'", "yaw_rate?")),
    ({"gain": "estimate.yaw_rad"}, {}, ("gain=estimate.yaw_rad", "parameter", "input", "output", "--param")),
    ({"vx": "velocity_m_s.3"}, {}, ("vx=velocity_m_s.3", "'3'", "velocity_m_s", "0", "2")),
    ({"vx": "velocity_m_s"}, {}, ("vx", "1", "velocity_m_s", "3")),
    (
        {"vx": "velocity.speed_m_s.0"},
        {},
        ("drone/drone1/cmd/velocity", "'speed_m_s'", "velocity_m_s", "yaw_rate_rad_s"),
    ),
    ({"vx": "truth.position_m.0"}, {}, ("vx=truth.position_m.0", "drone/drone1/truth")),
    ({"vx": "mode.fly"}, {}, ("'fly'", "takeoff", "land", "emergency", "reset")),
    ({"vx": "drone7/velocity_m_s.0"}, {}, ("vx=drone7/velocity_m_s.0", "drone7/velocity_m_s")),
    ({"x": "drone/drone7/estimate.yaw_rad"}, {}, ("'drone7'", "drone1?")),
    ({"x": "cluster/main/state.margin"}, {}, ("'main'", "the run has none")),
    ({"x": "estimate.sensors"}, {}, ("x=estimate.sensors", "sensors")),
    ({"x": "status.state"}, {}, ("x=status.state", "text", "number")),
    ({"crash": "estimate.yaw_rad"}, {}, ("crash=estimate.yaw_rad", "number", "boolean")),
    ({"state": "estimate.yaw_rad"}, {}, ("state=estimate.yaw_rad", "number", "text")),
    ({"x": "estimate.yaw_rad"}, {}, ("vx", "yaw_rate", "up", "count")),
    (["vx"], {}, ("--map", "'vx'", "NAME=PLACE")),
    (["vx=velocity_m_s.0", "yaw_rate=velocity_m_s.0"], {}, ("yaw_rate=velocity_m_s.0", "vx")),
    ({"vx": "attitude.orientation_wxyz.0"}, {}, ("drone/drone1/cmd/attitude", "0", "1", "thrust_n")),
    ({"vx": "estimate.position_m.0"}, {}, ("drone/drone1/estimate", "1", "3", "position_m")),
    (MAP, {"period_s": 0.03}, ("--period", "0.03", "0.02")),
    (MAP, {"param": {"gain": "high"}}, ("--param", "gain", "'high'", "number")),
    (MAP, {"param": {"vx": "1"}}, ("--param", "vx", "output", "parameter", "input")),
    (MAP, {"drone": "drone2"}, ("--drone", "'drone2'", "drone1")),
]


@pytest.mark.parametrize(("mapping", "more", "terms"), REFUSALS, ids=[" ".join(terms) for _, _, terms in REFUSALS])
def test_a_bad_mapping_or_option_is_refused_in_one_line(
    everything: Path, mapping: Any, more: dict[str, Any], terms: tuple[str, ...]
) -> None:
    with refused(RunError, *terms) as raised:
        flight(Fmu(everything, **{"drone": "drone1", "map": mapping, **more}))
    assert "\n" not in str(raised.value)


def test_an_fmu_without_outputs_is_refused(tmp_path: Path) -> None:
    path = fmus.build(tmp_path, "Silent", 3, 'variable("x", 0.0, I)', "pass")
    with refused(RunError, "Silent.fmu", "no output"):
        flight(Fmu(path, "drone1", {"x": "estimate.yaw_rad"}))


def test_a_file_that_is_not_a_usable_fmu_is_refused(tmp_path: Path, waypoint: Path) -> None:
    def refuses(path: Path, *terms: str) -> None:
        with refused(RunError, path.name, *terms):
            FmuModel(path)

    path = tmp_path / "not.fmu"
    refuses(path, "FMI 2 or 3")
    path.write_text("text")
    refuses(path, "zip", "FMI 2 or 3")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "")
    refuses(path, "modelDescription.xml")
    old, new = "CoSimulation", "ModelExchange"
    refuses(rewritten(waypoint, tmp_path / "exchange.fmu", lambda text: text.replace(old, new)), "co-simulation")
    refuses(rewritten(waypoint, tmp_path / "amiss.fmu", lambda text: text.replace("<Float64", "<Float65")), "Float65")
    refuses(
        rewritten(waypoint, tmp_path / "windows.fmu", lambda text: text, without="-linux/"),
        fmpy.platform_tuple,
        "x86_64-windows",
    )


def rewritten(fmu: Path, path: Path, change: Callable[[str], str], without: str = "\0") -> Path:
    """Write an FMU with a changed description, without the files whose names contain a text; return its path."""
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                content = change(content.decode()).encode()
            if without not in name:
                target.writestr(name, content)
    return path
