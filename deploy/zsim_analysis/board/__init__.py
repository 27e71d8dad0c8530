"""Compares formation laws in the same scenarios with the same seeds and sensors, in one table and on one page."""
