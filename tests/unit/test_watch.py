"""The watch over a run's processes, with processes that only say how they end."""

import signal
from typing import Any

import pytest

from zsim_deploy.watch import RESTARTS_MAX, SUPERSEDED, USER_FAULT, Watch


class Show:
    """Keeps what is said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def clock(self, line: dict[str, Any]) -> None: ...
    def event(self, line: dict[str, Any]) -> None: ...
    def health(self, line: dict[str, Any]) -> None: ...

    def say(self, text: str) -> None:
        self.said.append(text)


class Member:
    """A process that ends with the codes given, one per start; None lives until it is told to stop."""

    def __init__(self, name: str, *codes: int | None, lives_for: int = 0) -> None:
        self.name, self.role = name, name.split(".")[0]
        self.restarts, self.started_s, self.pid = 0, 0.0, 0
        self._codes, self._left, self._lives_for = list(codes), 0, lives_for
        self.code: int | None = None
        self.stopped_for: str | None = None
        self.closed = False

    def start(self) -> None:
        self.pid += 1
        self.code = None
        self._next = self._codes.pop(0) if self._codes else None
        self._left = self._lives_for

    def wait(self, timeout_s: float) -> bool:
        self._left -= 1
        if self.stopped_for is not None or (self._next is not None and self._left <= 0):
            self.code = self._next or 0
        return self.code is not None

    def outcome(self) -> str:
        return f"exit code {self.code}"

    def last_words(self) -> str:
        return f"{self.name}: last words"

    def tell_stop(self, reason: str) -> None:
        self.stopped_for = reason

    def close(self) -> None:
        self.closed = True


class Team:
    """A world that lives for so many looks, a recorder, and others; the looks let the others live on too."""

    def __init__(
        self, *others: Member, looks: int = 20, on_death: dict[str, Any] | None = None, world: int = 0
    ) -> None:
        self.show = Show()
        self.watch = Watch(on_death or {}, self.show)
        self.world = Member("world", world, lives_for=looks)
        self.recorder = Member("recorder", 0, lives_for=looks + 1)
        self.others = others
        self.members: list[Any] = [self.world, self.recorder, *others]
        self.watch.members = list(self.members)

    def go(self, look=lambda: None):
        def live() -> None:
            for member in (self.recorder, *self.others):
                member.wait(0.0)
            look()

        return self.watch.go(live)


def test_a_run_that_ends_well():
    team = Team(Member("estimator.d1"))
    outcome = team.go()
    assert (outcome.failed, outcome.interrupted) == (False, False)
    assert all(member.closed for member in team.members)


def test_a_dead_estimator_is_started_again():
    team = Team(Member("estimator.d1", 1, None))
    assert not team.go().failed
    assert team.others[0].restarts == 1
    assert "on_death: restart" in team.show.said[0]


def test_too_many_deaths_in_a_row_end_the_run():
    team = Team(Member("estimator.d1", *[1] * 20), looks=100)
    outcome = team.go()
    assert outcome.failed
    assert outcome.reason.startswith("estimator.d1 ended")
    assert team.others[0].restarts == RESTARTS_MAX


def test_deaths_far_apart_do_not_add_up(monkeypatch):
    now = iter(range(0, 100_000, 100))
    monkeypatch.setattr("zsim_deploy.watch.time.monotonic", lambda: float(next(now)))
    team = Team(Member("estimator.d1", *[1] * 8, None), looks=12)
    assert not team.go().failed
    assert team.others[0].restarts == 8


@pytest.mark.parametrize(
    ("name", "code", "on_death", "fails"),
    [
        ("estimator.d1", USER_FAULT, {}, True),
        ("recorder2", 1, {}, False),
        ("estimator.d1", 1, {"estimator": "drop"}, False),
        ("estimator.d1", 1, {"estimator.d1": "end", "estimator": "drop"}, True),
        ("estimator.d1", SUPERSEDED, {"estimator": "end"}, False),
        ("estimator.d1", 0, {"estimator": "end"}, False),
    ],
)
def test_what_a_death_means(name, code, on_death, fails):
    team = Team(Member(name, code), on_death=on_death)
    assert team.go().failed == fails


def test_a_dead_world_fails_the_run_and_stops_the_rest():
    team = Team(Member("estimator.d1"), world=-signal.SIGKILL)
    outcome = team.go()
    assert outcome.failed
    assert outcome.reason == "the world died: exit code -9"
    assert team.others[0].stopped_for == outcome.reason


def test_an_interrupt_ends_everybody():
    team = Team(Member("estimator.d1"), looks=1000)
    outcome = team.go(lambda: team.watch.interrupt("ended by zsim down"))
    assert outcome.interrupted
    assert {member.stopped_for for member in team.members} == {"ended by zsim down"}


def test_a_process_takes_the_place_of_another():
    old, new = Member("estimator.d1", SUPERSEDED, lives_for=1000), Member("estimator.d1")
    team = Team(old)
    team.watch.order(lambda: team.watch.replace(old, new))
    assert not team.go().failed
    assert new.restarts == 1
    assert old.closed
    assert new.closed
    assert new in team.watch.members
