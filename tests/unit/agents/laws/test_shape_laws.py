"""The shape laws, integrated without a simulator, against closed forms: rates, lags, ranks and invariants."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from zsim_agents.laws.bearing_only import bearing_only, bearing_rigidity_matrix
from zsim_agents.laws.consensus import consensus
from zsim_agents.laws.distance_based import distance_based, rigidity_matrix
from zsim_agents.laws.pilot import FormationReference, polygon, repulsion
from zsim_agents.laws.virtual_structure import virtual_structure

Array = NDArray[np.float64]
Edges = list[tuple[int, int]]

PATH: Edges = [(0, 1), (1, 2), (2, 3), (3, 4)]
RING: Edges = [*PATH, (4, 0)]
STAR: Edges = [(0, 1), (0, 2), (0, 3), (0, 4)]
COMPLETE: Edges = [(i, j) for i in range(5) for j in range(i + 1, 5)]
HOUSE: Edges = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4)]
RIGID: Edges = [*RING, (0, 2), (0, 3)]
PENTAGON = polygon(5, 1.0)
SQUARE = polygon(4, 1.0)


def laplacian(edges: Edges, n: int = 5) -> Array:
    L = np.zeros((n, n))
    for i, j in edges:
        L[[i, j], [j, i]] -= 1.0
        L[[i, j], [i, j]] += 1.0
    return L


def neighbours(edges: Edges, i: int) -> list[int]:
    return sorted([b for a, b in edges if a == i] + [a for a, b in edges if b == i])


def scattered(c: Array, by: float = 0.5, seed: int = 1) -> Array:
    return c + np.random.default_rng(seed).normal(0.0, by, c.shape)


def consensus_of(edges: Edges, c: Array, k: float = 1.0) -> Callable[[Array], Array]:
    def u(p: Array) -> Array:
        return np.array(
            [consensus([(p[j] - p[i], c[j] - c[i]) for j in neighbours(edges, i)], k) for i in range(len(p))]
        )

    return u


def distances_of(edges: Edges, c: Array, k: float = 1.0) -> Callable[[Array], Array]:
    def u(p: Array) -> Array:
        between = {(i, j): float((c[j] - c[i]) @ (c[j] - c[i])) for i in range(len(c)) for j in range(len(c))}
        return np.array(
            [distance_based([(p[j] - p[i], between[i, j]) for j in neighbours(edges, i)], k) for i in range(len(p))]
        )

    return u


def bearings_of(edges: Edges, c: Array, k: float = 1.0) -> Callable[[Array], Array]:
    def bearing(p: Array, i: int, j: int) -> Array:
        return (p[j] - p[i]) / np.linalg.norm(p[j] - p[i])

    def u(p: Array) -> Array:
        pairs = [[(bearing(p, i, j), bearing(c, i, j)) for j in neighbours(edges, i)] for i in range(len(p))]
        return np.array([bearing_only(each, k) for each in pairs])

    return u


def flown(u: Callable[[Array], Array], p: Array, h: float, steps: int) -> list[Array]:
    """Return the positions at every Euler step."""
    track = [p]
    for _ in range(steps):
        track.append(track[-1] + h * u(track[-1]))
    return track


def fitted_rate(errors: Sequence[float], h: float) -> float:
    """Return the rate of decay [1/s] over the last half of errors that are a time step h apart."""
    half = np.log(np.asarray(errors[len(errors) // 2 :]))
    return float(-np.polyfit(h * np.arange(len(half)), half, 1)[0])


@pytest.mark.parametrize(
    ("edges", "lambda_2", "lambda_n"),
    [(PATH, 0.3820, 3.6180), (RING, 1.3820, 3.6180), (STAR, 1, 5), (COMPLETE, 5, 5), (HOUSE, 1.3820, 4.6180)],
    ids=["path", "ring", "star", "complete", "house"],
)
def test_consensus_decays_at_lambda_2_and_keeps_its_mean(edges: Edges, lambda_2: float, lambda_n: float) -> None:
    eigenvalues = np.linalg.eigvalsh(laplacian(edges))
    assert eigenvalues[[1, -1]] == pytest.approx([lambda_2, lambda_n], abs=1e-4)
    h, p = 0.01, scattered(PENTAGON)
    track = flown(consensus_of(edges, PENTAGON), p, h, round(12 / lambda_2 / h))
    errors = [float(np.linalg.norm(each - PENTAGON - np.mean(p - PENTAGON, axis=0))) for each in track]
    assert fitted_rate(errors, h) == pytest.approx(-np.log(1 - h * eigenvalues[1]) / h, rel=1e-3)
    assert np.mean(track[-1], axis=0) == pytest.approx(np.mean(p, axis=0), abs=1e-12)


def test_random_message_loss_slows_the_mean_as_predicted() -> None:
    """Each directed link drops with probability p, omitting its term: the rate is -ln(1 - h (1 - p) lambda_2) / h."""
    h, lost, runs, steps, rng = 0.05, 0.3, 400, 60, np.random.default_rng(4)
    values, vectors = np.linalg.eigh(laplacian(RING))
    start = np.column_stack([vectors[:, 1], np.zeros(5)])
    mean = np.zeros((steps + 1, 5))
    for _ in range(runs):
        p = start
        mean[0] += p[:, 0] / runs
        for step in range(steps):
            heard = [[j for j in neighbours(RING, i) if rng.random() > lost] for i in range(5)]
            u = np.array([consensus([(p[j] - p[i], np.zeros(2)) for j in heard[i]], 1.0) for i in range(5)])
            p = p + h * u
            mean[step + 1] += p[:, 0] / runs
    errors = np.abs(mean @ vectors[:, 1])
    rate = -np.polyfit(h * np.arange(steps + 1), np.log(errors), 1)[0]
    assert rate == pytest.approx(-np.log(1 - h * (1 - lost) * values[1]) / h, rel=0.03)


def test_an_informed_drone_ties_the_shape_to_its_place() -> None:
    """The rate about the reference is lambda_min(k L + diag(b)); see zsim_agents.laws.shape."""
    b = np.array([0.5, 0, 0, 0, 0])
    law, h = consensus_of(RING, PENTAGON), 0.01
    track = flown(lambda p: law(p) + b[:, None] * (PENTAGON - p), scattered(PENTAGON), h, 8000)
    rate = fitted_rate([float(np.linalg.norm(each - PENTAGON)) for each in track], h)
    assert rate == pytest.approx(np.linalg.eigvalsh(laplacian(RING) + np.diag(b))[0], rel=2e-3)


@pytest.mark.parametrize(
    ("edges", "rate"), [(PATH, 0.1206), (RING, 0.3820), (STAR, 1.0)], ids=["path", "ring", "hub leads"]
)
def test_followers_converge_at_the_rate_of_their_laplacian_block(edges: Edges, rate: float) -> None:
    L_ff, h = laplacian(edges)[1:, 1:], 0.01
    assert np.linalg.eigvalsh(L_ff)[0] == pytest.approx(rate, abs=1e-4)
    law = consensus_of(edges, PENTAGON)
    start = scattered(PENTAGON)
    start[0] = PENTAGON[0]
    track = flown(lambda p: np.vstack([np.zeros(2), law(p)[1:]]), start, h, round(10 / rate / h))
    errors = [float(np.linalg.norm(each - PENTAGON)) for each in track]
    assert fitted_rate(errors, h) == pytest.approx(-np.log(1 - h * np.linalg.eigvalsh(L_ff)[0]) / h, rel=2e-3)


def test_a_chain_of_followers_lags_behind_a_moving_leader() -> None:
    k, v, h = 2.0, np.array([0.5, 0.0]), 0.02
    law = consensus_of(PATH, PENTAGON, k)
    track = flown(lambda p: np.vstack([v, law(p)[1:]]), PENTAGON.copy(), h, 6000)
    lag = (PENTAGON + 6000 * h * v - track[-1])[1:, 0]
    assert lag == pytest.approx(np.array([4, 7, 9, 10]) * v[0] / k, rel=1e-6)
    assert lag == pytest.approx(np.linalg.solve(laplacian(PATH)[1:, 1:], np.full(4, v[0] / k)), rel=1e-6)


def test_a_moving_virtual_structure_is_joined_at_the_rate_k() -> None:
    reference, k, h, c = FormationReference(("2*t", "sin(t)"), "30*t", "1 + t/10"), 0.8, 1e-3, np.array([1.0, 0.5])
    p, errors = np.array([3.0, -2.0]), []
    for step in range(4000):
        pose = reference.at(step * h)
        place, rate = pose.place(c)
        errors.append(float(np.linalg.norm(p - pose.p_W - place)))
        p = p + h * virtual_structure(p, pose.p_W + place, pose.v_W + rate, k)
    assert -np.log(errors[-1] / errors[0]) / (3999 * h) == pytest.approx(k, rel=2e-3)


# Distances


def test_the_rigidity_matrix_has_the_expected_rank() -> None:
    R = rigidity_matrix(PENTAGON, RIGID)
    assert np.linalg.matrix_rank(R) == 2 * 5 - 3
    assert np.linalg.matrix_rank(rigidity_matrix(PENTAGON, RING)) == 5  # a ring with joints is flexible
    assert np.linalg.eigvalsh(R @ R.T)[0] == pytest.approx(0.80769, abs=1e-5)
    tetrahedron = np.vstack([np.zeros(3), np.eye(3)])
    every = [(i, j) for i in range(4) for j in range(i + 1, 4)]
    assert np.linalg.matrix_rank(rigidity_matrix(tetrahedron, every)) == 3 * 4 - 6


def test_distances_converge_at_the_rate_of_the_rigidity_matrix() -> None:
    h, start = 0.005, scattered(PENTAGON, 0.02)
    track = flown(distances_of(RIGID, PENTAGON), start, h, 1600)
    wanted = [np.linalg.norm(PENTAGON[j] - PENTAGON[i]) for i, j in RIGID]
    errors = [float(np.linalg.norm([np.linalg.norm(p[j] - p[i]) for i, j in RIGID] - np.array(wanted))) for p in track]
    assert fitted_rate(errors, h) == pytest.approx(2 * 0.80769, rel=0.01)
    assert np.mean(track[-1], axis=0) == pytest.approx(np.mean(start, axis=0), abs=1e-12)


def test_the_distance_law_descends_its_potential() -> None:
    law, k, dt = distances_of(RIGID, PENTAGON, 0.7), 0.7, 1e-6

    def V(p: Array) -> float:
        squared = [
            (p[j] - p[i]) @ (p[j] - p[i]) - (PENTAGON[j] - PENTAGON[i]) @ (PENTAGON[j] - PENTAGON[i]) for i, j in RIGID
        ]
        return float(0.25 * np.sum(np.square(squared)))

    p = scattered(PENTAGON)
    u = law(p)
    rate = (V(p + dt * u) - V(p - dt * u)) / (2 * dt)
    assert rate == pytest.approx(-np.sum(u * u) / k, rel=1e-6)


def test_distances_may_converge_mirrored_and_never_leave_a_line() -> None:
    edges: Edges = [(0, 1), (1, 2), (2, 0), (1, 3), (2, 3)]
    c = np.array([[0.0, 0], [1, -0.6], [1, 0.6], [2, 0]])
    mirrored = c.copy()
    mirrored[3] = [0.05, 0.02]  # across the edge 1-2, on the side of drone 0
    end = flown(distances_of(edges, c), mirrored, 0.01, 6000)[-1]
    lengths = [np.linalg.norm(end[j] - end[i]) - np.linalg.norm(c[j] - c[i]) for i, j in edges]
    assert np.abs(lengths).max() < 1e-9
    assert np.linalg.norm(end[3] - end[0]) < 0.1  # instead of 2
    line = np.column_stack([np.arange(4.0), np.zeros(4)])
    assert np.abs(flown(distances_of(edges, c), line, 0.01, 500)[-1][:, 1]).max() == 0.0


# Bearings


@pytest.mark.parametrize(
    ("c", "edges", "rank", "rigid"),
    [
        (SQUARE, [(0, 1), (1, 2), (2, 3), (3, 0)], 4, 5),
        (SQUARE, [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)], 5, 5),
        (PENTAGON, RIGID, 7, 7),
    ],
    ids=["square", "braced square", "pentagon"],
)
def test_the_bearing_rigidity_matrix_has_the_expected_rank(c: Array, edges: Edges, rank: int, rigid: int) -> None:
    assert rigid == 2 * len(c) - 2 - 1
    assert np.linalg.matrix_rank(bearing_rigidity_matrix(c, edges), tol=1e-9) == rank


def test_bearings_keep_centroid_and_size_and_converge_as_linearised() -> None:
    law, h = bearings_of(RIGID, PENTAGON), 0.01
    start = scattered(PENTAGON, 0.1)
    u, arms = law(start), start - np.mean(start, axis=0)
    assert np.sum(u, axis=0) == pytest.approx([0, 0], abs=1e-14)
    assert float(np.sum(u * arms)) == pytest.approx(0.0, abs=1e-14)  # d/dt of s^2 / 2, zero up to rounding

    size = float(np.sqrt(np.sum(arms * arms) / np.sum(PENTAGON * PENTAGON)))
    wanted = np.mean(start, axis=0) + size * PENTAGON
    track = flown(law, start, h, 5000)
    V = [0.5 * float(np.sum((p - wanted) ** 2)) for p in track]
    assert np.all(np.diff(V[:2000]) < 0)
    n = len(PENTAGON)
    M = np.zeros((n, 2, n, 2))  # the linearisation: a Laplacian of projections
    for i, j in RIGID:
        z = wanted[j] - wanted[i]
        P = (np.eye(2) - np.outer(z, z) / (z @ z)) / np.linalg.norm(z)
        for a, b in ((i, j), (j, i)):
            M[a, :, a] += P
            M[a, :, b] -= P
    slowest = np.linalg.eigvalsh(M.reshape(2 * n, 2 * n))[3]  # after the three of translation and scale
    final = track[-1]
    errors = [float(np.linalg.norm(p - final)) for p in track[:2000]]
    assert fitted_rate(errors, h) == pytest.approx(slowest, rel=0.02)


def test_repulsion_is_the_negative_slope_of_its_potential() -> None:
    D, eta, dd = 1.5, 0.7, 1e-6

    def V(d: float) -> float:
        return 0.5 * eta * (1 / d - 1 / D) ** 2

    assert repulsion(0.8, D, eta) == pytest.approx(-(V(0.8 + dd) - V(0.8 - dd)) / (2 * dd), rel=1e-6)
    assert repulsion(D, D, eta) == 0.0
    assert repulsion(-0.01, 0.0, eta) == 0.0  # inside an obstacle, with avoidance switched off
