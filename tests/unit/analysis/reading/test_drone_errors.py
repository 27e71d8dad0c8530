"""Estimates, commands and references of drones against the truth: known errors match their closed form."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import synthetic_record
from synthetic_record import Flown

from zsim.contract import keys
from zsim.contract.flight_messages import Estimate, Reference, ReferencePhase, Status, Truth, Velocity
from zsim.schema.message import Vector3
from zsim_analysis.reading import drone_errors
from zsim_analysis.reading.drone_errors import (
    YAW,
    distances,
    estimate_errors,
    nees,
    reference_errors,
    separations,
    tracking_of,
    velocity_responses,
)
from zsim_analysis.reading.formation import formations_of, goal_errors
from zsim_analysis.reading.recorded_flight import FlightReader, RecordedFlight, read_flight
from zsim_analysis.reading.shortfall import shortfalls
from zsim_analysis.report.figure_style import TimeMarks
from zsim_analysis.report.flight_figures import draw_references

OFFSET_M, VELOCITY_M_S, YAW_RAD = (0.1, -0.25, 0.05), (0.02, 0.0, -0.01), 0.03
SIGMA_M, SIGMA_M_S, SIGMA_RAD = 0.1, 0.02, 0.01
COVARIANCE = tuple(np.diag([SIGMA_M**2] * 3 + [SIGMA_M_S**2] * 3).ravel().tolist())
NEES = (0.01 + 0.0625 + 0.0025) / SIGMA_M**2 + (0.0004 + 0.0001) / SIGMA_M_S**2
EVE = "eve"


def traffic(flown: Flown) -> Iterator[tuple[str, Any, int]]:
    """Yield a flight with constant estimate errors, flown by `controller.main`, while eve sends commands as well."""
    for key, message, wall_ns in synthetic_record.traffic(flown):
        if isinstance(message, Status):
            message = msgspec.structs.replace(message, commander="controller.main")
        yield key, message, wall_ns
        if isinstance(message, Truth):
            yield keys.estimate(keys.thing(key)), estimate_of(message), wall_ns
            for source, forward in (("controller.main", 0.3), (EVE, 5.0)):
                command = Velocity(message.t_ns, message.seq, source, (forward, 0.1, 0.2), 0.4)
                yield keys.command(keys.thing(key), "velocity"), command, wall_ns


def estimate_of(truth: Truth) -> Estimate:
    w, _, _, z = truth.orientation_wxyz
    yaw = 2 * math.atan2(z, w) + YAW_RAD
    position, velocity = moved(truth.position_m, OFFSET_M), moved(truth.velocity_m_s, VELOCITY_M_S)
    heading = math.remainder(yaw, 2 * math.pi)
    pose = (position, velocity, truth.orientation_wxyz, heading)
    return Estimate(truth.t_ns, truth.seq, *pose, COVARIANCE, SIGMA_RAD, (0.0, 0.0, 0.0), {})


def moved(vector: Vector3, by: Vector3) -> Vector3:
    return vector[0] + by[0], vector[1] + by[1], vector[2] + by[2]


@pytest.fixture(scope="module")
def flight() -> RecordedFlight:
    return synthetic_record.flight(traffic(Flown(duration_s=3.0)), answers=True)


def test_errors_of_estimates_and_their_stated_sigmas_are_found(flight: RecordedFlight) -> None:
    errors = estimate_errors(flight)
    assert list(errors) == ["drone1", "drone2", "drone3"]
    for each in errors.values():
        assert len(each.t_s) == 151
        assert each.error[:, :YAW] == pytest.approx(np.tile(OFFSET_M, (151, 1)), abs=1e-5)
        assert each.error[:, YAW] == pytest.approx(YAW_RAD, abs=1e-6)
        assert each.sigma[0] == pytest.approx([SIGMA_M] * 3 + [SIGMA_RAD], rel=1e-6)
        assert each.nees == pytest.approx(NEES, rel=1e-3)
        assert each.share_inside(np.ones(151, bool)).tolist() == [1.0, 0.0, 1.0, 0.0]


def test_too_many_estimates_are_thinned_to_the_same_instants(
    flight: RecordedFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = estimate_errors(flight)
    monkeypatch.setattr(drone_errors, "ESTIMATES_MAX", 200)  # fewer than the 3 x 151 of the flight
    some = estimate_errors(flight)
    for name, each in some.items():
        assert each.t_s == pytest.approx(whole[name].t_s[::3])
        assert each.error == pytest.approx(whole[name].error[::3])


def test_nees_of_consistent_errors_is_six_and_nan_if_singular() -> None:
    error = np.ones((3, 6))
    covariance = np.stack([np.eye(6), np.zeros((6, 6)), np.diag([1.0, 1, 1, 1, 1, -1])])
    assert nees(error, covariance)[0] == pytest.approx(6.0)
    assert np.isnan(nees(error, covariance)[1:]).all()
    rng = np.random.default_rng(5)
    root = rng.standard_normal((6, 6))
    error = rng.standard_normal((20_000, 6)) @ root.T
    assert nees(error, np.tile(root @ root.T, (20_000, 1, 1))).mean() == pytest.approx(6, abs=0.1)


def test_velocities_are_the_commander_s_in_the_heading_frame(flight: RecordedFlight) -> None:
    (first, *_) = velocity_responses(flight).values()
    assert first.commanded == pytest.approx(np.tile([0.3, 0.1, 0.2, 0.4], (len(first.t_s), 1)), abs=1e-6)
    yaw = flight.tracks[0].yaw[0]
    x, y, z = 0.1, 0.2, 0.3  # velocity of the synthetic truth
    flown = (x * math.cos(yaw) + y * math.sin(yaw), y * math.cos(yaw) - x * math.sin(yaw), z, 0.6)
    assert first.flown[0] == pytest.approx(flown, abs=1e-9)


def test_a_flight_read_from_a_record_equals_the_original(flight: RecordedFlight, tmp_path: Path) -> None:
    synthetic_record.record(tmp_path / "run.mcap", traffic(Flown(duration_s=3.0)))
    read = read_flight(tmp_path / "run.mcap", answers=True)
    assert np.array_equal(read.estimates["drone2"].p_W, flight.estimates["drone2"].p_W)
    assert np.array_equal(read.commands["drone2"].velocity, flight.commands["drone2"].velocity)
    assert read_flight(tmp_path / "run.mcap").estimates == read_flight(tmp_path / "run.mcap").commands == {}
    still = read_flight(tmp_path / "run.mcap", motion=False)
    assert still.last_ns == read.last_ns
    assert [(track.t_ns // 10**9).tolist() for track in still.tracks] == 3 * [[0, 1, 2, 3]]


def test_distances_match_the_paper_s_triangle(flight: RecordedFlight) -> None:
    apart = distances(flight, pairs_max=6)
    assert apart is not None
    base = 8 * math.sin(math.pi / 8)  # 2 p sin(beta / 2), p = q = 4 m
    assert apart.pairs == (("drone1", "drone2"), ("drone1", "drone3"), ("drone2", "drone3"))
    assert apart.between[0] == pytest.approx([4, 4, base])
    assert apart.nearest[-1] == pytest.approx([4, base, base])
    many = distances(flight, pairs_max=2)
    assert many is not None
    assert many.pairs == ()
    assert np.array_equal(many.nearest, apart.nearest)
    assert separations(flight) == (2.0, 1.5, pytest.approx(0.52))


def test_errors_from_the_goal_include_the_climb() -> None:
    flight = synthetic_record.flight(synthetic_record.traffic(Flown(duration_s=6.0, climb_s=4.0)))
    (formation,) = formations_of(flight)
    goal = goal_errors(formation, flight.scenario)
    assert goal is not None
    z = formation.column("z_c")
    assert goal.true[[0, 100, 200, 300], z] == pytest.approx([-15, -7.5, 0, 0], abs=1e-9)
    assert np.abs(formation.true_error[:, z]).max() < 1e-9
    assert flight.scenario is not None
    (cluster,) = flight.scenario.clusters
    plan = msgspec.structs.replace(cluster.plan, takeoff_s=1.0, target={"z_c": 15}, land_s=5.0)
    clusters = (msgspec.structs.replace(cluster, plan=plan),)
    some = goal_errors(formation, msgspec.structs.replace(flight.scenario, clusters=clusters))
    assert some is not None
    assert np.isnan(some.true[251:]).all()
    assert [formation.names[i] for i in np.flatnonzero(np.isfinite(some.true[0]))] == ["z_c"]


# References

Phases = dict[float, ReferencePhase]
SECONDS, GATES = 30, 10  # 30 s with ten gates per second


def referenced(off_m: float, off_s: tuple[float, float], phases: Phases) -> RecordedFlight:
    """Return a flight whose drone is `off_m` away from its reference, to the north-east, during `off_s`."""
    reader = FlightReader()
    for gate in range(SECONDS * GATES + 1):
        t_ns, t_s = gate * 10**9 // GATES, gate / GATES
        phase: ReferencePhase = next(each for from_s, each in reversed(phases.items()) if from_s <= t_s)
        share = off_m / 5.0 if off_s[0] <= t_s < off_s[1] else 0.0
        half = math.pi / 4 if share else 0.0  # the heading is off by a quarter turn, too
        attitude = math.cos(half), 0.0, 0.0, math.sin(half)
        truth = Truth(t_ns, gate, (t_s + 3 * share, 4 * share, 2), (1, 0, 0), attitude, (0, 0, 0), (0, 0, 0), (0,) * 4)
        reference = Reference(t_ns, gate, phase, (t_s, 0, 2), (1, 0, 0), math.tau, 0, None, "reference.d1")
        state = "landed" if phase == "waiting" else "flying"
        for key, message in ((keys.truth("d1"), truth), (keys.reference("d1"), reference), (keys.status("d1"), Status(t_ns, gate, state, 90, False, None, 1))):  # fmt: skip
            reader.add_message(key, message, gate)
    return reader.flight()


PHASES: Phases = {0: "waiting", 2: "approaching", 5: "path", 20: "holding", 28: "over"}


def test_errors_cover_the_time_in_flight_and_separately_the_path() -> None:
    flown = referenced(1.0, (10, 15), PHASES)
    errors = reference_errors(flown)["d1"]
    assert (errors.t_s[0], errors.t_s[-1]) == (2.0, 27.9)
    tracking = tracking_of(errors, (0, 30))
    assert tracking.true_max_m == pytest.approx(1.0)
    assert tracking.true_rms_m == pytest.approx(math.sqrt(50 / 260))
    assert tracking.path_rms_m == pytest.approx(math.sqrt(50 / 150))
    assert tracking.yaw_rms_rad == pytest.approx(math.pi / 2 * math.sqrt(50 / 260))
    assert tracking_of(errors, (29, 30)) == (type(tracking))(None, None, None, None)
    assert not [line for line in shortfalls(flown, (0, 30)) if line.kind != "record"]
    drawn = draw_references({"d1": errors}, {"d1": "#000000"}, TimeMarks())
    assert [len(axes.lines) for axes in drawn.axes] == [3, 3, 3, 3]


@pytest.mark.parametrize(
    ("off_m", "off_s", "strayed"), [(6, (10, 15), True), (6, (10, 11.5), False), (4, (10, 20), False)]
)
def test_a_drone_far_from_its_reference_for_long_has_strayed(
    off_m: float, off_s: tuple[float, float], strayed: bool
) -> None:
    lines = [line for line in shortfalls(referenced(off_m, off_s, PHASES), (0, 30)) if line.kind == "strayed"]
    assert [(line.subject, line.t_s, line.fails) for line in lines] == [("d1", 10.0, True)] * strayed


def test_a_drone_that_never_takes_off_falls_short_of_its_plan() -> None:
    (line,) = [line for line in shortfalls(referenced(0, (0, 0), {0: "waiting"}), (0, 30)) if line.kind == "reference"]
    assert (line.subject, line.fails) == ("d1", True)
    assert np.isclose(line.t_s, 0.0)
