"""The world process: received messages, lost outputs, a diverged state, the end of a run and delayed gates."""

from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import pytest
from fake_link import BAD_UTF8, NESTED, UNANSWERED, FakeLink
from refused import has_terms, parts, refused
from small_world import GATE_NS, small_world
from synthetic_pictures import image, info, sightings

from zsim.contract import keys, messages, run_messages
from zsim.contract.flight_messages import ClusterState, Estimate, Velocity
from zsim.contract.framing import decode_batch
from zsim.contract.run_messages import ControlAnswer, ControlRequest, Done, Event, Health, Join
from zsim.errors import DecodeError
from zsim.runtime.membership import HealthMeter
from zsim.scenario import roles
from zsim.schema.message import Message
from zsim_world.fleet.fleet import DivergedError
from zsim_world.run.world import DURATION_OVER, World
from zsim_world.server.world_process import DELAY_MAX_NS, GATES_SENT, LAG_GATES, Pipelining, TurnWatch, WorldProcess

GATES = 10
ME = "tester.one"
FRONT, FRONT_INFO, DETECTIONS = keys.camera("d1", "front"), keys.camera_info("d1", "front"), keys.detections("d1")
ESTIMATE, STATE, VELOCITY = keys.estimate("d1"), keys.cluster_state("main"), keys.command("d1", "velocity")
ZEROS = (0.0, 0.0, 0.0)


def world(*expect: str) -> World:
    made = small_world(duration_s=GATES * GATE_NS / 1e9)
    for name in expect:
        made.barrier.expect(name)
    return made


def run(made: World, link: FakeLink, **options: Any) -> WorldProcess:
    process = WorldProcess(link, made, **options)  # type: ignore[arg-type]
    process.run()
    return process


def events(link: FakeLink, kind: str) -> list[Event]:
    return [event for event in link.published_on(keys.EVENT) if event.kind == kind]


# Received messages


@pytest.mark.parametrize("key", [ESTIMATE, STATE, VELOCITY, keys.process(ME, "done"), keys.process(ME, "health")])
@pytest.mark.parametrize("payload", [BAD_UTF8, NESTED, b"\xc1", b"\x91" * 5000], ids=["utf8", "nested", "no", "deep"])
def test_an_invalid_payload_does_not_end_the_run(key: str, payload: bytes):
    made, link = world(), FakeLink()
    link.deliver(key, payload)
    assert run(made, link).health.refused == 1
    assert made.ended == DURATION_OVER
    assert link.published_on(keys.CLOCK)[-1].state == "stopped"
    assert [event.subject for event in events(link, "refused")] == [key]


def test_an_estimate_from_the_future_is_refused():
    made, link = world(), FakeLink()
    link.deliver(ESTIMATE, estimate(10**6))
    run(made, link)
    (event,) = events(link, "refused")
    assert parts(event.data["reason"]) == ("t_ns", "20000000000000")
    assert event.text == f"{ESTIMATE}: {event.data['reason']}"


@pytest.mark.parametrize("source", ["\x1b[2J", "Über", "a b", "x" * 49, ""])
def test_a_command_with_an_invalid_source_is_refused(source: str):
    made, link = world(), FakeLink()
    link.deliver(VELOCITY, Velocity(0, 0, source, ZEROS, 0.0))
    run(made, link)
    (event,) = events(link, "refused")
    assert event.source == "somebody"
    assert parts(event.data["reason"]) == ("source", repr(source[:48]))
    assert events(link, "commander") == []


def test_a_request_with_an_invalid_source_is_refused():
    made = world()
    answer = made.control(ControlRequest("stop", {}, "\x1b[2J"))
    assert parts(answer.error) == ("source", "'\\x1b[2J'")
    assert made.ended is None
    assert made.control(ControlRequest("stop", {}, "")).ok


def test_states_and_health_messages_are_shown_with_their_cluster_or_process():
    made, link, shown = world(), FakeLink(), []
    health = Health(0, 0, "estimator", "h", 1, {}, 0, 0, 0, 0, received=7)
    link.deliver(STATE, state(0))
    link.deliver("process/estimator.d1/health", health)
    seconds = iter(range(1000))
    meter = HealthMeter("world", lambda: float(next(seconds)))
    run(made, link, progress=lambda *args: shown.append(args), health=meter)
    assert [about for kind, _, about in shown if kind == "state"] == ["main"]
    healths = [args[1:] for args in shown if args[0] == "health"]
    assert healths[0] == (health, "estimator.d1")
    assert {name for _, name in healths[1:]} == {"world"}
    assert healths[-1][0].received == 2


# Messages from cameras


def test_camera_info_is_kept_and_passed_on_but_pictures_are_not():
    made, link = world(), FakeLink()
    for key, message in ((FRONT_INFO, info()), (FRONT, image(0)), (DETECTIONS, sightings(0))):
        link.deliver(key, message)
    process = run(made, link)
    assert process.health.refused == 0
    assert process._history.last(FRONT_INFO) == [(FRONT_INFO, messages.encode(info()))]
    assert process._history.last(FRONT) == []
    assert any(keys.matches(expression, FRONT_INFO) for expression in roles.LAST_VALUES)
    assert not any(keys.matches(expression, FRONT) for expression in roles.LAST_VALUES)
    passed = [key for at, payload in link.published if at == keys.BATCH for key, _ in decode_batch(payload)]
    assert [key for key in passed if key in (FRONT_INFO, FRONT, DETECTIONS)] == [FRONT_INFO, DETECTIONS]


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (FRONT_INFO, image(0)),
        (DETECTIONS, info()),
        (FRONT_INFO, info(10**12)),
        (keys.sensor("d1", keys.SIGHTINGS), sightings(0)),  # a key on which only the world publishes
    ],
)
def test_an_invalid_camera_message_is_refused_and_changes_nothing(key: str, message: Message):
    made, link = world(), FakeLink()
    link.deliver(key, message)
    process = run(made, link)
    assert process.health.refused == 1
    assert [event.subject for event in events(link, "refused")] == [key]
    assert process._history.last(key) == []


def test_replayed_pictures_are_published_only_on_their_own_key():
    """A recorder reads pictures on their keys; if batches contained them as well, they would be recorded twice."""
    made, link = world(), FakeLink()
    made.outbox.put(FRONT, msgspec.Raw(messages.encode(image(0))))
    made.outbox.put(FRONT_INFO, msgspec.Raw(messages.encode(info())))
    process = run(made, link)
    assert link.published_on(FRONT) == [image(0)]
    passed = [key for at, payload in link.published if at == keys.BATCH for key, _ in decode_batch(payload)]
    assert (FRONT in passed, FRONT_INFO in passed) == (False, True)
    assert process._history.last(FRONT) == []


# Lost outputs


def estimate(gate: int) -> Estimate:
    return Estimate(gate * GATE_NS, gate, ZEROS, ZEROS, (1.0, *ZEROS), 0.0, (0.0,) * 36, 0.1, ZEROS, {}, ME)


def state(gate: int) -> ClusterState:
    return ClusterState(gate * GATE_NS, gate, "idle", (), (), (), (), (), None, 0.0, "", ME)


class Lossy(FakeLink):
    """A link that loses some outputs of its only participant, which publishes two outputs and a done per gate.

    Args:
        loses: key and gate of each lost output.
        keeps: whether the participant still has them when they are requested.
    """

    def __init__(self, loses: set[tuple[str, int]], keeps: bool = True, incarnation: int = 1) -> None:
        super().__init__()
        self._incarnation = incarnation
        self.on_publish, self.on_request = self._answer, self._outputs
        self._loses, self._keeps = loses, keeps
        self._kept: list[list[Any]] = []
        self._gate = 0
        for number in range(1, incarnation + 1):
            self.deliver(keys.process(ME, "join"), Join(0, number, "run1", number, "tester", "h", 1, GATE_NS))

    def _answer(self, key: str, payload: bytes) -> None:
        if key == keys.CLOCK and messages.decode(key, payload).step == self._gate <= GATES:
            if messages.decode(key, payload).state == "running":
                self._say(self._gate)
                self._gate += 1
        elif key == keys.EVENT and messages.decode(key, payload).kind == "end":
            self.deliver(keys.process(ME, "bye"), run_messages.Bye(0, 0, "over"))

    def _say(self, gate: int) -> None:
        for key, message in ((ESTIMATE, estimate(gate)), (STATE, state(gate))):
            lost = (key, gate) in self._loses
            if not lost:
                self.deliver(key, message)
            if self._keeps or not lost:
                self._kept.append([key, messages.encode(message)])
        self.deliver(keys.process(ME, "done"), Done(gate * GATE_NS, gate, "run1", self._incarnation, gate * GATE_NS, 2))

    def _outputs(self, key: str, args: dict[str, Any]) -> ControlAnswer:
        assert key == keys.process(ME, "outputs")
        return ControlAnswer(True, result=self._kept[-6:])

    def recorded(self, key: str) -> list[int]:
        """Return the gates of the messages on a key in the order in which the recorder receives them."""
        passed = [pair for name, payload in self.published if name == keys.BATCH for pair in decode_batch(payload)]
        return [messages.decode(name, payload).t_ns // GATE_NS for name, payload in passed if name == key]


def test_every_lost_output_is_recovered_and_nothing_is_duplicated():
    """Losses in two consecutive gates and a single later one: each is requested once, and none hides another."""
    link = Lossy({(ESTIMATE, 2), (STATE, 3), (ESTIMATE, 7)})
    run(world(ME), link)
    assert len(link.requests) == 3
    assert events(link, "outputs_missing") == []
    assert link.recorded(ESTIMATE) == link.recorded(STATE) == list(range(GATES + 1))


@pytest.mark.parametrize(("incarnation", "missing"), [(1, [1]), (2, [])])
def test_a_participant_that_just_rejoined_is_queried_until_it_answers(incarnation: int, missing: list[int]):
    """Behind a new router, it may not be reachable at once; the outputs of any other silent participant are missing."""
    link = Lossy({(ESTIMATE, 2)}, incarnation=incarnation)
    silent = iter(range(3))
    link.on_request = lambda key, args: link._outputs(key, args) if next(silent, None) is None else UNANSWERED
    run(world(ME), link)
    assert [event.data["missing"] for event in events(link, "outputs_missing")] == missing


def test_an_old_output_does_not_replace_a_missing_one():
    link = Lossy({(ESTIMATE, 4)}, keeps=False)
    run(world(ME), link)
    assert [event.data["missing"] for event in events(link, "outputs_missing")] == [1]
    assert link.recorded(ESTIMATE) == [gate for gate in range(GATES + 1) if gate != 4]


def refuse(key: str, args: dict[str, Any]) -> ControlAnswer:
    raise DecodeError(f"{key}: ok is missing")


BAD_ANSWERS: dict[str, Callable[[str, dict[str, Any]], ControlAnswer]] = {
    "none": lambda key, args: UNANSWERED,
    "no answer": refuse,
    "a number": lambda key, args: ControlAnswer(True, result=7),
    "nothing": lambda key, args: ControlAnswer(True),
    "no pairs": lambda key, args: ControlAnswer(True, result=[[ESTIMATE], 3]),
    "no payload": lambda key, args: ControlAnswer(True, result=[[ESTIMATE, "text"]]),
    "garbage": lambda key, args: ControlAnswer(True, result=[[ESTIMATE, b"\xc1"], ["a", b"x"], [STATE, BAD_UTF8]]),
    "a done": lambda key, args: ControlAnswer(True, result=[[keys.process(ME, "bye"), b"\x80"], ["clock", b"x"]]),
}


@pytest.mark.parametrize("name", BAD_ANSWERS)
def test_an_invalid_answer_changes_nothing(name: str):
    link = Lossy({(ESTIMATE, 4)})
    link.on_request = BAD_ANSWERS[name]
    made = world(ME)
    run(made, link)
    assert [event.data["missing"] for event in events(link, "outputs_missing")] == [1]
    assert made.ended == DURATION_OVER


def test_the_age_of_a_command_is_measured_at_its_first_arrival():
    made = world()
    made.handle(keys.process(ME, "join"), Join(0, 0, "run1", 1, "tester", "h", 1, GATE_NS), 0)
    made.advance(0)
    command = Velocity(0, 0, ME, ZEROS, 0.0)
    for wall_ns in (1_000_000, 900_000_000):
        made.handle(VELOCITY, command, wall_ns)
    assert made.result()["command_age_ms"]["max"] == pytest.approx(1.0)


# A diverged state


def test_a_diverged_state_ends_the_run_for_everybody(monkeypatch: pytest.MonkeyPatch):
    made, link = world(), FakeLink()
    advance = made.fleet.advance

    def diverge() -> None:
        if made.now_ns == 3 * GATE_NS:
            raise DivergedError("d1", 0.08)
        advance()

    monkeypatch.setattr(made.fleet, "advance", diverge)
    with refused(DivergedError, "d1", "0.080", "finite"):
        run(made, link)
    assert [(event.kind, event.subject) for event in link.published_on(keys.EVENT)] == [
        ("diverged", "d1"),
        ("end", "world"),
    ]
    end = events(link, "end")[0]
    assert has_terms(end.text, "d1", "0.080", "finite")
    assert end.data["last_ns"] == 3 * GATE_NS
    assert link.published_on(keys.CLOCK)[-1].state == "stopped"


# The end


@pytest.mark.parametrize(("action", "waits"), [("restart", True), ("wait", True), ("end", False), ("drop", False)])
def test_the_end_waits_for_a_dead_recorder_only_if_it_may_return(action: str, waits: bool):
    """A recorder still has to write the last gates; other processes have nothing left to do."""
    made = small_world(processes={"on_death": {"recorder": action}})
    join = Join(0, 0, "run1", 1, "recorder", "here", 1, 0, slack_ns=GATE_NS)
    made.handle(keys.process("recorder", "join"), join, 0)
    made.handle(keys.process(ME, "join"), Join(0, 0, "run1", 1, "tester", "here", 2, GATE_NS), 0)
    made.publish_end()
    made.handle(keys.process(ME, "bye"), run_messages.Bye(0, 0, "over"), 0)
    assert made.waiting_to_leave()
    made.died("recorder", 0)
    assert bool(made.waiting_to_leave()) is waits
    made.handle(keys.process("recorder", "join"), Join(0, 1, "run1", 2, "recorder", "here", 3, 0, slack_ns=GATE_NS), 0)
    assert made.waiting_to_leave()
    made.handle(keys.process("recorder", "bye"), run_messages.Bye(0, 0, "over"), 0)
    assert not made.waiting_to_leave()


def test_the_stopped_clock_names_the_processes_waited_for():
    made, link = world("recorder"), FakeLink()
    link.deliver(keys.process("recorder", "join"), Join(0, 0, "run1", 1, "recorder", "here", 1, 0, slack_ns=10**12))
    run(made, link)
    waited = [clock for clock in link.published_on(keys.CLOCK) if clock.state == "stopped" and clock.waiting_for]
    assert [each.name for each in waited[0].waiting_for] == ["recorder"]
    assert waited[0].waiting_for[0].since_wall_s == pytest.approx(1.0, abs=0.5)


class Lagging:
    """A world with one agent, which has completed `done` gates; the delay is five gates by default."""

    def __init__(self, delay: int = 5, mode: str = "lockstep", rate: float = 0.0) -> None:
        self.gate_ns, self.ahead_ns = GATE_NS, delay * GATE_NS
        self.mode, self.rate = mode, rate
        self.clock = self
        self.now, self.done = 0, 0

    def blocking(self, ahead_ns: int = 0) -> list[str]:
        needed = self.now - (self.ahead_ns - ahead_ns) // GATE_NS
        return ["estimator.d1"] if self.done < needed else []

    def may_advance(self) -> bool:
        return not self.blocking()


def pipelining_of(world: Lagging) -> Pipelining:
    made: Any = Pipelining
    return made(world)


def advance(world: Lagging, pipelining: Pipelining, wall_ns: int = 0) -> int:
    """Advance as the process does; return the number of gates."""
    gates = 0
    while world.may_advance() and not pipelining.delays(wall_ns):
        world.now += 1
        gates += 1
    pipelining.pause(wall_ns)
    return gates


def test_after_a_wait_the_world_resumes_once_the_agent_has_nearly_caught_up() -> None:
    world = Lagging()
    pipelining = pipelining_of(world)
    assert advance(world, pipelining) == 6  # the first gate and the five of the delay need no answer
    gates = []
    for _ in range(12):
        world.done += 1
        gates.append(advance(world, pipelining))
    size = 5 - LAG_GATES + 1
    assert gates[:8] == [0] * (size - 1) + [size] + [0] * (size - 1) + [size]
    assert world.now - world.done <= 5 + 1


def test_a_delay_for_a_slow_agent_is_limited_in_time() -> None:
    world = Lagging()
    pipelining = pipelining_of(world)
    advance(world, pipelining)
    world.done += 1
    assert advance(world, pipelining, wall_ns=DELAY_MAX_NS // 2) == 0
    assert pipelining.blocking() == ["estimator.d1"]
    assert advance(world, pipelining, wall_ns=2 * DELAY_MAX_NS) == 1


@pytest.mark.parametrize(
    "world", [Lagging(mode="realtime"), Lagging(rate=1.0), Lagging(delay=1), Lagging(delay=LAG_GATES)]
)
def test_a_world_that_is_paced_or_has_no_slack_delays_no_gate(world: Lagging) -> None:
    pipelining = pipelining_of(world)
    advance(world, pipelining)
    for _ in range(10):
        world.done += 1
        assert advance(world, pipelining) == 1
        assert not pipelining.continues()


def test_messages_are_sent_every_few_gates_and_before_a_wait() -> None:
    world = Lagging(delay=9)
    pipelining = pipelining_of(world)
    sent = []
    while world.may_advance():
        world.now += 1
        sent.append(not pipelining.continues())
    assert sent == [(gate + 1) % GATES_SENT == 0 or gate == len(sent) - 1 for gate in range(len(sent))]


TICK_MS = 100


def looks(watch: TurnWatch, at_ms: Iterable[int], turn_ms: int) -> list[tuple[int, float]]:
    """Return when a stuck turn was reported, and how long it had lasted."""
    found = [(ms, watch.stuck_s(ms * 1_000_000, turn_ms * 1_000_000)) for ms in at_ms]
    return [(ms, stuck_s) for ms, stuck_s in found if stuck_s is not None]


def test_a_stuck_turn_is_reported_every_two_seconds() -> None:
    named = looks(TurnWatch(0), range(TICK_MS, 5_000, TICK_MS), turn_ms=100)
    assert named == [(2_200, 2.1), (4_300, 4.2)]


def test_nothing_is_reported_while_no_turn_is_running() -> None:
    assert looks(TurnWatch(0), range(TICK_MS, 5_000, TICK_MS), turn_ms=0) == []


def test_a_suspended_process_does_not_count_as_stuck() -> None:
    watch = TurnWatch(0)
    assert looks(watch, [100, 12_100, 12_200], turn_ms=50) == []
    assert looks(watch, range(12_300, 14_300, TICK_MS), turn_ms=50) == [(14_200, 2.1)]
