"""Fixtures of the tests that start processes."""

from chromium import browser
from console_browser import opened
from deployment import deployment, faketime, small_disk
from federation import compiled, federation
from lab import lab

from zsim_api.pytest_plugin import federation as flights  # as users have it; ours starts single commands, too

__all__ = ["browser", "compiled", "deployment", "faketime", "federation", "flights", "lab", "opened", "small_disk"]
