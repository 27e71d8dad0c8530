"""Comparisons with other simulators that take turns at the same work; each row is a ratio within one run."""
