"""Looking at a federation: whatever somebody publishes can be shown and counted."""

import json

import msgspec
import pytest
from fake_link import BAD_UTF8, NESTED, FakeLink

from zsim.contract import keys, messages
from zsim.errors import SessionError
from zsim.transport.session import Sample
from zsim_deploy.cli.inspect import look

GARBAGE = [BAD_UTF8, NESTED, b"\xc1", b"\x91" * 5000]
FOREIGN = [
    ({"raw": b"\x01\x02"}, {"raw": "AQI="}),
    ({7: "seven", 2.5: "half"}, {"7": "seven", "2.5": "half"}),
    ({"deep": [{b"k": b""}]}, {"deep": [{"aw==": ""}]}),
    ({None: 1}, "{None: 1}"),
    ([{True: b"x"}], "[{True: b'x'}]"),
]


class Clock:
    """Wall time that passes only while somebody sleeps; `due` are (time, key, payload) that arrive meanwhile."""

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
    """Return the lines of `hz` while messages arrive."""
    link, lines = FakeLink(), []
    monkeypatch.setattr(look, "time", Clock(link, due))
    look.hz(link, keys.CLOCK, 1000, seconds, lines.append)  # type: ignore[arg-type]
    return lines


@pytest.mark.parametrize("key", [keys.CLOCK, "of/somebody"])
@pytest.mark.parametrize("payload", GARBAGE, ids=["utf8", "nested", "no", "deep"])
def test_garbage_is_shown_as_refused(key: str, payload: bytes):
    shown = look.readable(Sample(key, payload))
    assert shown["bytes"] == len(payload)
    assert shown["refused"].startswith(key)


@pytest.mark.parametrize(("said", "shown"), FOREIGN, ids=["bytes", "numbers", "inside", "none", "flag"])
def test_what_json_cannot_say_is_shown_all_the_same(said: object, shown: object):
    assert look.readable(Sample("of/somebody", msgspec.msgpack.encode(said))) == shown
    event = messages.Event(0, 0, "note", "eve", "drone1", "", {"said": said})
    read = look.readable(Sample(keys.EVENT, messages.encode(event)))
    assert json.loads(json.dumps(read)) == read


@pytest.mark.parametrize("payload", GARBAGE, ids=["utf8", "nested", "no", "deep"])
def test_garbage_counts_for_the_rate(payload: bytes, monkeypatch: pytest.MonkeyPatch):
    assert rates(monkeypatch, [(0.01, keys.CLOCK, payload)], 0.05) == ["1 message"]


def test_the_rate_is_told_once_a_second_and_at_the_end(monkeypatch: pytest.MonkeyPatch):
    due = [(0.5, keys.CLOCK, b"\x80"), (1.2, keys.CLOCK, b"\x80")]
    assert rates(monkeypatch, due, 1.5) == ["1 message", "1.4 Hz wall (gap 700.0 to 700.0 ms), 2 messages"]


def test_the_gaps_are_those_of_the_messages(monkeypatch: pytest.MonkeyPatch):
    due = [(0.02 * (k + 1), keys.CLOCK, msgspec.msgpack.encode({"t_ns": 20_000_000 * k})) for k in range(10)]
    lines = rates(monkeypatch, due, 0.3)
    assert lines == ["50.0 Hz wall (gap 20.0 to 20.0 ms), 50.0 Hz simulated, 10 messages"]


def test_a_rate_of_what_is_no_key_is_refused():
    with pytest.raises(SessionError, match="a//b"):
        look.hz(FakeLink(), "a//b", 10, 0.05, print)  # type: ignore[arg-type]


def test_a_key_that_fell_silent_is_told():
    rate = look.Rate(10)
    for number in range(5):
        rate.add(10 + 0.02 * number, 20_000_000 * number)
    assert rate.line(10.1).startswith("50.0 Hz wall (gap 20.0 to 20.0 ms), 50.0 Hz simulated")
    assert rate.line(12.08) == "nothing for 2.0 s, 5 messages before"


def test_a_key_that_speaks_seldom_is_not_called_silent():
    rate = look.Rate(10)
    for wall_s in (0.0, 3.0, 6.0):
        rate.add(wall_s, None)
    assert rate.line(11.0).startswith("0.3 Hz wall")
