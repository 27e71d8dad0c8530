"""Fixtures of the tests that start processes."""

from federation import compiled, federation
from lab import lab
from team import faketime, small_disk, team

__all__ = ["compiled", "faketime", "federation", "lab", "small_disk", "team"]
