"""Sensors of a fleet: measurement equations, error models, schedules, latency. Imports physics."""
