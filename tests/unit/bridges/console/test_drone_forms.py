"""How a page sorts and filters its drones, and selects several of them for one command."""

from typing import Any

import pytest
from fake_gui import Gui

from zsim_bridges.console.alarms import DroneCondition
from zsim_bridges.console.console_page import FILTERS, MANY, NO_ROW, SORTINGS, Filtered, FleetTable
from zsim_bridges.console.console_tables import DroneRow, drone_table


def row(
    name: str, faults: tuple[str, ...] = (), link: Any = ("", ""), severity: Any = None, **changes: Any
) -> DroneRow:
    drone = DroneCondition(name, "flying", 80.0, 5.0, 0.1, commander="controller.main")._replace(**changes)
    return DroneRow(drone, "9 / 1", faults, link, severity)


LOST = {"is_external": True, "link_state": "lost", "link_age_s": 0.0}
ROWS = [
    row("drone1", sigma_m=0.3),
    row("drone2", battery_percent=15.0, severity="amber"),
    row("drone3", battery_percent=8.0, severity="red", state="landing", faults=("gps_dropout",)),
    row("drone4", sigma_m=None, severity="red", link=("external; lost: 10.0.0.4", "red"), **LOST),
    row("drone5", state="landed", commander=None, battery_percent=60.0, lag_ms=80.0, sigma_m=2.5),
]


def names(rows: list[DroneRow]) -> list[str]:
    return [each.name.removeprefix("drone") for each in rows]


@pytest.mark.parametrize(
    ("order", "expected"),
    [
        ("as in the scenario", "12345"),
        ("worst first", "34251"),
        ("battery, lowest first", "32514"),
        ("link, worst first", "45123"),
        ("σ, largest first", "45123"),
    ],
)
def test_rows_are_sorted_the_worst_first(order: str, expected: str):
    assert "".join(names(Filtered(order).rows(ROWS))) == expected


@pytest.mark.parametrize(
    ("choice", "text", "expected"),
    [
        ("all", "", "12345"),
        ("with an alarm", "", "234"),
        ("on the ground", "", "5"),
        ("in the air", "", "1234"),
        ("battery low", "", "23"),
        ("selected", "", "15"),
        ("all", "Drone4", "4"),
        ("all", "gps", "3"),
        ("all", "nobody", "5"),
        ("all", "lost external", "4"),
        ("with an alarm", "landing", "3"),
        ("all", "drone1 landed", ""),
    ],
)
def test_rows_are_filtered(choice: str, text: str, expected: str):
    assert "".join(names(Filtered(choice=choice, text=text).rows(ROWS, frozenset({"drone1", "drone5"})))) == expected


def test_every_order_and_choice_is_tried():
    assert len(SORTINGS) == 5
    assert len(FILTERS) == 6


@pytest.mark.parametrize(("count", "order"), [(MANY, "as in the scenario"), (MANY + 1, "worst first")])
def test_of_many_drones_the_worst_stand_first(count: int, order: str):
    gui: Any = Gui()
    FleetTable(gui, [f"drone{i}" for i in range(count)], lambda: None)
    assert gui.at["sort by"].value == order


def test_drones_are_selected_one_by_one_and_as_they_are_shown():
    gui: Any = Gui()
    seen: list[list[str]] = []
    table = FleetTable(gui, [each.name for each in ROWS], lambda: seen.append(table.selected))
    table.toggle("drone3")
    table.toggle("drone1")
    table.toggle("stranger")
    assert seen == [["drone3"], ["drone1", "drone3"]]
    table.toggle("drone3")
    gui.at["show"].value = "battery low"
    table.show(ROWS, {}, "drone2")
    gui.at["select"].press()
    assert table.selected == ["drone1", "drone2", "drone3"]
    table.show(ROWS, {}, "drone2")
    html = str(table.table.content)
    assert html.count("aria-checked=true") == 2
    assert html.count("data-zsim-chosen") == 2  # both rows of the drone whose instruments are shown
    gui.at["filter"].value = "nothing like that"
    table.show(ROWS, {}, "drone2")
    assert NO_ROW in str(table.table.content)
    gui.at["select"].value = "none"
    gui.at["select"].press()
    assert table.selected == []


def test_a_name_is_no_html():
    assert "<script>" not in drone_table([row("<script>'")], selected=("<script>'",))
