"""The lines that a run shows: lasting reasons, repeated events, control codes and progress."""

import io

import pytest
from refused import has_terms
from rich.console import Console

from zsim.contract.flight_messages import ClusterState
from zsim.errors import printable
from zsim.runtime import progress
from zsim.runtime.progress import REASON_NS, HoldReasons

GATE_NS = 20_000_000
WAITS = "Follow of the plan waits: the reference is not allowed: p is -1; allowed: between 0 and inf"


def state(t_ns: int, reason: str) -> ClusterState:
    return ClusterState(t_ns, t_ns // GATE_NS, "engaged", (), (), (), (), (), None, 1.0, reason)


def lines_of(reasons: HoldReasons, reason: str, from_ns: int, to_ns: int) -> list[str]:
    lines = [reasons.line("main", state(t_ns, reason)) for t_ns in range(from_ns, to_ns, GATE_NS)]
    return [line for line in lines if line]


def test_a_lasting_reason_is_shown_once():
    reasons = HoldReasons()
    assert lines_of(reasons, WAITS, 0, REASON_NS) == []
    (line,) = lines_of(reasons, WAITS, REASON_NS, 10 * REASON_NS)
    assert has_terms(line, "5.00", "main", "engaged", WAITS)
    for t_ns in (0, REASON_NS):  # each cluster has its own reasons
        lines = [reasons.line(cluster, state(t_ns, WAITS)) for cluster in ("a", "b")]
    assert [line and line.split()[2] for line in lines] == ["a,", "b,"]


def test_a_passing_reason_is_not_shown():
    reasons = HoldReasons()
    for start_ns in range(0, 10 * REASON_NS, REASON_NS):
        assert lines_of(reasons, WAITS, start_ns, start_ns + REASON_NS // 2) == []
        assert lines_of(reasons, "", start_ns + REASON_NS // 2, start_ns + REASON_NS) == []


def test_reasons_that_differ_only_in_numbers_are_the_same():
    reasons, times = HoldReasons(), range(0, 2 * REASON_NS, GATE_NS)
    lines = [reasons.line("main", state(t_ns, f"drone2 is at z = {t_ns / 1e12:.3f} m")) for t_ns in times]
    assert len([line for line in lines if line]) == 1


def test_equal_events_are_merged_into_one_line_with_their_count():
    output = io.StringIO()
    with progress.Screen(60.0, Console(file=output, width=200)) as screen:
        for k in range(20):
            screen.event({"t_s": 1.0 + k / 10, "kind": "collision", "text": "drone1 and drone2"})
            screen.event({"t_s": 1.0 + k / 10, "kind": "collision", "text": "drone1 and drone3"})
    lines = [line.split(": ")[1] for line in output.getvalue().splitlines()]
    assert lines[:2] == ["drone1 and drone2", "drone1 and drone3"]
    assert len(lines) == 4
    assert all(has_terms(line, "19", "1.00") for line in lines[2:])


def test_counting_of_equal_events_restarts_after_a_while():
    events = progress.RepeatedEvents()
    times = (0.0, 1.0, progress.REPEATED_S, progress.REPEATED_S + 1.0)
    shown = [events.lines(t_s, "collision", "a and b") for t_s in times]
    assert [len(lines) for lines in shown] == [1, 0, 2, 0]
    assert events.over(progress.REPEATED_S + 1.5) == []


ESCAPES = "\x1b]0;title\x07\x1b[2Ka\x9b1m\r\u202eb"


def test_terminal_control_codes_are_escaped():
    output = io.StringIO()
    screen = progress.Screen(10.0, Console(file=output))
    assert printable("one\n\ttwo: Zürich, 東京 ×") == "one\n\ttwo: Zürich, 東京 ×"
    screen.say(ESCAPES)
    screen.event({"t_s": 1.0, "kind": "death", "text": f"estimator.d1 on {ESCAPES}"})
    waiting = {"name": "a", "host": ESCAPES, "since_wall_s": 1.0}
    screen.clock({"t_s": 1.0, "rate": 1.0, "state": "waiting", "waiting_for": [waiting]})
    assert len(output.getvalue().splitlines()) == 3
    assert output.getvalue().replace("\n", "").isprintable()
    assert output.getvalue().count(r"\x1b]0;title\x07\x1b[2Ka\x9b1m\r\u202eb") == 3


@pytest.mark.parametrize("is_slow", [True, False])
def test_a_slow_start_is_explained(monkeypatch: pytest.MonkeyPatch, is_slow: bool):
    monkeypatch.setattr(progress, "SLOW_S", 0.0 if is_slow else 600.0)
    shown: list[str] = []
    start = progress.SlowStart(shown.append)
    if is_slow:
        start._timer.join()
    start.over()
    start._timer.join()
    assert shown == [progress.SLOW_NOTICE] * is_slow


def test_progress_of_a_part_is_relative_to_that_part() -> None:
    line = {"t_s": 15.0, "rate": 1.0, "state": "running", "waiting_for": []}
    assert progress.describe(line, 20.0, from_s=10.0).count("█") == 10
    assert progress.describe({**line, "t_s": 10.0}, 20.0, from_s=10.0).count("█") == 0
    assert progress.describe({**line, "t_s": 20.0}, 20.0, from_s=10.0).count("░") == 0
