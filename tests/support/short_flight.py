"""A scenario of a drone that stands on the ground for half a second, and a fleet whose state diverges."""

import pytest

from zsim_world.fleet.fleet import DivergedError, Fleet

GATE_NS = 20_000_000
DIVERGED_NS = 5 * GATE_NS  # simulated time at which the fleet diverges
ONE = """
name: one
seed: 3
duration_s: 0.5
drones: [{name: d1, position_m: [0, 0, 0]}]
processes: {expect: []}
"""


def diverge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every fleet report after 0.1 s that drone d1 diverged at 0.12 s."""
    advance = Fleet.advance

    def advance_or_diverge(fleet: Fleet) -> None:
        if fleet.t_ns == DIVERGED_NS:
            raise DivergedError("d1", 0.12)
        advance(fleet)

    monkeypatch.setattr(Fleet, "advance", advance_or_diverge)
