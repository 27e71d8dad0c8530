"""A scenario of two drones that take off at once and hold their positions, for tests of the Python interface."""

from typing import Any

PAIR: dict[str, Any] = {
    "name": "pair",
    "seed": 3,
    "duration_s": 6,
    "sensors": {"preset": "paper"},
    "drones": [{"name": "d1", "position_m": [0, 3, 0]}, {"name": "d2", "position_m": [0, -3, 0]}],
    "clusters": [{"name": "main", "drones": ["d1", "d2"], "plan": {"takeoff_s": 0.1}}],
}
