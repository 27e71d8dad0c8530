"""Fixtures for tests that start processes."""

import pytest
from chromium import browser
from console_browser import opened
from deployment import deployment, faketime, small_disk
from federation import compiled, federation, forked
from lab import lab
from near_worker import near

from zsim_api.pytest_plugin import Federations
from zsim_api.pytest_plugin import federation as users_federation  # the users'; the tests' own starts single commands

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
    """Return the plugin's fixture `federation`, with its `zsim` commands forked."""
    return users_federation
