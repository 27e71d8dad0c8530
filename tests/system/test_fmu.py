"""`zsim fmu`: FMUs built by pythonfmu3 and pythonfmu as processes in lockstep."""

import math
from pathlib import Path
from typing import Any

import fmus
import numpy as np
import pytest
from federation import ONE, Federation, Record
from fmpy.validation import validate_fmu
from refused import has_terms

import zsim
from zsim.contract import flight_messages, keys
from zsim.contract.flight_messages import Estimate, Mode, Status, Velocity
from zsim.record import RecordReader
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.spaces.cluster_space import robot_rates
from zsim_agents.formation.spaces.scenario_space import scenario_space
from zsim_agents.formation.spaces.triad_cluster import TriadCluster
from zsim_api.pytest_plugin import Federations

GOAL = (2.0, 1.0, 3.0)
SCENARIO = ONE.replace("expect: []", "expect: [estimator.drone1, fmu.drone1]")
MAP = ("--map", "p=estimate.position_m", "--map", "v=velocity_m_s")


class Waypoint(Agent):
    """The law of examples/waypoint_fmu.py as an agent in Python."""

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
C_DES = (5.0, -5.0, 15.0, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0, 4.0, 4.0, math.pi / 4)  # equation (3) of the paper
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
    """The law of the FMU as an agent in Python, with its own kinematics."""

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


def test_an_fmu_flies_test_1_as_the_cluster_space_controller(federation: Federation, tmp_path: Path) -> None:
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


def test_fmpy_validates_the_example(waypoint: Path) -> None:
    assert validate_fmu(str(waypoint)) == []


def test_an_fmu_flies_the_bits_of_the_same_law_in_python(
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


# Deaths

DUO = {
    "name": "duo",
    "seed": 3,
    "duration_s": 6,
    "sensors": {"preset": "paper"},
    "environment": {"wind": {"gust_m_s": 0.3}},
    "drones": [{"name": f"drone{number}", "position_m": [4 * number, 0, 0]} for number in (2, 3)],
    "processes": {"on_death": {"fmu": "wait", "fmu.drone2": "restart"}},
}
COUNTED_VARIABLES = """
variable("x", 0.0, I)
variable("steps", 0, O, Whole)
variable("vx", 0.0, O)
"""
COUNTED_LAW = """
self.steps += 1
self.vx = 0.001 * self.steps + 0.1 * (8.0 - self.x)
"""
KILLED_S = 4.5  # out of 6 s: both drones are airborne, and the last snapshots are from 4 s
PLACES = {"x": "estimate.position_m.0", "vx": "velocity_m_s.0"}


def command(path: Path, drone: str) -> str:
    places = " ".join(f"--map {name}={place}" for name, place in PLACES.items())
    return f"fmu.{drone}=zsim fmu {path} --drone {drone} {places} --takeoff 0.5 --frame world"


def test_restarted_fmus_fly_the_bits_of_the_undisturbed_flight(flights: Federations, tmp_path: Path) -> None:
    """The output of each FMU depends on its number of steps; `zsim run` restarts one FMU, the test the other."""
    made = [
        zsim.Fmu(
            fmus.build(tmp_path, f"Counted{version}", version, COUNTED_VARIABLES, COUNTED_LAW),
            f"drone{version}",
            PLACES,
            takeoff_s=0.5,
            frame="world",
        )
        for version in (2, 3)
    ]
    flight = flights(DUO, agents=made[:1], programs=[command(made[1].path, "drone3")])
    flight.wait_until(KILLED_S)
    flight.kill("fmu.drone2")
    flight.kill("fmu.drone3")
    flight.start("fmu.drone3")
    flight.assert_same_bits(zsim.run(DUO, agents=made, out=tmp_path / "alone", progress=False))
    for drone in ("drone2", "drone3"):
        log = (flight.folder / "logs" / f"fmu.{drone}.log").read_text()
        assert has_terms(log, f"fmu.{drone}:", "4.00", "s")  # the time of its snapshot


def test_an_fmu_that_cannot_save_its_state_restarts_afresh_and_reports_it(flights: Federations, tmp_path: Path) -> None:
    path = fmus.build(tmp_path, "Forgetful", 3, COUNTED_VARIABLES, COUNTED_LAW.replace("0.1 *", "0 *"), restores=False)
    flight = flights(DUO, duration=5, programs=[command(path, "drone3")])
    flight.wait_until(KILLED_S)
    flight.kill("fmu.drone3")
    flight.start("fmu.drone3")
    v_m_s = np.array(flight.run().commands("drone3")["velocity_m_s_x"])
    assert v_m_s.max() == pytest.approx(0.05 * KILLED_S, abs=0.003)
    assert v_m_s[-1] == pytest.approx(0.05 * (5 - KILLED_S), abs=0.003)
    said = (flight.folder / "logs/fmu.drone3.log").read_text().splitlines()
    assert sum(has_terms(line, "fmu.drone3:", "Forgetful.fmu") for line in said) == 2
