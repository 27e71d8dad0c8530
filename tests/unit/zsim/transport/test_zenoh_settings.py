"""The limit of open files: raised where allowed, otherwise refused with the required number."""

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
    """Return a function that replaces the limits of this process by fake ones and returns them (soft, hard)."""

    def install(soft: int, hard: int) -> list[int]:
        held = [soft, hard]
        monkeypatch.setattr(resource, "getrlimit", lambda which: tuple(held))
        monkeypatch.setattr(resource, "setrlimit", lambda which, both: held.__setitem__(slice(None), list(both)))
        return held

    return install


def test_the_soft_limit_is_raised_as_required_up_to_the_hard_one(limits: Limits) -> None:
    held = limits(16, 1024)
    require_files(100, "10 processes")
    assert held == [100, 1024]
    require_files(50, "5 processes")
    assert held == [100, 1024]
    with refused(SessionError, "1024", "2000", "200 processes", "`ulimit -n 2000`"):
        require_files(2000, "200 processes")


def test_an_optional_raise_goes_as_far_as_the_hard_limit(limits: Limits) -> None:
    held = limits(256, 512)
    assert allow_files(2000) == 512
    assert held == [512, 512]
    limits(resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    assert allow_files(10**6) is None


@pytest.mark.parametrize(("clients", "measured"), [(2, 26), (4, 31), (11, 48), (31, 92)])
def test_the_files_of_a_hub_are_the_measured_number_plus_a_margin(clients: int, measured: int) -> None:
    assert measured < hub_files(clients) < 2 * measured + zenoh_settings.SESSION_FILES
    assert launcher_files(clients + 1, clients) >= hub_files(clients)
    # a host of many agents, for all of which its world waits
    assert launcher_files(roles=3, names=clients) >= hub_files(clients)
