"""Who loses its link: a reader that takes nothing and that nobody waits for; never anybody else."""

from fake_link import FakeLink

from zsim.transport.link_sockets import Progress
from zsim.transport.link_watch import HELD_BYTES, KEPT_OUT_S, LOOK_S, SPARED, STALL_BYTES, STALL_S, LinkWatch
from zsim.transport.session import FarEnd

READER, RECORDER, ROUTER = "10.0.0.1:1", "10.0.0.2:2", "10.0.0.3:3"
FAR_ENDS = {READER: FarEnd("r", False), RECORDER: FarEnd("rec", False), ROUTER: FarEnd("x", True)}


class Sockets:
    """Connections that hold back what a test says."""

    def __init__(self) -> None:
        self.held: dict[str, int] = {}
        self.taken: dict[str, int] = {}
        self.round_trip_s = 0.0
        self.closed: list[str] = []

    def queued(self) -> dict[str, int]:
        return dict(self.held)

    def progress(self, address: str) -> Progress:
        return Progress(self.taken.get(address, 0), self.round_trip_s)

    def close(self, address: str) -> None:
        self.closed.append(address)
        self.held.pop(address)


class Case:
    """A hub with a reader, the recorder, which is waited for, and a router."""

    def __init__(self) -> None:
        self.link, self.sockets, self.wall_s = FakeLink(), Sockets(), 100.0
        self.link.ends = dict(FAR_ENDS)
        self.link.holders = {"world": ["hub"], "recorder": ["rec"]}
        self.link.readers = {"zsim/drone/**": ["r"]}
        self.watch = LinkWatch(self.link, {"recorder"}.__contains__, self.sockets, lambda: self.wall_s)  # type: ignore[arg-type]

    def passes(self, wall_s: float, taken: int = 0) -> None:
        """Let time pass look by look; each far end takes so many bytes in each."""
        for _ in range(round(wall_s / LOOK_S)):
            self.wall_s += LOOK_S
            self.sockets.taken = {each: self.sockets.taken.get(each, 0) + taken for each in FAR_ENDS}
            self.watch.look()


def test_who_takes_nothing_is_closed_and_named_and_who_is_waited_for_is_not():
    case = Case()
    case.sockets.held = {READER: STALL_BYTES, RECORDER: 100 * HELD_BYTES, ROUTER: 100 * HELD_BYTES}
    case.passes(STALL_S + 2 * LOOK_S)
    assert case.sockets.closed == [READER]
    (closed,) = case.watch.closed
    assert (closed.reads, closed.names, closed.held_bytes, closed.times) == (("zsim/drone/**",), (), STALL_BYTES, 1)
    assert case.watch.stuck()[0].startswith("recorder")


def test_who_takes_something_of_little_is_left_alone():
    case = Case()
    case.sockets.held = {READER: STALL_BYTES}
    case.passes(10.0, taken=1)
    assert case.sockets.closed == []


def test_who_never_catches_up_is_closed():
    case = Case()
    case.sockets.held = {READER: HELD_BYTES}
    case.passes(2.0, taken=1)
    assert case.sockets.closed == [READER]


def test_a_long_way_is_given_its_time():
    case = Case()
    case.sockets.round_trip_s = 0.6
    case.sockets.held = {READER: STALL_BYTES}
    case.passes(1.0)
    assert case.sockets.closed == []
    case.passes(1.0)
    assert case.sockets.closed == [READER]


def test_nobody_is_closed_of_whom_it_is_not_known_who_they_are():
    case = Case()
    case.link.holders = {}
    case.sockets.held = {READER: HELD_BYTES}
    case.passes(2.0)
    assert case.sockets.closed == []


def test_who_comes_back_to_do_it_again_is_kept_out_for_a_while():
    case = Case()
    for _ in range(SPARED):
        case.sockets.held = {READER: HELD_BYTES}
        case.passes(2.0)
    assert len(case.sockets.closed) == SPARED
    case.sockets.held = {READER: 0}
    case.passes(2.0)
    assert len(case.sockets.closed) == SPARED + 1
    case.passes(2 * KEPT_OUT_S)
    case.sockets.held = {READER: 0}
    case.passes(2.0)
    assert len(case.sockets.closed) == SPARED + 1
