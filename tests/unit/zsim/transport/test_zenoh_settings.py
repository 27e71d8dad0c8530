"""The limit of open files: raised where that is allowed, refused with the number needed where it is not."""

import resource
from collections.abc import Callable

import pytest
from refused import refused

from zsim.errors import SessionError
from zsim.transport import zenoh_settings
from zsim.transport.zenoh_settings import allow_files, hub_files, launcher_files, require_files

Limits = Callable[[int, int], list[int]]


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> Limits:
    """Return what sets soft and hard limit of a process that is not this one, and returns them."""

    def install(soft: int, hard: int) -> list[int]:
        held = [soft, hard]
        monkeypatch.setattr(resource, "getrlimit", lambda which: tuple(held))
        monkeypatch.setattr(resource, "setrlimit", lambda which, both: held.__setitem__(slice(None), list(both)))
        return held

    return install


def test_a_soft_limit_is_raised_to_what_is_needed_and_a_hard_one_refuses(limits: Limits) -> None:
    held = limits(16, 1024)
    require_files(100, "10 processes")
    assert held == [100, 1024]
    require_files(50, "5 processes")
    assert held == [100, 1024]
    with refused(SessionError, "1024", "2000", "200 processes", "`ulimit -n 2000`"):
        require_files(2000, "200 processes")


def test_what_is_only_wanted_is_raised_as_far_as_it_goes(limits: Limits) -> None:
    held = limits(256, 512)
    assert allow_files(2000) == 512
    assert held == [512, 512]
    limits(resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    assert allow_files(10**6) is None


@pytest.mark.parametrize(("clients", "measured"), [(2, 26), (4, 31), (11, 48), (31, 92)])
def test_a_hub_needs_what_was_measured_and_room(clients: int, measured: int) -> None:
    assert measured < hub_files(clients) < 2 * measured + zenoh_settings.SESSION_FILES
    assert launcher_files(clients + 1, clients) >= hub_files(clients)
    # a host of many agents: its world waits for all
    assert launcher_files(roles=3, names=clients) >= hub_files(clients)
