"""Radio links between drones: graphs, distance, reception, lines of sight and nearest neighbours."""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from zsim.contract.run_messages import Fault, RadioLinks
from zsim.errors import ScenarioError
from zsim.scenario import scenario_file
from zsim.scenario.scenario import RECEPTION_MIN
from zsim.scenario.surroundings import packed, sheet_of
from zsim_world.fleet.radio import RadioChannel
from zsim_world.physics.rays import scene
from zsim_world.physics.surfaces import obstacle_rows

LINE_M = [[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [7.0, 0.0, 2.0], [16.0, 0.0, 2.0]]
WALL = {"name": "wall", "shape": "box", "position_m": [5.5, 0, 0], "size_m": [0.2, 3, 4]}


def scenario(**sections: Any) -> Any:
    drones = [{"name": f"d{i}", "position_m": [x, 0, 0]} for i, (x, _, _) in enumerate(LINE_M)]
    return scenario_file.resolve({"name": "t", "duration_s": 1, "drones": drones, **sections})


def links(faults: Iterable[Fault] = (), **sections: Any) -> RadioLinks:
    made = scenario(**sections)
    around = scene(obstacle_rows(made.environment), sheet_of(made.environment).triangle)
    return RadioChannel(made, around).links(0, 0, np.array(LINE_M), faults)


@pytest.mark.parametrize(
    ("sections", "hears"),
    [
        ({"topology": "complete"}, ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))),
        ({"topology": "ring"}, ((1, 3), (0, 2), (1, 3), (0, 2))),
        ({"topology": "path"}, ((1,), (0, 2), (1, 3), (2,))),
        ({"topology": {"d1": ["d0", "d3"], "d2": []}}, ((), (0, 3), (), ())),
        ({"topology": {"graph": {"d1": ["d0", "d3"]}, "symmetric": True}}, ((1,), (0, 3), (), (1,))),
        ({"topology": {"within_m": 4}}, ((1,), (0, 2), (1,), ())),
        ({"topology": {"nearest": 1}}, ((1,), (2,), (1,), (2,))),
        ({"topology": {"nearest": 1, "symmetric": True}}, ((1,), (0, 2), (1, 3), (2,))),
        ({"topology": {"nearest": 2, "within_m": 7.5}}, ((1, 2), (0, 2), (0, 1), ())),
        ({"radio": {"range_m": 9}}, ((1, 2), (0, 2), (0, 1, 3), (2,))),
        ({"radio": {"range_m": 9}, "topology": "ring"}, ((1,), (0, 2), (1, 3), (2,))),
        (
            {"radio": {"range_m": 9, "line_of_sight": True}, "environment": {"obstacles": [WALL]}},
            ((1,), (0,), (3,), (2,)),
        ),
        ({"radio": {"range_m": 9, "station_m": [12, 0, 0]}}, ((1, 2), (0, 2, 4), (0, 1, 3, 4), (2, 4), (1, 2, 3))),
    ],
)
def test_the_topology_and_the_radio_determine_the_links(
    sections: dict[str, Any], hears: tuple[tuple[int, ...], ...]
) -> None:
    made = links(**sections)
    assert made.hears == hears
    assert made.reception == ()


def test_reception_falls_with_distance_until_drones_are_not_neighbours() -> None:
    made = links(radio={"range_m": 7, "spread_m": 1.0})
    assert made.hears == ((1, 2), (0, 2, 3), (0, 1, 3), (1, 2))  # 12 m: .0067; 16 m: 1.2e-4 < RECEPTION_MIN
    at = dict(zip(made.hears[1], made.reception[1], strict=True))
    assert at == pytest.approx({each: 1 / (1 + math.exp(d - 7)) for each, d in ((0, 4.0), (2, 3.0), (3, 12.0))})
    assert min(map(min, made.reception)) > RECEPTION_MIN


def hill(crest_m: float) -> dict[str, Any]:
    """Return a height map that rises from 0 at x = 4.5 m to a crest at x = 5.5 m and falls to 0 at 6.5 m."""
    corners = [[(x, y, crest_m if x == 5.5 else 0.0) for y in (-3.0, 3.0)] for x in (4.5, 5.5, 6.5)]
    faces = [face for (a, b), (c, d) in pairwise(corners) for face in ((a, b, c), (b, d, c))]
    return {"surfaces": [{"name": "hill", "triangles": packed(np.array(faces))}]}


@pytest.mark.parametrize(
    ("environment", "is_between"),
    [
        (hill(2.001), True),
        (hill(1.999), False),
        (
            {"surfaces": [{"name": "wall", "triangles": packed(np.array([[[5.5, -9, 0], [5.5, 9, 0], [5.5, 0, 9]]]))}]},
            True,
        ),
        (
            {"surfaces": [{"name": "wall", "triangles": packed(np.array([[[5.5, 1, 0], [5.5, 9, 0], [5.5, 9, 9]]]))}]},
            False,
        ),
    ],
    ids=["a hill to the line", "a hill below it", "a wall", "a wall beside it"],
)
def test_a_surface_blocks_the_lines_of_sight_that_cross_it(environment: dict[str, Any], is_between: bool) -> None:
    """d0 and d1 are on one side, d2 and d3 on the other, all at 2 m; d3 is 9 m from d2 and out of the others' range."""
    hears = ((1,), (0,), (3,), (2,)) if is_between else ((1, 2), (0, 2), (0, 1, 3), (2,))
    assert links(radio={"range_m": 9, "line_of_sight": True}, environment=environment).hears == hears


def test_radio_faults_lower_the_reception_of_their_target_drones() -> None:
    def fault(number: int, target: str, range_m: float, spread_m: float, kind: str = "radio") -> Fault:
        return Fault(number, kind, target, {"range_m": range_m, "spread_m": spread_m, "place": {}}, 0, None, "test")

    acting = (fault(1, "main", 4, 2), fault(2, "world", 9, 3), fault(3, "world", 1, 1, "link_cut"))
    clusters = [{"name": "main", "drones": ["d0", "d1"]}]
    made = links(acting, radio={"range_m": 20}, clusters=clusters)
    for hearer, (heard, chances) in enumerate(zip(made.hears, made.reception, strict=True)):
        for sender, chance in zip(heard, chances, strict=True):
            d = abs(LINE_M[hearer][0] - LINE_M[sender][0])
            of_main = 1 / (1 + math.exp((d - 4) / 2)) if {0, 1} & {hearer, sender} else 1.0
            assert chance == pytest.approx(of_main / (1 + math.exp((d - 9) / 3)))
    assert made.hears == ((1, 2), (0, 2, 3), (0, 1, 3), (1, 2))  # d0 and d3: 16 m, 2.2e-4 < RECEPTION_MIN


def test_an_obstacle_beside_the_line_of_sight_does_not_block_it() -> None:
    beside = {**WALL, "position_m": [5.5, 1.6, 0]}
    radio = {"range_m": 9, "line_of_sight": True}
    assert links(radio=radio, environment={"obstacles": [beside]}).hears == links(radio={"range_m": 9}).hears


@pytest.mark.parametrize(
    ("sections", "field", "value"),
    [
        ({"topology": "star"}, "topology", "star"),
        ({"topology": {"d0": ["d9"]}}, "topology.d0[0]", "d9"),
        ({"topology": {"d0": ["d0"]}}, "topology.d0[0]", "d0"),
        ({"topology": {"d9": ["d0"]}}, "topology.d9", "d9"),
        ({"topology": {"graph": {"d0": ["d9"]}}}, "topology.graph.d0[0]", "d9"),
        ({"topology": {"nearest": 0}}, "topology.nearest", "0"),
        ({"topology": {"within_m": -1}}, "topology.within_m", "-1"),
        ({"topology": {"radius_m": 3}}, "topology.radius_m", "within_m"),
        ({"radio": {"range_m": 0}}, "radio.range_m", "0"),
        ({"radio": {"loss": 1.5}}, "radio.loss", "1.5"),
        ({"radio": {"delay_ms": -2}}, "radio.delay_ms", "-2"),
        ({"radio": {"bandwidth_kbit_s": 0}}, "radio.bandwidth_kbit_s", "0"),
        ({"radio": {"queue_max": 0}}, "radio.queue_max", "0"),
        ({"radio": {"station_m": [1, 2]}}, "radio.station_m", "[1, 2]"),
    ],
)
def test_a_faulty_section_is_refused_with_its_path(sections: dict[str, Any], field: str, value: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        scenario(**sections)
    (line,) = raised.value.faults
    assert f": {field} " in line
    assert value in line
