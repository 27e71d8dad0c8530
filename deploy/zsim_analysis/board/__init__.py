"""Compares formation laws in the same scenarios with the same seeds and sensors, in tables and on one page."""
