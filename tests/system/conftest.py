"""Fixtures of the tests that start processes."""

from deployment import deployment, faketime, small_disk
from federation import compiled, federation
from lab import lab

__all__ = ["compiled", "deployment", "faketime", "federation", "lab", "small_disk"]
