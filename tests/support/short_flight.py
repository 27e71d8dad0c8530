"""A drone that stands for half a second, and a fleet whose state does not stay finite."""

import pytest

from zsim_world.fleet.fleet import DivergedError, Fleet

GATE_NS = 20_000_000
DIVERGED_NS = 5 * GATE_NS  # simulated time at which a diverging fleet ends
ONE = """
name: one
seed: 3
duration_s: 0.5
drones: [{name: d1, position_m: [0, 0, 0]}]
processes: {expect: []}
"""


def diverge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every fleet diverge with drone d1, 0.12 s after its start."""
    advance = Fleet.advance

    def advance_or_diverge(fleet: Fleet) -> None:
        if fleet.t_ns == DIVERGED_NS:
            raise DivergedError("d1", 0.12)
        advance(fleet)

    monkeypatch.setattr(Fleet, "advance", advance_or_diverge)
