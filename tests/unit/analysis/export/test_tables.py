"""Tables and MATLAB files: what pandas, pyarrow, scipy and Octave read is what was recorded."""

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import recorded_run
import scipy.io
from recorded_run import messages_on
from refused import has_terms, refused
from synthetic_pictures import image, info, sightings
from typer.testing import CliRunner

from zsim.contract import flight_messages, keys, messages
from zsim.contract.flight_messages import CameraImage, Sightings
from zsim.errors import ReportError, RunError
from zsim.record import RecordReader, RecordWriter
from zsim.sensors.sensor import message_type
from zsim_analysis.export import Format, make_export
from zsim_analysis.export.columns import MessageSelection, Sighting, table_columns, table_name
from zsim_analysis.export.make_export import export, matlab_names, staged_outputs
from zsim_deploy import arguments
from zsim_deploy.cli.cli import app

GATES = 301  # number of gates in a run of 6 s
ROTORS = ("front_left", "front_right", "rear_right", "rear_left")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run with a message of every kind, exported in all three forms."""
    folder = tmp_path_factory.mktemp("run")
    recorded_run.write(folder / "run.mcap")
    for each in (Format.CSV, Format.PARQUET, Format.MAT):
        export(folder, each)
    return folder


def counts(run: Path) -> dict[str, int]:
    """Return the number of recorded messages per table, without the commands repeated for drivers."""
    found = Counter[str]()
    with RecordReader(run / "run.mcap") as reader:
        for key, count in reader.topics().items():
            kind = messages.type_of(key)
            if kind is not CameraImage and "/accepted/" not in key:
                kind = Sighting if kind is Sightings else kind  # each shows one hat here
                found[table_name(kind) if kind else "foreign"] += count
    return found


READ: dict[str, Any] = {"csv": pd.read_csv, "parquet": pd.read_parquet}


def csv(run: Path, name: str) -> Any:
    return pd.read_csv(run / "csv" / f"{name}.csv")


@pytest.mark.parametrize("suffix", READ)
def test_every_message_is_a_row_of_its_table(run: Path, suffix: str) -> None:
    found = {path.stem: len(READ[suffix](path)) for path in (run / suffix).glob(f"*.{suffix}")}
    assert found == counts(run)


@pytest.mark.parametrize("drone", ["drone1", "a-b.c", "end"])
def test_truth_is_exported_bit_for_bit(run: Path, drone: str) -> None:
    truths = messages_on(run, keys.truth(drone))
    for suffix, read in READ.items():
        table = read(run / suffix / f"truth.{suffix}")
        mine = table[table["name"] == drone]
        assert len(mine) == GATES
        assert mine["t_ns"].tolist() == [truth.t_ns for truth in truths]
        assert mine["t_s"].tolist() == [truth.t_ns / 1e9 for truth in truths]
        for field, columns in {
            "position_m": ["position_m_x", "position_m_y", "position_m_z"],
            "orientation_wxyz": ["orientation_w", "orientation_x", "orientation_y", "orientation_z"],
            "rotor_rad_s": [f"rotor_rad_s_{place}" for place in ROTORS],
        }.items():
            assert mine[columns].to_numpy().tolist() == [list(getattr(truth, field)) for truth in truths]


def test_covariances_sensors_and_variables_have_a_column_each(run: Path) -> None:
    table, estimates = csv(run, "estimate"), messages_on(run, keys.estimate("end"))
    mine = table[table["name"] == "end"]
    assert mine["covariance_01"].tolist() == [estimate.covariance[1] for estimate in estimates]
    assert mine["covariance_55"].tolist() == [estimate.covariance[35] for estimate in estimates]
    used = [estimate.sensors.get("gps", (np.nan, np.nan))[0] for estimate in estimates]
    np.testing.assert_array_equal(mine["sensors_gps_used"], used)
    states, table = messages_on(run, keys.cluster_state("main")), csv(run, "cluster_state")
    assert table["desired_beta"].tolist() == [state.desired[state.names.index("beta")] for state in states]
    assert table["phase"].tolist() == [state.phase for state in states]
    assert table["trajectory_t_s"].isna().all()
    assert set(csv(run, "status")["collision"]) <= {0, 1}
    assert pq.read_schema(run / "parquet" / "status.parquet").field("collision").type == "bool"


def test_data_without_columns_is_exported_as_json(run: Path) -> None:
    events = csv(run, "event")
    recorded = messages_on(run, keys.EVENT)
    assert [json.loads(text) for text in events["data"]] == [msgspec.to_builtins(event.data) for event in recorded]
    foreign = csv(run, "foreign")
    assert json.loads(foreign["content"][0])["x"] == [1, 2]
    assert json.loads(foreign["content"][1]) == {"hexadecimal": "c100"}
    info = csv(run, "info")
    assert json.loads(info["drones"][0])[1]["name"] == "a-b.c"
    assert info["origin_latitude_deg"][0] == messages_on(run, keys.INFO)[0].origin.latitude_deg


def test_the_manifest_describes_the_tables(run: Path) -> None:
    manifest = json.loads((run / "csv" / "export.json").read_bytes())
    assert manifest["complete"] is True
    assert [note for note in manifest["notes"] if not has_terms(note, "2", "pictures")] == []
    row_counts = {file.removesuffix(".csv"): table["rows"] for file, table in manifest["tables"].items()}
    assert row_counts == counts(run)
    for file, table in manifest["tables"].items():
        assert (run / "csv" / file).read_text().splitlines()[0] == ",".join(f'"{name}"' for name in table["columns"])


def test_columns_are_unique_and_each_sensor_of_a_module_has_a_table() -> None:
    for kind in set(messages.types_by_shape().values()):
        names = [column for field in table_columns(kind, {}) for column in field.columns]
        assert len(names) == len(set(names)), kind
    left, right = (message_type("Ranged", {"range_m": "number"}, name) for name in ("left", "right"))
    assert [table_name(left), table_name(right)] == ["sensor_left", "sensor_right"]


def test_a_matlab_file_has_a_struct_per_drone(run: Path) -> None:
    loaded = scipy.io.loadmat(run / "run.mat", simplify_cells=True)
    assert set(loaded["truth"]) == {"drone1", "a_b_c", "xend"}
    for drone, valid in {"drone1": "drone1", "a-b.c": "a_b_c", "end": "xend"}.items():
        truths, struct = messages_on(run, keys.truth(drone)), loaded["truth"][valid]
        assert struct["name"] == drone
        assert struct["t_ns"].dtype == np.int64
        np.testing.assert_array_equal(struct["position_m"], [truth.position_m for truth in truths])
        np.testing.assert_array_equal(struct["orientation_wxyz"], [truth.orientation_wxyz for truth in truths])
    estimate = messages_on(run, keys.estimate("drone1"))
    struct = loaded["estimate"]["drone1"]
    assert struct["covariance"].shape == (GATES, 36)
    np.testing.assert_array_equal(struct["sensors"]["gps"][-1], estimate[-1].sensors["gps"])
    states = messages_on(run, keys.cluster_state("main"))
    struct = loaded["cluster_state"]["main"]
    assert struct["names"].tolist() == list(states[0].names)
    np.testing.assert_array_equal(struct["desired"], [state.desired for state in states])


@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="Octave is not installed")
def test_octave_loads_the_matlab_file(run: Path) -> None:
    script = (
        f"load('{run / 'run.mat'}'); t = truth.a_b_c; "
        "printf('%d %d %.17g %s %s %s\\n', size(t.position_m), t.position_m(end, 3), class(t.t_ns), "
        "cellstr(status.xend.state){end}, cluster_state.main.names{1});"
    )
    done = subprocess.run(["octave-cli", "--norc", "--eval", script], capture_output=True, text=True, timeout=120)
    z = messages_on(run, keys.truth("a-b.c"))[-1].position_m[2]
    state = messages_on(run, keys.status("end"))[-1].state
    assert done.stdout.split() == [str(GATES), "3", f"{z:.17g}", "int64", state, "x_c"], done.stderr


def test_matlab_names_are_valid_and_unique() -> None:
    names = ["a.b", "a-b", "a_b", "2nd", "_x", "end", "for", "é", "q" * 80, "q" * 81]
    made = set(matlab_names(names).values())
    assert len(made) == len(names)
    assert all(valid.isascii() and valid.isidentifier() and valid[0] != "_" and len(valid) <= 63 for valid in made)
    assert not made & make_export.KEYWORDS


def test_a_variable_too_large_for_matlab_is_refused(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make_export, "VARIABLE_MAX", 100_000)
    estimates = MessageSelection(("drone/*/estimate",))
    with refused(ReportError, "estimate", "GiB", "MATLAB", "--keys", "--from", "--to"):
        export(run, Format.MAT, tmp_path / "all.mat", estimates)
    assert not list(tmp_path.iterdir())
    done = export(run, Format.MAT, tmp_path / "some.mat", estimates._replace(from_s=1.0, to_s=1.1))
    assert done.tables == {"estimate": 3 * 6}


def test_values_absent_from_a_message_are_empty(tmp_path: Path) -> None:
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for k, drones in enumerate([("a", "b"), ("c",)]):
            names = ("x_c", "y_c", "z_c", "yaw", "pitch", "phi_1", "phi_2", "p")[: 4 * len(drones)]
            values = (1.5,) * len(names)
            state = flight_messages.ClusterState(k, 0, "engaged", drones, names, values, values, values, None, 1.0, "")
            writer.add_message(keys.cluster_state(f"of_{len(drones)}"), state, k)
    export(tmp_path, Format.CSV)
    export(tmp_path, Format.PARQUET)
    lines = (tmp_path / "csv" / "cluster_state.csv").read_text().splitlines()
    place = lines[0].split(",").index('"value_p"')
    assert "nan" not in lines[2]
    assert [line.split(",")[place] for line in lines[1:]] == ["1.5", ""]
    column = pq.read_table(tmp_path / "parquet" / "cluster_state.parquet").column("value_p")
    assert (column.null_count, column.to_pylist()) == (1, [1.5, None])


def test_messages_are_selected_by_keys_and_times(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "run.mcap", tmp_path / "flight1.mcap")
    done = export(tmp_path / "flight1.mcap", Format.CSV, selection=MessageSelection(("clock",)))
    assert (done.paths, done.tables) == ((tmp_path / "csv",), {"clock.csv": counts(run)["clock"]})
    selection = MessageSelection(("drone/*/truth", "cluster/**"), from_s=1.0, to_s=2.0)
    done = export(run, Format.PARQUET, tmp_path / "some", selection)
    assert done.tables == {"cluster_state.parquet": 51, "truth.parquet": 153}
    times = pd.read_parquet(tmp_path / "some" / "truth.parquet")["t_ns"]
    assert (times.min(), times.max()) == (1_000_000_000, 2_000_000_000)
    with refused(ReportError, "run.mcap", "drone/nobody/**", "messages"):
        export(run, Format.CSV, tmp_path / "none" / "a" / "b", MessageSelection(("drone/nobody/**",)))
    assert not (tmp_path / "none").exists()  # not even the parent folders are created


def test_nothing_is_overwritten_without_force(run: Path, tmp_path: Path) -> None:
    some = MessageSelection(("clock",))
    export(run, Format.CSV, tmp_path / "out", some)
    with refused(ReportError, str(tmp_path / "out"), "--out", "--force"):
        export(run, Format.CSV, tmp_path / "out", some)
    export(run, Format.CSV, tmp_path / "out", MessageSelection(("world/info",)), force=True)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"info.csv", "export.json"}
    for _ in range(2):
        export(run, Format.MAT, tmp_path / "again.mat", some, force=True)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("precious")
    for form, target, *terms in (
        (Format.CSV, tmp_path / "home", "folder", "not an export"),
        (Format.MAT, run / "run.mcap", "record", "itself"),
        (Format.MAT, tmp_path / "home" / "thesis.tex", "file", "not an export"),
    ):
        with refused(ReportError, str(target), *terms):
            export(run, form, target, some, force=True)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "precious"
    (tmp_path / "home" / "export.json").write_text("[]")
    with pytest.raises(ReportError, match=r"export\.json"):
        export(run, Format.CSV, tmp_path / "home", some, force=True)


def test_force_does_not_replace_files_that_no_export_wrote(run: Path, tmp_path: Path) -> None:
    some, out = MessageSelection(("clock",)), tmp_path / "out"
    export(run, Format.CSV, out, some)
    for name in ("plots", "notes.txt"):
        (out / name).mkdir() if name == "plots" else (out / name).write_text("precious")
        with pytest.raises(ReportError, match=rf" {name}\).*--out"):
            export(run, Format.CSV, out, some, force=True)
    assert {path.name for path in out.iterdir()} == {"clock.csv", "export.json", "plots", "notes.txt"}
    shutil.copy(run / "run.mcap", tmp_path / "flight1.mcap")
    (tmp_path / "own.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64, Created on: Sun Nov 22".ljust(128))
    for name in ("flight1.mcap", "own.mat"):
        before = (tmp_path / name).read_bytes()
        with refused(ReportError, str(tmp_path / name), "file", "not an export"):
            export(run, Format.FOXGLOVE, tmp_path / name, MessageSelection(("clock",)), force=True)
        assert (tmp_path / name).read_bytes() == before


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("step", range(4))
def test_an_interrupt_while_an_export_is_put_in_place_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, after: bool
) -> None:
    """An interrupt before or after any of the four moves that replace a folder and a file leaves both as they were."""
    folder, file, moves, replace = tmp_path / "folder", tmp_path / "file", count(), Path.replace
    folder.mkdir()
    (folder / "old").touch()
    file.write_text("old")

    def interrupted(self: Path, target: Path) -> Path:
        due = next(moves) == step
        if not due or after:
            replace(self, target)
        if due:
            raise KeyboardInterrupt
        return target

    def put() -> None:
        with staged_outputs(folder, file) as (new_folder, new_file):
            new_folder.mkdir()
            new_file.write_text("new")
            monkeypatch.setattr(Path, "replace", interrupted)

    with pytest.raises(KeyboardInterrupt):
        put()
    assert [path.name for path in folder.iterdir()] == ["old"]
    assert file.read_text() == "old"
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "file"}


def test_a_target_whose_name_is_too_long_is_refused(tmp_path: Path) -> None:
    with (
        refused(ReportError, "written", os.strerror(errno.ENAMETOOLONG)),
        staged_outputs(tmp_path / ("x" * 300) / "csv"),
    ):
        pass


def test_garbage_in_a_record_is_left_out_and_reported(run: Path, tmp_path: Path) -> None:
    with RecordReader(run / "run.mcap") as reader, RecordWriter(tmp_path / "run.mcap") as writer:
        for each in reader.messages(by_time=False):
            writer.add(each.key, each.payload, messages.encoding(each.key), each.t_ns, each.wall_ns)
        for payload in (b"", b"\xff", msgspec.msgpack.encode({"t_ns": "soon"})):
            writer.add(keys.truth("drone1"), payload, "", 5, 5)
        huge = {**msgspec.to_builtins(messages_on(run, "process/controller.main/join")[0]), "incarnation": 2**63}
        writer.add("process/controller.main/join", msgspec.msgpack.encode(huge), "", 5, 5)
    done = export(tmp_path, Format.PARQUET)
    (note, _) = done.notes  # the other note is about the pictures
    assert has_terms(note, "3", "messages", "left out")
    assert done.tables["truth.parquet"] == counts(run)["truth"]
    joins: Any = pd.read_parquet(tmp_path / "parquet" / "join.parquet")
    assert joins["incarnation"].isna().sum() == 1


def test_nothing_to_export_is_reported_with_the_path(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=rf"^{tmp_path}: .*run\.mcap"):
        export(tmp_path, Format.CSV)
    RecordWriter(tmp_path / "run.mcap").close()
    for each in Format:
        with pytest.raises(ReportError, match=r"run\.mcap: "):
            export(tmp_path, each)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_the_command_line_starts_without_loading_export_packages() -> None:
    loaded = (
        "import sys, zsim_deploy.cli.cli; print({'numba', 'scipy', 'mcap', 'pyarrow', 'foxglove'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "set()"


def test_the_command_prints_what_it_wrote_and_missing_packages(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    asked = ["export", str(run), "--format", "csv", "--keys", "drone/*/truth", "--from", "1", "--out", str(out)]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 0, done.output
    assert [line.split() for line in done.stdout.splitlines()] == [["truth.csv", "753"], ["written:", str(out)]]
    refused = CliRunner().invoke(app, [*asked, "--to", "0.5"])
    assert refused.exit_code == 2
    assert "before --from" in refused.output
    monkeypatch.setattr(arguments, "find_spec", lambda module: None if module == "foxglove" else module)
    done = CliRunner().invoke(app, ["export", str(run), "--format", "foxglove"])
    assert has_terms(str(done.exception), "foxglove", "'.[export]'")


EXPORT = """
    import resource, sys
    from pathlib import Path
    from zsim_analysis.export import Format
    from zsim_analysis.export.make_export import export
    print("begun", flush=True)
    export(Path(sys.argv[1]), Format(sys.argv[2]))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


def long_record(path: Path, gates: int) -> None:
    """Write a record of the estimates of four drones over `gates` gates."""
    covariance = tuple(float(i) for i in range(36))
    with RecordWriter(path) as writer:
        for k in range(gates):
            t_ns = 20_000_000 * k
            v, level, counts = (0.1 * k, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0), {"gps": (k, 0), "imu": (k, k)}
            estimate = flight_messages.Estimate(t_ns, k, v, v, level, 0.1, covariance, 0.1, v, counts)
            for name in ("a", "b", "c", "d"):
                writer.add_message(keys.estimate(name), estimate, t_ns)


@pytest.mark.parametrize("suffix", [pytest.param("csv", marks=pytest.mark.soak), "parquet"])
def test_a_longer_record_takes_no_more_memory(tmp_path: Path, suffix: str) -> None:
    """Ten times as many messages may take one more row group, 30 MB; all of them as objects would take 200 MB."""
    peaks_mb = []
    for gates in (1_000, 10_000):
        folder = tmp_path / str(gates)
        folder.mkdir()
        long_record(folder / "run.mcap", gates)
        command = [sys.executable, "-c", textwrap.dedent(EXPORT), str(folder), suffix]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
        peaks_mb.append(int(done.stdout.split()[-1]))
    assert peaks_mb[1] - peaks_mb[0] < 90


@pytest.mark.parametrize(
    "suffix", ["csv", *(pytest.param(each, marks=pytest.mark.soak) for each in ("parquet", "mat", "foxglove"))]
)
def test_ctrl_c_leaves_no_files(tmp_path: Path, suffix: str) -> None:
    long_record(tmp_path / "run.mcap", 5_000)
    command = [sys.executable, "-m", "zsim_deploy.cli", "export", str(tmp_path), "--format", suffix]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until_s = time.monotonic() + 120
    while not list(tmp_path.glob(".export-*")) and time.monotonic() < until_s:
        os.sched_yield()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("form", Format)
def test_a_full_disk_is_reported_in_one_line_and_leaves_no_files(form: Format, run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "run.mcap", tmp_path)
    with files_of_at_most(50_000), refused(ReportError, "cannot be written") as raised:
        export(tmp_path, form)
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(str(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


@contextmanager
def files_of_at_most(size_bytes: int) -> Iterator[None]:
    """Limit the size of the files that this process writes."""
    before, on_excess = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, on_excess)


# Cameras


@pytest.fixture
def seen(tmp_path: Path) -> Path:
    """Return a record of sightings in four pictures: two, no and one hat by a detector, and three by the world."""
    with RecordWriter(tmp_path / "run.mcap") as writer:
        for number, hats in enumerate((2, 0, 1)):
            t_ns = number * 20_000_000
            writer.add_message(keys.camera("d1", "front"), image(t_ns, number), number)
            writer.add_message(keys.detections("d1"), sightings(t_ns, number, hats), number)
        writer.add_message(keys.sensor("d1", "sightings"), sightings(60_000_000, 0, 3, source=""), 3)
        writer.add_message(keys.camera_info("d1", "front"), info(60_000_000), 3)
    return tmp_path


@pytest.mark.parametrize("form", [Format.CSV, Format.PARQUET])
def test_every_sighted_hat_and_every_picture_without_one_is_a_row(seen: Path, form: Format) -> None:
    done = export(seen, form)
    assert done.tables == {f"camera_info.{form.value}": 1, f"sighting.{form.value}": 7}
    table = READ[form.value](seen / form.value / f"sighting.{form.value}")
    assert table["hats"].tolist() == [2, 2, 0, 1, 3, 3, 3]
    np.testing.assert_array_equal(table["hat"], [0, 1, np.nan, 0, 0, 1, 2])
    np.testing.assert_array_equal(table["range_m"], [4.0, 5.0, np.nan, 4.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(table["direction_B_x"].isna(), table["hats"] == 0)
    assert table["source"].tolist() == ["detector.d1"] * 4 + ["world"] * 3
    assert set(table["name"]) == {"d1"}
    assert table["t_sample_ns"].tolist() == [0, 0, 16_000_000, 36_000_000] + [56_000_000] * 3


def test_exports_omit_pictures_with_a_note_but_matlab_has_sightings(seen: Path) -> None:
    for form in (Format.CSV, Format.PARQUET, Format.MAT):
        (note,) = [note for note in export(seen, form).notes if "pictures" in note]
        assert has_terms(note, "3", "foxglove")
    with refused(ReportError, "drone/d1/camera/*", "8"):
        export(seen, Format.CSV, seen / "none", MessageSelection(("drone/d1/camera/*",)))
    loaded = scipy.io.loadmat(seen / "run.mat", simplify_cells=True)["sighting"]["d1"]
    assert loaded["direction_B"].shape == (7, 3)
    np.testing.assert_array_equal(loaded["range_m"], [4.0, 5.0, np.nan, 4.0, 4.0, 5.0, 6.0])
