"""Pairs land and rest on the roof of a box and on a hill in a height map; a drone that lands on an edge tips over."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from operated_flight import OperatedFlight

import zsim
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario_file import resolve
from zsim.schema import plugin
from zsim.vehicles.ardrone2 import VEHICLE

ROOF_M, LAND_S = 1.0, 60.0
TOP_M, SLOPE, LANDED_S = 1.0, 0.12, 80
STAND_M = VEHICLE.airframe.foot_depth_m - VEHICLE.airframe.foot_sag_m


def pair(west_m: float, east_m: float, **sonar: float) -> OperatedFlight:
    """Return a flight to a box between two x coordinates, with these sonar settings."""
    size, place = [east_m - west_m, 6, ROOF_M], [0.5 * (west_m + east_m), 0, 0]
    plan = {"takeoff_s": 5, "target": {"x_c": 8, "y_c": 0, "z_c": 4, "p": 4}, "land_s": LAND_S}
    drones = [{"name": "drone1", "position_m": [2, 0, 0]}, {"name": "drone2", "position_m": [-2, 0, 0]}]
    document: dict[str, Any] = {
        "name": "roof",
        "duration_s": 200,
        "sensors": {"preset": "paper", "sonar": sonar},
        "environment": {"obstacles": [{"name": "box", "shape": "box", "position_m": place, "size_m": size}]},
        "drones": drones,
        "clusters": [{"name": "main", "drones": ["drone1", "drone2"], "plan": plan}],
    }
    return OperatedFlight(resolve(document))


def tilts_deg(flight: OperatedFlight) -> Any:
    q = flight.world.fleet.truth().orientation_wxyz
    return np.degrees(np.arccos(np.clip(1.0 - 2.0 * (q[:, 1] ** 2 + q[:, 2] ** 2), -1.0, 1.0)))


def rest(flight: OperatedFlight) -> None:
    """Check that both drones rest on the roof."""
    truth = flight.world.fleet.truth()
    assert np.degrees(np.linalg.norm(truth.angular_velocity_rad_s, axis=1)).max() < 1.0
    assert np.linalg.norm(truth.velocity_m_s, axis=1).max() < 1e-3
    assert tilts_deg(flight).max() < 1.0
    np.testing.assert_allclose(truth.position_m[:, 2], ROOF_M + STAND_M, atol=1e-3)


@pytest.mark.slow
def test_a_pair_lands_on_a_roof_rests_and_takes_off_again() -> None:
    """Expected: as on the ground, no collision is reported; the second take-off ends at its height above the roof."""
    flight = pair(5.0, 11.0)
    flight.until(lambda: flight.t_s > LAND_S and set(flight.states.values()) == {"landed"})
    flight.fly(2.0)
    rest(flight)
    for name in ("drone1", "drone2"):
        flight.mode(name, "takeoff")
    heights = [flight.places_m[name][2] for name in ("drone1", "drone2")]
    np.testing.assert_allclose(heights, ROOF_M + VEHICLE.takeoff_height_m, atol=0.2)
    for name in ("drone1", "drone2"):
        flight.mode(name, "land")
    flight.fly(2.0)
    rest(flight)
    assert flight.collisions == []


@pytest.mark.slow
def test_a_drone_that_lands_half_over_the_edge_tips_over() -> None:
    """The edge is 3 cm short of where drone1 comes down, as found by a flight to the whole roof.

    The sonars are off, since they would see the edge on the way down and so change where drone1 lands.
    """
    whole = pair(5.0, 11.0, dropout=1.0)
    whole.until(lambda: whole.t_s > LAND_S and set(whole.states.values()) == {"landed"})
    x_m = whole.places_m["drone1"][0]
    flight, tilt = pair(5.0, x_m - 0.03, dropout=1.0), 0.0
    flight.until(lambda: flight.t_s > LAND_S)
    for _ in range(120):
        flight.fly(0.1)
        tilt = max(tilt, float(tilts_deg(flight)[0]))
    assert tilt > 30.0
    assert flight.places_m["drone1"][2] < 0.3
    assert math.isclose(flight.places_m["drone2"][2], ROOF_M + STAND_M, abs_tol=1e-3)


def test_a_drone_that_starts_on_a_roof_knows_its_height(tmp_path: Path) -> None:
    """The sonar, which alone gives the first heights, measures above the roof."""
    roof = {"name": "roof", "shape": "box", "position_m": [0, 0, 0], "size_m": [4, 4, 3]}
    drone = {"name": "d1", "position_m": [0, 0, 3], "reference": {"takeoff_s": 0.5}}
    document = {"name": "roof", "duration_s": 6, "environment": {"obstacles": [roof]}, "drones": [drone]}
    run = zsim.run(zsim.Scenario(**document), out=tmp_path / "run", progress=False)
    error_m = run.estimate("d1").position_m_z - run.truth("d1").position_m_z
    assert error_m.abs().max() < 0.1
    assert run.truth("d1").position_m_z.iloc[-1] == pytest.approx(4.0, abs=0.1)


def height_m(x_m: float) -> float:
    """Return the height of the hill: 1 m up to x = 9 m, then falling by 12 cm per metre."""
    return float(np.clip(TOP_M - SLOPE * (x_m - 9.0), 0.0, TOP_M))


@pytest.fixture
def hill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the document of a flight to a height map that spans x = 4 to 14 m in cells of 1 m."""
    rows = [",".join(f"{height_m(x):g}" for x in range(4, 15))] * 9
    (tmp_path / "hill.csv").write_text("\n".join(rows))
    monkeypatch.setenv(plugin.FOLDERS, "")
    plugin.search(tmp_path)
    surface = {"name": "hill", "file": "hill.csv", "cell_m": 1, "position_m": [9, 0, 0]}
    plan = {"takeoff_s": 3, "target": {"x_c": 9, "y_c": 0, "z_c": 4, "p": 4}, "land_s": 50}
    drones = [{"name": f"drone{k + 1}", "position_m": [x, 0, 0]} for k, x in enumerate((2, -2))]
    return {
        "name": "hill",
        "duration_s": LANDED_S,
        "environment": {"surfaces": [surface]},
        "drones": drones,
        "clusters": [{"name": "main", "drones": ["drone1", "drone2"], "plan": plan}],
    }


@pytest.mark.soak
def test_a_pair_lands_on_a_hill_and_rests_there(hill: dict[str, Any], tmp_path: Path, forked: None) -> None:
    """Expected: both rest on the hill to millimetres, at its slope, and no collision is reported; processes give
    the same bits, although the world is killed during the descent."""
    path = tmp_path / "hill.yaml"  # beside the height map
    path.write_text(json.dumps(hill))
    run = zsim.run(path, out=tmp_path / "alone", progress=False)
    truths = [run.truth(drone) for drone in run.drones]
    for truth in truths:
        end = truth.iloc[-1]
        x_m, slope = end.position_m_x, SLOPE if end.position_m_x > 9.2 else 0.0
        assert end.position_m_z == pytest.approx(height_m(x_m) + STAND_M * np.hypot(1.0, slope), abs=2e-3)
        assert np.linalg.norm(end[["velocity_m_s_x", "velocity_m_s_y", "velocity_m_s_z"]].astype(float)) < 1e-3
        tilt = 2.0 * np.arcsin(np.hypot(end.orientation_x, end.orientation_y))
        assert tilt == pytest.approx(np.arctan(slope), abs=0.02)
    assert max(truth.position_m_x.iloc[-1] for truth in truths) > 9.5
    assert run.events[run.events.kind == "collision"].empty
    assert all(0.03 < away_m < 0.07 for away_m in run.summary.obstacle_distance_m.values())
    with zsim.Federation(path, out=tmp_path / "many") as flight:
        flight.wait_until(60.0)
        flight.kill("world")
        assert flight.run().truth_sha256 == run.truth_sha256


@pytest.mark.parametrize(
    ("place", "is_sound"),
    [((5.0, 0.0, 1.0), True), ((11.0, 0.0, 0.76), True), ((5.0, 0.0, 0.9), False), ((14.2, 0.0, 0.4), False)],
    ids=["on the top", "on the slope", "below the top", "beside its rim"],
)
def test_a_drone_may_start_on_a_surface_but_not_inside_it(hill: dict[str, Any], place: Any, is_sound: bool) -> None:
    document = {**hill, "clusters": []}
    document["drones"] = [{"name": "drone1", "position_m": [*place]}]
    if is_sound:
        scenario_file.resolve(document)
        return
    with pytest.raises(ScenarioError) as refused:
        scenario_file.resolve(document)
    assert [fault.split(" ")[1] for fault in refused.value.faults] == ["drones[0].position_m"]


def test_a_surface_must_have_a_unique_name(hill: dict[str, Any]) -> None:
    for name in ("drone1", "post"):
        document = {**hill}
        post = {"name": "post", "shape": "sphere", "position_m": [0, 30, 9], "radius_m": 1}
        surface = {**document["environment"]["surfaces"][0], "name": name}
        document["environment"] = {"obstacles": [post], "surfaces": [surface]}
        with pytest.raises(ScenarioError) as refused:
            scenario_file.resolve(document)
        assert [fault.split(" ")[1] for fault in refused.value.faults] == ["environment.surfaces[0].name"]
