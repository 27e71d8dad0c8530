"""Compares formation laws: the same scenarios, seeds and sensors for all, one table, one page."""
