"""A search for events that change a bit of the truth: processes die, stop, move and lose their link. `make soak`.

Each flight has rounds in which every process dies once and is stopped once; on three hosts, processes also move and
hosts are cut off. The flight's number seeds order and times: an event strikes while processes still recover from
others, and the orders are chosen so that in the end every event has followed every other. A flight must have the same
bits as one without events, and its record must lack no gate and no message.

    ZSIM_SOAK_BUDGET_S=28800 make soak         a night, half of it for each of the two tests
    ZSIM_SOAK_DRAWS=7                          further draws

The numbers of events and successions are printed at the end.
"""

import os
import random
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest
from deployment import ROLES, START_S, STEP, Deployment, closing, in_flight
from federation import PAIR, PAIR_ROLES, Federation, Record, Role
from lab import Lab
from said_lines import say
from test_kill import Flight, check_end, check_whole

from zsim.record import RecordReader
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim_analysis.in_process import fly
from zsim_deploy.launch.supervisor import RESTART_WINDOW_S, RESTARTS_MAX

pytestmark = pytest.mark.soak

BUDGET_S = float(os.environ.get("ZSIM_SOAK_BUDGET_S", "240")) / 2  # wall time of each test
DRAWS = int(os.environ.get("ZSIM_SOAK_DRAWS", "1"))
EVENTS = 10_000  # number of events in both tests together; more are not needed
ROUNDS = 15  # maximum number of rounds in a flight
STOPPED_S, CUT_S = 0.3, 3.0  # wall time; the second is long enough to be noticed
PAUSE_S = 0.5  # maximum wall time between two events: most strike while processes still recover from others
ROUND_S = (
    1.5 * RESTART_WINDOW_S / RESTARTS_MAX
)  # minimum wall time of a round; a launcher treats more frequent restarts as a fault
TRIES = 20  # orders drawn for a round, of which the one with the most untried successions is used
ESTIMATORS = ("estimator.drone1", "estimator.drone2", "estimator.drone3")
LAB_ROLES = (*ESTIMATORS, "controller.main", "recorder", "world")
HOSTS, FAR_HOSTS = ("h1", "h2", "h3"), ("h2", "h3")  # FAR_HOSTS do not run the world
BACK = {"world": "world: continues at t = "}


class Event(NamedTuple):
    """Something that happens to a process or a host."""

    name: str  # kind and target
    act: Callable[[], object]  # returns False if refused
    back: str = ""  # pattern of the line that reports its end; empty for an event that goes unnoticed


class Tally:
    """The events of all flights, and which event followed which."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.flights = 0
        self.successions: set[tuple[str, str]] = set()
        self.possible = 0

    @property
    def events(self) -> int:
        return sum(self.counts.values())

    def lines(self) -> Iterator[str]:
        kinds: Counter[str] = Counter(dict.fromkeys(("kill", "stop", "move", "cut"), 0))
        for name, count in self.counts.items():
            kinds[name.partition(" ")[0]] += count
        parts = ", ".join(f"{count} {kind}s" for kind, count in kinds.items())
        yield f"{self.events} events ({parts}) in {self.flights} flights, all with the same bits"
        yield f"{len(self.successions)} of {self.possible} successions of two events"


@pytest.fixture(scope="module")
def tally(request: pytest.FixtureRequest) -> Iterator[Tally]:
    made = Tally()
    yield made
    say(request, made.lines())


class Deaths:
    """Triggers events in rounds, each event before the previous one is over.

    Args:
        run: the launcher.
        tally: tally of all flights.
        number: number of the flight, which seeds orders and times.
    """

    def __init__(self, run: Role, tally: Tally, number: int) -> None:
        self._run, self._tally = run, tally
        self._chance = random.Random(f"{DRAWS} {number}")
        self._last = ""
        self.history: list[str] = []

    def round(self, events: Sequence[Event]) -> None:
        """Trigger these events in a drawn order, then wait until all are over."""
        until_s = time.monotonic() + ROUND_S
        expected = {event.back: len(re.findall(event.back, self._run.text())) + 1 for event in events if event.back}
        for event in self._order(events):
            if event.act() is False:
                continue
            self._tally.counts[event.name] += 1
            self.history.append(event.name)
            if self._last:
                self._tally.successions.add((self._last, event.name))
            self._last = event.name
            threading.Event().wait(self._chance.uniform(0, PAUSE_S))
        for pattern, number in expected.items():
            self._run.line(pattern, START_S, number)
        threading.Event().wait(max(0.0, until_s - time.monotonic()))

    def _order(self, events: Sequence[Event]) -> list[Event]:
        orders = [self._chance.sample(events, len(events)) for _ in range(TRIES)]

        def untried(order: Sequence[Event]) -> int:
            names = [self._last, *(event.name for event in order)]
            return len({*pairwise(names)} - self._tally.successions)

        return max(orders, key=untried)

    def choice(self, of: Sequence[str]) -> str:
        return self._chance.choice(of)


def back(role: str) -> str:
    """Return the pattern of the line that reports the return of a dead role."""
    return BACK.get(role, f"(restart|superseded): {role} on ")


def pause(kill: Callable[[int], object]) -> None:
    """Stop a process for a moment."""
    kill(signal.SIGSTOP)
    threading.Event().wait(STOPPED_S)
    kill(signal.SIGCONT)


def kills_and_stops(kill: Callable[..., object], roles: Sequence[str]) -> list[Event]:
    events = [Event(f"kill {role}", lambda role=role: kill(role), back(role)) for role in roles]
    return [*events, *(Event(f"stop {role}", lambda r=role: pause(lambda n: kill(r, n))) for role in roles)]


def sha256_in_process(scenario: Scenario, record: Record, folder: Path) -> str:
    """Return the hash of the truth of the same flight without events."""
    path = folder / "undisturbed.mcap"
    path.unlink(missing_ok=True)  # left by an earlier flight
    fly(msgspec.structs.replace(scenario, duration_s=record.end()["last_ns"] / 1e9), path)
    with RecordReader(path) as reader:
        return Record(reader).sha256()


def flights(tally: Tally, share: int) -> Iterator[tuple[int, Callable[[], bool]]]:
    """Yield flight numbers until the budget or a share of the events is spent, each with a function to check that."""
    until_s, most = time.monotonic() + BUDGET_S, tally.events + share

    def is_spent() -> bool:
        return time.monotonic() >= until_s or tally.events >= most

    number = 0
    while number == 0 or not is_spent():
        yield number, is_spent
        number, tally.flights = number + 1, tally.flights + 1


def test_events_change_no_bit_on_one_host(tmp_path: Path, tally: Tally, compiled: None) -> None:
    names = (*PAIR_ROLES, "recorder", "world")
    tally.possible += (2 * len(names)) ** 2
    for number, is_spent in flights(tally, EVENTS // 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        with Federation(folder) as federation:
            flight = Flight(federation)
            deaths = Deaths(flight.run, tally, number)
            for _ in range(ROUNDS):
                deaths.round(kills_and_stops(partial(kill_there, federation), names))
                if is_spent():
                    break
            flight.finish()
            record = check_end(federation, whole=True)
            check_whole(record)
            drones = ["drone1", "drone2"]
            wanted = sha256_in_process(scenario_file.from_text(PAIR), record, folder)
            assert (record.sha256(), record.recomputed_sha256(drones)) == (wanted, wanted), deaths.history


def test_events_change_no_bit_on_three_hosts(lab: Lab, tmp_path: Path, tally: Tally) -> None:
    moves = [f"move {role} to {host}" for role in ESTIMATORS for host in HOSTS]
    tally.possible += (2 * len(LAB_ROLES) + len(moves) + len(FAR_HOSTS)) ** 2
    for number, is_spent in flights(tally, EVENTS // 2):
        with closing(Deployment(lab, ROLES)) as deployment:
            run = deployment.up("--rate", "4", "--duration", "100000", *(["--force"] if number else []))
            in_flight(run)
            deaths = Deaths(run, tally, number)
            for _ in range(ROUNDS):
                deaths.round(kills_and_stops(deployment.kill, LAB_ROLES))
                role, to, far = deaths.choice(ESTIMATORS), deaths.choice(HOSTS), deaths.choice(FAR_HOSTS)
                deaths.round([Event(f"move {role} to {to}", lambda r=role, to=to: move(deployment, r, to))])
                deaths.round([Event(f"cut {far}", lambda far=far: cut(deployment, far))])
                if is_spent():
                    break
            deployment.zsim("down").ends(with_code=0)
            run.ends(with_code=130, within_s=START_S)
            record = deployment.record()
            wanted = sha256_in_process(scenario_file.load(STEP), record, tmp_path)
            drones = ["drone1", "drone2", "drone3"]
            assert (record.sha256(), record.recomputed_sha256(drones)) == (wanted, wanted), deaths.history
            check_whole(record)


def kill_there(federation: Federation, role: str, number: int = signal.SIGKILL) -> None:
    """Send a signal to a role once it runs."""
    until_s = time.monotonic() + START_S
    while True:
        try:
            federation.kill(role, number)
            return
        except (pytest.fail.Exception, ProcessLookupError):
            if time.monotonic() > until_s:
                raise
        threading.Event().wait(0.05)  # the test has no notice of processes that the run starts


def move(deployment: Deployment, role: str, host: str) -> bool:
    """Move a role; return False if refused, because the role is already on the host or still moving."""
    return deployment.zsim("move", role, host).process.wait(START_S) == 0


def cut(deployment: Deployment, host: str) -> None:
    """Cut a host off for a while."""
    deployment.cut(host)
    threading.Event().wait(CUT_S)
    deployment.heal(host)
