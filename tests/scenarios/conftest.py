"""Fixtures of the tests that start processes."""

from federation import compiled, federation

__all__ = ["compiled", "federation"]
