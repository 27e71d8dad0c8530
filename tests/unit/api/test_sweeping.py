"""`zsim.sweep`: the data frame of runs, and classes and functions of a script in workers that do not execute it."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil
import pytest
from forked_commands import run_here
from refused import has_terms, refused
from short_flight import ONE, diverge

import zsim
from zsim.errors import RunError, ScenarioError
from zsim.scenario import scenario_file
from zsim.schema import plugin, yaml_file
from zsim_agents.formation.control_law import ControlLaw
from zsim_analysis.reading.recorded_flight import RecordedFlight
from zsim_analysis.sweep.sweep import load, read_table
from zsim_analysis.sweep.sweep_run import fly_scenario

PATIENCE_S = 120.0  # wall time allowed for processes to end
DOCUMENT = yaml_file.value(ONE)


def highest_m(flight: RecordedFlight) -> float:
    return max(float(track.p_W[:, 2].max()) for track in flight.tracks)


def counts(flight: RecordedFlight) -> dict[str, float | None]:
    return {"drones": len(flight.tracks), "nothing_m": None}


def fails(flight: RecordedFlight) -> float:
    raise ValueError(f"no {len(flight.tracks)}")


def climb_m(run: "zsim.Run") -> dict[str, float]:
    height_m = run.truth("d1")["position_m_z"].to_numpy()
    return {"climb_m": float(np.ptp(height_m)), "gates": len(height_m)}


@pytest.mark.parametrize("keep", [False, True])
def test_a_metric_gets_the_run_or_the_arrays_by_its_parameter_s_name(near: None, tmp_path: Path, keep: bool) -> None:
    frame: Any = zsim.sweep(
        DOCUMENT, {"seed": [4, 6]}, metrics=[climb_m, counts], out=tmp_path, keep_records=keep, progress=False
    )
    assert frame["metrics_failure"].isna().all()
    assert frame["metrics.gates"].tolist() == [26, 26]  # 0.5 s, including the first instant
    assert frame["metrics.drones"].tolist() == [1, 1]
    records = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("run.mcap"))
    assert records == ([f"runs/00000{run}/run.mcap" for run in range(2)] if keep else [])


def test_a_frame_has_a_row_per_run_with_values_and_metrics(near: None, tmp_path: Path) -> None:
    gusts = np.array([0.0, 0.5])
    frame: Any = zsim.sweep(
        DOCUMENT,
        {"seed": range(2, 4), "wind.gust_m_s": gusts},
        metrics=[highest_m, counts, fails],
        out=tmp_path / "swept",
        progress=False,
    )
    assert frame.index.tolist() == [0, 1, 2, 3]
    assert frame.index.name == "run"
    gust = "environment.wind.gust_m_s"
    assert frame[["seed", gust]].to_numpy().tolist() == [[2, 0.0], [2, 0.5], [3, 0.0], [3, 0.5]]
    assert frame["metrics.nothing_m"].isna().all()
    assert {str(frame[f"metrics.{name}"].dtype) for name in ("nothing_m", "highest_m")} == {"float64"}
    assert (frame["metrics.drones"] == 1).all()
    assert frame["metrics_failure"].str.contains("fails: ValueError: no 1").all()
    single, _ = fly_scenario(scenario_file.from_text(f"{ONE}environment: {{wind: {{gust_m_s: 0.5}}}}\n"))
    assert single.end is not None
    assert frame["truth_sha256"][3] == single.end["truth_sha256"]
    assert frame.attrs["folder"] == str(tmp_path / "swept")
    points = frame.attrs["summary"]["points"]
    assert [each["spreads"]["metrics.highest_m"]["mean"]["value"] for each in points] == pytest.approx(
        [frame.loc[frame[gust] == value, "metrics.highest_m"].mean() for value in gusts]
    )


SCRIPT = """
import zsim
from beside import FACTOR, Slow

print("the script runs")

class Law(Slow):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return GAIN * FACTOR * self.towards(c, c_des)

GAIN = 0.2

def highest_m(flight):
    return GAIN * float(max(track.p_W[:, 2].max() for track in flight.tracks))

frame = zsim.sweep(
    "pair.yaml",
    vary={"seed": [1, 2], "clusters.main.law": [Law, "proportional"]},
    metrics=[highest_m],
    workers=2,
    out="swept",
    keep_records=True,
)
print(frame["clusters.main.law"].tolist(), frame["failure"].isna().all(), frame["metrics.highest_m"].gt(0.01).all())
"""
BESIDE = """
from zsim_agents.formation.control_law import ControlLaw

FACTOR = 2.0

class Slow(ControlLaw):
    def towards(self, c, c_des):
        return self.space.inverse_jacobian(c) @ (c_des - c)
"""
PAIR = """
name: pair
duration_s: 2
drones:
  - {name: drone1, position_m: [2, 0, 0]}
  - {name: drone2, position_m: [-2, 0, 0]}
clusters: [{name: main, drones: [drone1, drone2], plan: {takeoff_s: 0.2}}]
"""


def write(folder: Path, **files: str) -> None:
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)


def test_workers_have_a_script_s_classes_without_executing_it_again(tmp_path: Path) -> None:
    """The script has no `if __name__ == "__main__"`, and its law derives from a class in a module beside it."""
    write(tmp_path, script_py=SCRIPT, beside_py=BESIDE, pair_yaml=PAIR)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [
        "the script runs",
        "['Law', 'proportional', 'Law', 'proportional'] True True",
    ], done.stderr
    assert " 4 / 4 runs" in done.stderr
    law = read_table(tmp_path / "swept/sweep.parquet")[0]["clusters.main.law"].partition(":")[0]
    assert law.startswith(plugin.MADE)
    assert (tmp_path / f"swept/runs/000000/{law}.py").exists()
    assert not (tmp_path / f"swept/runs/000001/{law}.py").exists()  # this run uses the built-in law
    again = run_here("rerun", "--trust", str(tmp_path / "swept/runs/000000"))
    assert again.code == 0, again


WAITING = """
import pathlib
import time
import zsim

def waits(flight):
    if flight.scenario.seed > 1:
        pathlib.Path("flying").touch()
        time.sleep(600)
    return 1.0

frame = zsim.sweep("one.yaml", {"seed": range(1, 4)}, metrics=[waits], workers=1, out=OUT)
print("not reached")
"""


def interrupted(folder: Path, out: str) -> subprocess.CompletedProcess[str]:
    """Run a sweep of three runs and interrupt it once the first one has finished."""
    write(folder, script_py=f"OUT = {out!r}\n{WAITING}", one_yaml=ONE)
    with subprocess.Popen(
        [sys.executable, "script.py"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        while not (folder / "flying").exists() and process.poll() is None:
            time.sleep(0.05)
        workers = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        output, errors = process.communicate()
    assert workers
    assert psutil.wait_procs(workers, PATIENCE_S)[1] == []
    return subprocess.CompletedProcess([], process.returncode, output, errors)


def test_ctrl_c_ends_the_workers_and_keeps_finished_runs(near: None, tmp_path: Path) -> None:
    done = interrupted(tmp_path, "swept")
    assert done.stdout == ""
    assert done.returncode == -signal.SIGINT
    assert has_terms(done.stderr, "interrupted", "1 of 3", "out='swept'")
    (kept,) = read_table(tmp_path / "swept/sweep.parquet")
    assert (kept["seed"], kept["metrics.waits"]) == (1, 1.0)
    plan = load(tmp_path / "swept").plan
    assert (plan.runs, plan.vary) == (3, ("seed=1,2,3",))


def test_the_remains_of_a_killed_sweep_are_removed_by_the_next_one(tmp_path: Path) -> None:
    """The remains are the sweep's folder, the modules of the script's definitions, and the record of a worker's run."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary)}
    waiting = (
        WAITING.replace("(flight)", "(run)").replace("flight.", "run.").replace("scenario.seed", "scenario['seed']")
    )
    write(tmp_path, script_py=f"OUT = None\n{waiting}", one_yaml=ONE)
    with subprocess.Popen(
        [sys.executable, "script.py"], cwd=tmp_path, env=environment, start_new_session=True
    ) as killed:
        while not (tmp_path / "flying").exists() and killed.poll() is None:
            time.sleep(0.05)
        started = psutil.Process(killed.pid).children(recursive=True)
        killed.kill()
    assert psutil.wait_procs(started, PATIENCE_S)[1] == []
    left = {path.name.partition("-")[0] for path in temporary.glob("*/*")}
    assert left == {"modules", "sweep", "run"}
    write(tmp_path, next_py="import zsim; zsim.sweep('one.yaml', {'seed': [1]}, workers=1, progress=False)")
    subprocess.run([sys.executable, "next.py"], cwd=tmp_path, env=environment, check=True)
    assert [*temporary.iterdir()] == []


def test_a_repeated_call_flies_only_the_missing_runs(
    near: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def call(count: int) -> pd.DataFrame:
        return zsim.sweep(DOCUMENT, {"seed": range(count)}, metrics=[highest_m], out=tmp_path / "swept")

    first, whole = call(2), call(3)
    assert has_terms(capsys.readouterr().err, "2", "already done")
    pd.testing.assert_frame_equal(whole.iloc[:2], first)
    with refused(RunError, "it varies seed=0,1,2", "give out"):
        call(1)
    with refused(RunError, "it has 3 runs"):
        zsim.sweep(DOCUMENT, {"seed": range(3)}, runs=2, metrics=[highest_m], out=tmp_path / "swept")


def test_a_run_that_fails_is_a_row_with_its_reason(
    near: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    diverge(monkeypatch)
    frame: Any = zsim.sweep(DOCUMENT, {"seed": [1, 2]})
    assert frame["failure"].str.contains("d1").all()
    assert frame["seed"].tolist() == [1, 2]
    shown = capsys.readouterr().err.splitlines()
    assert shown[-1] == f"2 of 2 runs failed: {frame['failure'][0]}"


def test_missing_values_have_the_same_types_in_good_and_failed_sweeps(
    near: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    good: Any = zsim.sweep(DOCUMENT, {"seed": [1, 2]}, progress=False)
    assert good["failure"].isna().all()
    assert (good["failure"] != "").all()
    assert not good["failure"].str.contains("d1").any()
    assert len(good[~good["crashed"]]) == 2
    diverge(monkeypatch)
    bad: Any = zsim.sweep(DOCUMENT, {"seed": [1, 2]}, progress=False)
    assert bad["failure"].str.contains("d1").all()
    shared = [column for column in good if column in bad]
    assert {"failure", "shortfall", "engaged", "collisions", "truth_sha256", "wall_s"} <= {*shared}
    assert good[shared].dtypes.to_dict() == bad[shared].dtypes.to_dict()
    missing = [value for column in ("failure", "shortfall") for value in good[column]]
    assert [*map(type, missing)] == [float] * 4


def made_law(gain: float) -> type:
    class Law(ControlLaw):
        def rates(self, c: Any, p_W: Any, v_W: Any, c_des: Any, c_dot_des: Any) -> Any:
            return self.space.inverse_jacobian(c) @ (gain * (c_des - c))

    return Law


def test_classes_created_by_one_function_have_distinct_names(near: None, tmp_path: Path) -> None:
    laws = [made_law(0.1), made_law(0.2), made_law(0.3), "proportional"]
    laws[2].__name__ = "Law 0.3"
    frame: Any = zsim.sweep(
        yaml_file.value(PAIR), {"clusters.main.law": laws}, duration_s=0.5, out=tmp_path / "swept", progress=False
    )
    assert frame["failure"].isna().all()
    assert frame["clusters.main.law"].tolist() == ["Law", "Law-2", "Law 0.3", "proportional"]
    labels = [each["label"] for each in frame.attrs["summary"]["points"]]
    assert labels[:2] == ["Law", "Law-2"]


BAD: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "no sequence": ({"seed": 5}, ("vary", "seed", "5", "sequence", "values")),
    "twice": ({"seed": [1, 1]}, ("vary", "seed=1,1", "1", "once")),
    "nothing": ({"seed": []}, ("vary", "seed=", "no value")),
    "no field": ({"no.such": [1]}, ("no", "not known")),
    "no value of YAML": ({"seed": [object()]}, ("vary", "seed", "object", "YAML")),
    "out of range": ({"duration_s": [1, -1]}, ("duration_s", "-1", "0")),
    "no words": ({"duration_s": "uniform(2, 1)"}, ("vary", "duration_s=uniform(2,", "low", "high")),
}


@pytest.mark.parametrize("case", BAD)
def test_an_invalid_variation_is_refused_before_any_run(case: str) -> None:
    vary, terms = BAD[case]
    with refused(ScenarioError, *terms) as raised:
        zsim.sweep(DOCUMENT, vary)
    assert "--" not in str(raised.value)


CELL = """
import zsim
from zsim_agents.formation.control_law import ControlLaw

class Law(ControlLaw):
    def rates(self, c, p_W, v_W, c_des, c_dot_des):
        return self.space.inverse_jacobian(c) @ (0.3 * (c_des - c))

def drones(flight):
    return len(flight.tracks)

frame = zsim.sweep("pair.yaml", {"clusters.main.law": [Law, "proportional"]}, metrics=[drones], workers=1)
print(frame["clusters.main.law"].tolist(), frame["failure"].isna().all(), frame["metrics.drones"].tolist())
"""


@pytest.mark.slow
def test_a_notebook_cell_shows_progress_in_one_updated_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    write(tmp_path, pair_yaml=PAIR)
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # the kernel is killed at the end and leaves temporary files
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    options = {"resources": {"metadata": {"path": str(tmp_path)}}, "kernel_name": "python3"}
    nbclient.NotebookClient(notebook, timeout=300, **options).execute()
    outputs = notebook.cells[0].outputs
    printed = "".join(each.text for each in outputs if each.get("name") == "stdout")
    assert printed == "['Law', 'proportional'] True [2.0, 2.0]\n"
    lines = [each.data["text/plain"] for each in outputs if "█" in each.get("data", {}).get("text/plain", "")]
    assert len(lines) == 1  # it is updated in place
    assert " 2 / 2 runs" in lines[0]
    assert not [each for each in outputs if each.get("name") == "stderr"]  # no warning about a missing widget


@pytest.mark.slow
def test_an_interrupted_cell_ends_its_workers_and_keeps_its_folder(tmp_path: Path) -> None:
    jupyter = pytest.importorskip("jupyter_client")
    pytest.importorskip("ipykernel")
    write(tmp_path, one_yaml=ONE)
    manager, client = jupyter.manager.start_new_kernel(kernel_name="python3", cwd=str(tmp_path))
    try:
        sent = client.execute(f"OUT = None\n{WAITING}", stop_on_error=False)  # else its error aborts the next request
        while not (tmp_path / "flying").exists():
            time.sleep(0.05)
        kernel = psutil.Process(manager.provisioner.process.pid)
        workers = [each for each in kernel.children(recursive=True) if "spawn_main" in " ".join(each.cmdline())]
        assert len(workers) == 1
        manager.interrupt_kernel()
        replies = iter(lambda: client.get_shell_msg(timeout=PATIENCE_S), None)  # start-up replies come first
        reply = next(each for each in replies if each["parent_header"]["msg_id"] == sent)
        assert reply["content"]["ename"] == "KeyboardInterrupt"
        shown = iter(lambda: client.get_iopub_msg(timeout=PATIENCE_S)["content"], None)
        folder = next(found[1] for each in shown if (found := re.search(r"out='([^']*)' continues", str(each))))
        assert psutil.wait_procs(workers, PATIENCE_S)[1] == []
        again = client.execute("assert 'frame' not in globals()", reply=True, timeout=PATIENCE_S)
        assert again["content"]["status"] == "ok"
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
    assert [row["seed"] for row in read_table(Path(folder) / "sweep.parquet")] == [1]
    shutil.rmtree(folder)


@pytest.mark.soak
def test_workers_of_a_dask_client_get_the_script_s_modules(tmp_path: Path) -> None:
    """The workers run in a folder in which the modules cannot be found."""
    pytest.importorskip("distributed")
    script = f"""
import logging
import distributed

if __name__ == "__main__":  # for the cluster, whose workers Dask starts
    options = {{"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}}
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, **options) as cluster:
        with distributed.Client(cluster) as client:
            {
        SCRIPT.strip()
        .replace(chr(10), chr(10) + " " * 12)
        .replace("workers=2", "client=client")
        .replace("keep_records=True,", "")
    }
            print(client.status)
"""
    write(tmp_path, script_py=script, beside_py=BESIDE, pair_yaml=PAIR)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [
        "the script runs",
        "['Law', 'proportional', 'Law', 'proportional'] True True",
        "running",  # the client stays open
    ], done.stderr
    with refused(RunError, "client", "'object'", "distributed.Client"):
        zsim.sweep(DOCUMENT, {"seed": [1]}, client=object(), out=tmp_path / "other")


def test_a_sweep_without_pandas_is_refused_before_any_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with refused(RunError, "pandas"):
        zsim.sweep(DOCUMENT, {"seed": [1]}, duration_s=1, out=tmp_path / "sweep")
    assert not (tmp_path / "sweep").exists()
