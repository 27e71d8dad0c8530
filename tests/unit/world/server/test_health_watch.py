"""Who has fallen silent."""

from zsim_world.server.liveliness import SILENT_NS, HealthWatch

S = 1_000_000_000
LOOK_NS = S // 10
ME = "estimator.d1"


class Case:
    """A watch, and what it reports."""

    def __init__(self) -> None:
        self.reports: list[tuple[str, int | None]] = []
        self.watch = HealthWatch(lambda name, since_ns: self.reports.append((name, since_ns)))

    def looks(self, from_ns: int, to_ns: int) -> None:
        for wall_ns in range(from_ns, to_ns + 1, LOOK_NS):
            self.watch.look(wall_ns)


def test_a_stopped_process_is_reported_once_within_two_seconds_and_when_it_is_back():
    case = Case()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.looks(10 * S, 10 * S + SILENT_NS - LOOK_NS)
    assert case.reports == []
    case.looks(10 * S + SILENT_NS, 15 * S)
    assert case.reports == [(ME, 10 * S)]
    assert SILENT_NS + LOOK_NS < 2 * S
    case.watch.received(ME, 15 * S)
    assert case.reports[1:] == [(ME, None)]


def test_what_the_world_did_not_read_while_it_was_held_up_is_nobody_s_silence():
    case = Case()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.watch.look(15 * S)
    assert case.reports == []


def test_nothing_is_expected_of_one_that_has_left():
    case = Case()
    case.watch.look(10 * S)
    case.watch.received(ME, 10 * S)
    case.watch.forget(ME)
    case.looks(10 * S, 15 * S)
    assert case.reports == []
