"""Fixtures of the tests of zsim in Python."""

from near_worker import near

__all__ = ["near"]
