"""Looking at a federation: whatever somebody publishes can be shown and counted."""

import sys
from pathlib import Path

import pytest

from zsim import keys
from zsim.session import Sample
from zsim_deploy import look

sys.path.insert(0, str(Path(__file__).parent))
from fake_link import BAD_UTF8, NESTED, FakeLink

GARBAGE = [BAD_UTF8, NESTED, b"\xc1", b"\x91" * 5000]


@pytest.mark.parametrize("key", [keys.CLOCK, "of/somebody"])
@pytest.mark.parametrize("payload", GARBAGE, ids=["utf8", "nested", "no", "deep"])
def test_garbage_is_shown_as_refused(key: str, payload: bytes):
    shown = look.readable(Sample(key, payload))
    assert shown["bytes"] == len(payload)
    assert shown["refused"].startswith(key)


@pytest.mark.parametrize("payload", GARBAGE, ids=["utf8", "nested", "no", "deep"])
def test_garbage_counts_for_the_rate(payload: bytes, monkeypatch: pytest.MonkeyPatch):
    link, lines, added = FakeLink(), [], []
    link.deliver(keys.CLOCK, payload)
    monkeypatch.setattr(look.Rate, "add", lambda self, wall_s, t_ns: added.append(t_ns))
    look.hz(link, keys.CLOCK, 10, 0.05, lines.append)  # type: ignore[arg-type]
    assert len(added) == 1


def test_the_rate_is_told_at_the_end_too():
    link, lines = FakeLink(), []
    link.deliver(keys.CLOCK, b"\x80")
    look.hz(link, keys.CLOCK, 10, 0.05, lines.append)  # type: ignore[arg-type]
    assert lines == ["1 message"]


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
