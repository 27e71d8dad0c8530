"""Cameras: rendering of pictures from the drones' true states, and detection of the drones' hats in pictures."""
