"""Flights along references: fitted to the drone's limits or refused with the factor; distances to other drones."""

import math
from typing import Any

import numpy as np
import pytest
from refused import has_terms

from zsim.errors import RunError, ScenarioError
from zsim.scenario import scenario_file
from zsim_agents.formation.engagement_setup import planned_motion
from zsim_agents.hosting import check_plans
from zsim_agents.references.flight import SHARE, FlightError, checked_flight, exchange_flights, flight_of, limits_of
from zsim_agents.references.path import peaks_of
from zsim_agents.references.pilot import DroneRequestError, Goto, read_request, requested_flight

FAST = [{"at_s": 0, "position_m": [0, 0, 2]}, {"at_s": 2, "position_m": [20, 0, 2]}]
SLOW = [{"at_s": 0, "position_m": [0, 0, 2]}, {"at_s": 30, "position_m": [20, 0, 2], "yaw_deg": 90}]


def scenario_of(*references: Any, **more: Any) -> Any:
    drones = [
        {"name": f"d{k + 1}", "position_m": [0, 3 * k, 0]} | ({"reference": each} if each else {})
        for k, each in enumerate(references)
    ]
    return scenario_file.resolve({"name": "s", "duration_s": 90, "drones": drones, **more})


def refusal(scenario: Any) -> str:
    with pytest.raises(ScenarioError) as raised:
        check_plans(scenario, "s.yaml")
    return str(raised.value)


@pytest.mark.parametrize(
    ("path", "factor"),
    [
        # from rest to rest the peak speed is 2.1875 d / T; 0.8 of 5 m/s is allowed
        ({"minimum_snap": FAST}, 2.1875 * 20 / 2 / (SHARE * 5.0)),
        ({"waypoints": FAST}, 1.5 * 20 / 2 / (SHARE * 5.0)),  # that of a cubic is 1.5 d / T
        ({"pieces": [{"duration_s": 2, "z": [2, 4]}]}, 4 / (SHARE * 1.0)),
        ({"pieces": [{"duration_s": 2, "z": [2], "yaw": [0, 7]}]}, 7 / (SHARE * math.radians(200))),
        # accelerations fall with the square of time; 0.8 g tan(20 deg) is allowed
        ({"expressions": {"x": "2*t*t", "z": 2}, "duration_s": 0.5}, math.sqrt(4 / (SHARE * 9.80665 * math.tan(math.radians(20))))),
        ({"circle": {"radius_m": 10, "period_s": 10}, "origin_m": [0, 0, 2]}, 2 * math.pi / (SHARE * 5.0)),
    ],
)  # fmt: skip
def test_a_path_that_is_too_fast_is_refused_with_the_factor_or_fitted(path: dict[str, Any], factor: float) -> None:
    assert factor > 1.0
    text = refusal(scenario_of({**path, "start_s": 40}))
    assert has_terms(text, "drones[0].reference", "(drone 'd1')")
    named = float(text.partition("by a factor of ")[2].split()[0])
    assert named == pytest.approx(factor, rel=2e-3)
    fitted = scenario_of({**path, "start_s": 40, "fit": True})
    flown = flight_of(fitted, "d1").legs[-1].path
    limits = limits_of(fitted.drones[0], 9.80665).share(SHARE)
    assert peaks_of(flown).factor(limits) == pytest.approx(1.0, abs=2e-3)
    check_plans(scenario_of({**path, "start_s": 40, "time_scale": named}), "s.yaml")


def test_the_approach_to_a_path_ends_with_its_motion() -> None:
    moving = {"expressions": {"x": "3 + cos(0.5*t)", "y": "sin(0.5*t)", "z": 2, "yaw_deg": "45 + 6*t"}, "start_s": 20}
    flight = flight_of(scenario_of(moving), "d1")
    before, after = flight.value(20 - 1e-9), flight.value(20.0)
    assert before[0][:3] == pytest.approx(after[0][:3], abs=1e-6)
    assert math.remainder(before[0][3] - after[0][3], math.tau) == pytest.approx(0.0, abs=1e-6)
    assert before[1] == pytest.approx([0, 0.5, 0, math.radians(6)], abs=1e-6)
    assert flight.value(0.0)[0] == pytest.approx([0, 0, 1, 0])  # above its start, at the take-off height


@pytest.mark.parametrize(
    ("references", "terms"),
    [
        ([{"minimum_snap": SLOW, "start_s": 3}], ("drones[0].reference.start_s", "3", "(drone 'd1')")),
        ([{"minimum_snap": SLOW, "start_s": 30, "origin_m": [0, 0, -3]}], ("drones[0].reference", "-1.00", "0.2")),
        ([{"minimum_snap": SLOW, "start_s": 90, "origin_m": [0, 0, 99]}], ("drones[0].reference", "101.00", "100")),
        ([{"expressions": {"x": "sqrt(3 - t)", "z": 2}, "start_s": 30}], ("drones[0].reference.expressions.x", "3…")),
        ([{"expressions": {"q": 1}, "start_s": 30}], ("'q'", "x", "y", "z", "yaw", "yaw_deg")),
        ([{"minimum_snap": SLOW, "start_s": 30}] * 2, ("drones", "d1", "d2", "0.6")),
    ],
)
def test_flights_that_cannot_be_flown_are_refused_with_the_field(references: list[Any], terms: tuple[str, ...]) -> None:
    scenario = scenario_of(*references)
    assert has_terms(refusal(scenario), *terms), refusal(scenario)
    with pytest.raises(RunError):
        checked_flight(scenario, "d1")


def test_places_are_assigned_and_reached_simultaneously() -> None:
    """Four drones in a row get places listed in another order: no paths cross, and all arrive together."""
    places = [[20, 3 * k, 2] for k in (3, 1, 0, 2)]
    stages = [{"start_s": 10, "over_s": 14, "places_m": places}]
    exchange = {"drones": ["d1", "d2", "d3", "d4"], "stages": stages}
    scenario = scenario_of(*[None] * 4, exchanges=[exchange])
    check_plans(scenario, "s.yaml")
    flights = exchange_flights(scenario, scenario.exchanges[0])
    for k, flight in enumerate(flights.values()):
        assert flight.value(24.0)[0][:3] == pytest.approx([20, 3 * k, 2], abs=1e-9)
        assert flight.value(17.0)[0][0] == pytest.approx(10.0, abs=1e-9)


def test_a_stage_that_is_too_fast_is_refused_with_a_time_or_fitted() -> None:
    stages = [{"start_s": 10, "over_s": 2, "places_m": [[20, 0, 1], [20, 3, 1]]}]
    exchange = {"drones": ["d1", "d2"], "stages": stages}
    least_s = 2.1875 * 20 / (SHARE * 5.0)
    text = refusal(scenario_of(None, None, exchanges=[exchange]))
    assert has_terms(text, "exchanges[0].stages[0].over_s", "2", f"{least_s:.3f}…"[:5] + "…"), text
    fitted = scenario_of(None, None, exchanges=[{**exchange, "fit": True}])
    flight = exchange_flights(fitted, fitted.exchanges[0])["d1"]
    assert flight.duration_s == pytest.approx(10 + least_s, abs=2e-3)


@pytest.mark.parametrize(
    ("op", "args", "terms"),
    [
        ("jump", {}, ("goto", "follow")),
        ("hold", {"for_s": 3}, ("for_s",)),
        ("goto", {}, ("position_m", "missing", "places_m")),
        ("goto", {"position_m": [1, 2, 3], "places_m": [[1, 2, 3]]}, ("position_m", "places_m")),
        ("goto", {"position_m": [1, 2, 3], "speed_m_s": 0}, ("speed_m_s", "0")),
        ("goto", {"places_m": [[1, 2, 3]], "radius_m": -1}, ("radius_m", "-1", "0")),
        ("goto", {"places_m": [[1, 2, 3]], "over_s": 5}, ("over_s", "5", "places_m")),
        ("goto", {"position_m": [1, 2, 3], "over_s": 5, "speed_m_s": 1}, ("over_s", "5", "speed_m_s")),
        ("goto", {"position_m": [1, 2]}, ("position_m", "[1, 2]", "3")),
        ("goto", {"position_m": [1, 2, 3], "over_s": -1}, ("over_s", "-1", "0")),
        ("follow", {}, ("none", "minimum_snap")),
        ("follow", {"minimum_snap": SLOW, "waypoints": SLOW}, ("waypoints", "minimum_snap")),
        ("follow", {"circle": {"radius_m": -1, "period_s": 3}}, ("circle.radius_m", "-1", "0")),
        ("follow", {"minimum_snap": SLOW, "file": "way.csv"}, ("file", "way.csv", "pieces")),
        ("follow", {"minimum_snap": SLOW, "start_s": 3}, ("start_s", "3", "time_scale")),
        ("follow", {"minimum_snap": SLOW, "takeoff_s": 0, "land_s": 40}, ("takeoff_s", "0", "land_s", "40", "fit")),
        ("follow", {"minimum_snap": SLOW, "gain_1_s": 1.5}, ("gain_1_s", "1.5", "origin_m")),
        ("follow", {"minimum_snap": SLOW, "duration_s": 9}, ("duration_s", "9", "expressions")),
    ],
)
def test_invalid_requests_are_refused_with_the_field(op: str, args: dict[str, Any], terms: tuple[str, ...]) -> None:
    with pytest.raises(DroneRequestError) as raised:
        read_request(op, args)
    assert all(term in str(raised.value) for term in terms), raised.value
    assert isinstance(read_request("goto", {"position_m": [1, 2, 3]}), Goto)


@pytest.mark.parametrize("times", [(0,), (1, 1), (2, 1), (0, 3, 3)])
@pytest.mark.parametrize("kind", ["minimum_snap", "waypoints"])
def test_a_request_for_points_without_rising_times_is_refused(kind: str, times: tuple[float, ...]) -> None:
    """In a scenario, the file is checked; requests during a flight are checked here."""
    drone = scenario_of(None).drones[0]
    points = [{"at_s": at_s, "position_m": [k, 0, 2]} for k, at_s in enumerate(times)]
    asked = read_request("follow", {kind: points, "fit": True})
    if (kind, len(times)) == ("waypoints", 1):
        return  # a fixed place is allowed
    with pytest.raises(FlightError) as raised:
        requested_flight(asked, 5.0, np.array([0.0, 0, 2, 0]), np.zeros(4), drone, limits_of(drone, 9.81))
    assert raised.value.path == kind


def test_flights_depend_only_on_time_and_have_exact_rates() -> None:
    flight = flight_of(scenario_of({"minimum_snap": SLOW, "start_s": 20}), "d1")
    for t in np.linspace(0, 60, 50).tolist():
        (place, rate), slope = flight.value(t), (flight.value(t + 1e-5)[0] - flight.value(t - 1e-5)[0]) / 2e-5
        assert flight.value(t)[0].tolist() == place.tolist()
        assert rate == pytest.approx(slope, abs=1e-5)


# Formations whose plans conflict with the references of other drones, if this is known before the flight

TRIANGLE = [{"name": f"d{k}", "position_m": place} for k, place in enumerate([[0, 2, 0], [0, -2, 0], [4, 0, 0]])]
CIRCLE = {"start_s": 40, "expressions": {"x_c": "10*cos(t/20)", "y_c": "10*sin(t/20)", "z_c": "3", "yaw": "0"}}
SHAPE = {"p": 4, "q": 4, "beta": 1.0}


def with_formation(plan: dict[str, Any], **reference: Any) -> Any:
    alone = {"name": "alone", "position_m": [30, 0, 0], "reference": reference}
    cluster = {"name": "main", "drones": ["d0", "d1", "d2"], "plan": {"takeoff_s": 1, **plan}}
    document = {"name": "t", "duration_s": 120, "drones": [*TRIANGLE, alone], "clusters": [cluster]}
    return scenario_file.resolve(document)


def hold(place: list[float], at_s: float = 0.0, **reference: Any) -> dict[str, Any]:
    return {
        "start_s": 20,
        "minimum_snap": [{"at_s": at_s, "position_m": [30, 0, 3]}, {"at_s": at_s + 30, "position_m": place}],
        **reference,
    }


@pytest.mark.parametrize(
    ("plan", "reference", "path"),
    [
        # there is no robot at the centre of the formation
        ({"target": {"x_c": 12, "y_c": 0, "z_c": 3, "yaw": 0, **SHAPE}}, hold([12, 0, 3]), None),
        ({"target": {"x_c": 12, "y_c": 0, "z_c": 3, "yaw": 0, **SHAPE}}, hold([12, 0, 9]), None),
        ({"trajectory": CIRCLE, "target": SHAPE}, hold([0, 10, 3]), "clusters[0].plan.trajectory"),
        ({"trajectory": CIRCLE, "target": SHAPE}, hold([0, 10, 3], land_s=60), None),
        ({"trajectory": CIRCLE, "target": SHAPE, "land_s": 60}, hold([0, 10, 3]), None),
        ({"trajectory": CIRCLE, "target": SHAPE}, hold([0, 30, 3]), None),
    ],
)
def test_a_plan_is_compared_with_references_if_both_are_known(plan: Any, reference: Any, path: str | None) -> None:
    made = with_formation(plan, **reference)
    if path is None:
        check_plans(made, "t.yaml")
        return
    with pytest.raises(ScenarioError) as refused:
        check_plans(made, "t.yaml")
    (line,) = refused.value.faults
    assert line.split(" ")[1] == path
    assert "alone" in line


def test_a_reference_to_the_place_of_a_formation_s_robot_is_refused() -> None:
    plan = {"target": {"x_c": 12, "y_c": 0, "z_c": 3, "yaw": 0, **SHAPE}}
    free = with_formation(plan, **hold([12, 0, 9]))
    planned = planned_motion(free, free.clusters[0])
    assert planned is not None
    assert 4 < planned.from_s < 40
    for robot, place in enumerate(planned.positions(100.0).tolist()):
        with pytest.raises(ScenarioError) as refused:
            check_plans(with_formation(plan, **hold(place)), "t.yaml")
        assert has_terms(str(refused.value), "clusters[0].plan.target", "robot", str(robot + 1), "alone")
