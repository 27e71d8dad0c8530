"""Fixtures of the tests that start processes."""

import pytest
from chromium import browser
from console_browser import opened
from deployment import deployment, faketime, small_disk
from federation import compiled, federation, forked
from lab import lab
from near_worker import near

from zsim_api.pytest_plugin import Federations
from zsim_api.pytest_plugin import federation as users_federation  # as users have it; ours starts single commands, too

__all__ = [
    "browser",
    "compiled",
    "deployment",
    "faketime",
    "federation",
    "forked",
    "lab",
    "near",
    "opened",
    "small_disk",
]
__all__ += ["users_federation"]


@pytest.fixture
def flights(users_federation: Federations, forked: None) -> Federations:
    """The fixture `federation` of the plugin; its `zsim` commands are forked."""
    return users_federation
