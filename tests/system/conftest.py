"""Fixtures of the tests that start processes."""

from chromium import browser
from deployment import deployment, faketime, small_disk
from federation import compiled, federation
from lab import lab

__all__ = ["browser", "compiled", "deployment", "faketime", "federation", "lab", "small_disk"]
