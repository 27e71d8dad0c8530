"""The greatest numbers that may be asked for on `world/control`."""

GATES_MAX = 1_000_000  # of one `step`: 5.5 hours at 20 ms
RATE_MAX = 1000.0  # simulated per wall second; beyond it nothing paces
PRIORITY_MAX = 100  # programs have 0, operators 10
