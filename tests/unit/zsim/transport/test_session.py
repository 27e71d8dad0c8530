"""The end of a session."""

from types import SimpleNamespace

import pytest
import zenoh

from zsim.transport.session import open_session
from zsim.transport.tls import Identity


def test_a_far_end_that_takes_nothing_does_not_fail_who_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zenoh gives up closing after 10 s; nothing is lost by it that would still be taken."""
    closed: list[None] = []

    def close() -> None:
        closed.append(None)
        raise zenoh.ZError("close operation timed out!")

    monkeypatch.setattr(zenoh, "open", lambda config: SimpleNamespace(close=close))
    with open_session({}, "zsim", Identity("here"), str):
        pass
    assert closed
