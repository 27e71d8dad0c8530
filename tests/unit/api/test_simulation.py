"""A flight stepped from Python: identity with a whole flight, timing of commands, and requests of callers."""

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pair_flight
import pytest
from refused import refused

import zsim
from zsim.errors import RequestRefusedError, RunError, ScenarioError
from zsim.runtime.agent import Agent, Output
from zsim_analysis.in_process import InProcessFlight
from zsim_analysis.reading.recorded_flight import read_flight
from zsim_api.scenarios import Scenario
from zsim_world.run.world import DURATION_OVER

GUSTS = {"wind": {"gust_m_s": 0.3}}
PAIR: dict[str, Any] = {**pair_flight.PAIR, "environment": GUSTS}
ONE: dict[str, Any] = {**PAIR, "name": "one", "drones": [{"name": "d1", "position_m": [1, 2, 0]}], "clusters": []}


def climb(sim: zsim.Simulation) -> Iterator[bytes]:
    """Make a drone take off and fly east; yield the truth and estimates at every gate."""
    for gate in count():
        commands = {0: zsim.takeoff()}.get(gate) or zsim.velocity(0.5, 0, 0.2, frame="world")
        sim.step({"d1": commands})
        yield b"".join(np.ascontiguousarray(part).tobytes() for part in (*sim.truth, *sim.estimates))


def gates(sim: zsim.Simulation, number: int) -> list[bytes]:
    return [known for known, _ in zip(climb(sim), range(number), strict=False)]


def test_a_stepped_flight_is_identical_to_a_whole_one() -> None:
    sim = zsim.Simulation(PAIR)
    assert sim.run() == DURATION_OVER
    flight = InProcessFlight(Scenario(**PAIR).resolved)
    flight.run([])
    assert sim.t_s == 6.0
    assert sim.truth_sha256 == flight.world.truth_hash.hexdigest()


def test_built_in_agents_fly_if_steps_have_no_commands() -> None:
    sim = zsim.Simulation(PAIR)
    while sim.ended is None:
        sim.step()
    assert sim.clusters["main"].phase == "engaged"
    assert {sim.state("d1"), sim.state("d2")} == {"flying"}
    assert np.abs(sim.estimates.position_m - sim.truth.position_m).max() < 5


def test_a_command_acts_after_the_command_delay() -> None:
    sim = zsim.Simulation(ONE, agents=None, set={"time.command_delay_gates": 3})
    before = sim.state("d1")
    assert sim.command_delay_s == pytest.approx(0.06)
    states = []
    for _ in range(6):
        sim.step({"d1": zsim.takeoff()} if not states else {})
        states.append(sim.state("d1"))
    # stamped at 0, it acts from the gate at 0.06 s, which the fourth step shows
    assert states == [before] * 3 + ["taking_off"] * 3


@pytest.mark.parametrize("agents", ["stock", None])
def test_a_seed_gives_the_same_flight_after_every_reset(agents: Any) -> None:
    sim = zsim.Simulation(ONE, agents=agents)
    first = gates(sim, 100)
    sim.reset()
    assert gates(sim, 100) == first
    sim.reset(seed=4)
    other = gates(sim, 100)
    assert other != first
    assert gates(zsim.Simulation(ONE, seed=4, agents=agents), 100) == other
    sim.reset(seed=3)
    assert gates(sim, 100) == first


def test_a_restored_flight_continues_bit_for_bit() -> None:
    sim = zsim.Simulation(ONE)
    gates(sim, 100)
    kept, t_s = sim.snapshot(), sim.t_s
    first = gates(sim, 60)
    sim.step({"d1": zsim.emergency()})
    sim.run()  # to the end
    with refused(RunError, "snapshot:"):
        sim.snapshot()
    for each in (sim, zsim.Simulation(ONE, seed=8)):
        each.restore(kept)
        assert each.t_s == t_s
        assert gates(each, 60) == first


def test_arrays_are_read_only_views() -> None:
    sim = zsim.Simulation(PAIR, agents=None)
    position_m = sim.truth.position_m
    assert position_m.shape == (2, 3)
    stands_m = position_m[0, 2]
    assert position_m.tolist() == [[0, 3, stands_m], [0, -3, stands_m]]
    with pytest.raises(ValueError, match="read-only"):
        position_m[0, 0] = 1.0
    sim.step({"d1": zsim.takeoff()})
    for _ in range(100):
        sim.step()
    assert position_m[0, 2] > stands_m + 0.1
    assert position_m[1, 2] == pytest.approx(stands_m, abs=1e-3)


def test_sensors_give_their_newest_samples_by_field() -> None:
    sim = zsim.Simulation(PAIR, agents=None)
    sim.run(until_s=1.0)
    assert set(sim.sensors) == {"imu", "gps", "mag", "baro", "sonar", "flow"}
    assert sim.sensors["gps"].position_m.shape == (2, 3)
    assert sim.sensors["imu"].accel_m_s2[:, 2] == pytest.approx(9.81, abs=1.0)
    assert sim.sensors["imu"].t_ns.tolist() == [1_000_000_000] * 2
    with refused(RunError, "'gpss'", "gps?"):
        sim.sensors["gpss"]
    with pytest.raises(AttributeError, match="position_m"):
        _ = sim.sensors["gps"].positon_m


class Counter(Agent):
    """An agent that counts its gates and makes d1 take off."""

    reads = ("drone/*/sensor/status",)

    def __init__(self) -> None:
        super().__init__()
        self.gates = 0

    def receive(self, key: str, message: Any) -> None:
        self.state = message.state

    def step(self, t_ns: int) -> list[Output]:
        self.gates += 1
        return [self.command(t_ns, "d1", zsim.takeoff())] if self.state == "landed" else []


class Short:
    """A class whose constructor returns an agent of another class."""

    def __new__(cls) -> Any:
        return Counter()


@pytest.mark.parametrize("made", [Counter, Counter(), Short, lambda: Counter()])
def test_a_user_s_agents_start_afresh_at_every_reset(made: Any) -> None:
    sim = zsim.Simulation(ONE, agents=[made], stock=False)
    for _ in range(2):
        sim.run(until_s=3.0)
        assert sim.state("d1") == "hovering"
        sim.reset()
        assert sim.state("d1") == "landed"
    if isinstance(made, Counter):
        assert made.gates < 5


class Failing(Counter):
    def step(self, t_ns: int) -> list[Output]:
        if t_ns >= 100_000_000:
            raise ZeroDivisionError
        return super().step(t_ns)


def test_an_agent_that_raises_ends_the_flight(capsys: pytest.CaptureFixture[str]) -> None:
    sim = zsim.Simulation(ONE, agents=[Failing])
    with pytest.raises(ZeroDivisionError):
        sim.run()
    assert "agent.failing at 0.10 s" in capsys.readouterr().err
    assert sim.ended is not None
    with refused(RunError, "flight is over", "reset()"):
        sim.step()


@pytest.mark.parametrize(
    ("commands", "terms"),
    [
        ({"d9": zsim.takeoff()}, ("'d9'", "d1")),
        ({"d1": 1.0}, ("d1", "float", "Velocity")),
        ({"d1": [zsim.takeoff(), None]}, ("NoneType",)),
    ],
)
def test_an_invalid_command_is_refused_before_anything_is_sent(commands: Any, terms: tuple[str, ...]) -> None:
    sim = zsim.Simulation(ONE, agents=None)
    with refused(RunError, *terms):
        sim.step(commands)
    sim.step({"d1": zsim.takeoff()})
    assert sim.t_s == pytest.approx(sim.gate_s)


@pytest.mark.parametrize(
    "make",
    [
        lambda: zsim.velocity(float("nan"), 0, 0),
        lambda: zsim.velocity(0, 0, 0, frame="body"),  # type: ignore[arg-type]
        lambda: zsim.attitude((1, 0, 0), 4.0),
        lambda: zsim.rotors([float("inf")] * 4),
    ],
)
def test_values_of_commands_are_checked_at_creation(make: Any) -> None:
    with pytest.raises(RunError):
        make()


def test_requests_and_faults_are_handled_between_steps() -> None:
    sim = zsim.Simulation(PAIR)
    sim.run(until_s=1.0)
    sim.inject({"kind": "gps_dropout", "target": "d1", "at_s": 1.5, "for_s": 2.0})
    sim.run(until_s=3.4)
    last_s = sim.sensors["gps"].t_sample_ns / 1e9
    assert last_s[0] < 1.5 < 3.0 < last_s[1]
    with pytest.raises(RequestRefusedError):
        sim.ask("world/control", "fly_to_the_moon")
    with pytest.raises(RequestRefusedError, match="main"):
        sim.ask("cluster/other/control", "hold")


def test_a_stepped_flight_is_recorded(tmp_path: Path) -> None:
    with zsim.Simulation(PAIR, record=tmp_path / "run") as sim:
        sim.run(until_s=2.0)
        with refused(RunError, "record"):
            sim.reset()
    flight = read_flight(tmp_path / "run" / "run.mcap")
    assert flight.last_ns == 2_000_000_000
    assert flight.completeness.complete


def test_a_refused_reset_leaves_the_scenario_unchanged(tmp_path: Path) -> None:
    with zsim.Simulation(ONE, agents=None, record=tmp_path / "run") as sim:
        source = sim.source
        with refused(RunError, "record"):
            sim.reset(seed=7)
        assert sim.source is source
    sim = zsim.Simulation(ONE, agents=None)
    source = sim.source
    with refused(ScenarioError, "drones[0].mass_kg is -1.4"):
        sim.reset(set={"drones.d1.mass_kg": -1.4})
    assert sim.source is source
    sim.reset()


def test_faults_of_a_scenario_are_reported_as_for_yaml() -> None:
    with refused(ScenarioError, "scenario: drones[0].mass_kg is -1.4", "> 0"):
        zsim.Simulation(ONE, set={"drones.d1.mass_kg": -1.4})
    with refused(ScenarioError, "environment.wnd", "wind"):
        zsim.Simulation(ONE, set={"environment.wnd": 1})
    with refused(RunError, "agents", "'stock',"):
        zsim.Simulation(ONE, agents="none")  # type: ignore[arg-type]
