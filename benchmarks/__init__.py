"""Comparisons with other simulators: each row is a ratio within one run; contenders do the same work, in turn."""
