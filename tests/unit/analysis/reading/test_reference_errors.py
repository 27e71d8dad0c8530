"""Errors against the references of single drones, and the shortfalls that follow, of known flights."""

import math

import numpy as np
import pytest

from zsim.contract import keys
from zsim.contract.flight_messages import Reference, ReferencePhase, Status, Truth
from zsim_analysis.reading.drone_errors import reference_errors, tracking_of
from zsim_analysis.reading.recorded_flight import FlightReader, RecordedFlight
from zsim_analysis.reading.shortfall import shortfalls
from zsim_analysis.report.figure_style import TimeMarks
from zsim_analysis.report.flight_figures import draw_references

Phases = dict[float, ReferencePhase]
SECONDS, GATES = 30, 10  # ten gates a second


def flight(off_m: float, off_s: tuple[float, float], phases: Phases) -> RecordedFlight:
    """Return a flight whose drone is 3 m east and 4 m north times a share of its reference, for some time."""
    reader = FlightReader()
    for gate in range(SECONDS * GATES + 1):
        t_ns, t_s = gate * 10**9 // GATES, gate / GATES
        phase: ReferencePhase = next(each for from_s, each in reversed(phases.items()) if from_s <= t_s)
        share = off_m / 5.0 if off_s[0] <= t_s < off_s[1] else 0.0
        half = math.pi / 4 if share else 0.0  # a quarter turn off in heading, too
        attitude = math.cos(half), 0.0, 0.0, math.sin(half)
        truth = Truth(t_ns, gate, (t_s + 3 * share, 4 * share, 2), (1, 0, 0), attitude, (0, 0, 0), (0, 0, 0), (0,) * 4)
        reference = Reference(t_ns, gate, phase, (t_s, 0, 2), (1, 0, 0), math.tau, 0, None, "reference.d1")
        state = "landed" if phase == "waiting" else "flying"
        for key, message in ((keys.truth("d1"), truth), (keys.reference("d1"), reference), (keys.status("d1"), Status(t_ns, gate, state, 90, False, None, 1))):  # fmt: skip
            reader.add_message(key, message, gate)
    return reader.flight()


PHASES: Phases = {0: "waiting", 2: "approaching", 5: "path", 20: "holding", 28: "over"}


def test_errors_are_those_in_the_air_and_of_the_path_apart() -> None:
    flown = flight(1.0, (10, 15), PHASES)
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
def test_a_drone_that_is_far_from_its_reference_for_long_has_strayed(
    off_m: float, off_s: tuple[float, float], strayed: bool
) -> None:
    lines = [line for line in shortfalls(flight(off_m, off_s, PHASES), (0, 30)) if line.kind == "strayed"]
    assert [(line.subject, line.t_s, line.fails) for line in lines] == [("d1", 10.0, True)] * strayed


def test_a_drone_that_never_takes_off_has_not_flown_as_planned() -> None:
    (line,) = [line for line in shortfalls(flight(0, (0, 0), {0: "waiting"}), (0, 30)) if line.kind == "reference"]
    assert (line.subject, line.fails) == ("d1", True)
    assert np.isclose(line.t_s, 0.0)
