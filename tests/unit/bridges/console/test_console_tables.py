"""Tables of the console: sensor rates, escaped texts, the sorting and filtering of drones, and the event log."""

import re
from typing import Any

import pytest
from fake_gui import Gui
from refused import has_terms, without_tags

from zsim.contract.run_messages import Event
from zsim_bridges.console import console_tables
from zsim_bridges.console.console_page import FILTERS, MANY_DRONES, NO_ROW, SORTINGS, FleetTable, filtered_rows
from zsim_bridges.console.console_tables import DroneRow, SensorRates, drone_table
from zsim_bridges.console.run_condition import DroneCondition, drone_alarms
from zsim_bridges.console.view_buffer import ALL, OWN, ROWS_KEPT, EventLog, EventRow, chosen_rows

S = 1_000_000_000


def test_rates_follow_from_counts_and_restart_with_another_estimator():
    rates = SensorRates()
    assert rates.update("d1", 0, {"gps": (10, 0)}) == {}
    assert rates.update("d1", 2 * S, {"gps": (19, 1)})["gps"] == pytest.approx(5.0)
    assert rates.update("d2", 2 * S, {"gps": (100, 0), "imu": (9, 0)}) == {}
    assert rates.update("d2", 3 * S, {"imu": (10, 0)}) == {}
    assert rates.update("d2", 4 * S, {"gps": (5, 0), "imu": (20, 0)})["imu"] == pytest.approx(10.0)
    assert rates.update("d2", 5 * S, {"gps": (2, 0), "imu": (30, 0)}) == {}


def test_a_paused_run_adds_nothing_to_the_rates():
    rates = SensorRates()
    rates.update("d1", 0, {"gps": (0, 0)})
    for _ in range(1000):
        assert rates.update("d1", S // 2, {"gps": (5, 0)})["gps"] == pytest.approx(10.0)
    assert len(rates._samples["d1"]) == 2


def test_rates_of_several_drones_are_followed_until_they_are_no_longer_shown():
    rates = SensorRates()
    for t_ns in (0, S):
        found = [rates.update(drone, t_ns, {"gps": (5 * t_ns // S, 0)}) for drone in ("d1", "d2")]
    assert found == [{"gps": pytest.approx(5.0)}] * 2
    rates.keep(("d2",))
    assert rates.update("d1", 2 * S, {"gps": (10, 0)}) == {}
    assert rates.update("d2", 2 * S, {"gps": (10, 0)}) == {"gps": pytest.approx(5.0)}


def test_a_user_defined_sensor_has_a_row_with_or_without_counts():
    """The stock estimator does not count its samples; an estimator of the user's own may."""
    own = {"pitot": 20.0, "my_uwb": 10.0}
    table = console_tables.sensor_table("drone1", {"gps": (5, 0), "my_uwb": (7, 1)}, {}, "", own)
    rows = [without_tags(row.replace("</td>", " ")).split() for row in table.split("<tr>")[2:]]
    assert rows == [["gps", "5", "0", "–"], ["my_uwb", "7", "1", "–"], ["pitot", "–", "–", "20", "Hz", "(configured)"]]


def test_tables_escape_the_texts_of_others():
    condition = DroneCondition("d1", "flying", 9.0, 400.0, commander="<script>")
    html = drone_table([DroneRow(condition, "3 / 1", ("gps_dropout",))])
    assert "<script>" not in html + drone_table([row("<script>'")], selected=("<script>'",))
    assert "&lt;script&gt;" in html
    assert "gps_dropout" in html
    assert html.count(console_tables.AMBER) == 2  # late, and a fault
    assert console_tables.RED in html  # the battery
    assert has_terms(without_tags(html), "flying", "9 %", "lag 400 ms")
    event = Event(1_500_000_000, 0, "refused", "x", "y", "<b>no</b>")
    tables = [console_tables.event_table([EventRow(event, times, False)]) for times in (3, 4)]
    assert "1.50" in tables[0]
    assert "&lt;b&gt;no" in tables[0]
    assert has_terms(without_tags(tables[0]), "3 ×")
    marks = [
        re.findall("data-zsim-event='([0-9a-f]+)'", each) for each in tables
    ]  # by which the page recognizes events
    assert marks[0] == marks[1] != []


@pytest.mark.parametrize(
    ("percent", "colour"),
    [(20.0, "inherit"), (17.0, console_tables.AMBER), (10.0, console_tables.AMBER), (9.0, console_tables.RED)],
)
def test_a_battery_has_the_colour_of_its_alarm(percent: float, colour: str):
    html = drone_table([DroneRow(DroneCondition("d1", "flying", percent))])
    assert f"<span style='color:{colour}'>{percent:.0f} %" in html
    alarms = drone_alarms(DroneCondition("d1", "flying", percent))
    assert [console_tables.SEVERITY_COLOURS[each.severity] for each in alarms] == [c for c in [colour] if c[0] == "#"]


def test_many_formations_leave_room_for_the_emergency_button():
    html = console_tables.formation_lines({f"c{i}": ("taking_off", "<waits>") for i in range(16)})
    assert console_tables.LIMITED_HEIGHT in html
    assert html.count("<br>") == 15
    assert has_terms(without_tags(html), "taking off", "&lt;waits&gt")


def test_active_and_past_faults_are_listed():
    assert console_tables.NO_FAULT in console_tables.fault_lines([])
    lines = console_tables.fault_lines(["gust of world", "link_cut of a/<b>"], ["gps_stuck of drone1"])
    assert has_terms(without_tags(lines), "gust of world", "link_cut of a/&lt;b&gt;", "over", "gps_stuck of drone1")
    assert "<b>" not in lines


# Sorting, filtering and selecting drones


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
SORTED = {
    "as in the scenario": "12345",
    "worst first": "34251",
    "battery, lowest first": "32514",
    "link, worst first": "45123",
    "σ, largest first": "45123",
}
FILTERED = {
    ("all", ""): "12345",
    ("with an alarm", ""): "234",
    ("on the ground", ""): "5",
    ("in the air", ""): "1234",
    ("battery low", ""): "23",
    ("selected", ""): "15",
    ("all", "Drone4"): "4",
    ("all", "gps"): "3",
    ("all", "nobody"): "5",
    ("all", "lost external"): "4",
    ("with an alarm", "landing"): "3",
    ("all", "drone1 landed"): "",
}


def test_rows_are_sorted_and_filtered():
    numbers = lambda rows: "".join(each.name.removeprefix("drone") for each in rows)  # noqa: E731
    selected = frozenset({"drone1", "drone5"})
    assert {order: numbers(filtered_rows(ROWS, order)) for order in SORTINGS} == SORTED
    found = {of: numbers(filtered_rows(ROWS, choice=of[0], text=of[1], selected=selected)) for of in FILTERED}
    assert found == FILTERED
    assert {choice for choice, _ in FILTERED} == set(FILTERS)


@pytest.mark.parametrize(("count", "order"), [(MANY_DRONES, "as in the scenario"), (MANY_DRONES + 1, "worst first")])
def test_many_drones_are_sorted_worst_first_by_default(count: int, order: str):
    gui: Any = Gui()
    FleetTable(gui, [f"drone{i}" for i in range(count)], lambda: None)
    assert gui.at["sort by"].value == order


def test_drones_are_selected_individually_or_as_shown():
    gui: Any = Gui()
    seen: list[list[str]] = []
    table = FleetTable(gui, [each.name for each in ROWS], lambda: seen.append(table.selected))
    for drone in ("drone3", "drone1", "stranger", "drone3"):
        table.toggle(drone)
    assert seen == [["drone3"], ["drone1", "drone3"], ["drone1"]]
    gui.at["show"].value = "battery low"
    table.show(ROWS, {}, "drone2")
    gui.at["select"].press()
    assert table.selected == ["drone1", "drone2", "drone3"]
    table.show(ROWS, {}, "drone2")
    html = str(table.table.content)
    assert html.count("aria-checked=true") == 2
    assert html.count("data-zsim-chosen") == 2  # both rows of the chosen drone
    gui.at["filter"].value = "nothing like that"
    table.show(ROWS, {}, "drone2")
    assert NO_ROW in str(table.table.content)
    gui.at["select"].value = "none"
    gui.at["select"].press()
    assert table.selected == []


# Events

OWN_NAME = "console.1"


@pytest.fixture
def log() -> EventLog:
    return EventLog(OWN_NAME)


def event(kind: str, source: str, subject: str, text: str, t_ns: int = 0) -> Event:
    return Event(t_ns, 0, kind, source, subject, text)


def test_equal_events_share_a_row_with_a_count(log: EventLog):
    for t_ns in range(20):
        log.add(event("refused", "mine", "drone1", f"age is {t_ns} ms; must be less", t_ns))
    log.add(event("refused", "mine", "drone2", "age is 4 ms; must be less"))
    assert [(row.event.subject, row.times) for row in log.rows()] == [("drone2", 1), ("drone1", 20)]
    assert log.rows()[1].event.t_ns == 19
    assert len(log.newest) == 21


def test_a_flood_of_events_leaves_the_actions_of_the_operator(log: EventLog):
    log.add(event("accepted", OWN_NAME, "main", "main: takeoff: accepted"))
    for number in range(3 * ROWS_KEPT):
        log.add(event("refused", f"s{number}", "drone1", "no"))
    rows = log.rows()
    assert len(rows) == ROWS_KEPT + 1
    assert [row.event.subject for row in chosen_rows(rows, kind=OWN)] == ["main"]


def test_events_are_filtered_by_drone_and_kind(log: EventLog):
    log.add(event("death", "world", "estimator.drone1", "died"))
    log.add(event("fault", "world", "drone10", "gps_dropout of drone10 begins"))
    log.add(event("fault", "world", "drone1", "gps_dropout of drone1 begins"))
    rows = log.rows()
    assert [row.event.subject for row in chosen_rows(rows, "drone1")] == ["drone1", "estimator.drone1"]
    assert [row.event.subject for row in chosen_rows(rows, "drone10")] == ["drone10"]
    assert [row.event.kind for row in chosen_rows(rows, ALL, "processes")] == ["death"]
