"""Tables of the console: rates of sensors, and texts of others as text."""

import re
from pathlib import Path

import numpy as np
import pytest
from refused import has_terms, without_tags

from zsim.contract.run_messages import Event
from zsim_bridges.console import console_tables
from zsim_bridges.console import picture as pic
from zsim_bridges.console.alarms import DroneCondition, drone_alarms
from zsim_bridges.console.console_tables import SensorRates
from zsim_bridges.console.view_buffer import EventRow

SCENARIOS = Path(__file__).parents[4] / "scenarios"
LEVEL = (1.0, 0.0, 0.0, 0.0)
RNG = np.random.default_rng(4)


def some_attitudes(count: int) -> np.ndarray:
    q = RNG.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def drones(p_W: np.ndarray, q_WB: np.ndarray, t_ns: int = 0) -> pic.DronePoses:
    names = tuple(f"drone{i}" for i in range(len(p_W)))
    return pic.DronePoses(t_ns, names, p_W, q_WB, np.full((len(p_W), 4), 300.0), np.zeros(3))


def test_rates_follow_from_counts():
    rates = SensorRates()
    assert rates.update("d1", 0, {"gps": (10, 0)}) == {}
    assert rates.update("d1", 2_000_000_000, {"gps": (19, 1)})["gps"] == pytest.approx(5.0)
    assert rates.update("d2", 2_000_000_000, {"gps": (50, 1)}) == {}


def test_a_run_that_stands_still_adds_nothing_to_the_rates():
    rates = SensorRates()
    rates.update("d1", 0, {"gps": (0, 0)})
    for _ in range(1000):
        assert rates.update("d1", 500_000_000, {"gps": (5, 0)})["gps"] == pytest.approx(10.0)
    assert len(rates._samples) == 2


def test_a_sensor_of_the_user_s_has_a_row_counted_or_not():
    """The stock estimator counts none; an estimator of the user's own may."""
    own = {"pitot": 20.0, "my_uwb": 10.0}
    table = console_tables.sensor_table("drone1", {"gps": (5, 0), "my_uwb": (7, 1)}, {}, "", own)
    rows = [without_tags(row.replace("</td>", " ")).split() for row in table.split("<tr>")[2:]]
    assert rows == [["gps", "5", "0", "–"], ["my_uwb", "7", "1", "–"], ["pitot", "–", "–", "20", "Hz", "as", "set"]]


def test_rates_begin_anew_with_a_fresh_estimator():
    rates = SensorRates()
    rates.update("d1", 0, {"gps": (100, 0), "imu": (9, 0)})
    assert rates.update("d1", 1_000_000_000, {"imu": (10, 0)}) == {}
    assert rates.update("d1", 2_000_000_000, {"gps": (5, 0), "imu": (20, 0)})["imu"] == pytest.approx(10.0)
    assert rates.update("d1", 3_000_000_000, {"gps": (2, 0), "imu": (30, 0)}) == {}


def test_tables_show_text_of_others_as_text():
    row = console_tables.DroneRow(
        DroneCondition("d1", "flying", 9.0, 400.0, commander="<script>"), "3 / 1", ("gps_dropout",)
    )
    html = console_tables.drone_table([row])
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "gps_dropout" in html
    assert html.count(console_tables.AMBER) == 2  # late, and a fault
    assert has_terms(without_tags(html), "flying", "9 %", "lag 400 ms")
    assert console_tables.RED in html  # the battery
    event = Event(1_500_000_000, 0, "refused", "x", "y", "<b>no</b>")
    events = console_tables.event_table([EventRow(event, 3, False)])
    assert "1.50" in events
    assert html_marks(events) == html_marks(console_tables.event_table([EventRow(event, 4, False)]))
    assert "&lt;b&gt;no" in events
    assert has_terms(without_tags(events), "3 ×")


def html_marks(html: str) -> list[str]:
    """Return by which rows of events are known to the page."""
    found = re.findall("data-zsim-event='([0-9a-f]+)'", html)
    assert found
    return found


@pytest.mark.parametrize(
    ("percent", "colour"),
    [(20.0, "inherit"), (17.0, console_tables.AMBER), (10.0, console_tables.AMBER), (9.0, console_tables.RED)],
)
def test_a_battery_has_the_colour_of_its_alarm(percent: float, colour: str):
    html = console_tables.drone_table([console_tables.DroneRow(DroneCondition("d1", "flying", percent))])
    assert f"<span style='color:{colour}'>{percent:.0f} %" in html
    alarms = drone_alarms(DroneCondition("d1", "flying", percent))
    assert [console_tables.SEVERITY_COLOURS[each.severity] for each in alarms] == [c for c in [colour] if c[0] == "#"]


def test_many_formations_leave_room_for_the_emergency_button():
    html = console_tables.formation_lines({f"c{i}": ("taking_off", "<waits>") for i in range(16)})
    assert console_tables.FEW_LINES in html
    assert html.count("<br>") == 15
    assert has_terms(without_tags(html), "taking off", "&lt;waits&gt")


def test_acting_faults_are_listed():
    assert console_tables.NO_FAULT in console_tables.fault_lines([])
    lines = console_tables.fault_lines(["gust of world", "link_cut of a/<b>"], ["gps_stuck of drone1"])
    assert has_terms(without_tags(lines), "gust of world", "link_cut of a/&lt;b&gt;", "over", "gps_stuck of drone1")
    assert "<b>" not in lines
