"""`zsim sweep` gives the same bits as single runs with any workers, and after kills and interruptions."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import forked_commands
import psutil
import pyarrow.parquet as pq
import pytest
from federation import PAIR, Federation, Role, free_port
from forked_commands import USER_FAULT
from refused import has_terms
from wire import PATIENCE_S

from zsim_analysis.report import indented_json
from zsim_analysis.report.summary import judge
from zsim_analysis.sweep.sweep import load, locked

GUST = "environment.wind.gust_m_s"
DURATION_S, LONG_S = 10.0, 40.0  # LONG_S is long enough for a signal to arrive before a run ends
FLIGHT = ("--set", "drones.drone1.mass_kg=0.45")
PLAN = ("--vary", "seed", "--vary", "wind.gust_m_s=0,1", *FLIGHT)
RUNS = 4
FIRST = rf" [1-{RUNS - 1}] / {RUNS} runs"  # a line of progress while runs are left
WALL = ("wall_s", "real_time_factor", "date")  # the only columns that may differ between two sweeps


def rows(out: Path) -> list[dict[str, Any]]:
    return pq.read_table(out / "sweep.parquet").to_pylist()


def without_wall(out: Path) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name not in WALL} for row in rows(out)]


def sweep(federation: Federation, out: Path, *options: str, duration_s: float = LONG_S) -> Role:
    path = federation.write(PAIR, "pair.yaml")
    fixed = ("--runs", str(RUNS), "--duration", str(duration_s), "--out", str(out), "--no-report")
    return federation.start("sweep", path, *PLAN, *fixed, *options)


def workers(role: Role) -> list[psutil.Process]:
    """Return the worker processes, without multiprocessing's resource tracker."""
    children = psutil.Process(role.process.pid).children()
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def gone(processes: list[psutil.Process]) -> bool:
    return psutil.wait_procs(processes, PATIENCE_S)[1] == []


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of an undisturbed sweep by two workers, with its report."""
    folder = tmp_path_factory.mktemp("undisturbed")
    with Federation(folder) as federation:
        options = ("--workers", "2", "--report")
        sweep(federation, folder / "sweep", *options, duration_s=DURATION_S).ends(with_code=0)
    return folder / "sweep"


@pytest.fixture(scope="module")
def undisturbed_for_long(tmp_path_factory: pytest.TempPathFactory, compiled: None) -> Path:
    """The folder of an undisturbed sweep of longer runs."""
    folder = tmp_path_factory.mktemp("undisturbed_for_long")
    with Federation(folder) as federation:
        sweep(federation, folder / "sweep", "--workers", "2").ends(with_code=0)
    return folder / "sweep"


def test_a_run_of_a_sweep_has_the_bits_of_a_single_run(federation: Federation, undisturbed: Path) -> None:
    row = rows(undisturbed)[3]
    options = ("--in-process", "--duration", str(DURATION_S), *FLIGHT, "--seed", str(row["seed"]))
    federation.run(PAIR, *options, "--set", f"{GUST}={row[GUST]}").ends(with_code=0)
    summary = json.loads(indented_json(judge(federation.out / "run.mcap")[2]))  # as `zsim report` writes it
    assert row["truth_sha256"] == summary["truth_sha256"] == federation.record().sha256()
    assert row["min_separation_m"] == summary["min_separation_m"]
    for parameter, errors in summary["errors"].items():
        assert {each: row[f"errors.{parameter}.{each}"] for each in errors} == errors


def test_a_sweep_writes_its_table_and_report(undisturbed: Path) -> None:
    found = rows(undisturbed)
    assert [row["run"] for row in found] == list(range(RUNS))
    assert [row[GUST] for row in found] == [0, 1, 0, 1]
    assert len({row["seed"] for row in found}) == len({row["truth_sha256"] for row in found}) == RUNS
    assert all(row["failure"] is None and row["sim_s"] == DURATION_S for row in found)
    assert sorted(path.name for path in undisturbed.iterdir() if not path.name.startswith(".")) == [
        "figures",
        "plan.json",
        "report.html",
        "summary.json",
        "sweep.parquet",
    ]
    points = json.loads((undisturbed / "summary.json").read_text())["points"]
    assert [(point["values"][GUST], point["runs"]) for point in points] == [(0, 2), (1, 2)]


@pytest.mark.soak  # in CI, the next test covers kills
def test_a_killed_worker_is_replaced_and_its_run_repeated(federation: Federation, undisturbed_for_long: Path) -> None:
    out = federation.folder / "sweep"
    role = sweep(federation, out, "--workers", "1")
    role.line(FIRST)
    (worker,) = workers(role)
    worker.kill()
    role.ends(with_code=0)
    assert "SIGKILL" in role.text()
    assert without_wall(out) == without_wall(undisturbed_for_long)


@pytest.mark.soak
def test_an_interrupted_or_killed_sweep_can_be_continued(federation: Federation, undisturbed_for_long: Path) -> None:
    """Finished runs are kept and not repeated; no worker outlives the sweep."""
    out = federation.folder / "sweep"
    role = sweep(federation, out, "--workers", "1", "--keep-records")
    role.line(FIRST)
    flying = workers(role)
    os.killpg(role.process.pid, signal.SIGINT)  # to all of its processes, as a terminal sends it
    role.ends(with_code=130)
    assert gone(flying)
    assert f"--out {out}" in role.text()
    kept = rows(out)
    assert 1 <= len(kept) < RUNS

    role = sweep(federation, out, "--workers", "1", "--keep-records")
    role.line(f"{len(kept)} of them (is|are) already done")
    role.line(rf" [{len(kept) + 1}-{RUNS}] / {RUNS} runs")
    flying = workers(role)
    role.signal(signal.SIGKILL)
    role.ends(with_code=-signal.SIGKILL)
    assert gone(flying)
    done = len(kept) + (out / "journal.jsonl").read_text().count("\n")
    assert done > len(kept)

    role = sweep(federation, out, "--workers", "1", "--keep-records")
    role.ends(with_code=0)
    role.line(f"{done} of them are already done")
    assert without_wall(out) == without_wall(undisturbed_for_long)
    assert rows(out)[: len(kept)] == kept
    assert sorted(path.name for path in (out / "runs").iterdir()) == [f"{run:06d}" for run in range(RUNS)]
    assert all((path / "run.mcap").stat().st_size > 10_000 for path in (out / "runs").iterdir())
    role = sweep(federation, out, "--seed", "9")
    role.ends(with_code=2)
    assert has_terms(role.text(), f"{out}: ", "seed", "--out")


def test_failed_runs_have_rows(federation: Federation, near: None) -> None:
    """One combination cannot be flown; the others are, and the sweep exits with 1."""
    out, path = federation.folder / "sweep", federation.write(PAIR, "pair.yaml")
    values = "processes.expect=[estimator.drone1,estimator.drone2,controller.main],[console.1]"
    done = forked_commands.run_here(
        "sweep", path, "--vary", values, "--duration", "0.2", "--out", str(out), "--workers", "1", "--no-report"
    )
    assert done.code == 1, done
    failures = [row["failure"] for row in rows(out)]
    reason = "the world waits for console.1, not run in-process; see `processes.expect`"
    assert failures == [None, reason]
    assert reason in done.stderr


FIGURES = """
def length_s(flight):
    if flight.scenario.duration_s > 0.3:
        raise ValueError("too\\nlong")
    return {"length_s": flight.last_ns / 1e9}
"""


def test_a_failing_user_metric_affects_only_its_run(federation: Federation) -> None:
    """The worker process loads the module from the scenario's folder."""
    out, path = federation.folder / "sweep", federation.write(PAIR, "pair.yaml")
    (federation.folder / "figures_of_mine.py").write_text(FIGURES)
    options = ("--vary", "duration_s=0.2,0.4", "--set", "report.metrics=figures_of_mine:length_s", "--workers", "1")
    role = federation.start("sweep", path, *options, "--out", str(out))
    role.ends(with_code=0)
    assert [row["failure"] for row in rows(out)] == [None, None]
    assert [row["metrics.length_s"] for row in rows(out)] == [0.2, None]
    assert rows(out)[1]["metrics_failure"] == "report.metrics figures_of_mine:length_s: ValueError: too long"
    assert has_terms(role.text(), "run 1", "report.metrics", "ValueError", "too long")
    assert "Traceback" not in role.text()
    assert "length (s)" in (out / "report.html").read_text()


@pytest.mark.soak
@pytest.mark.parametrize(
    "name", [pytest.param("stüp.yaml", marks=pytest.mark.soak), b"st\xfcp.yaml".decode(errors="surrogateescape")]
)
def test_a_scenario_file_may_have_any_name(federation: Federation, name: str) -> None:
    """This holds in an ASCII-only locale, too."""
    out, path = federation.folder / "sweep", federation.write(PAIR, name)
    ascii_only = ("env", "LC_ALL=C", "PYTHONUTF8=0")
    options = ("--duration", "0.2", "--workers", "1", "--out", str(out))
    federation.start("sweep", path, *options, prefix=ascii_only).ends(with_code=0)
    assert [row["failure"] for row in rows(out)] == [None]
    federation.start("sweep", path, *options).ends(with_code=0)


BAD = {
    "no such field": (("--vary", "wings=1"), "wings is not known; allowed: "),
    "several at once": (("--vary", "duration_s=1,-1", "--vary", "time.gate_ms=0"), "\npair.yaml: duration_s is -1"),
    "not a variation": (
        ("--vary", "duration_s"),
        "--vary duration_s: is not a variation; must be seed, seed=paired, a.b.c=v1,v2",
    ),
    "a bad override": (("--set", "drones.drone9.mass_kg=1"), "--set drones.drone9.mass_kg=1: drone9 is not in drones"),
    "too few runs": (("--vary", "duration_s=1,2,3", "--runs", "2"), "--runs is 2; must be at least 3"),
    "the same again": (("--runs", "2"), "--runs is 2; must be 1"),
    "no runs": (("--runs", "0"), "invalid value for '--runs'"),
    "workers and dask": (("--workers", "2", "--dask", "tcp://127.0.0.1:9"), "--workers"),
    "no scheduler": (("--dask", "nonsense://127.0.0.1:9"), "--dask nonsense://127.0.0.1:9: no scheduler"),
    "a file in the way": (("--out", __file__), "cannot be created"),
}


def test_bad_sweep_options_are_refused(federation: Federation) -> None:
    path = federation.write(PAIR, "pair.yaml")
    for name, (options, text) in BAD.items():
        done = forked_commands.run_forked("sweep", path, "--out", str(federation.folder / "sweep"), *options)
        assert done.code == USER_FAULT, name
        assert text in done.stderr, name
        assert "Traceback" not in done.stderr
    assert not (federation.folder / "sweep/sweep.parquet").exists() or rows(federation.folder / "sweep") == []


# Dask


@pytest.fixture
def cluster() -> Iterator[str]:
    """The address of a Dask cluster of two processes on this host."""
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    from distributed import LocalCluster

    options: dict[str, Any] = {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
    local: Any = LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **options)
    with local:
        yield local.scheduler_address


@pytest.mark.soak
def test_a_dask_cluster_produces_the_same_rows(
    federation: Federation, undisturbed_for_long: Path, cluster: str
) -> None:
    """The cluster continues a sweep that other workers have begun."""
    out = federation.folder / "sweep"
    with locked(out, load(undisturbed_for_long).plan) as folder, folder.journal() as journal:
        journal.append(rows(undisturbed_for_long)[1])
    role = sweep(federation, out, "--dask", cluster)
    role.ends(with_code=0)
    assert re.search(r"\b1 of them\b", role.text())
    assert re.search(r"\b2 Dask workers .*tcp://127.0.0.1:", role.text())
    assert without_wall(out) == without_wall(undisturbed_for_long)


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """The address and process of a Dask scheduler with one worker, for tests that kill it."""
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    from distributed import Client

    dask, output = [sys.executable, "-m", "dask"], tmp_path / "dask.log"
    address = f"tcp://127.0.0.1:{free_port()}"
    where = ("--no-dashboard", "--host", "127.0.0.1")
    with output.open("w") as log:
        scheduler = subprocess.Popen([*dask, "scheduler", *where, "--port", address.rpartition(":")[2]], stderr=log)
        worker = subprocess.Popen([*dask, "worker", address, *where, "--nthreads", "1", "--no-nanny"], stderr=log)
    try:
        with Client(address, timeout=PATIENCE_S, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=PATIENCE_S)
        yield address, scheduler
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()


@pytest.mark.soak
def test_the_death_of_a_dask_scheduler_is_reported(
    federation: Federation, hosts: tuple[str, subprocess.Popen[bytes]]
) -> None:
    (address, scheduler), out = hosts, federation.folder / "sweep"
    path = federation.write(PAIR, "pair.yaml")
    command = ("sweep", path, "--vary", "seed", "--duration", "2", "--out", str(out), "--no-report", "--dask", address)
    role = federation.start(*command, "--runs", "500")
    role.line(r" [1-9]\d* / 500 runs")
    scheduler.kill()
    role.ends(with_code=2)
    assert f"--dask {address}: " in role.text().splitlines()[-1]
    assert "Traceback" not in role.text()
    assert 1 <= len(rows(out)) < 500
