"""Killing each process of a run: the others report it, follow `on_death` and leave nothing behind."""

import re
import signal
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml
from federation import PAIR, PAIR_ROLES, Federation, Record, Role
from forked_commands import ROOT
from wire import PATIENCE_S, Client, Received, Subscription

from zsim.errors import RunFailedError
from zsim.record import RecordReader, repair
from zsim.record.completeness import record_completeness
from zsim.scenario import scenario_file
from zsim_analysis.in_process import fly
from zsim_api.pytest_plugin import Federations
from zsim_deploy.launch.supervisor import UNREAD

REASONS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "terminated"}
SEEN_BACK = ("restart", "superseded")  # the second if it rejoins before its death is noticed
GATE_NS = 20_000_000
ENGAGED_NS, END_NS = 6_000_000_000, 12_000_000_000
LATE_NS = 7_900_000_000  # just before the end of a run of 8 s
FROZEN_S = 14  # longer than LEASE_READER_MS
IN_FLIGHT = r" [1-9][0-9]*\.[0-9] . 100000 s"  # a line of progress after the first second
APART_M = 0.3  # permitted distance between the paths of a realtime run with deaths and of one without
MOVING = PAIR.replace(
    "{takeoff_s: 0.5}",
    "{takeoff_s: 0.5, trajectory: {start_s: 9, waypoints: [{at_s: 0, values: {x_c: 0}}, {at_s: 8, values: {x_c: 2}}]}}",
)
STEP = (ROOT / "scenarios" / "step.yaml").read_text()
UNWRITTEN_NS = 5_000_000_000  # simulated, at rate 4: may be unwritten, as a recorder holds data for 0.5 s or more


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of an undisturbed run of PAIR in one process."""
    with Federation(tmp_path_factory.mktemp("undisturbed")) as federation:
        federation.run(PAIR, "--in-process").ends(with_code=0)
        return federation.out


@pytest.fixture(scope="module")
def undisturbed(alone: Path) -> dict[str, np.ndarray]:
    """True positions in an undisturbed run of PAIR."""
    with RecordReader(alone / "run.mcap") as reader:
        return {drone: Record(reader).positions(drone) for drone in ("drone1", "drone2")}


class Flight:
    """A run of PAIR at four times real time with the formation engaged, observed by an external client.

    It runs until it is ended, so that no test has to meet a deadline.
    """

    def __init__(self, federation: Federation, *options: str) -> None:
        self.run: Role = federation.run(PAIR, "--rate", "4", "--duration", "100000", *options)
        self.client: Client = federation.client()
        self.clock: Subscription = self.client.subscribe("clock")
        self.events: Subscription = self.client.subscribe("world/event")
        self.clock.until(lambda m: m["t_ns"] >= ENGAGED_NS)

    def event(self, kind: str, subject: str) -> Received:
        return self.events.until(lambda m: (m["kind"], m["subject"]) == (kind, subject))

    def finish(self, with_code: int = 0) -> None:
        """Fly on to END_NS and end the run."""
        self.clock.until(lambda m: m["t_ns"] >= END_NS)
        assert self.client.request("world/control", "stop")["ok"]
        self.run.ends(with_code)

    def stands_for(self, name: str, longer_than_s: float = -1) -> Received:
        return self.clock.until(
            lambda m: any(w["name"] == name and w["since_wall_s"] > longer_than_s for w in m["waiting_for"])
        )


def waiting_for(clock: Received, name: str) -> dict[str, Any]:
    return next(entry for entry in clock.message["waiting_for"] if entry["name"] == name)


def check_end(federation: Federation, whole: bool) -> Record:
    """Check that no process is left and that the record can be read; return the record."""
    federation.nobody_left()
    record = federation.record()
    assert record.all("drone/drone1/truth")[-1]["t_ns"] >= ENGAGED_NS - UNWRITTEN_NS
    if whole:
        assert record.end()["last_ns"] >= END_NS
    return record


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("estimator.drone1", ()),
        pytest.param("controller.main", (), marks=pytest.mark.soak),
        pytest.param("controller.main", ("--hosted",), marks=pytest.mark.soak),
    ],
)
def test_a_killed_participant_is_restarted_with_the_same_bits(
    flights: Federations, alone: Path, name: str, options: tuple[str, ...]
) -> None:
    flight = flights(yaml.safe_load(PAIR), options=options)
    flight.wait_until("engaged")
    flight.kill(name)
    flight.wait_until(lambda moment: any(event.kind in SEEN_BACK for event in moment.events))
    flight.assert_same_bits(alone)
    with RecordReader(flight.folder / "run.mcap") as reader:
        record = Record(reader)
        assert {event["data"]["on_death"] for event in record.events("death")} <= {"restart"}
        assert {event["subject"] for event in record.events(*SEEN_BACK)} == {name}
    logs = flight.folder / "logs"
    assert "snapshot" in (logs / f"{name}.log").read_text()
    assert re.search(f"{name} .*(died|ended: killed by signal 9).*restart", (logs / "zsim-run.log").read_text())


@pytest.mark.parametrize("name", ["controller.main", pytest.param("recorder", marks=pytest.mark.soak)])
def test_a_run_ended_by_a_death_has_failed(flights: Federations, name: str) -> None:
    flight = flights(yaml.safe_load(PAIR), set={"processes.on_death": {name.partition(".")[0]: "end"}})
    flight.wait_until(3.0)
    flight.kill(name)
    with pytest.raises(RunFailedError):
        flight.run()


@pytest.mark.parametrize("name", ["estimator.drone1", pytest.param("controller.main", marks=pytest.mark.soak)])
def test_time_stops_until_a_killed_participant_is_started_again(federation: Federation, name: str) -> None:
    flight = Flight(federation, "--set", f"processes.on_death={{{name}: wait}}")
    federation.kill(name)
    flight.event("death", name)
    standing = flight.stands_for(name, longer_than_s=1)  # longer than any gate before the death took
    later = flight.stands_for(name, longer_than_s=waiting_for(standing, name)["since_wall_s"])
    assert waiting_for(later, name)["host"]
    assert later.message["t_ns"] == standing.message["t_ns"]
    role, thing = name.split(".")
    again = federation.role(role, thing)
    flight.finish()
    again.ends(with_code=0)
    assert [event["subject"] for event in check_end(federation, whole=True).events("restart")] == [name]


@pytest.mark.soak
def test_an_overdue_participant_ends_the_run(federation: Federation) -> None:
    flight = Flight(federation, "--set", "processes.on_death={estimator: wait}", "--set", "processes.return_s=1.5")
    federation.kill("estimator.drone1")
    flight.event("overdue", "estimator.drone1")
    flight.run.ends(with_code=1)
    assert "estimator.drone1 has not come back within 1.5 s" in flight.run.text()
    assert (federation.out / "journal").exists()


@pytest.mark.soak
def test_an_overdue_participant_is_dropped_and_the_run_goes_on(federation: Federation) -> None:
    options = (
        "processes.on_death={controller: wait}",
        "processes.return_s=1.5",
        "processes.on_overdue={controller: drop}",
    )
    flight = Flight(federation, *(word for option in options for word in ("--set", option)))
    federation.kill("controller.main")
    flight.event("overdue", "controller.main")
    flight.event("drop", "controller.main")
    flight.finish()
    record = check_end(federation, whole=True)
    assert [event["data"]["on_overdue"] for event in record.events("overdue")] == ["drop"]


@pytest.mark.parametrize("name", [pytest.param("estimator.drone1", marks=pytest.mark.soak), "controller.main"])
def test_a_killed_participant_is_dropped_and_the_run_goes_on(federation: Federation, name: str) -> None:
    flight = Flight(federation, "--set", f"processes.on_death={{{name}: drop}}")
    federation.kill(name)
    flight.event("drop", name)
    is_held = name.startswith("estimator")  # without an estimate the formation is held: the run is not as planned
    flight.finish(with_code=int(is_held))
    record = check_end(federation, whole=True)
    assert record.events("restart") == []
    assert ("held for" in flight.run.text()) == is_held


@pytest.mark.parametrize("name", [*(pytest.param(each, marks=pytest.mark.soak) for each in PAIR_ROLES[1:]), "recorder"])
def test_a_death_ends_the_run_if_the_scenario_says_so(federation: Federation, name: str) -> None:
    flight = Flight(federation, "--set", f"processes.on_death={{{name}: end}}")
    federation.kill(name)
    flight.event("death", name)
    flight.run.line(f"{name}.*(died|ended)")
    flight.run.ends(with_code=1)
    assert f"ended: {name} " in flight.run.text()
    check_end(federation, whole=False)


@pytest.mark.soak
def test_a_process_terminated_from_outside_counts_as_dead(federation: Federation) -> None:
    """SIGTERM comes from outside the launcher, first to an estimator, then to the recorder."""
    flight = Flight(federation)
    federation.kill("estimator.drone1", signal.SIGTERM)
    assert flight.event("death", "estimator.drone1").message["data"]["on_death"] == "restart"
    flight.event("restart", "estimator.drone1")
    federation.kill("recorder", signal.SIGTERM)
    flight.event("restart", "recorder")
    flight.finish()
    check_whole(check_end(federation, whole=True))


def check_whole(record: Record) -> None:
    """Check that the record holds every gate once and every message of every key.

    A message that a participant repeated because the world had died before receiving it may occur twice.
    """
    t_ns = [message["t_ns"] for message in record.all("drone/drone1/truth")]
    assert t_ns == list(range(0, record.end()["last_ns"] + 1, GATE_NS))
    for key in [*record.keys()]:
        if not key.startswith(("process/", "view/")):  # a restarted process numbers its messages from 0 again
            by_number: dict[int, dict[str, Any]] = {}
            for message in record.all(key):
                assert by_number.setdefault(message["seq"], message) == message, key
            assert list(by_number) == list(range(len(by_number))), key


@pytest.mark.parametrize("pace", [4, pytest.param(1000, marks=pytest.mark.soak)])
def test_repeated_kills_of_the_recorder_leave_no_gap(
    federation: Federation, undisturbed: dict[str, np.ndarray], pace: int
) -> None:
    flight = Flight(federation, "--rate", str(pace))
    for kills in range(1, 4):
        federation.kill("recorder")
        flight.run.line(r"recorder .*(died|ended: killed by signal 9).*restart")
        flight.events.until(lambda m: m["kind"] in ("restart", "superseded") and m["subject"] == "recorder")
        assert flight.clock.until(lambda m: not m["waiting_for"]), kills
    flight.finish()
    record = check_end(federation, whole=True)
    check_whole(record)
    for drone, wanted in undisturbed.items():
        assert np.array_equal(record.positions(drone)[: len(wanted)], wanted)


@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.soak), signal.SIGKILL])
@pytest.mark.soak
def test_a_recorder_that_dies_near_the_end_is_replaced_or_fails_the_run(
    federation: Federation, number: signal.Signals
) -> None:
    """Either its replacement writes the last gates, or the run fails and says why."""
    run = federation.run(PAIR, "--rate", "4", "--duration", "8")
    federation.client().subscribe("clock").until(lambda m: m["t_ns"] >= LATE_NS)
    federation.kill("recorder", number)
    code = run.process.wait(PATIENCE_S)
    assert code is not None
    run.ends(with_code=code)
    federation.nobody_left()
    repair(federation.out / "run.mcap")
    found = record_completeness(federation.out / "run.mcap")
    assert (code, f"record: {found}" in run.text()) == (0 if found.complete else 1, True)
    if code:
        assert "recorder" in run.text().splitlines()[-1] or str(found) in run.text().splitlines()[-1]
    else:
        check_whole(federation.record())


@pytest.mark.soak
@pytest.mark.parametrize("pace", [("--realtime",), ("--rate", "4")])
def test_a_recorder_stopped_just_before_the_end_fails_the_run(federation: Federation, pace: tuple[str, ...]) -> None:
    """It never continues: the run fails because its record is incomplete, and every other process ends normally."""
    run = federation.run(PAIR, *pace, "--duration", "8")
    federation.client().subscribe("clock").until(lambda m: m["t_ns"] >= LATE_NS)
    federation.kill("recorder", signal.SIGSTOP)
    run.line("waiting for recorder")
    run.ends(with_code=1, within_s=2 * PATIENCE_S)
    found = record_completeness(federation.out / "run.mcap")
    assert not found.complete
    assert str(found) in run.text().splitlines()[-1]
    assert "Traceback" not in "".join(log.read_text() for log in (federation.out / "logs").iterdir())


@pytest.mark.soak
def test_a_frozen_world_leaves_no_gap_in_the_record(federation: Federation) -> None:
    """The freeze outlasts the lease of every link; the recorder requests the gates that it has missed."""
    flight = Flight(federation)
    federation.kill("world", signal.SIGSTOP)
    federation.role("echo", "clock", "--wait", str(FROZEN_S)).ends(with_code=2, within_s=2 * PATIENCE_S)
    federation.kill("world", signal.SIGCONT)
    flight.finish()
    check_whole(check_end(federation, whole=True))


@pytest.mark.soak
@pytest.mark.parametrize("name", ["world", "recorder"])
def test_lost_gates_are_reported(federation: Federation, name: str) -> None:
    """Realtime does not wait, so a long stop of the recorder or the world may lose gates, which must be reported."""
    run = federation.run(PAIR, "--realtime", "--duration", "40")
    federation.client().subscribe("clock").until(lambda m: m["t_ns"] >= ENGAGED_NS // 6)
    federation.kill(name, signal.SIGSTOP)
    waiting = federation.role("echo", "nobody/publishes/this", "--federation", "other", "--wait", str(FROZEN_S))
    waiting.ends(with_code=2, within_s=2 * PATIENCE_S)
    federation.kill(name, signal.SIGCONT)
    code = run.process.wait(2 * PATIENCE_S)
    assert code is not None
    run.ends(with_code=code)
    found = record_completeness(federation.out / "run.mcap")
    steps = {clock["step"] for clock in federation.record().all("clock")}
    assert found.gates_missing == len(set(range(max(steps) + 1)) - steps)
    assert code == (0 if found.complete else 1)
    assert found.complete or str(found) in run.text().splitlines()[-1]


@pytest.mark.soak
def test_a_restarted_realtime_world_does_not_count_lost_time_as_misses(federation: Federation) -> None:
    """The time lost by the death counts as one or two misses per agent, not as one at every later gate."""
    run = federation.run(PAIR, "--realtime", "--rate", "2", "--duration", "16")
    federation.client().subscribe("clock").until(lambda m: m["t_ns"] >= ENGAGED_NS // 2)
    federation.kill("world")
    run.line(r"world: continues at t = ")
    run.ends(with_code=0)
    end = federation.record().end()
    assert end["sim_s"] == pytest.approx(end["last_ns"] / 1e9)
    assert max(end["deadline_misses_by"].values()) < 400  # out of 800 gates, about 650 of them after the death


@pytest.mark.soak  # on a slow machine a restart takes longer than the age of an estimate that a controller accepts
@pytest.mark.parametrize(
    ("scenario", "kills_s", "end_s"),
    [
        pytest.param(MOVING, (10.0, 12.0, 14.0), 17.0, id="two that move"),
        pytest.param(STEP, (30.0, 40.0, 50.0), 70.0, id="Test 1"),
    ],
)
def test_a_realtime_formation_keeps_its_path_despite_deaths(
    federation: Federation, tmp_path: Path, scenario: str, kills_s: tuple[float, ...], end_s: float
) -> None:
    """A controller, an estimator and the world are killed in turn while the formation moves to a target."""
    run = federation.run(scenario, "--realtime", "--duration", str(end_s))
    clock = federation.client().subscribe("clock")
    for name, at_s in zip(("controller.main", "estimator.drone1", "world"), kills_s, strict=True):
        clock.until(lambda m, at_s=at_s: m["t_ns"] >= at_s * 1e9)
        federation.kill(name)
    run.line("world: continues at t = ")
    run.ends(with_code=0)
    assert {event["subject"] for event in federation.record().events("death")} >= {"controller.main"}
    undisturbed = msgspec.structs.replace(scenario_file.from_text(scenario), duration_s=end_s)
    fly(undisturbed, tmp_path / "undisturbed.mcap")
    with RecordReader(tmp_path / "undisturbed.mcap") as reader:
        wanted = Record(reader)
        for drone in ("drone1", "drone2"):
            apart = federation.record().positions(drone) - wanted.positions(drone)
            assert np.linalg.norm(apart, axis=1).max() < APART_M


@pytest.mark.soak
def test_the_death_of_a_world_that_is_not_to_be_restarted_ends_the_run(federation: Federation) -> None:
    flight = Flight(federation, "--set", "processes.on_death={world: end}")
    federation.kill("world")
    flight.run.line("world .*signal 9")
    flight.run.ends(with_code=1)
    check_end(federation, whole=False)


@pytest.mark.parametrize(
    "how",
    [
        pytest.param("Ctrl-C", marks=pytest.mark.soak),
        "kill -9 of everything",
        pytest.param("kill -9 of everything, of the launcher when the world is back", marks=pytest.mark.soak),
    ],
)
def test_an_interrupted_run_can_be_continued(
    federation: Federation, undisturbed: dict[str, np.ndarray], how: str
) -> None:
    flight = Flight(federation)
    if how == "Ctrl-C":
        flight.run.signal(signal.SIGINT)
        flight.run.ends(with_code=130)
    else:
        for name in ("recorder", "world", "controller.main", "estimator.drone1", "estimator.drone2"):
            federation.kill(name)
        if "when the world is back" in how:
            flight.run.line("world: continues at t = ")
        flight.run.signal(signal.SIGKILL)
    federation.nobody_left()
    reached_ns = federation.record().all("clock")[-1]["t_ns"]
    again = federation.start("run", "--continue", str(federation.out), "--no-report")
    client = federation.client()
    clock = client.subscribe("clock")
    clock.until(lambda m: m["t_ns"] >= max(END_NS, reached_ns + 1_000_000_000))
    assert client.request("world/control", "stop")["ok"]
    again.ends(with_code=0)
    record = check_end(federation, whole=True)
    check_whole(record)
    assert len(record.events("end")) == 1
    for drone, wanted in undisturbed.items():
        assert np.array_equal(record.positions(drone)[: len(wanted)], wanted)


def test_the_death_of_the_launcher_ends_the_run(federation: Federation) -> None:
    flight = Flight(federation)
    flight.run.signal(signal.SIGKILL)
    end = flight.events.until(lambda m: m["kind"] == "end")
    assert "launcher" in end.message["data"]["reason"]
    record = check_end(federation, whole=False)
    assert record.complete
    assert record.end()["reason"] == end.message["data"]["reason"]


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.soak)])
def test_an_interrupt_ends_the_run_with_a_complete_record(federation: Federation, number: signal.Signals) -> None:
    flight = Flight(federation)
    flight.run.signal(number)
    flight.run.ends(with_code=130)
    record = check_end(federation, whole=False)
    assert record.complete
    assert REASONS[number] in record.end()["reason"]


@pytest.mark.parametrize(
    "options", [("--in-process",), pytest.param((), marks=pytest.mark.soak)], ids=["one process", "processes"]
)
def test_closing_the_terminal_ends_the_run(federation: Federation, options: tuple[str, ...]) -> None:
    where = options or ("--listen", federation.endpoint)
    command = ["run", federation.write(PAIR), "--out", str(federation.out), "--duration", "100000", *where]
    run = federation.start(*command, prefix=("env", "--default-signal=HUP"))  # the tests may run under nohup
    run.line(IN_FLIGHT)
    run.signal(signal.SIGHUP)
    run.signal(signal.SIGHUP)  # shells send it more than once
    run.ends(with_code=130)
    federation.nobody_left()
    record = federation.record()
    assert record.complete
    assert "closed" in record.end()["reason"]
    assert re.search("ended: .*closed", (federation.out / "run.log").read_text())


@pytest.mark.parametrize(
    "options", [pytest.param(("--in-process",), marks=pytest.mark.soak), ()], ids=["one process", "processes"]
)
def test_a_broken_output_pipe_ends_the_run(federation: Federation, tmp_path: Path, options: tuple[str, ...]) -> None:
    """As in `zsim run … 2>&1 | head`, the reader exits during the flight."""
    where = options or ("--listen", federation.endpoint)
    command = ["run", federation.write(PAIR), "--out", str(federation.out), "--duration", "100000", *where]
    code = tmp_path / "code"
    piped = '{ "$@" 2>&1; echo $? >"$0"; } | sed -E "/' + IN_FLIGHT + '/q"'
    federation.start(*command, prefix=("sh", "-c", piped, str(code))).ends(with_code=0)
    assert code.read_text() == "130\n"
    federation.nobody_left()
    record = federation.record()
    assert record.complete
    assert record.end()["reason"] == UNREAD
    assert f"ended: {UNREAD}" in (federation.out / "run.log").read_text()


@pytest.mark.soak
def test_an_interrupt_ends_a_run_whose_time_has_stopped(federation: Federation) -> None:
    flight = Flight(federation)
    federation.kill("estimator.drone2", signal.SIGSTOP)
    flight.stands_for("estimator.drone2")
    flight.run.signal(signal.SIGINT)
    flight.run.ends(with_code=130)
    check_end(federation, whole=False)


@pytest.mark.soak
def test_a_second_interrupt_ends_a_run_with_a_frozen_world(federation: Federation) -> None:
    flight = Flight(federation)
    federation.kill("world", signal.SIGSTOP)
    flight.run.signal(signal.SIGINT)
    flight.run.signal(signal.SIGINT)
    flight.run.ends(with_code=130)
    check_end(federation, whole=False)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.soak)])
def test_a_run_can_be_interrupted_while_it_loads(
    federation: Federation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "nothing_is_compiled"))
    run = federation.run(PAIR)
    run.line("2 drones, 12 s, into")
    run.signal(number)
    run.ends(with_code=130)
    assert re.search(f"ended: .*{REASONS[number]}", run.text())
    federation.nobody_left()
    assert [path.name for path in federation.out.iterdir()] == ["scenario.yaml"]  # the folder can be reused
