"""Inspecting keys, and sending messages and requests by hand."""

import json

import msgspec
import pytest
from fake_link import BAD_UTF8, NESTED, FakeLink
from refused import has_terms, refused
from synthetic_record import SCENARIOS, info

from zsim.contract import keys, messages, run_messages
from zsim.contract.run_messages import ControlAnswer
from zsim.errors import RunError, SessionError
from zsim.scenario import scenario_file
from zsim.transport.session import ReceivedSample
from zsim_deploy.cli import inspection

GARBAGE = [BAD_UTF8, NESTED, b"\xc1", b"\x91" * 5000]
FOREIGN = [
    ({"raw": b"\x01\x02"}, {"raw": "AQI="}),
    ({7: "seven", 2.5: "half"}, {"7": "seven", "2.5": "half"}),
    ({"deep": [{b"k": b""}]}, {"deep": [{"aw==": ""}]}),
    ({None: 1}, "{None: 1}"),
    ([{True: b"x"}], "[{True: b'x'}]"),
]


class Clock:
    """Wall time that passes only during sleeps; `due` lists the samples (time, key, payload) that then arrive."""

    def __init__(self, link: FakeLink, due: list[tuple[float, str, bytes]]) -> None:
        self.link, self.due, self.now_s = link, due, 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        until_s = self.now_s + seconds
        while self.due and self.due[0][0] <= until_s:
            self.now_s, key, payload = self.due.pop(0)
            self.link.deliver(key, payload)
        self.now_s = until_s


def rates(monkeypatch: pytest.MonkeyPatch, due: list[tuple[float, str, bytes]], seconds: float) -> list[str]:
    """Return the lines that `hz` prints while messages arrive."""
    link, lines = FakeLink(), []
    monkeypatch.setattr(inspection, "time", Clock(link, due))
    inspection.hz(link, keys.CLOCK, 1000, seconds, lines.append)  # type: ignore[arg-type]
    return lines


@pytest.mark.parametrize("key", [keys.CLOCK, "of/somebody"])
@pytest.mark.parametrize("payload", GARBAGE, ids=["utf8", "nested", "no", "deep"])
def test_garbage_is_shown_as_refused(key: str, payload: bytes):
    shown = inspection.readable(ReceivedSample(key, payload))
    assert shown["bytes"] == len(payload)
    assert shown["refused"].startswith(key)


@pytest.mark.parametrize(("said", "shown"), FOREIGN, ids=["bytes", "numbers", "inside", "none", "flag"])
def test_values_unknown_to_json_are_shown_nevertheless(said: object, shown: object):
    assert inspection.readable(ReceivedSample("of/somebody", msgspec.msgpack.encode(said))) == shown
    event = run_messages.Event(0, 0, "note", "eve", "drone1", "", {"said": said})
    read = inspection.readable(ReceivedSample(keys.EVENT, messages.encode(event)))
    assert json.loads(json.dumps(read)) == read


def test_the_rate_is_printed_every_second_and_at_the_end(monkeypatch: pytest.MonkeyPatch):
    due = [(0.5, keys.CLOCK, b"\x80"), (1.2, keys.CLOCK, b"\x80")]
    first, last = rates(monkeypatch, due, 1.5)
    assert first == "1 message"
    assert has_terms(last, "1.4 Hz wall", "700.0", "700.0 ms", "2 messages")
    for payload in GARBAGE:
        assert rates(monkeypatch, [(0.01, keys.CLOCK, payload)], 0.05) == ["1 message"]
    for call in (lambda: inspection.hz(FakeLink(), "a//b", 10, 0.05, print), lambda: inspection.list_keys(FakeLink(), "a//b")):  # type: ignore[arg-type] # fmt: skip
        with pytest.raises(SessionError, match="a//b"):
            call()


def test_the_rate_follows_from_the_gaps_between_messages(monkeypatch: pytest.MonkeyPatch):
    due = [(0.02 * (k + 1), keys.CLOCK, msgspec.msgpack.encode({"t_ns": 20_000_000 * k})) for k in range(10)]
    (line,) = rates(monkeypatch, due, 0.3)
    assert has_terms(line, "50.0 Hz wall", "20.0", "20.0 ms", "50.0 Hz simulated", "10 messages")


def test_a_silent_key_is_reported_but_a_slow_one_is_not():
    rate, slow = inspection.MessageRate(10), inspection.MessageRate(10)
    for number in range(5):
        rate.add(10 + 0.02 * number, 20_000_000 * number)
    assert has_terms(rate.line(10.1), "50.0 Hz wall", "20.0", "20.0 ms", "50.0 Hz simulated")
    assert has_terms(rate.line(12.08), "no messages", "2.0 s", "5 messages")
    for wall_s in (0.0, 3.0, 6.0):
        slow.add(wall_s, None)
    assert slow.line(11.0).startswith("0.3 Hz wall")


INFO = info(scenario_file.load(SCENARIOS / "step.yaml"))
MODE = "drone/drone1/cmd/mode"
TAKEOFF = '{"mode": "takeoff"}'

# name: (key, message, terms of the error)
BAD = {
    "a drone that is not there": ("drone/ghost/cmd/mode", TAKEOFF, ("drone", "'ghost'", "drone1")),
    "wildcards": ("drone/*/cmd/mode", TAKEOFF, ("one", "wildcards")),
    "the world's": (keys.CLOCK, "{}", (keys.CLOCK, "drone/…/cmd/…")),
    "a process's": ("process/world/bye", "{}", ("process/world/bye", "drone/…/cmd/…")),
    "nobody's": ("drone/drone1/fly", "{}", ("drone/drone1/fly", "zsim keys", "docs/protocol.md")),
    "no end": (MODE, "[" * 100_000, ("message", "JSON")),
    "a huge number": (MODE, f'{{"mode": "land", "seq": {2**64}}}', (MODE, "sent")),
    "half a character": (MODE, '{"mode": "\\ud800"}', (MODE, "sent")),
    "too deep": (MODE, f'{{"mode": {"[" * 900}{"]" * 900}}}', (MODE,)),
    "another mode": (MODE, '{"mode": "x"}', ("mode", "'x'", "takeoff")),
}


@pytest.mark.parametrize("name", BAD)
def test_an_invalid_message_is_refused_in_one_line(name: str):
    key, text, terms = BAD[name]
    link = FakeLink()
    with refused(RunError, *terms) as error:
        inspection.publish(link, INFO, key, text, 1, 1.0)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
    assert link.published == []


def test_messages_are_published_on_schedule(monkeypatch: pytest.MonkeyPatch):
    link, sent_s = FakeLink(), []
    watch = Clock(link, [])
    monkeypatch.setattr(inspection, "time", watch)
    link.last[keys.CLOCK] = messages.encode(run_messages.Clock(60_000_000, 3, "run", 3, "running", 1.0, ()))

    def take(key: str, payload: bytes) -> None:
        sent_s.append(watch.now_s)
        watch.now_s += 0.004

    link.on_publish = take
    assert inspection.publish(link, INFO, MODE, TAKEOFF, 5, 10.0).sent == 5  # type: ignore[arg-type]
    assert sent_s == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    first = messages.decode(MODE, link.published[0][1])
    assert (first.t_ns, first.seq, first.source) == (60_000_000, 0, "zsim.pub")


def test_time_stamps_advance_while_publishing():
    link = FakeLink()
    stamps = iter((20_000_000, 40_000_000))

    def pass_time(key: str, payload: bytes) -> None:
        link.deliver(keys.CLOCK, run_messages.Clock(next(stamps), 0, "run", 0, "running", 1.0, ()))

    link.on_publish = pass_time
    inspection.publish(link, INFO, MODE, TAKEOFF, 2, 1000.0)  # type: ignore[arg-type]
    assert [messages.decode(key, payload).t_ns for key, payload in link.published] == [0, 20_000_000]


@pytest.mark.parametrize(
    ("key", "text", "terms"),
    [
        ("world/*", "{}", ("one key", "wildcards")),
        (keys.CONTROL, "{x", ("step", "args", "JSON")),
        (keys.CONTROL, "3", ("step", "args", "'3'", "map")),
        (keys.CONTROL, f'{{"gates": {10**22}}}', ("step", "args", "sent")),
        (keys.CONTROL, "{}", ("nobody answered",)),
    ],
)
def test_an_invalid_request_is_refused(key: str, text: str, terms: tuple[str, ...]):
    with refused(RunError, *terms):
        inspection.ask(FakeLink(), key, "step", text)  # type: ignore[arg-type]


def test_arguments_may_have_any_name():
    link = FakeLink()
    link.on_request = lambda key, args: ControlAnswer(ok=True, result=args)
    args = {"source": "me", "key": 1, "op": 2, "timeout_s": 3}
    assert inspection.ask(link, keys.CONTROL, "step", msgspec.json.encode(args).decode()) == args  # type: ignore[arg-type]


def test_messages_in_an_answer_are_decoded():
    link = FakeLink()
    passed = [[keys.process("a.b", "bye"), messages.encode(run_messages.Bye(0, 0, "over"))]]
    link.on_request = lambda key, args: ControlAnswer(ok=True, result=passed)
    (shown,) = inspection.ask(link, keys.CONTROL, "replay", "{}")  # type: ignore[arg-type]
    assert shown == {"key": "process/a.b/bye", "message": {"t_ns": 0, "seq": 0, "reason": "over"}}


@pytest.mark.parametrize(
    ("expression", "found"),
    [
        ("**", {keys.CLOCK: 0, "drone/d1/truth": 1, "my/key": 1}),
        ("drone/**", {"drone/d1/truth": 1}),
        ("my/key", {"my/key": 1}),
    ],
)
def test_keys_are_selected_by_an_expression(
    monkeypatch: pytest.MonkeyPatch, expression: str, found: dict[str, int]
) -> None:
    link = FakeLink()
    link.last[keys.CLOCK] = b""
    monkeypatch.setattr(inspection, "time", Clock(link, [(0.1, "drone/d1/truth", b"1"), (0.2, "my/key", b"1")]))
    listed = inspection.list_keys(link, expression)  # type: ignore[arg-type]
    assert {key: count for key, _, count in listed} == found


def command_event(seq: int, apply_t_ns: int) -> run_messages.Event:
    data = {"command": "mode", "apply_t_ns": apply_t_ns, "message": {}}
    return run_messages.Event(20_000_000, seq, "command", inspection.PUB, "drone1", "", data)


def refusal_event(seq: int, subject: str = MODE) -> run_messages.Event:
    return run_messages.Event(40_000_000, seq, "refused", inspection.PUB, subject, f"{subject}: drone1 flies", {})


def clock_at(t_ns: int, state: str = "running") -> run_messages.Clock:
    return run_messages.Clock(t_ns, 0, "run", 0, state, 1.0, ())  # type: ignore[arg-type]


OTHERS = msgspec.structs.replace(refusal_event(0), source="controller.main")
OURS = f"{MODE}: drone1 flies"


@pytest.mark.parametrize(
    ("answers", "refused_count", "reason", "note"),
    [
        ([refusal_event(0)], 1, OURS, ""),
        ([command_event(0, 40_000_000), clock_at(60_000_000)], 0, "", ""),
        ([OTHERS, command_event(0, 40_000_000), clock_at(60_000_000)], 0, "", ""),
        ([command_event(0, 40_000_000), refusal_event(1), clock_at(60_000_000)], 1, OURS, ""),
        ([refusal_event(0, "drone/drone2/cmd/mode"), clock_at(20_000_000, "paused")], 0, "", "paused; the outcome"),
        ([clock_at(20_000_000)], 0, "", "not known after 3 s; the state of the world is running"),
        ([clock_at(20_000_000, "stopped")], 0, "", "not known after 3 s; the state of the world is stopped"),
    ],
    ids=["refused at once", "carried out", "another's refused", "refused when due", "paused", "running", "stopped"],
)
def test_the_outcome_of_a_command_is_reported(
    monkeypatch: pytest.MonkeyPatch, answers: list[msgspec.Struct], refused_count: int, reason: str, note: str
):
    link = FakeLink()
    monkeypatch.setattr(inspection, "time", Clock(link, []))

    def answer(key: str, payload: bytes) -> None:
        for message in answers:
            link.deliver(keys.CLOCK if isinstance(message, run_messages.Clock) else keys.EVENT, message)

    link.on_publish = answer
    found = inspection.publish(link, INFO, MODE, TAKEOFF, 1, 10.0)  # type: ignore[arg-type]
    assert (found.sent, found.refused, found.reason) == (1, refused_count, reason)
    assert note in found.note
    assert bool(found.note) is bool(note)


TRUTH = (1.5, "drone/drone1/truth", b"\x80")


def test_a_key_without_messages_is_reported_with_similar_keys(monkeypatch: pytest.MonkeyPatch):
    notes, lines, wrong = [], [], TRUTH[1][:-1]
    link = FakeLink()
    monkeypatch.setattr(inspection, "time", Clock(link, [TRUTH]))
    assert inspection.echo(link, wrong, None, print, False, 20.0, notes.append) == 0  # type: ignore[arg-type]
    (line,) = notes
    assert f"{wrong} for 3 s" in line
    assert line.endswith(TRUTH[1])
    monkeypatch.setattr(inspection, "time", Clock(link, [TRUTH]))
    assert inspection.hz(link, wrong, 10, 6.0, lines.append) == 0  # type: ignore[arg-type]
    assert TRUTH[1] in lines[-1]


@pytest.mark.parametrize(("count", "heard"), [(1, 1), (None, 2)])
def test_a_key_with_messages_causes_no_note(monkeypatch: pytest.MonkeyPatch, count: int | None, heard: int):
    """The first message arrives before the note would be printed, the second after that time."""
    link, shown, notes = FakeLink(), [], []
    monkeypatch.setattr(inspection, "time", Clock(link, [TRUTH, (5.0, *TRUTH[1:])]))
    came = inspection.echo(link, TRUTH[1], count, lambda key, _: shown.append(key), True, 8.0, notes.append)  # type: ignore[arg-type]
    assert (came, shown, notes) == (heard, [TRUTH[1]] * heard, [])
