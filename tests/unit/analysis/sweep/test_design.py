"""The design of a sweep: axes, combinations, random draws, and the report of all faults at once."""

import copy
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from refused import has_terms, refused

from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim_analysis.sweep.design import (
    Draw,
    Grid,
    Seeds,
    SweepDesign,
    SweepPlan,
    difference,
    field_path,
    is_inside,
    make_plan,
    parse,
    read_document,
)

STEP = Path(__file__).parents[4] / "scenarios/step.yaml"
GUST = "environment.wind.gust_m_s"
GAINS = "clusters.main.gains={proportional_1_s: 0.5},{proportional_1_s: 0.7}"


def plan(*vary: str, runs: int | None = None, **values: Any) -> SweepPlan:
    document, faults = read_document(STEP, [], **values)
    assert faults == []
    return make_plan(STEP.name, document, list(vary), runs)


def faults(*vary: str, runs: int | None = None, **values: Any) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        plan(*vary, runs=runs, **values)
    return caught.value.faults


@pytest.mark.parametrize(
    ("text", "axis"),
    [
        ("seed", Seeds()),
        ("seed=paired", Seeds(paired=True)),
        ("seed=1,2", Seeds(paired=True, values=(1, 2))),
        ("environment.wind.gust_m_s=0,1.5,2", Grid(GUST, (0, 1.5, 2))),
        ("drones.drone1.position_m=[0,0,0],[1, 0, 0]", Grid("drones.drone1.position_m", ([0, 0, 0], [1, 0, 0]))),
        ("sensors.preset=paper,ardrone2", Grid("sensors.preset", ("paper", "ardrone2"))),
        ("estimation.flow=true,false", Grid("estimation.flow", (True, False))),
        ("a.b=uniform(0,2)", Draw("a.b", "uniform", 0.0, 2.0)),
        ("a.b= normal(-1e-3, 0.5) ", Draw("a.b", "normal", -1e-3, 0.5)),
    ],
)
def test_variations_are_parsed(text: str, axis: Seeds | Grid | Draw) -> None:
    assert parse(text) == axis


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("wind", ("not a variation", "seed", "a.b.c=v1,v2…")),
        ("=1", ("not a variation",)),
        ("duration_s=", ("no value",)),
        ("duration_s=[1", ("YAML",)),
        ("duration_s=5,5.0", ("5", "twice")),
        ("duration_s=triangle(1,2)", ("triangle", "uniform(low,high)", "normal(mean,std)")),
        ("seed=1,-2", ("-2", ">=", "0", "seed=paired")),
        ("seed=1,1", ("1", "twice")),
        ("seed=two", ("'two'", "whole number", "seed=paired")),
        ("duration_s=uniform(2,1)", ("finite", "low", "<", "high")),
        ("duration_s=uniform(1)", ("two numbers",)),
        ("duration_s=normal(1,0)", ("finite", "std", ">", "0")),
        ("duration_s=normal(nan,1)", ("finite",)),
        ("wind.gust_m_s=uniform(-1e308,1e308)", ("finite", "<", "finite")),
    ],
)
def test_an_invalid_variation_is_refused_with_the_reason(text: str, terms: tuple[str, ...]) -> None:
    (fault,) = faults(text)
    assert fault.startswith(f"--vary {text}: ")
    assert has_terms(fault, *terms)


def test_runs_are_distributed_evenly_over_all_combinations() -> None:
    design = SweepDesign(plan("seed", "wind.gust_m_s=0,1,2", "estimation.flow=true,false", runs=20))
    assert design.points == 6
    flown = [(design.values(run)[GUST], design.values(run)["estimation.flow"]) for run in range(20)]
    assert flown[:6] == [(0, True), (0, False), (1, True), (1, False), (2, True), (2, False)]
    assert set(Counter(flown).values()) == {3, 4}
    assert [design.point_values(point) for point in range(6)] == [
        {GUST: gust, "estimation.flow": flow} for gust in (0, 1, 2) for flow in (True, False)
    ]
    assert plan("wind.gust_m_s=0,1,2", "estimation.flow=true,false").runs == 6


def test_the_scenario_of_a_run_equals_that_of_overrides() -> None:
    design = SweepDesign(plan("seed", "wind.gust_m_s=0,1", "drones.drone2.mass_kg=uniform(0.4,0.5)", runs=5))
    values = design.values(3)
    overrides = [f"{GUST}={values[GUST]}", f"drones.drone2.mass_kg={values['drones.drone2.mass_kg']!r}"]
    assert design.scenario(3) == scenario_file.load(STEP, overrides, seed=values["seed"])
    assert design.varied == [GUST, "drones.drone2.mass_kg"]


def test_seeds_are_distinct_and_a_longer_sweep_begins_with_the_same() -> None:
    short, long = Seeds().draw(7, 50), Seeds().draw(7, 20_000)
    assert long[:50] == short
    assert len(set(long)) == 20_000
    assert Seeds().draw(8, 50) != short
    design = SweepDesign(plan("seed", runs=3, seed=7))
    assert [design.scenario(run).seed for run in range(3)] == short[:3]


def test_paired_seeds_and_draws_are_the_same_for_every_combination() -> None:
    mass = "drones.drone2.mass_kg"
    design = SweepDesign(plan("seed=paired", "wind.gust_m_s=0,1,2", f"{mass}=uniform(0.4,0.5)", runs=6, seed=7))
    values = [design.values(run) for run in range(6)]
    assert [each[GUST] for each in values] == [0, 1, 2, 0, 1, 2]
    assert [each["seed"] for each in values] == [seed for seed in Seeds().draw(7, 2) for _ in range(3)]
    drawn_kg = Draw(mass, "uniform", 0.4, 0.5).draw(7, 2)
    assert [each[mass] for each in values] == [kg for kg in drawn_kg for _ in range(3)]
    assert [design.scenario(run).seed for run in range(6)] == [each["seed"] for each in values]


def test_given_seeds_are_flown_at_every_combination() -> None:
    given = plan("wind.gust_m_s=0,1", "seed=5,9,2")
    design = SweepDesign(given)
    assert (given.runs, design.points, design.paired) == (6, 2, True)
    flown = [(design.values(run)["seed"], design.values(run)[GUST]) for run in range(6)]
    assert flown == [(5, 0), (5, 1), (9, 0), (9, 1), (2, 0), (2, 1)]
    assert has_terms(faults("wind.gust_m_s=0,1", "seed=5,9,2", runs=7)[0], "--runs", "7", "6")


def test_the_section_of_the_one_cluster_may_be_left_out() -> None:
    design = SweepDesign(plan("gains.proportional_1_s=0.4,0.8", "plan.takeoff_s=2"))
    assert design.varied == ["clusters.main.gains.proportional_1_s", "clusters.main.plan.takeoff_s"]
    assert [design.scenario(run).clusters[0].gains.proportional_1_s for run in range(2)] == [0.4, 0.8]
    assert difference(plan("gains.proportional_1_s=0.4"), plan("clusters.main.gains.proportional_1_s=0.4")) is None
    document, _ = read_document(STEP, [])
    document["clusters"].append({"name": "other", "drones": ["drone1", "drone2"]})
    with refused(ScenarioError, "gains.proportional_1_s=0.4", "2", "clusters.main.gains.proportional_1_s"):
        make_plan(STEP.name, document, ["gains.proportional_1_s=0.4"], None)


def test_draws_follow_their_distribution_independently_of_each_other() -> None:
    uniform, normal = Draw("a", "uniform", -1.0, 3.0), Draw("b", "normal", 5.0, 0.5)
    u, n = np.array(uniform.draw(1, 20_000)), np.array(normal.draw(1, 20_000))
    assert u.min() >= -1
    assert u.max() < 3
    assert u.mean() == pytest.approx(1.0, abs=4 * (4 / 12**0.5) / 20_000**0.5)
    assert n.mean() == pytest.approx(5.0, abs=4 * 0.5 / 20_000**0.5)
    assert n.std() == pytest.approx(0.5, abs=4 * 0.5 / (2 * 20_000) ** 0.5)
    assert uniform.draw(1, 7) == u[:7].tolist()
    assert normal.draw(1, 7) == n[:7].tolist()
    path, density = "environment.height_m", "environment.air_density_kg_m3=normal(1.2,0.01)"
    one = SweepDesign(plan(f"{path}=uniform(0,9)", runs=4))
    two = SweepDesign(plan(density, f"{path}=uniform(0,9)", runs=4))
    assert [one.values(run)[path] for run in range(4)] == [two.values(run)[path] for run in range(4)]


def test_all_faults_are_reported_at_once_before_any_run() -> None:
    found = faults("seed", "wind.gust_m_s=0,-1,-2", "wings=1,2", "estimation.flow", "drones.drone9.mass_kg=1", runs=30)
    assert len(found) == 4
    assert has_terms(found[0], "--vary estimation.flow", "not a variation")
    assert has_terms(found[1], "--vary drones.drone9.mass_kg=1", "drone9", "drones")
    assert has_terms(found[2], "step.yaml", "wings", "known")
    assert has_terms(found[3], "step.yaml", GUST, "-1")
    found = faults("seed", "wind.gust_m_s=0,-1,-2", "duration_s=5,nan", "seed=3", runs=30)
    assert len(found) == 3
    assert has_terms(found[0], "--vary seed=3", "seed", "already", "seed")
    assert has_terms(found[1], "step.yaml", "duration_s", "'nan'")
    assert has_terms(found[2], "step.yaml", GUST, "-1", "4", "6", f"{GUST}=-1", "duration_s=5")
    assert has_terms(faults("seeds=1,2")[0], "seeds", "mean", "seed", "allowed")
    assert has_terms(faults("wind.gust=1")[0], "environment.wind.gust", "mean", "gust_m_s", "allowed")
    assert len(faults("duration_s=uniform(2,1)", "wind.gust_m_s=0,1,2", runs=2)) == 2
    body = {"drones": [{"name": "d1", "position_m": [0, 0, 0], "body": "external"}]}
    with refused(ScenarioError, "d1", "external", "lockstep"):
        make_plan("t.yaml", {"name": "t", "duration_s": 1, **body}, ["seed"], 2)
    body = {"drones": [{"name": "d1", "position_m": [0, 0, 0]}], "programs": {"my.look": {"command": ["look"]}}}
    body |= {"processes": {"gating": ["camera"]}}
    with pytest.raises(ScenarioError) as raised:
        make_plan("t.yaml", {"name": "t", "duration_s": 1, **body}, ["seed"], 2)
    gating, programs = raised.value.faults
    assert has_terms(gating, "processes.gating")
    assert has_terms(programs, "programs", "my.look")


def test_a_fault_of_the_file_is_reported_once() -> None:
    (fault,) = faults("seed", "wind.gust_m_s=0,1", runs=9, duration_s=-1)
    assert has_terms(fault, "step.yaml", "duration_s", "-1")
    assert has_terms(faults("seed", runs=3, seed=-4)[0], "seed", "-4")


def test_every_drawn_value_is_checked() -> None:
    (fault,) = faults("seed", "drones.drone1.battery_percent=uniform(99,101)", runs=40)
    path = "drones.drone1.battery_percent"
    design = SweepDesign(SweepPlan(source="", document={}, vary=(f"{path}=uniform(99,101)",), runs=40))
    too_much = [run for run in range(40) if design.values(run)[path] > 100]
    assert 0 < len(too_much) < 40
    limits = ("drones[0].battery_percent", ">=", "0", "<=", "100")
    assert has_terms(fault, *limits, str(len(too_much)), "40", f"{path}=100.…")


@pytest.mark.parametrize(
    ("vary", "runs", "terms"),
    [
        (["wind.gust_m_s=0,1,2"], 2, ("--runs", "2", "3")),
        (["wind.gust_m_s=0,1,2"], 4, ("--runs", "4", "3")),
        ([], 2, ("--runs", "2", "--vary seed")),
        (["seed"], 2_000_000, ("--runs", "2000000", "1000000")),
    ],
)
def test_an_invalid_number_of_runs_is_refused(vary: list[str], runs: int, terms: tuple[str, ...]) -> None:
    (fault,) = faults(*vary, runs=runs)
    assert has_terms(fault, *terms)


def test_plans_that_differ_only_in_more_runs_are_the_same_sweep() -> None:
    one = plan("seed", "wind.gust_m_s=0,1", runs=4)
    other = copy.deepcopy(one.document)
    other["duration_s"] = 5
    assert difference(one, msgspec.structs.replace(one, runs=8)) is None
    assert difference(one, plan("seed", f"{GUST}=0,1", runs=4)) is None
    for changed, *terms in (
        ({"runs": 2}, "4 runs", "2"),
        ({"vary": ("seed",)}, "seed wind.gust_m_s=0,1", "seed"),
        ({"vary": ("seed", f"{GUST}=0,2")}, "wind.gust_m_s=0,1", f"{GUST}=0,2"),
        ({"document": other}, "different", "duration_s"),
        ({"records": True}, "records"),
        ({"version": "9"}, "9"),
    ):
        assert has_terms(difference(one, msgspec.structs.replace(one, **changed)) or "", *terms)
    assert msgspec.json.decode(msgspec.json.encode(one), type=SweepPlan) == one


@pytest.mark.parametrize(
    ("first", "second", "terms"),
    [
        ("drones.drone2.mass_kg=0.40,0.45", "drones[1].mass_kg=0.42,0.43", ("drones[1].mass_kg", "already")),
        ("drones[0].mass_kg=uniform(0.4,0.5)", "drones[drone1].mass_kg=0.42", ("drones[drone1].mass_kg", "already")),
        (GAINS, "clusters[0].gains.proportional_1_s=0.6,0.4", ("clusters[0].gains.proportional_1_s", "part")),
        ("wind.gust_m_s=0,1", "environment.wind={gust_m_s: 2}", ("environment.wind", "contains")),
    ],
)
def test_a_field_varied_twice_by_different_names_is_refused(first: str, second: str, terms: tuple[str, ...]) -> None:
    (fault,) = faults(first, second)
    assert has_terms(fault, f"--vary {second}", *terms, first)
    assert plan(first).vary == (first,)
    assert plan(second).vary == (second,)


def test_all_names_of_a_field_give_the_same_path() -> None:
    document = {"drones": [{"name": "a"}, {"name": "b.c"}, 3], "seed": 1}
    for path, steps in {
        "drones.a.mass_kg": ("drones", 0, "mass_kg"),
        "drones[b.c].mass_kg": ("drones", 1, "mass_kg"),
        "drones.01.mass_kg": ("drones", 1, "mass_kg"),
        "drones[2].x.y": ("drones", 2, "x", "y"),
        "drones.nobody.x": ("drones", "nobody", "x"),
        "wind.gust_m_s": ("environment", "wind", "gust_m_s"),
        "seed.x": ("seed", "x"),
    }.items():
        assert field_path(document, path) == steps
    assert is_inside(("a", 1, "b"), ("a", 1))
    assert not is_inside(("a", 1), ("a", 1))
    assert not is_inside(("a", 1), ("a", 1, "b"))


def test_a_run_does_not_change_the_values_of_an_axis() -> None:
    """Two axes of one field are refused, so only an unchecked plan can set a part of a value."""
    document, _ = read_document(STEP, [])
    gains, part = "clusters.main.gains={proportional_1_s: 0.5}", "clusters.main.gains.proportional_1_s=0.6"
    design = SweepDesign(SweepPlan(source=STEP.name, document=document, vary=(gains, part), runs=1))
    assert design.scenario(0).clusters[0].gains.proportional_1_s == 0.6
    assert design.values(0)["clusters.main.gains"] == {"proportional_1_s": 0.5}


@pytest.mark.parametrize("name", ["stüp.yaml", b"st\xfcp.yaml".decode(errors="surrogateescape")])
def test_a_file_may_have_any_name(name: str) -> None:
    document, _ = read_document(STEP, [])
    of = make_plan(name, document, ["seed"], 2)
    assert of.source == ("stüp.yaml" if name.isprintable() else "st\ufffdp.yaml")
    assert msgspec.json.decode(msgspec.json.encode(of), type=SweepPlan) == of


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("x=1,2.5,true,paper", ["1", "2.5", "true", "paper"]),
        ("x=1000000.1,1000000.2", ["1000000.1", "1000000.2"]),
        ("x=[{kind: gps_dropout, target: d1}],[{kind: gps_dropout, target: d2}]", ['…"d1"}]', '…"d2"}]']),
        ("x=true,'true'", ["true (1)", "true (2)"]),
        (f"x={'a' * 30},{'a' * 30}b,c", [f"{'a' * 23}… (1)", f"{'a' * 23}… (2)", "c"]),
    ],
)
def test_values_of_a_field_have_distinct_names(text: str, names: list[str]) -> None:
    grid = parse(text)
    assert isinstance(grid, Grid)
    assert grid.names == names
