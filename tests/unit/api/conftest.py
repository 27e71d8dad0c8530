"""Fixtures for the tests of zsim's Python interface."""

from near_worker import near

__all__ = ["near"]
