"""Drones that cross a forest by their lidars: none touches a trunk, and the bits are the same however they are flown."""

from pathlib import Path

import numpy as np
import pytest

import zsim
from zsim.scenario import scenario_file
from zsim.scenario.obstacle import nearest, row_of
from zsim.vehicles.ardrone2 import VEHICLE

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(autouse=True)
def module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES))


def test_five_drones_fly_among_the_trunks_and_touch_none(tmp_path: Path, compiled: None) -> None:
    """Each hull keeps clear of every trunk and of every other hull; all have come a good way into the forest."""
    run = zsim.run(EXAMPLES / "forest.yaml", duration_s=22, out=tmp_path / "run", progress=False)
    rows = [row_of(each) for each in scenario_file.load(EXAMPLES / "forest.yaml").environment.obstacles]
    hull_m = VEHICLE.airframe.hull_radius_m
    tracks = []
    for drone in run.drones:
        truth = run.truth(drone)
        track = truth[["position_m_x", "position_m_y", "position_m_z"]].to_numpy()
        assert track[-1, 0] > 5.0
        least = min(nearest(row, *place)[0] for place in track[::10].tolist() for row in rows)
        assert hull_m < run.summary.obstacle_distance_m[drone] <= least
        tracks.append(track)
    for i, track in enumerate(tracks):
        for other in tracks[:i]:
            assert np.linalg.norm(track - other, axis=1).min() > 2.0 * hull_m
    assert run.events[run.events.kind == "collision"].empty


def test_as_processes_they_have_the_same_bits_though_a_pilot_is_killed(tmp_path: Path, compiled: None) -> None:
    alone = zsim.run(EXAMPLES / "forest.yaml", duration_s=9, out=tmp_path / "alone", progress=False)
    with zsim.Federation(EXAMPLES / "forest.yaml", duration=9, out=tmp_path / "many") as flight:
        flight.wait_until(6.0)
        flight.kill("pilot.drone3")
        run = flight.run()
    assert run.truth_sha256 == alone.truth_sha256
    assert "pilot.drone3" in [*run.events[run.events.kind == "restart"].subject]
    scans = [(each.messages("drone/drone3/sensor/lidar")).ranges_m.tolist() for each in (alone, run)]
    assert len(scans[0]) == 91
    assert scans[0] == scans[1]
