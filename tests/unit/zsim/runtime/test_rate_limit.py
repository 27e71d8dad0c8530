"""The rate limiter: a burst at once, then one more each period, separately for each subject."""

import pytest

from zsim.runtime import rate_limit
from zsim.runtime.rate_limit import RateLimit


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def spent(limit: RateLimit, subject: str = "", tries: int = 10) -> int:
    """Return how often a subject can spend now."""
    return [limit.spend(subject) for _ in range(tries)].count(True)


@pytest.mark.parametrize(
    ("burst", "periods", "more"), [(1, 0.9, 0), (1, 1, 1), (1, 5, 1), (3, 1, 1), (3, 2.5, 2), (3, 9, 3)]
)
def test_the_allowance_recovers_one_per_period_up_to_the_burst(burst: int, periods: float, more: int) -> None:
    clock = Clock()
    limit = RateLimit(20, burst, clock)
    assert spent(limit) == burst
    clock.now += 20 * periods
    assert limit.allows() == (more > 0)
    assert spent(limit) == more


def test_each_subject_has_its_own_allowance() -> None:
    limit = RateLimit(1.0, 2, Clock())
    assert not limit.knows("a")
    assert (spent(limit, "a"), spent(limit, "b")) == (2, 2)
    assert limit.knows("a")


def test_wait_returns_the_time_until_the_next_allowance() -> None:
    clock = Clock()
    limit = RateLimit(20, 2, clock)
    assert limit.wait() == 0
    spent(limit)
    clock.now += 5
    assert limit.wait() == pytest.approx(15)


def test_the_number_of_remembered_subjects_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rate_limit, "SUBJECTS_MAX", 10)
    limit = RateLimit(1.0, 1, Clock())
    for number in range(25):
        limit.spend(f"a.{number}")
    assert not limit.knows("a.0")
    assert limit.knows("a.24")
