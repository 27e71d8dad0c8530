"""The rate limiter: a burst at once, then one more each period, for each subject by itself."""

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
def test_what_is_spent_comes_back_one_by_one_up_to_the_burst(burst: int, periods: float, more: int) -> None:
    clock = Clock()
    limit = RateLimit(20, burst, clock)
    assert spent(limit) == burst
    clock.now += 20 * periods
    assert limit.allows() == (more > 0)
    assert spent(limit) == more


def test_each_subject_has_its_own() -> None:
    limit = RateLimit(1.0, 2, Clock())
    assert not limit.knows("a")
    assert (spent(limit, "a"), spent(limit, "b")) == (2, 2)
    assert limit.knows("a")


def test_how_long_to_wait() -> None:
    clock = Clock()
    limit = RateLimit(20, 2, clock)
    assert limit.wait() == 0
    spent(limit)
    clock.now += 5
    assert limit.wait() == pytest.approx(15)


def test_subjects_without_end_fill_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rate_limit, "SUBJECTS_MAX", 10)
    limit = RateLimit(1.0, 1, Clock())
    for number in range(25):
        limit.spend(f"a.{number}")
    assert not limit.knows("a.0")
    assert limit.knows("a.24")
