"""Injected faults: each kind changes the truth, which is reproducible to the bit wherever the agents run."""

import json
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from federation import PAIR, Federation
from refused import has_terms

from zsim.contract import flight_messages, keys
from zsim.contract.run_messages import ControlRequest, Event
from zsim.errors import RunError
from zsim.runtime.agent import Agent
from zsim.runtime.bus import Bus
from zsim.scenario import scenario_file
from zsim.scenario.faults import KINDS
from zsim.sensors.scanner import SCANNERS
from zsim.sensors.sensor_catalogue import STOCK
from zsim_agents.estimation.estimator import Estimator
from zsim_agents.formation.controller import Controller
from zsim_agents.hosting import hosted
from zsim_world.run.world import World

GATE_NS = 20_000_000
AT_S, FOR_S, DURATION_S = 6.0, 2.0, 9.0
ENGAGED_S, BRIEF_S = 5.0, 6.5  # the formation of PAIR is engaged from ENGAGED_S on; a brief flight ends at BRIEF_S
Document = dict[str, Any]
LINK = "estimator.drone1/controller.main"
KILL = "process_kill"

# A fault of each kind that affects the flight
MATRIX: dict[str, Document] = {
    **{f"{sensor}_dropout": {"target": "drone1"} for sensor in ("gps", "mag", "baro", "sonar", "flow")},
    "imu_dropout": {"target": "drone1", "probability": 0.3},
    **{f"{sensor}_stuck": {"target": "drone1"} for sensor in ("gps", "mag", "baro", "sonar", "flow")},
    "imu_stuck": {"target": "drone1", "for_s": 0.04},
    "accel_bias": {"target": "drone1", "value_m_s2": [0.3, 0, 0]},
    "gyro_bias": {"target": "drone1", "value_deg_s": [1, 0, 0]},
    "gps_bias": {"target": "drone1", "value_m": [2, 0, 0]},
    "mag_bias": {"target": "drone1", "value_ut": [5, 0, 0]},
    "baro_bias": {"target": "drone1", "value_m": 0.2},
    "sonar_bias": {"target": "drone1", "value_m": 0.2},
    "flow_bias": {"target": "drone1", "value_m_s": [0.3, 0, 0]},
    **{
        kind: {"target": "drone1", "factor": 3}
        for kind in KINDS
        if kind.endswith("_noise") and KINDS[kind].sensor in STOCK
    },
    "rotor_efficiency": {"target": "drone1", "rotor": "front_left", "value": 0.85},
    "rotor_stuck": {"target": "drone1", "rotor": "all", "for_s": 0.1},
    "gust": {"target": "world", "velocity_m_s": [3, 0, 0]},
    "link_delay": {"target": LINK, "delay_ms": 60},
    "link_jitter": {"target": LINK, "jitter_ms": 100},
    "link_loss": {"target": "controller.main/world", "probability": 0.5},
    "link_cut": {"target": "world/estimator.drone1"},
    "radio": {"target": "main", "range_m": 2, "spread_m": 1},
}
# Faults of sensors that a drone has only on request; tested in tests/unit/world/sensors
SCANNED = {kind for kind in KINDS if KINDS[kind].sensor in SCANNERS}
CHANCE = {"noise", "jitter", "loss", "radio"}  # words in the names of kinds that draw random numbers
SEVERAL: list[Document] = [
    {"kind": "link_loss", "target": "world/estimator.drone2", "probability": 0.3, "at_s": 4},
    {"kind": "link_jitter", "target": LINK, "jitter_ms": 70, "at_s": 5, "for_s": 4},
    {"kind": "link_delay", "target": "controller.main/world", "delay_ms": 30, "at_s": 6},
    {
        "kind": "radio",
        "target": "world",
        "range_m": 3,
        "spread_m": 2,
        "place": {"controller.main": "drone2"},
        "at_s": 7,
    },
    {"kind": "gps_noise", "target": "drone2", "factor": 2, "at_s": 5, "for_s": 3},
    {"kind": "rotor_efficiency", "target": "drone1", "rotor": "rear_left", "value": 0.9, "at_s": 6},
    {"kind": "gust", "target": "world", "velocity_m_s": [0, 2, 0], "at_s": 6, "for_s": 2},
]


class Flight(NamedTuple):
    """What is kept of a run."""

    sha256: str
    events: list[Event]
    states: list[flight_messages.ClusterState]
    estimates: list[flight_messages.Estimate]
    statuses: list[flight_messages.Status]

    def events_of(self, *kinds: str) -> list[Event]:
        return [event for event in self.events if event.kind in kinds]

    def changes(self) -> list[tuple[float, str]]:
        """Return the instants [s] at which drone1 changed state, each with the new state."""
        pairs = zip(self.statuses, self.statuses[1:], strict=False)
        return [(after.t_ns / 1e9, after.state) for before, after in pairs if after.state != before.state]


def document(faults: Sequence[Document], **values: Any) -> Document:
    return {**yaml.safe_load(PAIR), "duration_s": DURATION_S, "faults": list(faults), **values}


def apart(world: World) -> list[Agent]:
    """Return the estimators and the controller as separate agents, as in a run of processes."""
    info, scenario = world.info(), world.scenario
    estimators = [Estimator(info, scenario, drone.name) for drone in scenario.drones]
    return [*estimators, Controller(info, scenario, "main")]


def fly(
    faults: Sequence[Document],
    team: Callable[[World], list[Agent]] = lambda world: [hosted(world.info(), world.scenario, ["*"])],
    between: Callable[[World], None] = lambda world: None,
    **values: Any,
) -> Flight:
    """Fly PAIR in one process; `between` is called between gates, when requests arrive."""
    world = World(scenario_file.resolve(document(faults, **values)))
    flight = Flight("", [], [], [], [])
    kept = {
        keys.EVENT: flight.events,
        keys.cluster_state("main"): flight.states,
        keys.estimate("drone1"): flight.estimates,
        keys.status("drone1"): flight.statuses,
    }

    def sink(key: str, message: Any) -> None:
        if key in kept:
            kept[key].append(message)

    bus = Bus(world, team(world), time.monotonic_ns, sink)
    bus.join()
    while bus.turn():
        between(world)
    bus.end()
    return flight._replace(sha256=world.result()["truth_sha256"])


@pytest.fixture(scope="module")
def undisturbed() -> Flight:
    return fly([])


@pytest.fixture(scope="module")
def briefly_undisturbed() -> Flight:
    return fly([], duration_s=BRIEF_S)


def test_every_kind_of_fault_is_covered() -> None:
    assert {*MATRIX, *SCANNED, KILL} == {*KINDS}


@pytest.mark.parametrize("kind", MATRIX)
def test_each_fault_changes_the_truth(kind: str, briefly_undisturbed: Flight) -> None:
    """A fault lasts from 5 s to 6 s, unless MATRIX says otherwise.

    Expected: a hash other than that of the undisturbed flight; an event at the start and end of the fault; the flight
    continues to its end.
    """
    fault = {"kind": kind, "at_s": ENGAGED_S, "for_s": 1.0, **MATRIX[kind]}
    flight = fly([fault], duration_s=BRIEF_S)
    assert flight.sha256 != briefly_undisturbed.sha256
    times = [(event.kind, event.t_ns / 1e9) for event in flight.events_of("fault", "fault_end")]
    assert times == [("fault", ENGAGED_S), ("fault_end", ENGAGED_S + fault["for_s"])]
    assert flight.events_of("end")[0].data["last_ns"] == BRIEF_S * 1e9


def test_random_faults_give_the_same_bits_twice() -> None:
    """All faults that draw random numbers, each from its own stream, at once from 4 s on, flown twice."""
    chance = [kind for kind in MATRIX if CHANCE & set(kind.split("_")) or "probability" in MATRIX[kind]]
    faults = [{"kind": kind, "at_s": 4.0, **MATRIX[kind]} for kind in chance]
    assert len(faults) == 11
    assert fly(faults, duration_s=BRIEF_S).sha256 == fly(faults, duration_s=BRIEF_S).sha256


def test_a_fault_after_the_end_changes_nothing(undisturbed: Flight) -> None:
    assert fly([{"kind": "gps_dropout", "target": "drone1", "at_s": 100}]).sha256 == undisturbed.sha256


@pytest.mark.parametrize("delay_gates", [1, 5])
def test_grouped_and_separate_agents_give_the_same_bits(delay_gates: int) -> None:
    """Several faults at once, with the agents in one Group and separate; the world may run ahead by delay_gates.

    Expected: the same hash.
    """
    delay = {"command_delay_gates": delay_gates}
    assert fly(SEVERAL, time=delay).sha256 == fly(SEVERAL, apart, time=delay).sha256


def test_processes_give_the_same_bits_as_one_process(federation: Federation) -> None:
    """Several faults at once, with every role in its own process.

        world ──╳──sensors──▶ estimators ──╳──estimates──▶ controller ──╳──velocity──▶ world

    Expected: the hash of the run in one process; the faults are on record.
    """
    federation.run(yaml.safe_dump(document(SEVERAL))).ends(with_code=0)
    record = federation.record()
    assert record.sha256() == fly(SEVERAL).sha256
    assert len(record.all(keys.FAULTS)[0]["faults"]) == len(SEVERAL)
    assert len(record.events("fault")) == len(SEVERAL)


def requesting(at_gate: int, op: str, **args: Any) -> Callable[[World], None]:
    """Return a function that, called between gates, sends the world one request."""
    asked: list[Any] = []

    def ask(world: World) -> None:
        if not asked and world.now_ns >= at_gate * world.clock.gate_ns:
            asked.append(world.control(ControlRequest(op, args, "tester.one")))
            assert asked[0].ok, asked[0].error

    return ask


def planned_of(events: Sequence[Any]) -> list[Document]:
    """Return the faults in some events' data as a scenario would plan them."""
    return [
        {
            "kind": data["kind"],
            "target": data["target"],
            "at_s": data["from_ns"] / 1e9,
            **({} if data["until_ns"] is None else {"for_s": (data["until_ns"] - data["from_ns"]) / 1e9}),
            **{name: value for name, value in data["parameters"].items() if value is not None},
        }
        for data in events
    ]


@pytest.mark.parametrize("kind", ["gps_stuck", "rotor_stuck", "link_loss", "link_delay", "radio", "gust"])
def test_a_requested_fault_equals_the_one_planned_from_its_event(kind: str, undisturbed: Flight) -> None:
    """A fault is requested in flight; then the same fault is planned from the data of its event.

    Expected: the same hash, which differs from that of the undisturbed flight.
    """
    fault = {"kind": kind, "for_s": 0.5, **MATRIX[kind]}
    asked = fly([], between=requesting(300, "fault_add", **fault))
    again = fly(planned_of([event.data for event in asked.events_of("fault")]))
    assert asked.sha256 == again.sha256 != undisturbed.sha256


def test_a_fault_can_be_cleared_by_request(undisturbed: Flight) -> None:
    """A rotor is weak from 6 s on, until the fault is cleared in flight.

    Expected: the bits of a fault that is planned to end when this one is cleared.
    """
    weak = {"kind": "rotor_efficiency", "at_s": AT_S, **MATRIX["rotor_efficiency"]}
    cleared = fly([weak], between=requesting(350, "fault_clear", target="drone1"))
    (event,) = cleared.events_of("fault_clear")
    again = fly(planned_of([event.data]))
    assert cleared.sha256 == again.sha256 != fly([weak]).sha256
    assert event.data["until_ns"] == event.t_ns
    assert cleared.sha256 != undisturbed.sha256


def test_faults_can_be_added_and_cleared_by_command(federation: Federation) -> None:
    """`zsim fault add` and `clear` act on a federation; then the same faults are planned in one process.

    Expected: the commands print each fault with its number, target and times; the same hash.
    """
    run = federation.run(yaml.safe_dump(document([], duration_s=12.0)), "--rate", "1")
    client = federation.client()
    clock = client.subscribe("clock")
    clock.until(lambda m: m["t_ns"] > 0)
    client.request("world/control", "pause")
    paused = clock.until(lambda m: m["state"] == "paused").message
    client.request("world/control", "rate", value=4)
    client.request("world/control", "step", gates=round(5.5e9 - paused["t_ns"]) // GATE_NS)
    clock.until(lambda m: m["state"] == "paused" and m["t_ns"] == 5.5e9)
    printed = [
        fault(federation, "add", "drone1", "gps_bias", "value_m=[2, 0, 0]"),
        fault(federation, "add", LINK, "link_jitter", "jitter_ms=90", "--for", "1500ms"),
        fault(federation, "add", "world", "gust", "velocity_m_s=[2, 1, 0]", "--for", "1s", "--at", "11s"),
        fault(federation, "list"),
    ]
    client.request("world/control", "step", gates=50)
    clock.until(lambda m: m["t_ns"] == 6.5e9)
    printed.append(fault(federation, "clear", "drone1"))
    client.request("world/control", "resume")
    run.ends(with_code=0)
    assert has_terms(printed[0], "1: gps_bias", "drone1", "cleared")
    assert "2: link_jitter" in printed[1]
    assert has_terms(printed[2], "3: gust", "world", "11.00 s", "12.00 s")
    assert [line.split()[:2] for line in printed[3].splitlines()] == [
        ["1", "active"],
        ["2", "active"],
        ["3", "planned"],
    ]
    assert "cleared 1" in printed[4]
    record = federation.record()
    begun = {event["data"]["id"]: event["data"] for event in record.events("fault")}
    begun |= {event["data"]["id"]: event["data"] for event in record.events("fault_clear")}
    assert {data["source"] for data in begun.values()} == {"zsim.fault"}
    assert record.sha256() == fly(planned_of([begun[number] for number in sorted(begun)]), duration_s=12.0).sha256


def fault(federation: Federation, *arguments: str) -> str:
    """Run `zsim fault`; return what it prints once it has found the world."""
    role = federation.role("fault", *arguments)
    role.ends(with_code=0)
    return "\n".join(line.text for line in role.lines if not line.text.startswith("waiting for a world of"))


@pytest.mark.parametrize("victim", ["estimator.drone2", pytest.param("controller.main", marks=pytest.mark.soak)])
def test_a_killed_process_is_restarted_to_the_same_bits(federation: Federation, victim: str) -> None:
    """The victim kills itself after it has sent its outputs of the gate at 6.02 s.

        estimator or controller ──────┤ SIGKILL   started again ├──────▶
        clock                   ──────┤ waiting_for             ├──────▶ 9 s

    Expected: the launcher notices the death and restarts the process, which resumes from its snapshot; the hash is that
    of a run without deaths. On a busy machine the process may be back before the world notices its death.
    """
    run = federation.run(yaml.safe_dump(document([{"kind": KILL, "target": victim, "at_s": AT_S}])))
    run.line(f"{victim} .*(died|ended: killed by signal 9).*restart")
    run.ends(with_code=0)
    federation.nobody_left()
    record = federation.record()
    again = [*record.events("restart"), *record.events("superseded")]  # before or after its death is noticed
    assert {event["subject"] for event in again} == {victim}
    assert {event["data"]["on_death"] for event in record.events("death")} <= {"restart"}
    assert f"{record.events('fault')[0]['subject']}" == victim
    log = (federation.out / "logs" / f"{victim}.log").read_text()
    assert has_terms(log, "snapshot", "6.00 s")
    assert record.sha256() == fly([]).sha256


def test_process_kill_is_refused_in_a_single_process_run() -> None:
    with pytest.raises(RunError, match=r"process_kill of estimator\.drone1 "):
        fly([{"kind": KILL, "target": "estimator.drone1", "at_s": 1}])


# How the agents react


def test_an_estimator_without_sensors_reports_growing_uncertainty() -> None:
    """Nothing reaches estimator.drone1 from 6 s on.

    Expected: a finite estimate at every gate, whose sigma grows; the controller holds the formation and says why.
    """
    flight = fly([{"kind": "link_cut", "target": "world/estimator.drone1", "at_s": AT_S}])
    sigmas = [np.sqrt(np.array(e.covariance)[[0, 7, 14]]) for e in flight.estimates]
    assert len(flight.estimates) == 451
    assert np.isfinite(sigmas).all()
    assert sigmas[300].max() < 1.0
    assert sigmas[-1].min() > 2.0
    last = flight.states[-1]
    assert last.phase == "held"
    assert has_terms(last.reason, "drone1", "sigma")


@pytest.mark.parametrize("kind", ["link_cut", "link_loss"])
def test_a_controller_without_an_estimate_holds_and_says_why(kind: str) -> None:
    """No estimate of drone1 reaches the controller from 6 s to 8 s.

    Expected: the formation is held after half a second, because of the estimate's age, and engaged again at the end.
    """
    given = {"kind": kind, "target": LINK, "at_s": AT_S, "for_s": FOR_S}
    flight = fly([{**given, "probability": 1} if kind == "link_loss" else given])
    held = [state for state in flight.states if state.phase == "held"]
    assert held[0].t_ns / 1e9 == pytest.approx(AT_S + 0.5, abs=0.05)
    assert has_terms(held[0].reason, "estimate", "drone1")
    assert flight.states[-1].phase == "engaged"


@pytest.mark.parametrize(("for_s", "lands"), [(1.5, False), (3.5, True)])
def test_drones_without_a_controller_hover_and_then_land(for_s: float, lands: bool) -> None:
    """No command reaches the world from 6 s on, for 1.5 s or for longer than the firmware waits before it lands.

        cut    6.0 ├───────────────┤ 7.5     or     ├──────────────────────────────┤ 9.5
        state      flying │ hovering │ flying       flying │ hovering     │ landing
                         6.5                              6.5            8.5

    Expected: after half a second of silence the firmware hovers, and two seconds later it lands; no drone falls.
    """
    cut = {"kind": "link_cut", "target": "world/controller.main", "at_s": AT_S, "for_s": for_s}
    flight = fly([cut], duration_s=10.0)
    assert flight.events_of("collision", "diverged") == []
    changes = [(t_s, state) for t_s, state in flight.changes() if t_s > AT_S]
    assert [state for _, state in changes] == ["hovering", "landing" if lands else "flying"]
    assert [t_s for t_s, _ in changes] == pytest.approx([AT_S + 0.5, AT_S + (2.5 if lands else for_s)], abs=0.07)


def test_a_link_delay_of_commands_equals_a_longer_command_delay() -> None:
    """From the start, commands arrive two gates later.

    Expected: the bits of a scenario whose command delay is two gates longer.
    """
    slow = fly([{"kind": "link_delay", "target": "controller.main/world", "delay_ms": 40, "one_way": True}])
    assert slow.sha256 == fly([], time={"command_delay_gates": 3}).sha256


def test_fault_events_are_json(undisturbed: Flight) -> None:
    for event in fly([{"kind": "radio", "at_s": 1, **MATRIX["radio"]}]).events_of("fault"):
        assert json.loads(json.dumps(event.data))["kind"] == "radio"
