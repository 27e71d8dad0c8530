"""Fixtures of the tests that start processes."""

from federation import compiled, federation
from lab import lab

__all__ = ["compiled", "federation", "lab"]
