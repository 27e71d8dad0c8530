"""Numbers and figures of the laws' papers, recomputed with the laws as flown, but on ideal agents instead of drones.

margins     R. Olfati-Saber, R. M. Murray, Consensus problems in networks of agents with switching topology and
            time-delays, IEEE Trans. Automatic Control 49 (2004): errors decay at the rate lambda_2, and consensus
            oscillates from a delay of pi / (2 lambda_n) on, if an agent's own state is delayed like those of the others
flocking    R. Olfati-Saber, Flocking for multi-agent dynamic systems: algorithms and theory, IEEE Trans. Automatic
            Control 51 (2006): relative connectivity, deviation energy and velocity mismatch of a flock in free space
            with the paper's parameters, with and without the term for the group objective
bearings    S. Zhao, D. Zelazo, Bearing rigidity and almost global bearing-only formation stabilization, IEEE Trans.
            Automatic Control 61 (2016): centroid and scale are invariant, and the shape is reached from almost all
            starts
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from scipy.spatial import KDTree

from zsim.errors import OTHER_OUT, ReportError, file_fault
from zsim.math.randomness import stream
from zsim.presentation import Column, FittedTable
from zsim_agents.laws.bearing_only import bearing_only
from zsim_agents.laws.consensus import consensus
from zsim_agents.laws.olfati_saber import alpha_force, deviation_energy, gamma_force
from zsim_agents.laws.pilot import Heard, polygon
from zsim_analysis.reading.recorded_flight import Array
from zsim_analysis.report import figure_style as style

Graph = list[tuple[int, int]]
N = 5
PATH: Graph = [(0, 1), (1, 2), (2, 3), (3, 4)]
RING: Graph = [*PATH, (4, 0)]
GRAPHS: dict[str, Graph] = {
    "path": PATH,
    "ring": RING,
    "star": [(0, 1), (0, 2), (0, 3), (0, 4)],
    "complete": [(i, j) for i in range(N) for j in range(i + 1, N)],
    "house": [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4)],
}
STEPS_OF_DELAY = 120  # Euler steps per delay
DELAYS = 80  # number of delays for which a network is integrated
D, R, FLOCK, AREA_STD = 7.0, 8.4, 150, 50.0  # the paper's spacing, range [m], number of agents, std of starts [m]
FLOCK_C1 = {"alpha": 3.0, "gamma": 0.1}  # design choice, as the paper leaves these gains open
REACHED_M = 1e-3
STARTS = 10  # number of random starts of the formation controlled by bearings
FLOCK_H_S, FLOCK_S = 0.02, 30.0


class Line(Struct, frozen=True):
    """A number from a paper, and its value computed here."""

    paper: str
    what: str
    expected: float
    found: float


def neighbours(graph: Graph, i: int) -> list[int]:
    return sorted([b for a, b in graph if a == i] + [a for a, b in graph if b == i])


def laplacian(graph: Graph) -> Array:
    L = np.zeros((N, N))
    for i, j in graph:
        L[[i, j], [j, i]] -= 1.0
        L[[i, j], [i, j]] += 1.0
    return L


def consensus_rate(graph: Graph, h: float = 0.005) -> float:
    """Return the asymptotic rate at which the errors of consensus decay [1/s], for k = 1."""
    adjacency = [neighbours(graph, i) for i in range(N)]
    zero = np.zeros(1)
    p = np.array([[1.0], [-2.0], [0.5], [3.0], [-1.0]])
    p -= np.mean(p)
    norms = []
    for _ in range(round(12.0 / (np.linalg.eigvalsh(laplacian(graph))[1] * h))):
        p = p + h * np.array([consensus([(p[j] - p[i], zero) for j in adjacency[i]], 1.0) for i in range(N)])
        norms.append(float(np.linalg.norm(p)))
    second_half = np.log(norms[len(norms) // 2 :])
    return float(-(second_half[-1] - second_half[0]) / (h * (len(second_half) - 1)))


def delay_margin(graph: Graph) -> float:
    """Return the smallest delay, common to all states, at which consensus no longer settles [s].

    The network is integrated for many delays at once, each a dimension with its own step; the margin is where
    the growth of the fastest mode changes sign.
    """
    adjacency, values, vectors = [neighbours(graph, i) for i in range(N)], *np.linalg.eigh(laplacian(graph))
    delays = np.linspace(0.8, 1.2, DELAYS) * math.pi / (2.0 * values[-1])
    h, zero = delays / STEPS_OF_DELAY, np.zeros(DELAYS)
    history = [np.repeat(vectors[:, -1:], DELAYS, axis=1)] * (STEPS_OF_DELAY + 1)
    peaks = []
    for _ in range(2):  # peak over ten periods (of four delays each), early and late
        peak = np.zeros(DELAYS)
        for _ in range(10 * 4 * STEPS_OF_DELAY):
            delayed = history.pop(0)
            u = np.array([consensus([(delayed[j] - delayed[i], zero) for j in adjacency[i]], 1.0) for i in range(N)])
            history.append(history[-1] + h * u)
            peak = np.maximum(peak, np.abs(history[-1]).max(axis=0))
        peaks.append(peak)
    growth = np.log(peaks[1] / peaks[0])
    return float(np.interp(0.0, growth, delays))


class FlockTrack(NamedTuple):
    """A flock in free space, sampled once a second."""

    t_s: Array  # (T,)
    connectivity: Array  # rank of the Laplacian / (n - 1): 1 if the flock is connected
    energy: Array  # deviation energy / d^2
    mismatch: Array  # mean |v_i - mean v| [m/s]
    p: Array  # (n, 2) final positions [m]


@cache
def free_flock(n: int = FLOCK, with_aim: bool = True, seed: int = 1) -> FlockTrack:
    """Return the track of the flock in the paper's simulation section, with its scattered start and parameters."""
    rng = stream(seed, "papers/flock")
    p, v = rng.normal(0.0, AREA_STD, (n, 2)), rng.uniform(-2.0, -1.0, (n, 2))
    rows = []
    sample_steps = round(1.0 / FLOCK_H_S)
    for step in range(round(FLOCK_S / FLOCK_H_S) + 1):
        pairs = KDTree(p).query_ball_point(p, R)
        if step % sample_steps == 0:
            energy, _ = deviation_energy(p, D, R)
            velocity_scatter = float(np.mean(np.linalg.norm(v - np.mean(v, axis=0), axis=1)))
            rows.append((step * FLOCK_H_S, _connectivity(pairs), energy / D**2, velocity_scatter))
        u = np.zeros((n, 2))
        for i in range(n):
            received = [Heard("", p[j], v[j]) for j in sorted(pairs[i]) if j != i]
            u[i] = alpha_force(p[i], v[i], received, D, R, FLOCK_C1["alpha"])
            if with_aim:
                u[i] += gamma_force(p[i], v[i], np.zeros(2), np.zeros(2), FLOCK_C1["gamma"])
        v = v + FLOCK_H_S * u
        p = p + FLOCK_H_S * v
    t_s, connectivity, energy, mismatch = np.array(rows).T
    return FlockTrack(t_s, connectivity, energy, mismatch, p)


def _connectivity(pairs: list[list[int]]) -> float:
    """Return (n - components) / (n - 1), which is the rank of the Laplacian relative to its maximum."""
    group = list(range(len(pairs)))

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for i, adjacent in enumerate(pairs):
        for j in adjacent:
            group[root(i)] = root(j)
    return (len(pairs) - sum(root(i) == i for i in range(len(pairs)))) / (len(pairs) - 1)


class BearingTrack(NamedTuple):
    """A formation controlled by bearings alone, from one start."""

    t_s: Array  # (T,)
    error: Array  # sum over the edges of |g - g*|
    centroid_drift: float  # largest drift of the centroid [m]
    scale_drift: float  # largest drift of the scale [m]
    distance: Array  # |p - p*|, where p* has the centroid and scale of the start


@cache
def bearing_flight(seed: int = 1, h: float = 0.05, duration_s: float = 80.0) -> BearingTrack:
    """Return the track of a pentagon with two diagonals from a random start, by fourth-order Runge–Kutta."""
    graph, c = [*RING, (0, 2), (0, 3)], polygon(N, 1.0)
    adjacency = [neighbours(graph, i) for i in range(N)]

    def bearing(p: Array, i: int, j: int) -> Array:
        z = p[j] - p[i]
        return z / math.sqrt(z @ z)

    desired_bearings = {(i, j): bearing(c, i, j) for i in range(N) for j in adjacency[i]}

    def u(p: Array) -> Array:
        return np.array(
            [bearing_only([(bearing(p, i, j), desired_bearings[i, j]) for j in adjacency[i]], 1.0) for i in range(N)]
        )

    p = stream(seed, "papers/bearings").uniform(-2.0, 2.0, (N, 2))
    start_centroid, start_scale = np.mean(p, axis=0), _scale(p)
    target = start_centroid + start_scale * c / _scale(c)
    rows, drifts = [], [(0.0, 0.0)]
    for step in range(round(duration_s / h)):
        if step % 10 == 0:
            error = sum(float(np.linalg.norm(bearing(p, i, j) - desired_bearings[i, j])) for i, j in graph)
            rows.append((step * h, error, float(np.linalg.norm(p - target))))
            drifts.append((float(np.linalg.norm(np.mean(p, axis=0) - start_centroid)), abs(_scale(p) - start_scale)))
        k1 = u(p)
        k2 = u(p + h / 2 * k1)
        k3 = u(p + h / 2 * k2)
        p = p + h / 6 * (k1 + 2 * k2 + 2 * k3 + u(p + h * k3))
    t_s, error, distance = np.array(rows).T
    return BearingTrack(t_s, error, max(a for a, _ in drifts), max(b for _, b in drifts), distance)


def _scale(p: Array) -> float:
    offsets = p - np.mean(p, axis=0)
    return math.sqrt(float(np.mean(np.sum(offsets * offsets, axis=1))))


def lines(progress: Callable[[str], None] = lambda _: None) -> Iterator[Line]:
    """Yield the papers' numbers beside those computed here with the laws."""
    for name, graph in GRAPHS.items():
        progress(f"consensus, {name} …")
        values = np.linalg.eigvalsh(laplacian(graph))
        line = partial(Line, "Olfati-Saber, Murray 2004")
        yield line(f"rate of consensus, {name} (1/s)", float(values[1]), consensus_rate(graph))
        yield line(f"delay margin, {name} (s)", math.pi / (2 * float(values[-1])), delay_margin(graph))
    for with_aim in (True, False):
        progress(f"a flock of {FLOCK}, {'with' if with_aim else 'without'} an aim …")
        track = free_flock(with_aim=with_aim)
        variant = "with its aim" if with_aim else "without it, for comparison"
        line = partial(Line, "Olfati-Saber 2006")
        yield line(f"relative connectivity of {FLOCK} agents, {variant}", 1.0, float(track.connectivity[-1]))
        yield line(f"deviation energy / d^2, {variant}", 0.0, float(track.energy[-1]))
        yield line(f"velocity mismatch (m/s), {variant}", 0.0, float(track.mismatch[-1]))
    progress("shapes by bearings …")
    tracks = [bearing_flight(seed) for seed in range(1, STARTS + 1)]
    line = partial(Line, "Zhao, Zelazo 2016")
    yield line("drift of the centroid (m)", 0.0, max(track.centroid_drift for track in tracks))
    yield line("drift of the scale (m)", 0.0, max(track.scale_drift for track in tracks))
    reached_count = sum(float(track.distance[-1] < REACHED_M) for track in tracks)
    yield line(f"number of starts, out of {STARTS}, from which the figure is reached", float(STARTS), reached_count)


def write_papers(out: Path, progress: Callable[[str], None]) -> list[Line]:
    """Write papers.md, flocking.png and bearings.png into a folder; return the numbers.

    Raises:
        ReportError: the folder cannot be written.
    """
    results = list(lines(progress))
    with file_fault(out, "cannot be written", OTHER_OUT, ReportError):
        out.mkdir(parents=True, exist_ok=True)
        (out / "papers.md").write_text(markdown(results), encoding="utf-8")
        for figure in figures(progress):
            (out / figure.name).write_bytes(figure.png())
    return results


def cells(line: Line) -> list[str]:
    found_text = f"{line.found:.4g}" if line.found > 1e-4 else f"{line.found:.0e}"
    return [line.paper, line.what, f"{line.expected:.4g}", found_text]


def markdown(results: Sequence[Line]) -> str:
    rows = (f"| {' | '.join(cells(line))} |\n" for line in results)
    return f"| paper | | expected | here |\n|---|---|--:|--:|\n{''.join(rows)}"


def terminal_table(results: Sequence[Line]) -> FittedTable:
    columns = [Column("paper", "text"), Column("", "text"), Column("expected", right=True), Column("here", right=True)]
    return FittedTable(columns, [cells(line) for line in results])


def figures(progress: Callable[[str], None] = lambda _: None) -> Iterator[style.ReportFigure]:
    progress("drawing the flock …")
    yield _flocking(free_flock(), free_flock(with_aim=False))
    progress("drawing shapes by bearings …")
    yield _bearings()


def _flocking(led: FlockTrack, free: FlockTrack) -> style.ReportFigure:
    figure = style.new_figure(style.PAGE_IN, 4.6)
    panels = figure.subplots(2, 3)
    named = {
        "with the group's aim (algorithm 2)": (led, style.BLUE),
        "without it (algorithm 1)": (free, style.VERMILION),
    }
    measures = (("relative connectivity", "connectivity"), ("deviation energy / d²", "energy"),
                ("velocity mismatch (m/s)", "mismatch"))  # fmt: skip
    for axes, (title, name) in zip(panels[0], measures, strict=True):
        for label, (track, colour) in named.items():
            axes.plot(track.t_s, getattr(track, name), color=colour, lw=1.0, label=label)
        style.dress(axes, title)
        axes.set_ylim(bottom=0.0)
    style.label_time(panels[0])
    for axes, (label, (track, colour)) in zip(panels[1], named.items(), strict=False):
        p = track.p
        z = np.linalg.norm(p[:, None] - p[None], axis=2)
        for i, j in zip(*np.nonzero(np.triu(z < R, 1)), strict=True):
            axes.plot(*p[[i, j]].T, color=style.GREY, lw=0.4, zorder=1)
        axes.plot(*p.T, "o", color=colour, ms=1.6, zorder=2)
        style.dress(axes)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x (m)", fontsize=style.PAPER_PT)
        axes.set_title(f"{label.partition(' (')[0]}, {track.t_s[-1]:.0f} s", fontsize=style.PAPER_PT, color=style.DARK)
    panels[1, 2].set_visible(False)
    style.letter_panels([*panels[0], *panels[1, :2]])
    style.legend_above(figure, panels[0, 0])
    caption = f"{FLOCK} agents, d = 7 m, r = 1.2 d, from starts with a standard deviation of 50 m."
    return style.ReportFigure("flocking.png", "Flocking in free space, after Olfati-Saber 2006", caption, figure)


def _bearings() -> style.ReportFigure:
    figure = style.new_figure(style.PAGE_IN, 2.4)
    panels = figure.subplots(1, 2)
    for seed in range(1, STARTS + 1):
        track = bearing_flight(seed)
        panels[0].semilogy(track.t_s, track.error, color=style.BLUE, lw=0.7)
        panels[1].semilogy(track.t_s, track.distance, color=style.BLUE, lw=0.7)
    style.dress(panels[0], "sum of |g − g*|")
    style.dress(panels[1], "|p − p*| (m)")
    style.label_time(panels)
    style.letter_panels(panels)
    caption = f"A pentagon with two diagonals, from {STARTS} random starts."
    return style.ReportFigure(
        "bearings.png", "Formation by bearings alone, after Zhao and Zelazo 2016", caption, figure
    )
