"""A process that serves runs and refuses one leaves it, so that the world does not take it for dead."""

from typing import Any

import pytest
from fake_link import FakeLink

from zsim.contract import keys
from zsim.contract.messages import Info, Origin
from zsim.errors import RunError
from zsim_bridges.observer_process import ObserverProcess
from zsim_deploy.roles import roles

ME = "driver.ghost"


class NotStopped:
    """Nobody stops it."""

    def stopped(self) -> bool:
        return False

    def reason(self) -> str | None:
        return None


def test_who_refuses_a_run_says_bye_with_the_reason():
    link: Any = FakeLink()
    info = Info(0, 0, 1, "r", "zsim", "lockstep", 1.0, 1, 1, 1, 1, Origin(0.0, 0.0, 0.0), (), (), "", "", "", "")
    presence = ObserverProcess(link, info, ME)
    stop: Any = NotStopped()

    def serve(*_: object) -> None:
        raise RunError(f"{ME}: no such drone")

    with pytest.raises(RunError):
        roles._serve(serve, link, presence, info, stop, print)
    (bye,) = link.published_on(keys.process(ME, "bye"))
    assert bye.reason == "no such drone"
