"""The links to real aircraft, by what their drivers published, in the summary of a run."""

from pathlib import Path

import synthetic_record
from synthetic_record import Flown

from zsim.contract import keys, messages
from zsim.contract.flight_messages import LinkState
from zsim.record import RecordWriter
from zsim_analysis.reading.driver_links import DriverLink, driver_links, link_text
from zsim_analysis.report.comparison import ABSENT, ComparedRun
from zsim_analysis.report.make_report import fact_rows, facts, judge

SECOND_NS = 1_000_000_000
PEER = "192.168.1.20:14580"
OVERRIDES = ("drones.drone3.body=external",)
REPORTS = [  # state, age, loss, round trip, refused, of two drivers one after the other
    [("waiting", None, None, None, 0), ("armed", 20.0, 1.0, 4.0, 3), ("lost", 1200.0, 1.0, 6.0, 3)],
    [("connected", 30.0, 4.0, 20.0, 2), ("armed", 10.0, None, None, 2)],
]


def record(path: Path, reports: list[list[tuple]] = REPORTS) -> Path:
    """Write a flight of 5 s of whose drones one is external, with a report of its link each second."""
    flown = Flown(duration_s=5.0, overrides=OVERRIDES)
    links = [(seq, *report) for driver in reports for seq, report in enumerate(driver)]
    with RecordWriter(path) as writer:
        for key, message, wall_ns in synthetic_record.traffic(flown):
            writer.add(key, messages.encode(message), messages.encoding(key), message.t_ns, wall_ns)
        for t_s, (seq, state, age, loss, trip, refused) in enumerate(links):
            link = LinkState(t_s * SECOND_NS, seq, "driver.drone3", PEER, state, age, loss, trip, None, refused)
            key = keys.link("drone3")
            writer.add(key, messages.encode(link), messages.encoding(key), link.t_ns, link.t_ns)
    return path


def test_a_link_is_judged_over_all_drivers_of_its_drone(tmp_path: Path):
    (link,) = driver_links(record(tmp_path / "run.mcap")).values()
    assert link == DriverLink(PEER, 1200.0, 2.0, 4.0, 6.0, lost=1, lost_s=1.0, refused=5)


def test_what_is_not_known_is_left_out(tmp_path: Path):
    path = record(tmp_path / "run.mcap", [[("waiting", None, None, None, 0)]])
    assert driver_links(path) == {"drone3": DriverLink(PEER, None, None, None, None, 0, 0.0, 0)}
    assert link_text(driver_links(path)["drone3"]).split(", ")[0] == PEER


def test_a_report_has_the_link_of_an_external_drone_and_no_other(tmp_path: Path):
    summary = judge(record(tmp_path / "run.mcap"))[-1]
    assert list(summary.links) == ["drone3"]
    assert [label for label, _ in facts(summary) if "drone" in label] == ["Link of drone3"]


def test_a_run_without_external_drones_has_no_links(tmp_path: Path):
    synthetic_record.write(tmp_path / "run.mcap", Flown(duration_s=1.0))
    assert judge(tmp_path / "run.mcap")[-1].links == {}
    assert driver_links(tmp_path / "run.mcap") == {}


def test_a_run_with_a_link_is_compared_with_one_without(tmp_path: Path):
    directories = [tmp_path / name for name in ("simulated", "mixed")]
    for directory in directories:
        directory.mkdir()
    synthetic_record.write(directories[0] / "run.mcap", Flown(duration_s=1.0))
    record(directories[1] / "run.mcap")
    rows = fact_rows([ComparedRun(d.name, d, *judge(d / "run.mcap")) for d in directories])
    (link,) = (row.cells for row in rows if row.name == "Link of drone3")
    assert link[0] == ABSENT
    assert PEER in link[1]
