"""FMUs as processes in the lockstep: `zsim fmu`, with FMUs that pythonfmu3 and pythonfmu build."""

import math
from pathlib import Path
from typing import Any

import fmus
import pytest
from federation import ONE, Federation, Record
from fmpy.validation import validate_fmu

import zsim
from zsim.contract import flight_messages, keys
from zsim.contract.flight_messages import Estimate, Mode, Status, Velocity
from zsim.record import RecordReader
from zsim.runtime.agent import Agent, Output

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
