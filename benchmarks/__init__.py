"""Measurements against others: every row is a ratio within one run, on the same work, the contenders in turn."""
