"""FMUs as processes in the lockstep: `zsim fmu`, with FMUs that pythonfmu3 and pythonfmu build."""

import math
import shlex
import sys
from pathlib import Path
from typing import Any

import fmus
import numpy as np
import pytest
from federation import ONE, Federation, Record
from fmpy.validation import validate_fmu
from refused import refused

import zsim
from zsim.contract import flight_messages, keys
from zsim.contract.flight_messages import Estimate, Mode, Status, Velocity
from zsim.errors import RunError, RunFailedError
from zsim.record import RecordReader
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import robot_rates
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.spaces.triad_cluster import TriadCluster

GOAL = (2.0, 1.0, 3.0)
SCENARIO = ONE.replace("expect: []", "expect: [estimator.drone1, fmu.drone1]")
MAP = ("--map", "p=estimate.position_m", "--map", "v=velocity_m_s")


class Waypoint(Agent):
    """The law of examples/waypoint_fmu.py, as an agent in Python."""

    name = "fmu.drone1"
    reads = (keys.estimate("drone1"),)

    def __init__(self) -> None:
        super().__init__()
        self.p, self.state = (0.0, 0.0, 0.0), ""

    def receive(self, key: str, message: Any) -> None:
        if isinstance(message, Status):
            self.state = message.state
        elif isinstance(message, Estimate):
            self.p = message.position_m

    def step(self, t_ns: int) -> list[Output]:
        if t_ns == 1_000_000_000:
            return [self._sent("mode", Mode(t_ns, 0, "", "takeoff"))]
        if self.state not in ("hovering", "flying"):
            return []
        wanted = [0.5 * (g - p) for g, p in zip(GOAL, self.p, strict=True)]
        share = 1.0 / max(1.0, math.hypot(*wanted))
        v_W = (share * wanted[0], share * wanted[1], share * wanted[2])
        return [self._sent("velocity", Velocity(t_ns, 0, "", v_W, 0.0, "world"))]

    def _sent(self, kind: str, message: flight_messages.Command) -> Output:
        return Output(keys.command("drone1", kind), message)


# Test 1 of the paper: an FMU as the cluster space controller of three drones

STEP = Path(__file__).parents[2] / "scenarios" / "step.yaml"
SHORTER = ("--duration", "45")
C_DES = (5.0, -5.0, 15.0, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0, 4.0, 4.0, math.pi / 4)  # equation (3)
CLUSTER_VARIABLES = f"""
variable("c", [0.0] * 12, I)
variable("c_des", {list(C_DES)!r}, P)
variable("c_dot", [0.0] * 12, O)
"""
CLUSTER_LAW = """
import math

error = [wanted - found for wanted, found in zip(self.c_des, self.c, strict=True)]
error[3:9] = [math.remainder(angle, math.tau) for angle in error[3:9]]
limits = [0.8] * 3 + [0.1] * 6 + [0.3, 0.3, 0.1]
self.c_dot = [max(-limit, min(limit, 0.4 * each)) for each, limit in zip(error, limits, strict=True)]
"""


class ClusterController(Agent):
    """The law of the FMU, as an agent in Python with the kinematics of its own."""

    name = "controller.main"

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        cluster = scenario.cluster("main")
        self.drones, self.space = cluster.drones, scenario_space(scenario, cluster)
        self.reads = tuple(map(keys.estimate, self.drones))
        self.c_des, self.c, self.c_dot = list(C_DES), [0.0] * 12, [0.0] * 12
        self.latest: dict[str, Any] = {}

    def receive(self, key: str, message: Any) -> None:
        self.latest[key] = message

    def step(self, t_ns: int) -> list[Output]:
        if t_ns == 1_000_000_000:
            return [Output(keys.command(drone, "mode"), Mode(t_ns, 0, "", "takeoff")) for drone in self.drones]
        estimates = [self.latest[keys.estimate(drone)] for drone in self.drones]
        p_W, yaw = np.array([e.position_m for e in estimates]), np.array([e.yaw_rad for e in estimates])
        self.c = self.space.forward(p_W, yaw).tolist()
        exec(CLUSTER_LAW, {"self": self})
        v_W, yaw_rates = robot_rates(self.space, np.array(self.c), np.array(self.c_dot))
        return [
            Output(keys.command(drone, "velocity"), Velocity(t_ns, 0, "", tuple(v), float(rate), "world"))
            for drone, v, rate in zip(self.drones, v_W.tolist(), yaw_rates, strict=True)
            if self.latest[keys.status(drone)].state in ("hovering", "flying")
        ]


def test_flies_test_1_as_the_cluster_space_controller(federation: Federation, tmp_path: Path) -> None:
    path = fmus.build(tmp_path, "Cluster", 3, CLUSTER_VARIABLES, CLUSTER_LAW)
    assert validate_fmu(str(path)) == []
    world = federation.start("world", str(STEP), *SHORTER, "--listen", federation.endpoint, "--expect", "recorder")
    federation.role("record", "--out", str(federation.out))
    federation.role("host", "estimator.*")
    mapping = ("--map", "c=main/c", "--map", "c_dot=main/c_dot")
    flown = federation.role("fmu", str(path), "--name", "controller.main", *mapping, "--takeoff", "1")
    world.ends(with_code=0)
    flown.ends(with_code=0)
    record = federation.record()
    same = zsim.Simulation(STEP, duration_s=45.0, agents=[ClusterController], record=tmp_path / "law")
    with same:
        same.run()
    assert truth_sha256(tmp_path / "law") == record.sha256()
    p_W = np.array([record.positions(drone)[-1] for drone in ("drone1", "drone2", "drone3")])
    c = TriadCluster(3).forward(p_W, np.zeros(3))
    off = c - np.array(C_DES)
    assert np.abs(off[:3]).max() < 1.0
    assert np.abs(off[9:11]).max() < 0.5


def truth_sha256(folder: Path) -> str:
    with RecordReader(folder / "run.mcap") as reader:
        return Record(reader).sha256()


@pytest.fixture(scope="module")
def waypoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fmus.example(tmp_path_factory.mktemp("fmu"))


def test_the_example_is_an_fmu_by_fmpy(waypoint: Path) -> None:
    assert validate_fmu(str(waypoint)) == []


def test_flies_a_drone_as_a_process_with_the_bits_of_the_same_law_in_python(
    federation: Federation, waypoint: Path, tmp_path: Path
) -> None:
    world = federation.world(SCENARIO, "--expect", "recorder")
    federation.role("record", "--out", str(federation.out))
    federation.role("estimator", "drone1")
    flown = federation.role("fmu", str(waypoint), "--drone", "drone1", *MAP, "--takeoff", "1", "--frame", "world")
    world.ends(with_code=0)
    flown.ends(with_code=0)
    record = federation.record()
    assert record.complete
    assert len(record.all("drone/drone1/cmd/velocity")) > 200
    assert math.dist(record.positions("drone1")[-1], GOAL) < 1.0
    with zsim.Simulation(tmp_path / "scenario.yaml", agents=[Waypoint()], record=tmp_path / "law") as same:
        same.run()
    assert truth_sha256(tmp_path / "law") == record.sha256()


def test_killed_and_started_again_it_goes_on_to_the_same_bits(waypoint: Path, tmp_path: Path, compiled: None) -> None:
    words = ("fmu", str(waypoint), "--drone", "drone1", *MAP, "--takeoff", "1", "--frame", "world")
    command = [sys.executable, "-P", "-m", "zsim_deploy.cli", *words]
    (tmp_path / "one.yaml").write_text(ONE.replace("expect: []", "expect: [estimator.drone1]"))

    def flown(kills: bool) -> zsim.Run:
        patient = {"processes.on_death": {"fmu": "wait"}}
        program = f"fmu.drone1={shlex.join(command)}"
        with zsim.Federation(tmp_path / "one.yaml", 8, set=patient, programs=[program], out=tmp_path / "run") as flight:
            flight.wait_until(4.0)
            if kills:
                flight.kill("fmu.drone1")
                flight.start("fmu.drone1")
            return flight.run()

    undisturbed = flown(kills=False).truth_sha256
    run = flown(kills=True)
    assert run.truth_sha256 == undisturbed
    assert [*run.events[run.events.kind == "restart"].subject] == ["fmu.drone1"]


def test_a_process_that_is_not_there_cannot_be_killed(tmp_path: Path, compiled: None) -> None:
    (tmp_path / "one.yaml").write_text(ONE.replace("expect: []", "expect: [estimator.drone1]"))
    with zsim.Federation(tmp_path / "one.yaml", 2, out=tmp_path / "run") as flight:
        flight.wait_until(0.5)
        with refused(RunFailedError, "'estimator.drone2'", "estimator.drone1"):
            flight.kill("estimator.drone2")
        with refused(RunError, "'fmu.drone1'"):
            flight.start("fmu.drone1")
        flight.run()
