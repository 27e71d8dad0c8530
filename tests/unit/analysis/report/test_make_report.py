"""The report: known flights yield closed-form statistics, and damaged records are reported as far as possible."""

import errno
import hashlib
import json
import math
import os
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import msgspec
import numpy as np
import pytest
import synthetic_record
from refused import has_terms, refused
from sweep_rows import printed
from synthetic_record import GATE_NS, SCENARIOS, Flown

from zsim.contract import keys, messages, run_messages
from zsim.errors import DocumentError, RecordError, ReportError
from zsim.presentation import FittedTable
from zsim.record import RecordReader, RecordWriter
from zsim.scenario import scenario_file
from zsim_analysis.reading.shortfall import percent_text, span_text
from zsim_analysis.report.figure_style import thinned
from zsim_analysis.report.make_report import make_report, page, write_page, write_report
from zsim_analysis.report.summary import COLUMNS, PAPER_COLUMN, PAPER_TABLE_1, RunSummary, judge, table, terminal_text

NAMES = ["x_c", "y_c", "z_c", "roll", "pitch", "yaw", "phi_1", "phi_2", "phi_3", "p", "q", "beta"]
AMPLITUDE = np.array([0.12, 0.13, 0.03, 0.02, 0.01, 0.07, 0.05, 0.06, 0.04, 0.28, 0.3, 0.08])
OFFSET = np.array([0.05, -0.04, 0.01, 0.003, -0.002, 0.02, 0.01, -0.01, 0.03, 0.1, -0.1, 0.01])
FIGURES = {
    f"{name}.png"
    for name in ("figure_5_errors", "figure_6_position", "figure_7_orientation", "figure_8_shape", "plan_view")
} | {"distances.png", "drones.png"}
CONTRACT_FIELDS = {"scenario", "seed", "mode", "versions", "fingerprint", "real_time_factor", "wall_s", "sim_s", "ended",
                   "deadline_misses", "command_age_ms", "window_s", "errors", "min_separation_m", "paper_table_1",
                   "events", "truth_sha256"}  # fmt: skip
STATISTICS = {f"{whose}_{what}" for whose in ("est", "true") for what in ("std", "rms", "mean")}


def flown(**options) -> Flown:
    """Return a flight of 12 s whose window of 8 s covers four periods of the error."""
    wave = {"amplitude": AMPLITUDE, "offset": OFFSET, "est_amplitude": 0.5 * AMPLITUDE, "period_s": 2.0}
    return Flown(**{"duration_s": 12.0, "overrides": ("report.window_s=[2, 9.98]",), **wave, **options})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    directory = tmp_path_factory.mktemp("run")
    end = {
        "reason": "over",
        "wall_s": 0.6,
        "sim_s": 12.0,
        "last_ns": 12_000_000_000,
        "real_time_factor": 20.0,
        "deadlines": 600,
        "deadline_misses": 2,
        "deadline_misses_by": {"estimator.drone1": 2},
        "command_age_ms": {"p50": 1.0, "p99": 2.0, "max": 3.0},
        "truth_sha256": "0" * 64,
    }
    script = run_messages.Event(GATE_NS, 0, "refused", "eve", "drone1", "<script>alert(1)</script>", {})
    synthetic_record.write(directory / "run.mcap", flown(end=end, events=(script,)))
    steps: list[str] = []
    summary = make_report(directory, steps.append)
    assert len(steps) == 3 + len(FIGURES)
    return directory, summary


def summary_of(directory: Path, entries: synthetic_record.Entries) -> RunSummary:
    directory.mkdir(exist_ok=True)
    synthetic_record.record(directory / "run.mcap", entries)
    return judge(directory / "run.mcap")[-1]


def report_of(directory: Path, flight: Flown) -> RunSummary:
    return summary_of(directory, synthetic_record.traffic(flight))


def late(**info: Any) -> synthetic_record.Entries:
    """Yield `world/info` and the messages of a flight from 9 s."""
    for key, message, wall_ns in synthetic_record.traffic(flown(end=None)):
        if key == keys.INFO:
            yield key, msgspec.structs.replace(message, **info), wall_ns
        elif message.t_ns >= 9_000_000_000:
            yield key, message, wall_ns


def test_errors_match_the_closed_form(run):
    _, summary = run
    assert summary.window_s == (2.0, 9.98)
    assert list(summary.errors) == NAMES
    for name, amplitude, offset in zip(NAMES, AMPLITUDE, OFFSET, strict=True):
        sine = amplitude / math.sqrt(2)
        expected = (sine / 2, sine / 2, 0, sine, math.hypot(sine, offset), offset)
        assert msgspec.structs.astuple(summary.errors[name]) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_errors_of_angles_are_wrapped(tmp_path):
    # The paper's test 2 turns at 0.1 rad/s and passes pi; published estimates are in [-pi, pi].
    flight = flown(scenario="trajectory", duration_s=64.0, overrides=("report.window_s=[22, 61.98]",))
    summary = report_of(tmp_path, flight)
    yaw, sine = summary.errors["yaw"], AMPLITUDE[5] / math.sqrt(2)
    assert (yaw.true_std, yaw.true_mean, yaw.est_std) == pytest.approx((sine, OFFSET[5], sine / 2), rel=1e-6)


def test_summary_json_has_the_fields_of_the_contract(run):
    directory, summary = run
    summary_json = json.loads((directory / "summary.json").read_bytes())
    assert summary_json.keys() >= CONTRACT_FIELDS
    assert summary_json["errors"]["p"].keys() == STATISTICS
    assert summary_json["clusters"]["main"]["errors"] == summary_json["errors"]
    assert summary_json["paper_table_1"]["beta"] == 0.012
    assert (summary_json["scenario"], summary_json["seed"], summary_json["mode"]) == ("step", 1, "lockstep")
    assert (summary_json["real_time_factor"], summary_json["wall_s"], summary_json["deadline_misses"]) == (20.0, 0.6, 2)
    assert summary_json["ended"] == "over"
    assert [event["kind"] for event in summary_json["events"]] == ["refused", "end"]
    assert summary_json["versions"]["estimator.drone1"] == "0.1.0"
    assert msgspec.json.decode((directory / "summary.json").read_bytes(), type=type(summary)) == summary


def test_the_truth_hash_is_computed_as_in_the_contract(run):
    directory, summary = run
    digest = hashlib.sha256()
    with RecordReader(directory / "run.mcap") as reader:
        instants = {}
        for n in (1, 2, 3):
            for message in reader.messages({keys.truth(f"drone{n}")}):
                truth = messages.decode(message.key, message.payload)
                instants[truth.t_ns, n] = truth
    for _, truth in sorted(instants.items()):
        parts = truth.position_m, truth.velocity_m_s, truth.orientation_wxyz, truth.angular_velocity_rad_s
        digest.update(struct.pack("<q13d", truth.t_ns, *(number for part in parts for number in part)))
    assert summary.record.truth_sha256 == digest.hexdigest()
    assert summary.truth_sha256 == "0" * 64
    assert any(has_terms(note, "world", "000…") for note in summary.notes)
    assert summary.record.truth_missing == 0


def test_truth_missing_from_the_record_is_reported(tmp_path):
    def is_lost(key: str, message: Any) -> bool:
        return key == keys.truth("drone2") and 3_000_000_000 <= message.t_ns < 4_000_000_000

    summary = summary_of(tmp_path, (each for each in synthetic_record.traffic(flown()) if not is_lost(*each[:2])))
    assert summary.record.truth_missing == 50
    assert any(has_terms(note, "50", "1803", "truth") for note in summary.notes)
    assert summary.errors["p"].true_std == pytest.approx(AMPLITUDE[9] / math.sqrt(2), rel=0.05)


@pytest.mark.usefixtures("undrawn")
def test_a_replay_is_reported_and_judged_from_its_beginning(tmp_path):
    synthetic_record.record(tmp_path / "run.mcap", late(replay_of="20261122-run"))
    summary = make_report(tmp_path)
    assert summary.record.truth_missing == 0
    assert summary.sim_s == pytest.approx(3.0)
    assert summary.real_time_factor == pytest.approx(20.0)
    recorder_came_late = summary_of(tmp_path / "late", late())
    assert recorder_came_late.record.truth_missing == 3 * 449
    assert recorder_came_late.real_time_factor == pytest.approx(20.0)
    assert any(has_terms(note, "replay", "20261122-run") for note in summary.notes)
    assert has_terms((tmp_path / "report.html").read_text(), "replay", "20261122-run…")


def test_a_cluster_with_an_external_drone_has_no_true_errors(tmp_path):
    """Errors from the truth are null, with the reason; the hash covers the other drones, and the map shows all."""
    flown = Flown(amplitude=AMPLITUDE, est_amplitude=AMPLITUDE, overrides=("drones.drone2.body=external",))
    synthetic_record.write(tmp_path / "run.mcap", flown)
    flight, formations, summary = judge(tmp_path / "run.mcap")
    (formation,) = formations
    for name in NAMES:
        errors = summary.clusters["main"].errors[name]
        assert errors.true_std is errors.true_rms is errors.true_mean is None
        assert errors.est_std is not None
    assert any("drone2" in note and "external" in note for note in summary.notes)
    assert np.isnan(formation.true).all()
    simulated = report_of(tmp_path / "plain", replace(flown, overrides=()))
    assert summary.min_separation_m == simulated.min_separation_m
    assert summary.record.truth_instants * 3 == simulated.record.truth_instants * 2
    assert summary.record.truth_missing == 0
    assert summary.record.truth_sha256 != simulated.record.truth_sha256
    assert [len(track.t_ns) > 0 for track in flight.tracks] == [True] * 3


def test_the_separation_is_that_of_the_closest_pair_in_flight(tmp_path):
    summary = report_of(tmp_path, flown(amplitude=np.zeros(12), offset=np.zeros(12)))
    assert summary.min_separation_m == pytest.approx(8 * math.sin(math.pi / 8), rel=1e-9)  # 2 p sin(beta / 2)
    (tmp_path / "run.mcap").unlink()
    # p and q grow from 1 m on the ground; the drones are landed until 1 s.
    away, grow = np.zeros(12), np.zeros(12)
    away[9:11], grow[9:11] = -3.0, 3.0
    growing = Flown(duration_s=8.0, climb_s=10.0, offset=away, amplitude=grow, period_s=40.0)
    at_lift_off = 1 + 3 * math.sin(2 * math.pi / 40)
    assert report_of(tmp_path, growing).min_separation_m == pytest.approx(2 * at_lift_off * math.sin(math.pi / 8))
    (tmp_path / "run.mcap").unlink()
    nobody_flies = replace(growing, duration_s=0.9)
    assert report_of(tmp_path, nobody_flies).min_separation_m == pytest.approx(2 * math.sin(math.pi / 8))


def test_a_run_whose_world_died_is_reported_from_its_record(tmp_path):
    summary = report_of(tmp_path, flown(end=None, other_traffic=True))
    assert has_terms(summary.ended, "12.00", "no end")
    assert summary.wall_s == pytest.approx(0.6)  # the synthetic recorder takes 1 ms per gate
    assert summary.real_time_factor == pytest.approx(20.0)
    assert summary.deadline_misses is None
    assert summary.command_age_ms == {"p50": 0.0, "p99": 0.0, "max": 0.0}
    assert summary.truth_sha256 == summary.record.truth_sha256
    assert summary.errors["p"].true_std == pytest.approx(AMPLITUDE[9] / math.sqrt(2), rel=1e-9)


def test_a_truncated_record_is_reported_up_to_its_end(tmp_path):
    flight = flown(other_traffic=True, end=None)
    synthetic_record.write(tmp_path / "whole.mcap", flight)
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: len(data) // 2])
    summary = judge(tmp_path / "run.mcap")[-1]
    assert 4 < summary.sim_s < 8
    assert has_terms(summary.ended, "cut", f"{summary.sim_s:.2f}", "no end")
    assert any(has_terms(note, "ended", f"{summary.sim_s:.2f}") for note in summary.notes)
    assert any("was cut" in note for note in summary.notes)


@pytest.mark.usefixtures("unrendered")
def test_a_run_without_cluster_states_is_reported_without_errors(tmp_path, monkeypatch):
    """A controller that cannot load the user's space publishes no states; the report does not need the space either."""

    def load(*_: object) -> None:
        raise DocumentError(["space: nowhere:Space cannot be loaded"])

    summary = report_of(tmp_path, flown(overrides=("clusters=[]",)))
    make_report(tmp_path)
    assert summary.errors == {}
    assert any("no cluster" in note for note in summary.notes)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"plan_view.png", "distances.png", "drones.png"}
    assert '<table class="numbers">' not in (tmp_path / "report.html").read_text()
    assert not any(isinstance(each, FittedTable) for each in terminal_text(summary).renderables)
    silent = (each for each in synthetic_record.traffic(flown()) if each[0] != keys.cluster_state("main"))
    monkeypatch.setattr("zsim_analysis.reading.formation.scenario_space", load)
    summary = summary_of(tmp_path / "silent", silent)
    assert summary.errors == {}
    assert any(has_terms(note, "main", "no state") for note in summary.notes)


@pytest.mark.parametrize("length", [0, 1, 100])
def test_a_record_without_messages_or_without_truth_is_refused(tmp_path, length):
    (tmp_path / "still").mkdir()
    synthetic_record.write(tmp_path / "whole.mcap", flown(duration_s=0.1))
    (tmp_path / "run.mcap").write_bytes((tmp_path / "whole.mcap").read_bytes()[:length])
    with pytest.raises(RecordError, match=r"run\.mcap: "):
        make_report(tmp_path)
    assert [path.name for path in tmp_path.iterdir() if path.is_file() and path.suffix != ".mcap"] == []
    still = (each for each in synthetic_record.traffic(flown(duration_s=0.1)) if not each[0].endswith("/truth"))
    synthetic_record.record(tmp_path / "still" / "run.mcap", still)
    with refused(RecordError, "run.mcap", "messages", "truth"):
        make_report(tmp_path / "still")


def test_garbage_on_known_keys_is_counted_and_skipped(tmp_path):
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for key, message, wall_ns in synthetic_record.traffic(flown()):
            writer.add(key, messages.encode(message), messages.encoding(key), message.t_ns, wall_ns)
            if key == keys.CLOCK:
                for rubbish in (b"", b"\xff" * 40, msgspec.msgpack.encode({"t_ns": "soon"})):
                    writer.add(keys.truth("drone1"), rubbish, "", 0, 0)
                    writer.add(keys.cluster_state("main"), rubbish, "", 0, 0)
                    writer.add(keys.EVENT, rubbish, "", 0, 0)
    summary = judge(tmp_path / "run.mcap")[-1]
    assert summary.record.undecoded == 601 * 9
    assert summary.errors["p"].true_std == pytest.approx(AMPLITUDE[9] / math.sqrt(2), rel=1e-9)


def test_a_flood_of_events_does_not_hide_a_restart(tmp_path):
    flood = [run_messages.Event(GATE_NS, i, "refused", "eve", "drone1", f"refused {i}", {}) for i in range(5000)]
    restart = run_messages.Event(2 * GATE_NS, 0, "restart", "world", "estimator.drone1", "restarted", {})
    summary = report_of(tmp_path, flown(events=(*flood, restart)))
    assert [event.kind for event in summary.events].count("restart") == 1
    assert summary.events_left_out == {"refused": 4900}
    assert "4900 × refused" in page(summary, [])


def test_the_page_needs_no_network_and_has_no_scripts(run):
    directory, _ = run
    text = (directory / "report.html").read_text()
    links = re.findall(r"""\b(?:src|href|srcset|action|data)\s*=\s*["']([^"']*)""", text)
    assert len([link for link in links if link.startswith("data:image/png;base64,")]) == len(FIGURES)
    assert all(link.startswith("data:") for link in links)
    assert not re.search(r"https?:|@import|url\(|<script", text)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert 'name="viewport"' in text
    assert len(re.findall(r'<img src="[^"]+" alt="[^"]+" width="\d+" height="\d+">', text)) == len(FIGURES)
    assert "2 of 600 (estimator.drone1 2)" in text


def test_figures_are_not_blank(run):
    directory, _ = run
    assert {path.name for path in (directory / "figures").iterdir()} == FIGURES
    for name in FIGURES:
        picture = matplotlib.image.imread(directory / "figures" / name)[:, :, :3]
        assert picture.shape[1] in (700, 1432)  # 3.5 and 7.16 in at 200 pixels per inch
        inked = (picture < 0.9).any(axis=2)
        assert 0.005 < inked.mean() < 0.6
        colours = (picture * 255).astype(int) @ (65_536, 256, 1)
        assert len(np.unique(colours)) > 50


def test_the_terminal_table_compares_with_the_paper(run):
    _, judged = run
    cluster = msgspec.structs.replace(judged.clusters["main"], paper_std=PAPER_TABLE_1)
    summary = msgspec.structs.replace(judged, clusters={"main": cluster})
    text = printed(table(summary, "main"), 80)
    row = next(line for line in text.splitlines() if line.strip("│ ").startswith("p (m)"))
    assert "0.032" in row
    assert f"{AMPLITUDE[9] / math.sqrt(2):.4f}" in row
    assert any("beta (rad)" in line for line in text.splitlines())  # 80 columns break no name …
    assert table(summary, "main").left_out(80) == []  # … and omit no column
    assert judged.clusters["main"].paper_std == {}  # the flight is too short
    assert COLUMNS[PAPER_COLUMN][0] not in table(judged, "main").columns
    assert PAPER_COLUMN not in page(judged, [])


def test_times_of_a_window_have_two_decimals_at_most(tmp_path):
    summary = report_of(tmp_path, flown(duration_s=20.12, overrides=("report.window_s=null",)))
    assert summary.window_s == pytest.approx((20.12 / 3, 20.12))
    assert "6.71 to 20.12 s" in (table(summary, "main").title or "")
    assert "6.71 to 20.12 s" in page(summary, [])
    assert span_text((40 / 3, 40.0)) == "13.33 to 40 s"
    assert [percent_text(share) for share in (0.0, 1e-4, 0.3014, 0.9999, 1.0)] == ["0", "0.1", "30.1", "99.9", "100"]


@pytest.mark.usefixtures("undrawn")
def test_a_report_that_cannot_be_made_is_refused_with_the_path(tmp_path):
    with refused(RecordError, "run.mcap", os.strerror(errno.ENOENT)):
        make_report(tmp_path)
    synthetic_record.write(tmp_path / "run.mcap", flown(duration_s=0.1))
    (tmp_path / "figures").write_text("in the way")
    with pytest.raises(ReportError, match=f"^{tmp_path}: .*File exists"):
        make_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_thinning_keeps_every_extreme():
    rng = np.random.default_rng(7)
    y = rng.standard_normal(100_000)
    y[31_234], y[77_777], y[50_000:50_300] = 40.0, -50.0, np.nan
    x = np.arange(len(y), dtype=float)
    few_x, few_y = thinned(x, y)
    assert len(few_x) <= 2000
    assert (np.nanmax(few_y), np.nanmin(few_y)) == (40.0, -50.0)
    assert np.isnan(few_y).any()
    assert np.all(np.diff(few_x) > 0)


@pytest.mark.usefixtures("unrendered")
def test_several_clusters_have_a_table_and_figures_each(tmp_path):
    scenario = scenario_file.load(SCENARIOS / "step.yaml")
    pair, main = ("drone1", "drone2"), ("drone1", "drone2", "drone3")
    clusters = (messages.ClusterInfo("pair", pair), messages.ClusterInfo("main", main))
    second = msgspec.structs.replace(synthetic_record.info(scenario), clusters=clusters)
    pair_names = ("x_c", "y_c", "z_c", "pitch", "yaw", "phi_1", "phi_2", "p")
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for key, message, wall_ns in synthetic_record.traffic(flown()):
            message = second if key == keys.INFO else message
            t_ns = message.t_ns
            writer.add(key, messages.encode(message), messages.encoding(key), t_ns, wall_ns)
            if key == keys.CLOCK:
                rest = {"names": pair_names, "value": (1.0,) * 8, "desired": (1.0,) * 8}
                state = {"t_ns": t_ns, "seq": 0, "phase": "engaged", **rest}
                writer.add(keys.cluster_state("pair"), msgspec.msgpack.encode(state), "", t_ns, wall_ns)
    summary = make_report(tmp_path)
    assert list(summary.clusters) == ["pair", "main"]
    assert summary.errors == summary.clusters["pair"].errors
    assert set(summary.errors) == set(pair_names)
    assert (tmp_path / "figures" / "figure_8_shape.png").exists()
    assert (tmp_path / "figures" / "figure_8_shape_main.png").exists()


@pytest.mark.parametrize("name", ["figures", "report-figures"])
def test_a_report_is_not_written_through_a_link(tmp_path: Path, name: str) -> None:
    """Otherwise the report of a received run could replace and remove files elsewhere."""
    elsewhere, folder = tmp_path / "elsewhere", tmp_path / "run"
    elsewhere.mkdir()
    folder.mkdir()
    (elsewhere / "drones.svg").write_text("mine")
    link = folder / name
    link.symlink_to(elsewhere)
    with refused(ReportError, str(link), "link"):
        if name == "figures":
            write_report(folder, {}, (), lambda _: "", lambda _: None)
        else:
            write_page(folder / "report.html", (), lambda _: "", lambda _: None)
    assert [path.name for path in elsewhere.iterdir()] == ["drones.svg"]
    assert list(folder.iterdir()) == [link]
