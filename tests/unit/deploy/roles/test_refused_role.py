"""A process that serves runs and refuses one leaves it, so that the world does not take it for dead."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.messages import Info, Origin
from zsim.errors import NoWorldError, RunError
from zsim.runtime.participant import Participant
from zsim.transport.tls import Identity
from zsim_deploy.roles import roles

ME = "driver.ghost"
INFO = Info(0, 0, 1, "r", "zsim", "lockstep", 1.0, 1, 1, 1, 1, Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")


class NotStopped:
    """Nobody stops it."""

    def stopped(self) -> bool:
        return False

    def reason(self) -> str | None:
        return None

    def exit_if_terminated(self) -> None:
        """Nothing has ended it."""


def test_who_refuses_a_run_says_bye_with_the_reason():
    link: Any = FakeLink()
    presence = Participant(link, INFO, ME)
    stop: Any = NotStopped()

    def serve(*_: object) -> None:
        raise RunError(f"{ME}: no such drone")

    with pytest.raises(RunError):
        roles._serve(serve, link, presence, INFO, stop, print)
    (bye,) = link.published_on(keys.process(ME, "bye"))
    assert bye.reason == "no such drone"


def test_who_serves_run_after_run_waits_for_the_next_where_a_world_goes_as_it_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`zsim mavlink serve --rate 1` asks the world for its pace at first."""
    said: list[str] = []
    monkeypatch.setattr(roles, "log_printer", lambda _: said.append)
    runs = iter("ab")

    @contextmanager
    def found(*_: object) -> Iterator[tuple[Any, Info]]:
        yield FakeLink(), msgspec.structs.replace(INFO, run_id=next(runs))

    monkeypatch.setattr(roles, "find_world", found)
    served: list[str] = []
    gone = NoWorldError(f"{ME}: nobody answers")
    stop = NotStopped()
    monkeypatch.setattr(stop, "stopped", lambda: len(served) == 2)
    monkeypatch.setattr(roles, "StopChannel", lambda *_: stop)

    def serve(link: Any, info: Info, *_: object) -> None:
        served.append(info.run_id)
        if info.run_id == "a":
            raise gone

    reach: Any = SimpleNamespace(launched=None, wait_s=None, who=Identity(), endpoint="tcp/h:1", federation="zsim")
    roles.serve_runs(ME, serve, reach)
    assert served == ["a", "b"]
    assert str(gone) in said
