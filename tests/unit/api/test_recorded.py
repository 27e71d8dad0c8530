"""A run on record as tables, errors and figures: the numbers of the record, the report and the export."""

import builtins
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refused import refused

import zsim
from zsim.errors import RunError
from zsim_analysis.export import Format
from zsim_analysis.export.make_export import export
from zsim_analysis.reading.recorded_flight import read_flight

PAIR: dict[str, Any] = {
    "name": "pair",
    "seed": 3,
    "duration_s": 12,
    "sensors": {"preset": "paper"},
    "drones": [{"name": "d1", "position_m": [0, 3, 0]}, {"name": "d2", "position_m": [0, -3, 0]}],
    "clusters": [{"name": "main", "drones": ["d1", "d2"], "plan": {"takeoff_s": 0.1}}],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> zsim.Run:
    return zsim.run(PAIR, out=tmp_path_factory.mktemp("runs") / "pair", progress=False)


def test_a_table_has_simulated_time_as_index_and_units_in_its_columns(run: zsim.Run) -> None:
    truth = run.truth("d1")
    assert truth.index.name == "t_s"
    assert truth.index[[0, 1, -1]].tolist() == [0.0, 0.02, 12.0]
    track = read_flight(run.record).tracks[0]
    np.testing.assert_array_equal(truth[["position_m_x", "position_m_y", "position_m_z"]].to_numpy(), track.p_W)
    gps = run.sensor("d2", "gps")
    assert gps.index[1] - gps.index[0] == pytest.approx(0.2)
    assert gps["sigma_m"].iloc[0] == 2.0
    assert set(run.commands("d1").columns) >= {"velocity_m_s_x", "yaw_rate_rad_s", "source"}
    assert "takeoff" in run.commands("d1", "mode")["mode"].tolist()
    assert run.status("d1").state.iloc[0] == "landed"


def test_its_columns_are_those_of_an_export(run: zsim.Run, tmp_path: Path) -> None:
    export(run.folder, Format.CSV, tmp_path / "csv")
    for file, table in (("truth", run.truth("d1")), ("estimate", run.estimate("d1")), ("event", run.events)):
        header = (tmp_path / "csv" / f"{file}.csv").read_text().partition("\n")[0].replace('"', "").split(",")
        assert [*table.columns] == [name for name in header if name not in ("name", "t_s", "t_ns")]


def test_errors_are_those_of_the_report(run: zsim.Run) -> None:
    page = run.report()
    reported = json.loads((page.parent / "summary.json").read_text())
    errors = run.errors()
    for variable, of in reported["clusters"]["main"]["errors"].items():
        row = errors.loc["main", variable]
        assert [row[name] for name in of] == pytest.approx([*of.values()])
    assert errors.loc["main", "x_c"].unit == "m"
    assert run.truth_sha256 == reported["truth_sha256"]
    late = run.errors(window=(11, 12)).loc["main", "x_c"].true_rms
    formation = run.formation().loc[11:12]
    off = formation.truth_x_c_m - formation.desired_x_c_m
    assert late == pytest.approx(float(np.sqrt((off**2).mean())))
    assert np.isnan(run.errors(window=(0, 0.1)).true_rms).all()


def test_errors_of_estimates_are_against_the_truth(run: zsim.Run) -> None:
    errors = run.estimate_errors("d2")
    off = (run.estimate("d2").position_m_x - run.truth("d2").position_m_x).loc[errors.index]
    assert errors.x_m.to_numpy() == pytest.approx(off.to_numpy(), abs=1e-7)  # estimates are held as float32
    assert 0 < errors.nees.loc[8:].mean() < 20


def test_all_drones_are_one_dataset(run: zsim.Run) -> None:
    pytest.importorskip("xarray")
    data = run.xarray()
    assert dict(data.sizes) == {"t_s": 601, "drone": 2}
    assert data.truth_position_m_y.sel(drone="d2", t_s=0.0) == -3.0


def test_a_figure_is_that_of_the_report(run: zsim.Run) -> None:
    shape: Any = run.figure("shape")
    assert shape._repr_png_().startswith(b"\x89PNG")
    assert "$p$" in shape.axes[0].get_ylabel()


def test_a_run_shows_itself_in_a_notebook(run: zsim.Run) -> None:
    shown = run._repr_html_()
    assert "pair, seed 3, 2 drones" in shown
    assert "x_c" in shown


def test_without_pandas_tables_are_maps_of_arrays(run: zsim.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = run.truth("d1")
    kept = builtins.__import__

    def no_pandas(name: str, *more: Any) -> Any:
        if name == "pandas":
            raise ModuleNotFoundError(name=name)
        return kept(name, *more)

    monkeypatch.setattr(builtins, "__import__", no_pandas)
    table: Any = zsim.load(run.record).truth("d1")
    assert type(table) is dict
    assert table["t_s"].tolist() == frame.index.tolist()
    assert table["position_m_z"].tolist() == frame.position_m_z.tolist()


def test_what_is_not_on_record_is_named_with_what_is(run: zsim.Run, tmp_path: Path) -> None:
    with refused(RunError, "'d9';", "d1,"):
        run.truth("d9")
    with refused(RunError, "'gpss';", "gps?"):
        run.sensor("d1", "gpss")
    with refused(RunError, "'rotors';", "velocity"):
        run.commands("d1", "rotors")
    with refused(RunError, "'shap';", "shape?"):
        run.figure("shap")
    with refused(RunError, "'my/key';", "event,"):
        run.messages("my/key")
    with refused(RunError, "'side';", "main"):
        run.formation("side")
    with refused(RunError, "run.mcap"):
        zsim.load(tmp_path)
