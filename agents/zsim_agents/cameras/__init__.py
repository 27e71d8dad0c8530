"""Cameras: pictures rendered from the truth, and hats found in pictures."""
