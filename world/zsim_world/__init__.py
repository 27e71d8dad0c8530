"""The world: vehicles, their firmware, sensors, wind and contacts, and the process that owns simulated time."""
