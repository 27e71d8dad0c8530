"""Hunts over computed instead of simulated flights: draws, search and shrinking, in any order of completion."""

import csv
import random
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from refused import has_terms
from rich.console import Console

from zsim.errors import RunError, ScenarioError
from zsim.math.randomness import stream
from zsim.scenario.scenario import Scenario
from zsim.schema import yaml_file
from zsim_analysis.hunt import hunt as hunting
from zsim_analysis.hunt.hunt import SEARCH, TABLE, Hunted, HuntRequest, hunt
from zsim_analysis.hunt.requirements import Requirement
from zsim_analysis.hunt.space import HuntSpace
from zsim_analysis.sweep.sweep_run import Row, Task

DOCUMENT = yaml_file.parse(
    """
name: pair
seed: 7
duration_s: 40
drones: [{name: d1, position_m: [0, 0, 0]}, {name: d2, position_m: [3, 0, 0]}]
clusters: [{name: main, drones: [d1, d2], plan: {takeoff_s: 1}}]
""",
    "pair.yaml",
    "",
    ScenarioError,
)
KINDS = (
    "gps_dropout target=d1",
    "gust velocity_m_s=0..8 for_s=1..10",
    "link_delay delay_ms=20..200",
    "gps_bias value_m=0..3",
    "mag_noise",
    "sonar_stuck",
)
STRONG = 2.8  # least sum of the causes, of at most 3, for which the defect appears
DEFECT = {"gps_dropout", "gust", "link_delay"}


def gust_m_s(fault: dict[str, Any]) -> float:
    return sum(x * x for x in fault["velocity_m_s"]) ** 0.5


def separation_m(scenario: Scenario) -> float:
    """Return a separation that each cause reduces; only three strong ones together bring it below 1 m."""
    faults = {fault["kind"]: fault for fault in scenario.faults}
    strong = 0.0
    if "gust" in faults:
        strong += min(gust_m_s(faults["gust"]) / 6, 1.0)
    if "gps_dropout" in faults:
        strong += min(faults["gps_dropout"]["for_s"] / 12, 1.0)
    if "link_delay" in faults:
        strong += min(faults["link_delay"]["delay_ms"] / 150, 1.0)
    return 4.0 - strong - (0.5 if strong >= STRONG else 0.0)


def rows_of(hunted: Hunted) -> list[dict[str, str]]:
    return list(csv.DictReader((hunted.request.out / TABLE).read_text().splitlines()))


class FakePool:
    """A pool with several flights under way, any of which finishes first."""

    separation: Callable[[Scenario], float] = staticmethod(separation_m)
    stops_after: int | None = None  # number of flights after which Ctrl-C is pressed
    order = random.Random(1)

    def __init__(self, count: int, say: Callable[[str], None]) -> None:
        self._count = count

    def rows(self, tasks: Iterator[Task | None]) -> Iterator[Row]:
        held: list[Task] = []
        flown = 0
        while True:
            while len(held) < self._count and (task := next(tasks, None)) is not None:
                held.append(task)
            if not held:
                return
            task = held.pop(self.order.randrange(len(held)))
            if flown == self.stops_after:
                raise KeyboardInterrupt
            flown += 1
            yield self.row(task)

    def row(self, task: Task) -> Row:
        figures = {"min_separation_m": type(self).separation(task.scenario)}
        texts = task.judge.args[0]  # type: ignore[union-attr]
        made = [Requirement(text) for text in texts]
        faults = [fault for each in made for fault in each.faults(figures)]
        margins = [] if faults else [tuple(each.margin(figures)) for each in made]
        known = {"run": task.run, "failure": None, "truth_sha256": "", "shortfall": None}
        return {**known, "faults": faults, "margins": margins}


@pytest.fixture(scope="module")
def fly(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Hunted]]:
    """Hunt for a separation of 1 m, with other arguments of HuntRequest if given."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hunting, "ProcessPool", FakePool)

        def made(**more: Any) -> Hunted:
            request: dict[str, Any] = {
                "document": DOCUMENT, "source": "pair.yaml", "requirements": ("min_separation_m > 1",), "faults": KINDS,
                "out": tmp_path_factory.mktemp("hunt"), "flights": 3000, "workers": 1, "console": Console(quiet=True),
            }  # fmt: skip
            return hunt(HuntRequest(**{**request, **more}))

        yield made


@pytest.fixture(scope="module")
def whole(fly: Callable[..., Hunted]) -> Hunted:
    return fly()


def test_three_causes_are_found_and_everything_else_is_removed(whole: Hunted) -> None:
    found = whole.summary.violation
    assert found is not None
    faults = {fault["kind"]: fault for fault in found.shrunk.faults}
    assert set(faults) == DEFECT
    assert found.shrunk.values == {}
    strong = [gust_m_s(faults["gust"]) / 6, faults["gps_dropout"]["for_s"] / 12, faults["link_delay"]["delay_ms"] / 150]
    assert STRONG <= sum(strong) < STRONG + 0.1
    assert found.shrunk.duration_s is not None
    assert found.shrunk.duration_s < DOCUMENT["duration_s"]
    assert [each.without is not None and each.without > 0 for each in found.causes] == [True] * 3
    assert [each.alone is not None and each.alone > 0 for each in found.causes] == [True] * 3
    assert found.margin is not None
    assert found.margin < 0


def test_a_hunt_is_determined_by_its_seed_in_any_order_of_completion(fly: Callable[..., Hunted], whole: Hunted) -> None:
    other = fly(workers=7)
    assert whole.summary.verdict == "violated"
    assert [(each.stage, each.case) for each in whole.flown] == [(each.stage, each.case) for each in other.flown]
    assert whole.summary.violation == other.summary.violation
    shorter, third = fly(flights=20), fly(flights=20, seed=2)
    assert [each.case for each in shorter.flown] == [each.case for each in whole.flown[:20]]
    assert whole.flown[1].case != third.flown[1].case


def test_search_near_low_margins_needs_fewer_flights_than_random_draws(
    fly: Callable[..., Hunted], whole: Hunted
) -> None:
    counts = [sum(each.stage == SEARCH for each in one.flown) for one in (whole, fly(seed=0), fly(seed=2))]
    space, drawn = HuntSpace(DOCUMENT, "pair.yaml", KINDS), 2000
    hits = 0
    for number in range(drawn):
        rng = stream(3, f"alone/{number}")
        kinds = rng.choice(sorted(space.kinds), 3, replace=False)
        faults = [space.kinds[str(kind)].draw(rng) for kind in kinds]
        hits += separation_m(SimpleNamespace(faults=faults)) <= 1  # type: ignore[arg-type]
    assert sum(counts) / len(counts) < drawn / max(hits, 1) / 3


def test_a_requirement_that_holds_is_tried_with_all_pairs_and_triples(
    fly: Callable[..., Hunted], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakePool, "separation", staticmethod(lambda _: 3.0))
    hunted = fly(flights=60)
    assert (hunted.summary.verdict, hunted.summary.flights) == ("not violated", 60)
    assert [(each.together, each.tried, each.possible) for each in hunted.summary.coverage] == [
        (1, 6, 6),
        (2, 15, 15),
        (3, 20, 20),
    ]
    flown = {tuple(sorted(three)) for each in hunted.flown for three in combinations(each.case.kinds, 3)}
    assert len(flown) == 20
    assert hunted.summary.least == [2.0]
    rows = rows_of(hunted)
    assert [int(row["flight"]) for row in rows] == list(range(60))
    assert rows[0]["faults"] == ""


def test_a_violation_without_faults_needs_no_causes(
    fly: Callable[..., Hunted], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakePool, "separation", staticmethod(lambda _: 0.5))
    found = fly().summary.violation
    assert found is not None
    assert (found.number, found.shrunk.faults, found.shrunk.values, found.causes) == (0, (), {}, [])


@pytest.mark.parametrize(("stops_after", "verdict"), [(5, "interrupted"), (None, "violated")])
def test_ctrl_c_keeps_the_results_so_far(
    fly: Callable[..., Hunted], whole: Hunted, monkeypatch: pytest.MonkeyPatch, stops_after: int | None, verdict: str
) -> None:
    if stops_after is None:
        stops_after = sum(each.stage == SEARCH for each in whole.flown) + 10  # while it shrinks
    monkeypatch.setattr(FakePool, "stops_after", stops_after)
    hunted = fly()
    assert (hunted.summary.verdict, hunted.summary.interrupted) == (verdict, True)
    assert len(rows_of(hunted)) == len(hunted.flown) <= stops_after


def test_an_invalid_draw_is_skipped_and_the_hunt_continues(fly: Callable[..., Hunted]) -> None:
    path = "environment.wind.gust_m_s"
    hunted = fly(vary=(f"{path}=normal(0, 1)",), requirements=("min_separation_m > -9",), flights=60)
    drawn = [each.case.values[path] for each in hunted.flown[1:]]
    assert 10 < len(drawn) < 59
    assert min(drawn) >= 0.0
    assert hunted.summary.verdict == "not violated"


def test_the_folder_of_a_hunt_is_not_reused_unless_forced(fly: Callable[..., Hunted], tmp_path: Path) -> None:
    fly(flights=3, out=tmp_path / "a")
    with pytest.raises(RunError) as error:
        fly(flights=3, out=tmp_path / "a")
    assert has_terms(str(error.value), str(tmp_path / "a"), "--force")
    assert fly(flights=4, out=tmp_path / "a", force=True).summary.flights == 4


@pytest.mark.parametrize(
    ("more", "terms"),
    [
        ({"requirements": ()}, ("--require", "missing")),
        ({"requirements": ("min_separation > 1",)}, ("--require", "min_separation", "min_separation_m?")),
        ({"faults": ("gps_dropuot",)}, ("--fault", "'gps_dropuot'", "gps_dropout?")),
        ({"without": ("gusts",)}, ("--without", "'gusts'", "gust?")),
        ({"faults": ("gust velocity_m_s=0..900",)}, ("--fault", "velocity_m_s", "[900.0, 0.0, 0.0]", "100")),
        ({"faults": ("gust velocity_m_s=3..1",)}, ("--fault", "velocity_m_s", "'3..1'", "LOW", "HIGH")),
        ({"faults": ("gust speed=3..4",)}, ("--fault", "speed", "velocity_m_s")),
        ({"faults": ("gps_dropout target=d9",)}, ("--fault", "target", "'d9'", "d1", "d2")),
        ({"faults": ("rotor_stuck rotor=1..2",)}, ("--fault", "rotor", "'1..2'", "choice")),
        ({"faults": ("gust velocity",)}, ("--fault", "'gust velocity'", "NAME=VALUE")),
        ({"vary": ("seed=1,2",)}, ("--vary", "'seed=1,2'")),
        ({"vary": ("wind.gust_m_s=uniform(2)",)}, ("--vary", "uniform(2)")),
        ({"vary": ("environment.wind.gust_m_s=0,much",)}, ("--vary", "environment.wind.gust_m_s", "'much'")),
        ({"vary": ("environment.wind.gust_m_s=uniform(-1, 2)",)}, ("--vary", "environment.wind.gust_m_s", "-1.0")),
        # hardly any draw is a valid mass
        ({"vary": ("drones[0].mass_kg=normal(0.4, 1e7)",), "faults": ()}, ("drones[0].mass_kg", "100")),
    ],
)
def test_an_invalid_hunt_request_is_refused(
    fly: Callable[..., Hunted], more: dict[str, Any], terms: tuple[str, ...]
) -> None:
    with pytest.raises(ScenarioError) as error:
        fly(**more)
    assert any(has_terms(fault, *terms) for fault in error.value.faults), error.value.faults
