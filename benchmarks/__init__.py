"""Comparisons with other simulators, which take turns at the same work; each row is a ratio within one run."""
