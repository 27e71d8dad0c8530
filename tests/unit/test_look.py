"""Looking at a federation: whatever somebody publishes can be shown, and what a person types is a line."""

import sys
import time
from pathlib import Path

import pytest

from zsim import keys
from zsim.errors import RunError
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


def test_a_message_without_end_is_a_line():
    with pytest.raises(RunError, match=r"^clock: the message is no JSON"):
        look.publish(FakeLink(), keys.CLOCK, "[" * 100_000, 1, 1.0)  # type: ignore[arg-type]
