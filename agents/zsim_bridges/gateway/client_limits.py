"""How much clients may ask for, and how many of them there may be. Pure."""

from collections.abc import Callable

from zsim_bridges.gateway.http.http_errors import TooManyError


class TokenBucket:
    """Lets `rate_hz` requests through on average, `burst` at once.

    Args:
        rate_hz: requests per wall second.
        burst: tokens that it holds.
        wall_s: monotonic wall time.
    """

    def __init__(self, rate_hz: float, burst: float, wall_s: Callable[[], float]) -> None:
        self._rate_hz = rate_hz
        self._burst = burst
        self._wall_s = wall_s
        self._tokens = burst
        self._last_s = wall_s()

    def spend(self) -> None:
        """Take a token.

        Raises:
            TooManyError: there is none, with how long to wait.
        """
        now_s = self._wall_s()
        self._tokens = min(self._burst, self._tokens + (now_s - self._last_s) * self._rate_hz)
        self._last_s = now_s
        if self._tokens < 1.0:
            wait_s = (1.0 - self._tokens) / self._rate_hz
            raise TooManyError(f"more than {self._rate_hz:g} requests a second; wait {wait_s:.3f} s")
        self._tokens -= 1.0


class ConnectionLimit:
    """Lets so many through at a time.

    Args:
        limit: how many.
        what: of them, for the refusal.
    """

    def __init__(self, limit: int, what: str) -> None:
        self._limit = limit
        self._what = what
        self._inside = 0

    def enter(self) -> None:
        """Let one in.

        Raises:
            TooManyError: there are as many as may be.
        """
        if self._inside >= self._limit:
            raise TooManyError(f"there are {self._limit} {self._what} already; try again later")
        self._inside += 1

    def leave(self) -> None:
        """Let one out."""
        self._inside -= 1
