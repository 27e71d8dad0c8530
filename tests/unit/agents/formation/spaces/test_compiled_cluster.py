"""The compiled mathematics of the controller: the results of plain Python, and no compilation in flight."""

import importlib
import math
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

MODULES = (
    "formation.spaces.cluster_space",
    "formation.flight_check",
    "formation.control_law",
    "formation.spaces.scenario_space",
    "formation.spaces.template_cluster",
    "formation.trajectory",
    "formation.spaces.triad_cluster",
)
SIZES = (2, 3, 5)
SAME = 0.0  # relative tolerance: identical to the bit
DT_S = 0.02

pytest.importorskip("numba")


def package() -> SimpleNamespace:
    loaded = {name.rpartition(".")[2]: importlib.import_module(f"zsim_agents.{name}") for name in MODULES}
    return SimpleNamespace(**loaded)


@pytest.fixture(scope="module")
def both() -> tuple[SimpleNamespace, SimpleNamespace]:
    """Return the modules as they are, and a copy imported without numba."""
    compiled = package()
    with patch.dict(sys.modules, {"numba": None}):
        for name in [*sys.modules]:
            if name.partition(".")[0] == "zsim_agents" or name.startswith("zsim.math"):
                del sys.modules[name]
        return compiled, package()


def space_of(way: SimpleNamespace, kind: int | str):
    """Return a cluster space of these modules; `cluster_space` would import the compiled classes."""
    triad = way.triad_cluster.TriadCluster
    if isinstance(kind, str):
        return way.scenario_space.NestedCluster(triad(3), [(name, triad(3)) for name in kind])
    if kind > max(SIZES):
        return way.template_cluster.TemplateCluster(np.random.default_rng(kind).normal(scale=6.0, size=(kind, 3)))
    return way.triad_cluster.PairCluster() if kind == 2 else triad(kind)


def same(a, b, most: float = SAME) -> bool:
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return a.shape == b.shape and bool((np.abs(a - b) <= most * np.maximum(1.0, np.abs(a))).all())


def robots(n: int, rng: np.random.Generator, scale_m: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    return rng.normal(scale=scale_m, size=(n, 3)), rng.uniform(-4.0, 4.0, n)


def test_only_one_set_of_modules_is_compiled(both):
    compiled, plain = both
    for module, name in (("triad_cluster", "triad_forward"), ("control_law", "limited"), ("trajectory", "put_ramped")):
        assert hasattr(getattr(getattr(compiled, module), name), "py_func")
        assert not hasattr(getattr(getattr(plain, module), name), "py_func")


@pytest.mark.parametrize("scale_m", [1.0, 4.0], ids=["crowded", "apart"])
@pytest.mark.parametrize("kind", [*SIZES, 10, 30, "abc"])
def test_kinematics_and_law_are_identical_when_compiled(both, kind, scale_m):
    spaces = [space_of(way, kind) for way in both]
    laws = [way.control_law.ProportionalLaw(space) for way, space in zip(both, spaces, strict=True)]
    n, is_small, seen = spaces[0].n, kind in SIZES, set()
    rng, most = np.random.default_rng(10 + n), SAME
    for way, space in zip(both, spaces, strict=True):
        with pytest.raises(way.cluster_space.SingularClusterError):
            space.forward(np.ones((n, 3)), np.zeros(n))
    for _ in range(100 if is_small else 10):
        p_W, yaw = robots(n, rng, scale_m if is_small else 0.7)
        if not is_small:
            p_W += spaces[0].inverse(spaces[0].specimen(2.0))[0]
        c = spaces[0].forward(p_W, yaw)
        assert same(c, spaces[1].forward(p_W, yaw), most)
        for name in ("inverse_jacobian", "margin", "spread", *(() if is_small else ("condition",))):
            assert same(*(getattr(space, name)(c) for space in spaces), most=most), name
        assert same(*(space.wrapped(c * 3.0) for space in spaces), most=most)
        for one, other in zip(*(space.inverse(c) for space in spaces), strict=True):
            assert same(one, other, most)
        assert [type(space.margin(c)) for space in spaces] == [float, float]  # it is part of a message
        assert same(*(way.cluster_space.closest_pair(p_W) for way in both))
        v_W, c_des = rng.normal(size=(n, 3)), c + rng.normal(scale=rng.choice([0.01, 1.0]), size=4 * n)
        a, b = (law.command(c, p_W, v_W, c_des, np.zeros(4 * n), DT_S) for law in laws)
        assert same([*a.v_W.ravel(), *a.yaw_rate, a.factor], [*b.v_W.ravel(), *b.yaw_rate, b.factor], most)
        assert (a.guarded, a.alarmed) == (b.guarded, b.alarmed)
        assert same(*(law.integral for law in laws), most=most)
        cases = {"saturated": a.factor < 1.0, "free": a.factor == 1.0, "guarded": a.guarded, "alarmed": a.alarmed}
        seen |= {case for case, is_so in cases.items() if is_so}
    assert not is_small or seen >= {"saturated", "free", "guarded", *(["alarmed"] if scale_m == 1.0 else [])}


@pytest.mark.parametrize("n", SIZES)
def test_ramps_are_identical_when_compiled(both, n):
    rng = np.random.default_rng(20 + n)
    offsets = [rng.normal(size=4 * n) for _ in range(4)]
    for s in np.linspace(0.0, 1.0, 11).tolist():
        found = []
        for way in both:
            value, rate = np.empty(4 * n), np.empty(4 * n)
            way.trajectory.put_ramped(*offsets, s, 7.0, value, rate)
            found.append([*value, *rate])
        assert same(*found)


@pytest.mark.parametrize("n", SIZES)
def test_faults_of_places_are_identical_when_compiled(both, n):
    space, plain = (space_of(way, n) for way in both)
    rng, found = np.random.default_rng(40 + n), set()
    gains, limits = both[0].control_law.FormationGains(), both[0].flight_check.ShapeLimits()
    for _ in range(200):
        p_W, yaw = robots(n, rng)
        p_W[:, 2] += 6.0
        c = space.forward(p_W, yaw)
        faults = [
            way.flight_check.place_fault(of, c, gains, limits) for way, of in zip(both, (space, plain), strict=True)
        ]
        least_m = both[0].cluster_space.closest_pair(p_W)[0]
        assert faults[0] == faults[1]
        assert (faults[0] is None) == (least_m >= gains.separation_min_m and p_W[:, 2].min() >= limits.height_min_m)
        found.add("apart" if faults[0] and "apart" in faults[0] else bool(faults[0]))
    assert found == {"apart", True, False}


@pytest.mark.parametrize("n", SIZES)
def test_bounds_in_flight_agree_with_the_reported_faults(both, n):
    check, space = both[0].flight_check, space_of(both[0], n)
    limits = both[0].flight_check.ShapeLimits(spread_min_m=0.0, condition_max=math.inf)
    bounds, rng, found = check.bounds_of(space, limits), np.random.default_rng(50 + n), set()
    for _ in range(300):
        c = rng.uniform(0.01, 1.0, 4 * n)
        c[rng.choice(space.tilts)] = rng.uniform(-0.7, 0.7)
        if rng.random() < 0.3:
            c[rng.integers(4 * n)] = rng.choice(BAD)
        fault = check.shape_fault(space, c, limits)
        if fault is None or f"{space.spread_text} is" not in fault:
            assert (fault is None) == (check.first_outside(c, bounds) < 0)
            found.add(fault is None)
    assert found == {True, False}


BAD = (math.nan, math.inf, -math.inf, 1e7, 0.0, 1.7)


@pytest.mark.parametrize("n", SIZES)
def test_checks_of_estimates_are_identical_when_compiled(both, n):
    rng = np.random.default_rng(30 + n)
    bounds = space_of(both[0], n).bounds
    found = set()
    for _ in range(300):
        p_W, yaw = robots(n, rng)
        values = [np.full(n, 0.1), p_W, rng.normal(size=(n, 3)), yaw, np.full((n, 3), 0.2), np.full(n, 0.1)]
        spoiled = values[rng.integers(6)].reshape(-1)
        spoiled[rng.integers(spoiled.size)] = rng.choice(BAD)
        flaws = [way.flight_check.estimate_flaw(*values, 0.5, 1.0, 0.3) for way in both]
        assert flaws[0] == flaws[1]
        found.add(flaws[0][0])
        near = [way.flight_check.all_near(p_W, yaw) for way in both]
        assert near[0] == near[1] == bool((np.abs(p_W) < 1e6).all() and (np.abs(yaw) < 1e6).all())
        c = rng.uniform(0.1, 1.5, 4 * n)
        c[rng.integers(4 * n)] = rng.choice(BAD)
        outside = [way.flight_check.first_outside(c, bounds) for way in both]
        assert outside[0] == outside[1]
        out = ~((np.abs(c) < 1e6) & (bounds[:, 0] < c) & (c < bounds[:, 1]))
        assert outside[0] == (int(np.argmax(out)) if out.any() else -1)
    check = both[0].flight_check
    assert found == {check.VALID, check.STALE, check.NOT_FINITE, check.POSITION_UNCERTAIN, check.HEADING_UNCERTAIN}


FLIGHT = """
import sys
import numpy as np
from zsim_agents.formation.spaces.scenario_space import NestedCluster, cluster_space
from zsim_agents.formation.engagement_setup import _rehearse
from zsim_agents.formation.engagement import Engagement
from zsim_agents.formation.flight_check import GateInput
from zsim_agents.formation.flight_plan import MoveTo
from zsim_agents.formation.control_law import FormationGains, ProportionalLaw
from zsim_agents.formation.spaces.template_cluster import TemplateCluster

def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("zsim_agents.")]
    functions = {id(f): f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}
    return sum(len(f.signatures) for f in functions.values())

turn = np.pi / 5 * np.arange(10)
spaces = {
    "template": TemplateCluster(np.column_stack((9 * np.cos(turn), 9 * np.sin(turn), 0 * turn))),
    "nested": NestedCluster(cluster_space(3), [(name, cluster_space(3)) for name in "abc"]),
}
kind, gains = sys.argv[1], FormationGains()
space = spaces[kind] if kind in spaces else cluster_space(int(kind))
n = space.n
_rehearse(space, [f"d{i}" for i in range(space.n)], gains, ProportionalLaw)
before = compiled()
turn = 2 * np.pi * np.arange(n) / n
p_W, yaw = np.column_stack((9 * np.cos(turn), 9 * np.sin(turn), np.full(n, 9.0))), np.zeros(n)
if kind == "nested":
    p_W, yaw = space.inverse(space.specimen(5.0))
formation = Engagement(space, [str(i) for i in range(n)], gains)
for gate in range(20):
    still = np.zeros((n, 3))
    at = (gate * 0.02, p_W.copy(), yaw.copy(), still, still + 0.1, np.zeros(n), np.zeros(n), ("flying",) * n)
    if gate == 1:
        formation.warm_start("assembling", np.zeros(4 * n))
    elif gate == 5:
        formation.warm_start("engaged", space.forward(p_W, yaw))
    elif gate == 10:
        assert formation.request(MoveTo({"z_c": space.forward(p_W, yaw)[2] + 1.0})) is None
    output = formation.step(GateInput(*at))
print(output.phase, before, compiled())
"""


@pytest.mark.parametrize(
    "kind", ["3", "nested", *(pytest.param(each, marks=pytest.mark.soak) for each in ("2", "5", "template"))]
)
def test_nothing_is_compiled_in_flight_after_the_rehearsal(kind):
    run = [sys.executable, "-c", FLIGHT, kind]
    phase, before, after = subprocess.run(run, capture_output=True, text=True, check=True).stdout.split()
    assert phase == "engaged"
    assert int(before) > 10
    assert after == before
