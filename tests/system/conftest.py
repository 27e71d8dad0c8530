"""Fixtures of the tests that start processes."""

from chromium import browser
from console_browser import opened
from deployment import deployment, faketime, small_disk
from federation import compiled, federation
from lab import lab

__all__ = ["browser", "compiled", "deployment", "faketime", "federation", "lab", "opened", "small_disk"]
