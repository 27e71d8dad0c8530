"""Poking a federation: what a person types is sent on a schedule, or refused in a line."""

import msgspec
import pytest
from fake_link import FakeLink
from synthetic_record import SCENARIOS, info

from zsim.contract import keys, messages
from zsim.contract.messages import ControlAnswer
from zsim.errors import RunError
from zsim.scenario import scenario_file
from zsim_deploy.cli.inspect import poke

INFO = info(scenario_file.load(SCENARIOS / "step.yaml"))
MODE = "drone/drone1/cmd/mode"
TAKEOFF = '{"mode": "takeoff"}'

# name: (key, message, what the line must say)
BAD = {
    "a drone that is not there": ("drone/ghost/cmd/mode", TAKEOFF, "drone is 'ghost'; must be one of drone1, "),
    "wildcards": ("drone/*/cmd/mode", TAKEOFF, "takes one key, without wildcards"),
    "the world's": (keys.CLOCK, "{}", "clock: only the process that this is about speaks here"),
    "a process's": ("process/world/bye", "{}", "only the process that this is about speaks here"),
    "nobody's": ("drone/drone1/fly", "{}", "is no key of the contract"),
    "no end": (MODE, "[" * 100_000, "the message is no JSON"),
    "a huge number": (MODE, f'{{"mode": "land", "seq": {2**64}}}', "the message cannot be sent"),
    "half a character": (MODE, '{"mode": "\\ud800"}', "the message cannot be sent"),
    "too deep": (MODE, f'{{"mode": {"[" * 900}{"]" * 900}}}', MODE),
    "another mode": (MODE, '{"mode": "x"}', "mode is 'x'; must be one of"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_message_that_cannot_be_meant_is_a_line(name: str):
    key, text, says = BAD[name]
    link = FakeLink()
    with pytest.raises(RunError) as refused:
        poke.publish(link, INFO, key, text, 1, 1.0)  # type: ignore[arg-type]
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
    assert link.published == []


class Watch:
    """A clock that only sleeping moves on, and every look at the simulated time by 4 ms."""

    now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def test_messages_keep_to_their_schedule(monkeypatch: pytest.MonkeyPatch):
    watch, sent_s = Watch(), []
    monkeypatch.setattr(poke, "time", watch)
    link = FakeLink()
    link.last[keys.CLOCK] = messages.encode(messages.Clock(60_000_000, 3, "run", 3, "running", 1.0, ()))

    def take(key: str, payload: bytes) -> None:
        sent_s.append(watch.now_s)
        watch.now_s += 0.004

    link.on_publish = take
    assert poke.publish(link, INFO, MODE, TAKEOFF, 5, 10.0) == 5  # type: ignore[arg-type]
    assert sent_s == pytest.approx([100.0, 100.1, 100.2, 100.3, 100.4])
    first = messages.decode(MODE, link.published[0][1])
    assert (first.t_ns, first.seq, first.source) == (60_000_000, 0, "zsim.pub")


def test_time_goes_on_while_it_publishes():
    link = FakeLink()
    stamps = iter((20_000_000, 40_000_000))

    def pass_time(key: str, payload: bytes) -> None:
        link.deliver(keys.CLOCK, messages.Clock(next(stamps), 0, "run", 0, "running", 1.0, ()))

    link.on_publish = pass_time
    poke.publish(link, INFO, MODE, TAKEOFF, 2, 1000.0)  # type: ignore[arg-type]
    assert [messages.decode(key, payload).t_ns for key, payload in link.published] == [0, 20_000_000]


@pytest.mark.parametrize(
    ("key", "text", "says"),
    [
        ("world/*", "{}", "takes one key, without wildcards"),
        (keys.CONTROL, "{x", "step: args is no JSON"),
        (keys.CONTROL, "3", "must be a map such as"),
        (keys.CONTROL, f'{{"gates": {10**22}}}', "step: args cannot be sent"),
        (keys.CONTROL, "{}", "nobody answered"),
    ],
)
def test_a_request_that_cannot_be_meant_is_a_line(key: str, text: str, says: str):
    with pytest.raises(RunError) as refused:
        poke.ask(FakeLink(), key, "step", text)  # type: ignore[arg-type]
    assert says in str(refused.value)


def test_arguments_may_be_named_like_anything():
    link = FakeLink()
    link.on_request = lambda key, args: ControlAnswer(ok=True, result=args)
    args = {"source": "me", "key": 1, "op": 2, "timeout_s": 3}
    assert poke.ask(link, keys.CONTROL, "step", msgspec.json.encode(args).decode()) == args  # type: ignore[arg-type]


def test_messages_in_an_answer_are_shown_as_messages():
    link = FakeLink()
    passed = [[keys.process("a.b", "bye"), messages.encode(messages.Bye(0, 0, "over"))]]
    link.on_request = lambda key, args: ControlAnswer(ok=True, result=passed)
    (shown,) = poke.ask(link, keys.CONTROL, "replay", "{}")  # type: ignore[arg-type]
    assert shown == {"key": "process/a.b/bye", "message": {"t_ns": 0, "seq": 0, "reason": "over"}}
