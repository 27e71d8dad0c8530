"""Drones' paths and goals against closed forms, published numbers and an independent optimisation."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from zsim.scenario.scenario_file import pieces_of
from zsim_agents.formation.assembly import assign, straight_separation
from zsim_agents.references.cruise import RISE_S, Cruise, cruise, cruise_through
from zsim_agents.references.flight import first_approach
from zsim_agents.references.path import (
    EndMotion,
    Laps,
    PathLimits,
    PiecewisePolynomial,
    figure_eight,
    minimum_snap,
    move,
    peaks_of,
)

EXAMPLES = Path(__file__).parents[2] / "examples" / "trajectories"
AXES = ("x", "y", "z", "yaw")


def path_of(file: Path) -> PiecewisePolynomial:
    pieces = pieces_of(file, "file")
    coefficients = np.array([[piece[axis] for axis in AXES] for piece in pieces]).transpose(0, 2, 1)
    return PiecewisePolynomial(np.array([piece["duration_s"] for piece in pieces]), coefficients)


def test_a_rest_to_rest_path_has_the_closed_form() -> None:
    """35 t^4 - 84 t^5 + 70 t^6 - 20 t^7, whose speed peaks at 2.1875 and acceleration at 84 sqrt(5) / 25 = 7.5132."""
    path = minimum_snap((0.0, 1.0), np.array([[0.0] * 4, [1.0] * 4]))
    for column in path.coefficients[0].T.tolist():
        assert column == pytest.approx([0, 0, 0, 0, 35, -84, 70, -20], abs=1e-6)
    one = minimum_snap((0.0, 1.0), np.array([[0.0] * 4, [1.0, 0.0, 0.0, 0.0]])).peaks()
    assert (one.speed_m_s, one.accel_m_s2) == pytest.approx((2.1875, 84 * math.sqrt(5) / 25), abs=1e-6)
    assert one.at_s[0] == pytest.approx(0.5, abs=1e-6)


def test_minimum_snap_solves_the_quadratic_programme() -> None:
    """Mellinger and Kumar's equality-constrained programme is solved in monomials through its Lagrangian."""
    times, places = np.array([0.0, 1.0, 1.8, 3.5, 4.0]), np.array([0.0, 2.0, 1.0, -1.0, 0.5])
    spans, m = np.diff(times), len(times) - 1
    cost, rows, right = np.zeros((8 * m, 8 * m)), [], []

    def row(piece: int, derivative: int, t: float) -> np.ndarray:
        line = np.zeros(8 * m)
        for k in range(derivative, 8):
            line[8 * piece + k] = math.perm(k, derivative) * t ** (k - derivative)
        return line

    for piece, span in enumerate(spans):
        for j in range(4, 8):
            for k in range(4, 8):
                factor = math.perm(j, 4) * math.perm(k, 4) / (j + k - 7)
                cost[8 * piece + j, 8 * piece + k] = factor * span ** (j + k - 7)
        rows += [row(piece, 0, 0.0), row(piece, 0, span)]
        right += [places[piece], places[piece + 1]]
        for derivative in range(1, 4) if piece else ():
            rows.append(row(piece, derivative, 0.0) - row(piece - 1, derivative, spans[piece - 1]))
            right.append(0.0)
    for derivative in range(1, 4):
        rows += [row(0, derivative, 0.0), row(m - 1, derivative, spans[-1])]
        right += [0.0, 0.0]
    a, count = np.array(rows), len(rows)
    kkt = np.block([[cost, a.T], [a, np.zeros((count, count))]])
    best = np.linalg.solve(kkt, np.concatenate((np.zeros(8 * m), right)))[: 8 * m].reshape(m, 8)
    path = minimum_snap(times.tolist(), np.tile(places[:, None], 4))
    assert path.coefficients[:, :, 0] == pytest.approx(best, abs=1e-6)


def test_the_crazyflie_figure_eight_has_its_published_numbers() -> None:
    """7.283185 s, 6.134 m, 0.8423 m/s on average, peaks of 1.2172 m/s and 3.0655 m/s^2, all within 0.1 %."""
    path = path_of(EXAMPLES / "figure8.csv")
    peaks, end_s = path.peaks(), path.duration_s or 0.0
    speeds = [float(np.linalg.norm(path.value(t)[1][:3])) for t in np.linspace(0.0, end_s, 20_001)]
    length_m = float(np.trapezoid(speeds, dx=end_s / 20_000))
    assert end_s == pytest.approx(7.283185, rel=1e-3)
    assert (length_m, length_m / end_s) == pytest.approx((6.134, 0.8423), rel=1e-3)
    assert (peaks.speed_m_s, peaks.accel_m_s2) == pytest.approx((1.2172, 3.0655), rel=1e-3)
    assert peaks.speed_m_s >= max(speeds) - 1e-9  # no sample exceeds the extremum


def test_sampled_peaks_agree_with_those_from_roots() -> None:
    path = path_of(EXAMPLES / "swap6v" / "pp1.csv")

    class Other:
        duration_s = path.duration_s
        value = staticmethod(path.value)

    exact, refined = path.peaks(), peaks_of(Other())
    assert refined[:3] == pytest.approx(exact[:3], rel=1e-6, abs=1e-6)
    assert refined.accel_m_s2 == pytest.approx(exact.accel_m_s2, rel=1e-3)


def test_every_piece_is_read_as_the_file_gives_it() -> None:
    file = EXAMPLES / "swap6v" / "pp3.csv"
    rows = [[float(cell) for cell in row[:33]] for row in list(csv.reader(file.read_text().splitlines()))[1:]]
    path = path_of(file)
    for begin_s, row in zip(path.begins_s, rows, strict=False):
        for t in (0.0, 0.4 * row[0], 0.99 * row[0]):
            wanted = [sum(row[1 + 8 * axis + k] * t**k for k in range(8)) for axis in range(4)]
            assert path.value(float(begin_s) + t)[0] == pytest.approx(wanted, abs=1e-9)


def test_a_move_reaches_but_keeps_its_limits() -> None:
    limits = PathLimits(1.0, 0.5, 1.0, 2.0)
    for goal, quantity in (([8, 0, 0, 0], 0), ([0, 0, 3, 0], 1), ([0, 0, 0, 3.0], 2), ([0.3, 0, 0, 0], 3)):
        peaks = move(np.zeros(4), np.array(goal, float), limits).peaks()
        assert peaks[quantity] == pytest.approx(limits[quantity], rel=2e-3)
        assert peaks.factor(limits) <= 1.0 + 1e-9


@pytest.mark.parametrize("over_s", [100.0, 3600.0, 7200.0])
def test_a_move_from_flight_lasts_as_long_as_requested(over_s: float) -> None:
    begin = EndMotion(np.array([0.1, 0, 0, 0]), np.zeros(4), np.zeros(4))
    path = move(np.zeros(4), np.array([20.0, 0, 0, 0]), PathLimits(1.0, 0.5, 1.0, 2.0), over_s, begin)
    assert path.duration_s == over_s


LIMITS = PathLimits(5.0, 1.0, 1.0, 2.0)


@pytest.mark.parametrize(
    ("goal", "rate", "took_s"),
    [
        ([20, 0, 0, 0], [0, 0, 0, 0], 20 / 5 + 5 / 2),  # d / v + v / a: a trapezoid
        ([3, 4, 0, 0], [0, 0, 0, 0], 2 * math.sqrt(5 / 2)),  # 2 sqrt(d / a): a triangle
        ([0, 0, 6, 0], [0, 0, 0, 0], 6 / 1 + RISE_S),
        ([0, 0, 0, 2], [0, 0, 0, 0], 2 / 1 + RISE_S),
        ([20, 0, 0, 0], [3, 0, 0, 0], (5 - 3) / 2 + (20 - 4 - 25 / 4) / 5 + 5 / 2),  # it accelerates over 4 m
        # it cannot stop in 1 m: it brakes over 4 m and comes back over 3 m, as the time-optimal double integrator does
        ([1, 0, 0, 0], [4, 0, 0, 0], 4 / 2 + 2 * math.sqrt(3 / 2)),
        ([4, 0, 0, 0], [4, 0, 0, 0], 4 / 2),
        ([20, 0, 20, 0], [0, 0, 0, 0], 20 / 1 + 1 / 2),  # straight: the slower climb holds both speeds to 1 m/s
    ],
)
def test_a_cruise_takes_the_closed_form_time(goal: list[float], rate: list[float], took_s: float) -> None:
    way = cruise(np.zeros(4), np.array(goal, float), LIMITS, np.array(rate, float))
    assert way.duration_s == pytest.approx(took_s, abs=1e-6)
    assert way.value(took_s)[0] == pytest.approx(goal, abs=1e-9)


def test_a_cruise_keeps_its_limits_and_replanning_gives_its_remainder() -> None:
    random = np.random.default_rng(8)
    for _ in range(300):
        far = 10.0 ** random.uniform(-2, 2)
        goal = random.normal(size=4) * [far, far, far / 3, 1]
        rate = random.uniform(-1, 1, 4) * [3.5, 3.5, 1, 1] * random.choice([0, 0.1, 1])
        way = cruise(np.zeros(4), goal, LIMITS, rate)
        end_s = way.duration_s or 0.0
        assert way.value(0.0)[1] == pytest.approx(rate, abs=1e-9)
        away = way.value(end_s)[0] - goal
        assert away[:3] == pytest.approx(np.zeros(3), abs=1e-9)
        assert math.remainder(away[3], math.tau) == pytest.approx(0.0, abs=1e-9)
        assert way.peaks().factor(LIMITS) <= 1.0 + 1e-9
        for before, after in zip(way.begins_s[1:-1] - 1e-9, way.begins_s[1:-1], strict=True):
            for one, other in zip(way.value(before), way.value(after), strict=True):
                assert one == pytest.approx(other, abs=1e-7)  # neither position nor velocity jumps
        at_s = random.uniform(0.0, 0.9) * end_s
        rest = cruise(way.value(at_s)[0], goal, LIMITS, way.value(at_s)[1])
        for t in np.linspace(at_s, end_s, 7).tolist():
            assert rest.value(t - at_s)[0][:3] == pytest.approx(way.value(t)[0][:3], abs=1e-6)


def test_a_cruise_passes_places_within_their_radius_at_speed() -> None:
    places = [np.array(place, float) for place in ([30, 0, 0, 0], [30, 30, 0, 0], [0, 30, 0, 0])]
    rests = cruise_through(np.zeros(4), places, LIMITS, speeds=Cruise(2.0))
    assert rests.duration_s == pytest.approx(3 * (30 / 2 + 2 / 2), abs=1e-6)
    passes = cruise_through(np.zeros(4), places, LIMITS, speeds=Cruise(2.0), radius_m=1.0)
    times = np.linspace(0.0, passes.duration_s or 0.0, 5001).tolist()
    track = np.array([passes.value(t)[0] for t in times])
    nearest = [float(np.linalg.norm((track - place)[:, :3], axis=1).min()) for place in places]
    assert all(distance <= 1.0 for distance in nearest)
    assert nearest[-1] == pytest.approx(0.0, abs=1e-9)
    assert (passes.duration_s or 0.0) < (rests.duration_s or 0.0) - 1.5
    assert passes.peaks().speed_m_s == pytest.approx(2.0, abs=1e-9)
    cruising = [np.hypot(*passes.value(t)[1][:2]) for t in times]
    assert np.mean(np.array(cruising) > 1.999) > 0.8


def test_laps_follow_the_curve_and_rest_at_both_ends() -> None:
    curve = figure_eight(4.0, 2.0)
    path = Laps(curve, 10.0, 2.0)
    end_s = path.duration_s or 0.0
    for t in np.linspace(0.01, end_s - 0.01, 200).tolist():
        (x, y, *_), rate = path.value(t)
        assert y**2 == pytest.approx((2.0 * x / 4.0 * 2.0) ** 2 * (1.0 - (2.0 * x / 4.0) ** 2), abs=1e-9)  # Gerono
        slope = (path.value(t + 1e-5)[0] - path.value(t - 1e-5)[0]) / 2e-5
        assert rate == pytest.approx(slope, abs=1e-6)
    assert path.value(end_s)[0] == pytest.approx(np.zeros(4), abs=1e-9)
    assert not path.value(0.0)[1].any()
    assert path.value(end_s)[1] == pytest.approx(np.zeros(4), abs=1e-12)


def test_assignment_keeps_drones_apart_where_linear_cost_does_not() -> None:
    """CAPT: starts and goals at least 1 m apart leave 1/sqrt(2) m between drones, in 1000 random cases."""
    from scipy.optimize import linear_sum_assignment

    random = np.random.default_rng(5)

    def apart() -> np.ndarray:
        places: list[np.ndarray] = []
        while len(places) < 8:
            place = random.uniform(0.0, 4.0, 3)
            if all(np.linalg.norm(place - other) >= 1.0 for other in places):
                places.append(place)
        return np.array(places)

    least, least_linear = math.inf, math.inf
    for _ in range(1000):
        starts, goals = apart(), apart()
        least = min(least, straight_separation(starts, goals[assign(starts, goals)]))
        cost = np.linalg.norm(starts[:, None] - goals[None], axis=2)
        least_linear = min(least_linear, straight_separation(starts, goals[linear_sum_assignment(cost)[1]]))
    assert least >= 1.0 / math.sqrt(2.0) - 1e-12
    assert least_linear < 0.5


def test_only_approaches_below_the_clearance_are_found() -> None:
    """Two drones cross at right angles, a quarter of a second apart; dense sampling gives their least distance."""
    ways = [np.array([[-2.0, 0, 1, 0], [2.0, 0, 1, 0]]), np.array([[0, -2.0, 1, 0], [0, 2.0, 1, 0]])]
    one = minimum_snap((0.0, 4.0), ways[0])
    other = minimum_snap((0.0, 0.25, 4.25), np.vstack([ways[1][:1], ways[1][:1], ways[1][1:]]))
    times = np.linspace(0.0, 4.25, 42_501)
    distances = [float(np.linalg.norm(one.value(t)[0][:3] - other.value(t)[0][:3])) for t in times.tolist()]
    least = min(distances)
    half = np.array([0.5, 0.5])
    assert first_approach([one, other], half * (least - 2e-3), 4.25) is None
    found = first_approach([one, other], half * (least + 2e-3), 4.25)
    assert found is not None
    assert (found.first, found.second) == (0, 1)
    assert found.distance_m == pytest.approx(least, abs=3e-3)


def test_six_drones_of_the_public_swap_change_places() -> None:
    paths = [path_of(EXAMPLES / "swap6v" / f"pp{number}.csv") for number in range(1, 7)]
    starts, ends = (np.array([path.value(t)[0][:3] for path in paths]) for t in (0.0, 4.25))
    assert np.abs(ends - starts[::-1]).max() < 0.02
    assert first_approach(paths, np.full(6, 0.15), 4.25) is None
    assert first_approach(paths, np.full(6, 0.16), 4.25) is not None
