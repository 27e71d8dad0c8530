"""Reading a recorded run from Python: results agree with the written messages, the export and the report."""

import html
import json
import subprocess
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import recorded_run
import synthetic_record
from refused import has_terms, refused
from synthetic_record import Flown

import zsim
from zsim.contract import keys
from zsim.contract.messages import decode
from zsim.errors import DocumentError, RecordError, RunError, install_command
from zsim.record import RecordReader, RecordWriter
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_analysis.export import Format
from zsim_analysis.export.columns import MessageSelection
from zsim_analysis.export.make_export import export
from zsim_analysis.report import flight_figures, indented_json, make_report
from zsim_api import recorded
from zsim_world.run.world import DURATION_OVER

DRONE = "a-b.c"
NAMES = [*cluster_space(3).names]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a flight of 6 s with a message of every kind, engaged from about 4 s."""
    made = tmp_path_factory.mktemp("run")
    recorded_run.write(made / "run.mcap")
    return made


@pytest.fixture(scope="module")
def run(folder: Path) -> zsim.Run:
    return zsim.load(folder)


@pytest.fixture
def without_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)


# Tables


def test_truth_is_read_as_recorded(folder: Path, run: zsim.Run) -> None:
    truth, written = run.truth(DRONE), recorded_run.messages_on(folder, keys.truth(DRONE))
    assert len(truth) == len(written) > 290
    assert [*truth.index] == [message.t_ns / 1e9 for message in written]
    for i, axis in enumerate("xyz"):
        assert [*truth[f"position_m_{axis}"]] == [message.position_m[i] for message in written]
    assert truth.index.name == "t_s"
    assert not {"name", "t_ns", "seq", "wall_ns"} & {*truth}


EXPORTED = {
    "truth": lambda run: run.truth("drone1"),
    "estimate": lambda run: run.estimate("drone1"),
    "gps": lambda run: run.sensor("drone1", "gps"),
    "status": lambda run: run.sensor("drone1", "status"),
    "velocity": lambda run: run.commands("drone1"),
    "mode": lambda run: run.commands("drone1", "mode"),
    "cluster_state": lambda run: run.cluster("main"),
    "event": lambda run: run.events,
}


def test_a_frame_has_the_columns_and_rows_of_the_export(folder: Path, run: zsim.Run, tmp_path: Path) -> None:
    selection = MessageSelection(
        ("drone/drone1/*", "drone/drone1/sensor/*", "drone/drone1/cmd/*", "cluster/*/state", "world/event")
    )
    export(folder, Format.PARQUET, tmp_path / "tables", selection)
    for name, read in EXPORTED.items():
        table = pd.read_parquet(tmp_path / "tables" / f"{name}.parquet").set_index("t_s")
        expected = table.drop(columns=["name", "t_ns", "seq", "wall_ns"])
        pd.testing.assert_frame_equal(plain(read(run)), plain(expected), obj=name)


def plain(table: pd.DataFrame) -> pd.DataFrame:
    return table.astype(object).where(table.notna(), None)


def test_a_sighted_hat_is_a_row(run: zsim.Run) -> None:
    seen = run.messages("drone/drone1/sensor/sightings")
    assert {"camera", "hat", "direction_B_x", "range_m"} <= {*seen}


def test_foreign_messages_have_a_column_for_each_field(run: zsim.Run) -> None:
    thing = run.messages("own/thing")
    assert thing[["x_0", "x_1"]].to_numpy().tolist() == [[1.0, 2.0]]
    assert run.messages("own/noise")["hexadecimal"].tolist() == ["c100"]


@pytest.mark.parametrize(
    ("values", "columns"),
    [
        ([[1.5, 2, 3], None], {"f_x": [1.5, np.nan], "f_y": [2.0, np.nan], "f_z": [3.0, np.nan]}),
        ([1, 2], {"f": [1, 2]}),
        ([1, None, 0.5], {"f": [1.0, np.nan, 0.5]}),
        ([True, False], {"f": [True, False]}),
        ([True, None], {"f": [True, None]}),
        ([2**63, 1], {"f": [2.0**63, 1.0]}),
        (["a", None], {"f": ["a", None]}),
        ([[1, 2], [1]], {"f": ["[1,2]", "[1]"]}),
        ([{"a": 1}, 3], {"f": ['{"a":1}', "3"]}),
        ([[True, False]], {"f": ["[true,false]"]}),
        ([[]], {"f": ["[]"]}),
        ([b"\xff\xd8", None], {"f": [b"\xff\xd8", None]}),
    ],
)
def test_foreign_fields_become_numbers_if_all_values_are(values: list[Any], columns: dict[str, list[Any]]) -> None:
    made = recorded._own_columns("f", values)
    assert {*made} == {*columns}
    for name, expected in columns.items():
        np.testing.assert_array_equal(made[name], np.array(expected, made[name].dtype))


def test_a_picture_is_read_as_bytes(folder: Path, run: zsim.Run) -> None:
    (picture,) = recorded_run.messages_on(folder, "drone/drone1/camera/front")
    assert run.messages("drone/drone1/camera/front")["data"].tolist() == [picture.data]


def test_messages_include_their_stamps(folder: Path, run: zsim.Run) -> None:
    with RecordReader(folder / "run.mcap") as reader:
        written = [*reader.messages({"clock"})]
    clock = run.messages("clock")
    assert clock["t_ns"].tolist() == [each.t_ns for each in written]
    assert clock["wall_ns"].tolist() == [each.wall_ns for each in written]
    assert clock["seq"].tolist() == [decode("clock", each.payload).seq for each in written]


def test_without_pandas_a_frame_is_a_dict_of_arrays(folder: Path, without_pandas: None) -> None:
    run = zsim.load(folder)
    truth: Any = run.truth("drone1")
    assert isinstance(truth, dict)
    assert next(iter(truth)) == "t_s"
    assert truth["position_m_z"].shape == truth["t_s"].shape
    with pytest.raises(ValueError, match="read-only"):
        truth["position_m_z"][0] = 1.0
    assert "variable" in run.errors()


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return a list that collects the keys of each pass over a record."""
    made: list[list[str]] = []
    read = recorded.read_tables

    def read_tables(record: Path, wanted: Collection[str]) -> dict[str, recorded.Table]:
        made.append([*wanted])
        return read(record, wanted)

    monkeypatch.setattr(recorded, "read_tables", read_tables)
    return made


def test_a_key_is_read_once(folder: Path, passes: list[list[str]]) -> None:
    run = zsim.load(folder)
    first = run.truth("drone1")
    first.loc[:, "position_m_x"] = 7.0  # the frame belongs to the user
    assert run.truth("drone1")["position_m_x"].iloc[0] == pytest.approx(2.0)
    run.messages("drone/drone1/truth")
    assert passes == [["drone/drone1/truth"]]


def test_the_remaining_drones_are_read_together_with_the_second(folder: Path, passes: list[list[str]]) -> None:
    run = zsim.load(folder)
    heights = {drone: run.truth(drone)["position_m_y"].iloc[0] for drone in run.drones}
    assert heights == {"drone1": 0.0, DRONE: 0.0, "end": 3.0}
    assert passes == [["drone/drone1/truth"], [f"drone/{DRONE}/truth", "drone/end/truth"]]
    run.sensor("end", "gps")
    run.xarray()
    assert passes[2:] == [["drone/end/sensor/gps"], [f"drone/{drone}/estimate" for drone in run.drones]]


def test_a_fleet_too_large_for_memory_is_read_drone_by_drone(
    folder: Path, passes: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded, "ROWS_MAX", 500)
    run = zsim.load(folder)
    for drone in run.drones:
        run.truth(drone)
    assert [*map(len, passes)] == [1, 1, 1]


# Errors and summary


@pytest.fixture(scope="module")
def step(tmp_path_factory: pytest.TempPathFactory) -> zsim.Run:
    """Return a synthetic flight: true errors are sines of 1 to 12 mm about 1 cm, estimated ones half of them."""
    made = tmp_path_factory.mktemp("step")
    true = np.arange(1, 13) * 1e-3
    synthetic_record.write(
        made / "run.mcap", Flown(duration_s=12.0, amplitude=true, est_amplitude=true / 2, offset=np.full(12, 0.01))
    )
    return zsim.load(made)


def test_errors_of_a_formation_match_the_closed_form(step: zsim.Run) -> None:
    table = step.errors(window=(2.0, 9.98))
    assert [*table.index] == [("main", name) for name in NAMES]
    sine = np.arange(1, 13) * 1e-3 / np.sqrt(2)
    assert table["true_std"].to_numpy() == pytest.approx(sine)
    assert table["true_rms"].to_numpy() == pytest.approx(np.hypot(sine, 0.01))
    assert table["est_rms"].to_numpy() == pytest.approx(sine / 2)
    assert [table["unit"]["main", name] for name in ("p", "beta")] == ["m", "rad"]
    formation = step.formation("main").loc[2.0:9.98]
    p = NAMES.index("p")
    assert formation["truth_error_p_m"].to_numpy().std() == pytest.approx(sine[p])
    assert (formation["truth_p_m"] - formation["desired_p_m"]).mean() == pytest.approx(0.01)
    assert (formation["estimate_p_m"] - formation["desired_p_m"]).std(ddof=0) == pytest.approx(sine[p] / 2)
    assert formation["estimate_error_beta_rad"].to_numpy().std() == pytest.approx(sine[-1] / 2)
    assert set(formation["phase"]) == {"engaged"}


def test_errors_without_a_window_are_those_of_the_report(step: zsim.Run) -> None:
    page = step.report()
    reported = json.loads((page.parent / "summary.json").read_text())
    for name, errors in reported["clusters"]["main"]["errors"].items():
        row = step.errors().loc[("main", name)]
        assert [row[field] for field in errors] == [*errors.values()]
    assert "<html" in page.read_text()
    assert indented_json(step.summary) == (page.parent / "summary.json").read_bytes()


def test_errors_of_an_estimate_are_relative_to_the_truth(run: zsim.Run) -> None:
    errors, truth, estimate = run.estimate_errors("drone1"), run.truth("drone1"), run.estimate("drone1")
    own = (estimate["position_m_x"] - truth["position_m_x"]).dropna()
    assert errors["position_m_x"].to_numpy() == pytest.approx(own.to_numpy(), abs=1e-6)  # estimates are kept as float32
    stated = np.sqrt(estimate["covariance_11"].loc[errors.index])
    assert errors["sigma_position_m_y"].to_numpy() == pytest.approx(stated.to_numpy(), rel=1e-6)
    part = errors.loc[2.0:4.0]
    table = run.errors(window=(2.0, 4.0), of="estimates").loc["drone1"]
    assert table.loc["position_m_x", "rms"] == pytest.approx(np.sqrt(np.mean(part["position_m_x"] ** 2)))
    assert table.loc["yaw_rad", "mean"] == pytest.approx(part["yaw_rad"].mean())
    assert table.loc["nees", "mean"] == pytest.approx(part["nees"].mean())
    inside = (part["position_m_z"].abs() <= 2 * part["sigma_position_m_z"]).mean()
    assert table.loc["position_m_z", "inside"] == pytest.approx(inside)


def test_statistics_of_an_empty_window_are_unknown(run: zsim.Run) -> None:
    for of in ("formations", "estimates"):
        assert run.errors((100.0, 200.0), of).drop(columns="unit").isna().all(axis=None)


def test_a_run_has_its_drones_scenario_end_and_hash(run: zsim.Run) -> None:
    assert run.drones == ("drone1", "a-b.c", "end")
    assert run.clusters == ("main",)
    assert run.duration_s == 6.0
    assert run.ended == DURATION_OVER
    assert run.truth_sha256 == run.summary.truth_sha256
    assert run.scenario.resolved.seed == 3
    assert run.scenario.document()["drones"][1]["name"] == DRONE
    assert run.keys["drone/end/truth"] == len(run.truth("end"))


def test_a_rerun_of_the_scenario_is_identical_to_the_bit(run: zsim.Run, tmp_path: Path) -> None:
    again = zsim.run(run.scenario, out=tmp_path / "again", progress=False)
    assert again.truth_sha256 == run.truth_sha256
    pd.testing.assert_frame_equal(again.truth(DRONE), run.truth(DRONE))


def test_all_drones_form_one_xarray_dataset(run: zsim.Run) -> None:
    data = run.xarray()
    assert dict(data.sizes) == {"drone": 3, "t_s": 301}
    assert [*data.drone.values] == [*run.drones]
    assert data.truth_position_m_y.sel(drone="end", t_s=0.0) == 3.0
    last = run.estimate(DRONE)["position_m_x"].iloc[-1]
    assert data.estimate_position_m_x.sel(drone=DRONE).dropna("t_s")[-1] == last


# Presentation


def test_a_figure_of_the_report_is_drawn_alone(step: zsim.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(flight_figures, "draw_plan", lambda *_: drawn.append("plan"))
    monkeypatch.setattr(make_report, "draw_errors", lambda *_: drawn.append("errors"))
    shape: Any = step.figure("shape")
    assert "$p$" in shape.axes[0].get_ylabel()
    assert step.figure("figure_8_shape").axes[0].get_ylabel() == shape.axes[0].get_ylabel()
    assert drawn == []  # no other figure
    assert shape._repr_png_().startswith(b"\x89PNG")


def test_an_unknown_figure_is_refused_with_the_known_ones(run: zsim.Run) -> None:
    with refused(
        RunError,
        "'shap'",
        "mean shape?",
        "errors,",
        "plan_view,",
    ):
        run.figure("shap")


def test_a_notebook_shows_errors_and_shortfalls(step: zsim.Run) -> None:
    shown = step._repr_html_()
    assert "step, seed 1, 3 drones" in shown
    assert "12 s, " in shown
    assert "<td>beta (rad)</td>" in shown
    assert html.escape(step.shortfalls[0].text) in shown


# Missing data


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda run: run.truth("drone4"), ("no drone 'drone4'", "did you mean drone1?", "drone1, a-b.c, end")),
        (lambda run: run.sensor("drone1", "gsp"), ("no sensor 'gsp' of drone1", "did you mean gps?", "imu")),
        (lambda run: run.commands("end", "rotors"), ("no cmd 'rotors' of end", "none")),
        (lambda run: run.commands("drone1", "rotor"), ("no cmd 'rotor' of drone1", "did you mean rotors?", "velocity")),
        (lambda run: run.cluster("mian"), ("no cluster 'mian'", "did you mean main?")),
        (lambda run: run.formation("drone1"), ("no cluster 'drone1'", "main")),
        (lambda run: run.errors(window=(40, 20)), ("window is (40, 20)", "(20, 40)")),
        (lambda run: run.errors(window=(20,)), ("window is (20,)", "(20, 40)")),
        (lambda run: run.errors(of="estimate"), ("of is 'estimate'", "'formations'", "'estimates'")),
        (lambda run: run.messages("drone/*/truth"), ("no messages of 'drone/*/truth'", "drone/drone1/truth")),
        (lambda run: run.messages("own/thin"), ("'own/thin'", "did you mean own/thing?")),
    ],
)
def test_an_unknown_name_is_refused_with_the_known_ones(run: zsim.Run, ask: Any, words: tuple[str, ...]) -> None:
    with refused(RunError, *words):
        ask(run)


def test_a_folder_without_a_record_is_refused(tmp_path: Path) -> None:
    with refused(RunError, str(tmp_path), "run.mcap"):
        zsim.load(tmp_path)


@pytest.mark.parametrize(
    ("module", "code", "extra"),
    [
        ("mcap", "zsim.load", "record"),
        ("matplotlib", "zsim.load(sys.argv[1]).figure('shape')", "report"),
        ("xarray", "zsim.load(sys.argv[1]).xarray()", "notebook"),
    ],
)
def test_a_missing_extra_is_reported_with_its_install_command(folder: Path, module: str, code: str, extra: str) -> None:
    script = f"import sys, zsim; sys.modules[{module!r}] = None; {code}"
    done = subprocess.run([sys.executable, "-c", script, str(folder)], capture_output=True, text=True, check=False)
    assert has_terms(
        done.stderr.splitlines()[-1], "zsim.errors.RunError", module, "not installed", install_command([extra])
    )


# Incomplete and foreign records


def test_a_truncated_record_is_read_to_its_last_chunk(folder: Path, tmp_path: Path) -> None:
    content = (folder / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) // 2])
    run = zsim.load(tmp_path)
    assert not run.complete
    assert "was cut" in run.ended
    truth = run.truth("drone1")
    assert 50 < len(truth) < 290
    assert run.duration_s == truth.index[-1]
    pd.testing.assert_frame_equal(truth, zsim.load(folder).truth("drone1").iloc[: len(truth)])
    assert "was cut" in run._repr_html_()


def written_of(folder: Path, out: Path, is_kept: Callable[[str], bool]) -> zsim.Run:
    with RecordReader(folder / "run.mcap") as reader, RecordWriter(out / "run.mcap") as writer:
        for each in reader.messages([key for key in reader.topics() if is_kept(key)], by_time=False):
            writer.add(each.key, each.payload, "", each.t_ns, each.wall_ns)
    return zsim.load(out / "run.mcap")


def test_a_record_without_world_info_has_the_drones_of_its_messages(folder: Path, tmp_path: Path) -> None:
    run = written_of(folder, tmp_path, lambda key: key != keys.INFO)
    assert {*run.drones} == {"drone1", DRONE, "end"}
    assert run.clusters == ("main",)
    assert len(run.truth("end")) > 290
    with refused(RunError, "run.mcap", "no world/info"):
        _ = run.scenario


def test_a_record_without_truth_is_refused_where_truth_is_needed(folder: Path, tmp_path: Path) -> None:
    run = written_of(folder, tmp_path, lambda key: key in (keys.INFO, keys.EVENT))
    assert (run.duration_s, run.ended) == (6.0, DURATION_OVER)
    assert "end" in [*run.events["kind"]]
    assert not run.complete
    with refused(RecordError, "no truth"):
        run.errors()
    with refused(RunError, "no truth of drone1"):
        run.truth("drone1")
    assert "no truth" in run._repr_html_()


OWN_SPACE = """
from zsim_agents.formation.spaces.triad_cluster import TriadCluster

class Space(TriadCluster):
    pass
"""


def test_a_scenario_s_own_space_is_imported_only_if_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "space_of_a_stranger", None)  # so that monkeypatch removes the module afterwards
    del sys.modules["space_of_a_stranger"]
    module = tmp_path / "space_of_a_stranger.py"
    module.write_text(OWN_SPACE)
    own = {"clusters[0].space": "space_of_a_stranger:Space", "duration_s": 1}
    monkeypatch.chdir(tmp_path)
    flown = zsim.run(recorded_run.SCENARIO, set=own, out=tmp_path / "run", progress=False)
    assert len(flown.formation()) > 40
    del sys.modules["space_of_a_stranger"]
    run = zsim.load(tmp_path / "run")
    assert "x_c" not in run.errors().index.get_level_values("variable")
    with refused(RunError, "space_of_a_stranger:Space", "trust=True"):
        run.formation("main")
    assert "space_of_a_stranger" not in sys.modules
    assert len(zsim.load(tmp_path / "run", trust=True).formation()) == len(flown.formation())

    module.unlink()  # as if on another machine
    del sys.modules["space_of_a_stranger"]
    elsewhere = zsim.load(tmp_path / "run")
    assert elsewhere.summary.truth_sha256 == flown.truth_sha256
    assert elsewhere.figure("plan_view").axes
    with refused(DocumentError, "'space_of_a_stranger:Space'", "ModuleNotFoundError"):
        _ = zsim.load(tmp_path / "run", trust=True).summary
