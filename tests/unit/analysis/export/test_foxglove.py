"""The Foxglove file: what the mcap library, protobuf and Rerun read is what was recorded."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_run
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from recorded_run import messages_on
from refused import has_terms
from synthetic_pictures import AHEAD, FRONT_P_BK, NO_JPEG, image, info, jpeg

from zsim.contract import keys
from zsim.contract.flight_messages import ClusterState, Truth
from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.record import RecordWriter
from zsim_agents.formation.spaces.cluster_space import SingularClusterError
from zsim_agents.formation.spaces.scenario_space import cluster_space
from zsim_analysis.export import Format, viewers
from zsim_analysis.export.columns import MessageSelection
from zsim_analysis.export.foxglove_file import ConvertedRun, FoxgloveFile, Instant
from zsim_analysis.export.foxglove_messages import NumericMessageType, RotorDisc
from zsim_analysis.export.make_export import export
from zsim_analysis.export.viewers import TIMELINE, drone_mesh, plots

DRONES = ("drone1", "a-b.c", "end")
GATES = 301  # number of gates in a run of 6 s
GATE_NS = 20_000_000
RERUN = shutil.which("rerun", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    recorded_run.write(folder / "run.mcap")
    export(folder, Format.FOXGLOVE)
    return folder


@cache
def shown(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return log times and messages by topic, decoded with the descriptors in the file itself."""
    found: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    types: dict[int, Any] = {}
    with open(path, "rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            if schema.id not in types:
                types[schema.id] = protobuf_type(schema.data, schema.name)
            found[channel.topic].append((message.log_time, types[schema.id].FromString(message.data)))
    return dict(found)


def protobuf_type(data: bytes, name: str) -> Any:
    """Return the class of a message from a FileDescriptorSet."""
    pool = descriptor_pool.DescriptorPool()
    waiting = {file.name: file for file in descriptor_pb2.FileDescriptorSet.FromString(data).file}

    def add(file: descriptor_pb2.FileDescriptorProto) -> None:
        for other in file.dependency:
            if other in waiting:
                add(waiting.pop(other))
        pool.Add(file)

    while waiting:
        add(waiting.pop(next(iter(waiting))))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def xyz(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def wxyz(q: Any) -> tuple[float, float, float, float]:
    return q.w, q.x, q.y, q.z


def test_poses_and_frames_match_truth_estimate_and_cluster(run: Path) -> None:
    topics = shown(run / "foxglove.mcap")
    frames: dict[str, dict[int, Any]] = defaultdict(dict)
    for t_ns, message in topics["/tf"]:
        for transform in message.transforms:
            is_camera = transform.child_frame_id.endswith("_camera")
            assert transform.parent_frame_id == ("drone/drone1" if is_camera else "world")
            frames[transform.child_frame_id][t_ns] = transform
    for topic, name, key in [
        *((f"/drone/{d}/pose", f"drone/{d}", keys.truth(d)) for d in DRONES),
        *((f"/drone/{d}/estimate", f"drone/{d}/estimate", keys.estimate(d)) for d in DRONES),
    ]:
        recorded = messages_on(run, key)
        assert len(recorded) == GATES
        for (t_ns, pose), message in zip(topics[topic], recorded, strict=True):
            assert t_ns == message.t_ns == pose.timestamp.seconds * 10**9 + pose.timestamp.nanos
            assert pose.frame_id == "world"
            assert xyz(pose.pose.position) == xyz(frames[name][t_ns].translation) == message.position_m
            assert wxyz(pose.pose.orientation) == wxyz(frames[name][t_ns].rotation) == message.orientation_wxyz
    for state in messages_on(run, keys.cluster_state("main")):
        for name, values in (("cluster/main", state.value), ("cluster/main/desired", state.desired)):
            assert xyz(frames[name][state.t_ns].translation) == values[:3]
            turned = wxyz(frames[name][state.t_ns].rotation)
            assert turned == pytest.approx(quaternion_from_rpy(values[3:6]))


def test_the_numbers_of_a_cluster_are_desired_estimated_and_true(run: Path) -> None:
    space = cluster_space(3)
    truths = {drone: {truth.t_ns: truth for truth in messages_on(run, keys.truth(drone))} for drone in DRONES}
    states = messages_on(run, keys.cluster_state("main"))
    numbers = shown(run / "foxglove.mcap")["/cluster/main/variables"]
    for (t_ns, message), state in zip(numbers, states, strict=True):
        assert t_ns == state.t_ns
        assert [getattr(message, f"desired_{name}") for name in state.names] == list(state.desired)
        assert [getattr(message, f"estimated_{name}") for name in state.names] == list(state.value)
        assert (message.phase, message.margin) == (state.phase, state.margin)
        now = [truths[drone][t_ns] for drone in DRONES]
        R_WB = [rotation_matrix(truth.orientation_wxyz) for truth in now]
        yaw = np.array([math.atan2(R[1, 0], R[0, 0]) for R in R_WB])
        true = space.forward(np.array([truth.position_m for truth in now]), yaw)
        assert [getattr(message, f"true_{name}") for name in state.names] == pytest.approx(true.tolist(), abs=1e-12)


def test_numbers_fixes_and_events_are_as_recorded(run: Path) -> None:
    topics = shown(run / "foxglove.mcap")
    for drone in DRONES:
        recorded = (messages_on(run, key(drone)) for key in (keys.truth, keys.estimate, keys.status))
        for (_, message), truth, estimate, status in zip(topics[f"/drone/{drone}/numbers"], *recorded, strict=True):
            assert (message.true_x_m, message.true_y_m, message.true_z_m) == truth.position_m
            assert message.error_m == math.dist(truth.position_m, estimate.position_m)
            assert message.sigma_m == pytest.approx(math.sqrt(sum(estimate.covariance[7 * i] for i in range(3))))
            assert (message.state, message.battery_percent) == (status.state, status.battery_percent)
        fixes = messages_on(run, keys.sensor(drone, "gps"))
        for (_, fix), gps in zip(topics[f"/drone/{drone}/gps"], fixes, strict=True):
            assert (fix.latitude, fix.longitude, fix.altitude) == (gps.latitude_deg, gps.longitude_deg, gps.altitude_m)
            assert fix.position_covariance[0] == gps.sigma_m**2
    events = messages_on(run, keys.EVENT)
    assert [line.message for _, line in topics["/log"]] == [f"{event.kind}: {event.text}" for event in events]
    assert [line.name for _, line in topics["/log"]] == [event.source for event in events]


def test_the_scene_shows_drones_formations_estimates_and_trails(run: Path) -> None:
    topics = shown(run / "foxglove.mcap")
    ((_, drones),) = topics["/scene/drones"]
    assert {entity.frame_id for entity in drones.entities} == {f"drone/{drone}" for drone in DRONES}
    assert all(entity.frame_locked and entity.cubes and entity.cylinders for entity in drones.entities)
    truths = {drone: {truth.t_ns: truth for truth in messages_on(run, keys.truth(drone))} for drone in DRONES}
    for t_ns, update in topics["/scene/formations"]:
        (entity,) = update.entities
        outline = [xyz(corner) for corner in entity.lines[0].points]
        assert outline == [truths[drone][t_ns].position_m for drone in DRONES]
        assert len(entity.spheres) == 3
    estimates = {drone: {each.t_ns: each for each in messages_on(run, keys.estimate(drone))} for drone in DRONES}
    for t_ns, update in topics["/scene/estimates"]:
        for entity in update.entities:
            (sphere,) = entity.spheres
            estimate = estimates[entity.id][t_ns]
            assert xyz(sphere.pose.position) == estimate.position_m
            R, half_m = rotation_matrix(wxyz(sphere.pose.orientation)), np.array(xyz(sphere.size)) / 2
            covariance = np.array(estimate.covariance).reshape(6, 6)[:3, :3]
            np.testing.assert_allclose(R @ np.diag(np.square(half_m / 2)) @ R.T, covariance, atol=1e-12)
    last_ns, trails = topics["/scene/trails"][-1]
    assert xyz(trails.entities[0].lines[0].points[-1]) == truths["drone1"][last_ns].position_m
    assert len(trails.entities[0].lines[0].points) == len(topics["/scene/trails"]) == 13


def test_a_singular_desired_formation_has_no_ghosts(tmp_path: Path) -> None:
    """The robots of the desired formation coincide, so its cluster has no frame; the file is written all the same."""
    space = cluster_space(3)
    some = tuple(0.0 if name in ("p", "q") else 1.0 for name in space.names)
    with pytest.raises(SingularClusterError):
        space.inverse(np.array(some))
    state = ClusterState(0, 0, "engaged", DRONES, space.names, some, some, some, None, 0.0, "")
    rotors = {drone: [RotorDisc(0.2, 0.0, 0.1)] for drone in DRONES}
    file = FoxgloveFile(tmp_path / "some.mcap", rotors, {"main": space})
    file.write(Instant(0, states={"main": state}))
    file.close()
    assert file.counts["/scene/formations"] == file.counts["/cluster/main/variables"] == 1
    assert "/points/desired" not in file.counts


def test_encoded_numbers_are_read_by_the_protobuf_library() -> None:
    numbers = NumericMessageType("Some", [f"n{i}" for i in range(40)], ("text", "more"))
    kind = protobuf_type(numbers.schema, "zsim.Some")
    values = [*np.linspace(-1e300, 1e300, 39), math.nan]
    message = kind.FromString(numbers.encode(values, ("é" * 200, "")))
    assert [getattr(message, f"n{i}") for i in range(39)] == values[:39]
    assert math.isnan(message.n39)
    assert (message.text, message.more) == ("é" * 200, "")


def test_the_layout_shows_only_existing_topics_and_fields(run: Path) -> None:
    topics = shown(run / "foxglove.mcap")
    layout = json.loads((run / "foxglove-layout.json").read_text())
    paths = list(values_of(layout, "value"))
    assert len([path for path in paths if "/cluster/main/variables." in path]) == 12 * 3 + 1
    for path in paths:
        topic, field = path.removeprefix('"').replace('"', "").rsplit(".", 1)
        assert hasattr(topics[topic][0][1], field), path
        assert path.startswith('"') == bool(re.search(r"[^\w/]", topic)), path
    panels = Counter(values_of(layout, "panelType"))
    assert panels["ThreeDee"] == panels["Log"] == panels["StateTransitions"] == 1
    assert panels["Plot"] == 15
    shown_topics = next(config["topics"] for config in values_of(layout, "config") if "topics" in config)
    assert set(shown_topics) <= set(topics)
    assert next(values_of(layout, "topicToRender")) in topics


def values_of(tree: Any, name: str) -> Any:
    """Yield the values of all fields with this name."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        if key == name:
            yield value
        yield from values_of(value, name)


def test_messages_are_selected_by_keys_and_times(run: Path, tmp_path: Path) -> None:
    chosen = MessageSelection(("drone/end/truth", "world/**"), from_s=2.0, to_s=3.0)
    done = export(run, Format.FOXGLOVE, tmp_path / "some.mcap", chosen)
    topics = shown(tmp_path / "some.mcap")
    assert done.paths[:2] == (tmp_path / "some.mcap", tmp_path / "some-layout.json")
    assert {topic.split("/")[2] for topic in topics if topic.startswith("/drone/")} == {"end"}
    assert [t_ns for t_ns, _ in topics["/drone/end/pose"]] == list(range(2 * 10**9, 3 * 10**9 + 1, 20_000_000))
    assert done.tables == {topic: len(found) for topic, found in topics.items()}


# Cameras

FILMED = 10  # number of gates, each with a picture
FRONT = keys.camera("drone1", "front")


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run of a climbing drone whose front camera published its info, a picture per gate and a bad JPEG."""
    folder = tmp_path_factory.mktemp("filmed")
    with RecordWriter(folder / "run.mcap") as writer:
        writer.add_message(keys.camera_info("drone1", "front"), info(), 0)
        for gate in range(FILMED):
            t_ns = gate * GATE_NS
            p_W, level, still = (0.0, 0.0, 0.1 * gate), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            truth = Truth(t_ns, gate, p_W, still, level, still, still, (0.0,) * 4)
            writer.add_message(keys.truth("drone1"), truth, gate)
            writer.add_message(FRONT, image(t_ns, gate, jpeg(20 * gate)), gate)
        writer.add_message(FRONT, image(FILMED * GATE_NS, FILMED, NO_JPEG), FILMED)
    export(folder, Format.FOXGLOVE)
    return folder


def test_pictures_are_as_recorded_with_the_time_of_exposure(filmed: Path, tmp_path: Path) -> None:
    pictures = shown(filmed / "foxglove.mcap")["/drone/drone1/front_camera/image"]
    assert [t_ns for t_ns, _ in pictures] == [gate * GATE_NS for gate in range(FILMED)]
    for gate, (t_ns, picture) in enumerate(pictures):
        assert (picture.data, picture.format) == (jpeg(20 * gate), "jpeg")
        assert picture.frame_id == "drone/drone1/front_camera"
        assert picture.timestamp.nanos == max(0, t_ns - 4_000_000)
    again = export(filmed, Format.FOXGLOVE, tmp_path / "again.mcap")
    assert len([note for note in again.notes if has_terms(note, "1", "key")]) == 1


def test_calibration_and_pose_of_a_camera_are_as_published(filmed: Path) -> None:
    topics = shown(filmed / "foxglove.mcap")
    layout = json.loads((filmed / "foxglove-layout.json").read_text())
    assert list(values_of(layout, "imageTopic")) == ["/drone/drone1/front_camera/image"]
    assert set(values_of(layout, "calibrationTopic")) <= set(topics)
    ((_, calibration),) = topics["/drone/drone1/front_camera/calibration"]
    assert (tuple(calibration.K), tuple(calibration.D)) == (info().K, info().D)
    assert (calibration.width, calibration.height) == (info().width, info().height)
    assert (calibration.distortion_model, calibration.frame_id) == ("plumb_bob", "drone/drone1/front_camera")
    np.testing.assert_array_equal(np.reshape(calibration.P, (3, 4))[:, :3], np.reshape(info().K, (3, 3)))
    (placed,) = [
        t for _, message in topics["/tf"] for t in message.transforms if t.child_frame_id.endswith("front_camera")
    ]
    assert placed.parent_frame_id == "drone/drone1"
    assert (xyz(placed.translation), wxyz(placed.rotation)) == (FRONT_P_BK, AHEAD)


def test_part_of_a_flight_has_the_calibration_published_before_it(filmed: Path, tmp_path: Path) -> None:
    export(filmed, Format.FOXGLOVE, tmp_path / "late.mcap", MessageSelection(from_s=0.1))
    topics = shown(tmp_path / "late.mcap")
    assert len(topics["/drone/drone1/front_camera/image"]) == FILMED - 5
    ((t_ns, calibration),) = topics["/drone/drone1/front_camera/calibration"]
    assert (t_ns, tuple(calibration.K)) == (100_000_000, info().K)


# Rerun


def rerun(home: Path, *arguments: str) -> str:
    """Run Rerun with a separate home, in which its analytics are disabled."""
    assert RERUN
    own = {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home / "config")}
    if not home.exists():
        home.mkdir()
        subprocess.run([RERUN, "analytics", "disable"], env=own, capture_output=True, timeout=120, check=True)
    done = subprocess.run([RERUN, *arguments], env=own, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def rows_of(home: Path, path: Path) -> Counter[tuple[str, str]]:
    """Return the number of rows of each entity and column in a Rerun file."""
    rows: Counter[tuple[str, str]] = Counter()
    chunk = r"^Chunk\(\w+\) with (\d+) rows .* - (/\S*) - data columns: \[(.*)\]"
    for count, entity, columns in re.findall(chunk, rerun(home, "rrd", "print", "-v", str(path)), re.M):
        for column in {column.split("@", 1)[1] for column in columns.split()}:
            rows[entity.replace("\\", ""), column] += int(count)
    return rows


@pytest.fixture(scope="module")
def converted(run: Path) -> Path:
    """Return the file as converted by Rerun, whose home is beside it."""
    path = run / "foxglove.rrd"
    rerun(run / "home", "mcap", "convert", str(run / "foxglove.mcap"), "-o", str(path))
    return path


def test_rerun_reads_the_file_without_errors(run: Path, converted: Path) -> None:
    assert has_terms(rerun(run / "home", "rrd", "verify", str(converted)), "verified", "without error")
    assert "num_chunks" in rerun(run / "home", "rrd", "stats", str(converted))
    checked = rerun(run / "home", "mcap", "check", str(run / "foxglove.mcap"))
    assert set(re.findall(r"^(\w+) +\d+ +\d+ +/", checked, flags=re.MULTILINE)) == {"ok"}


def test_rerun_has_all_drawn_and_plotted_data_at_every_instant(run: Path, converted: Path) -> None:
    rows = rows_of(run / "home", converted)
    topics = shown(run / "foxglove.mcap")
    transforms = sum(len(message.transforms) for _, message in topics["/tf"])
    assert rows["/tf", "Transform3D:translation"] == transforms == GATES * 8 + 2  # and those of two cameras
    for drone in DRONES:
        assert rows[f"/drone/{drone}/pose", "InstancePoses3D:translations"] == GATES
        assert rows[f"/drone/{drone}/numbers", "zsim.Drone:message"] == GATES
        assert rows[f"/drone/{drone}/gps", "GeoPoints:positions"] == len(topics[f"/drone/{drone}/gps"])
    assert rows["/cluster/main/variables", "zsim.Cluster_main:message"] == GATES
    assert rows["/points/drones", "Points3D:positions"] == rows["/points/drones", "Points3D:colors"] == 61
    assert rows["/log", "TextLog:text"] == len(topics["/log"])


def test_rerun_has_pictures_and_camera_in_the_drone_s_tree(filmed: Path) -> None:
    path = filmed / "foxglove.rrd"
    rerun(filmed / "home", "mcap", "convert", str(filmed / "foxglove.mcap"), "-o", str(path))
    assert has_terms(rerun(filmed / "home", "rrd", "verify", str(path)), "verified", "without error")
    rows = rows_of(filmed / "home", path)
    assert rows["/drone/drone1/front_camera/image", "EncodedImage:blob"] == FILMED
    assert rows["/drone/drone1/front_camera/calibration", "Pinhole:image_from_camera"] == 1
    assert rows["/tf", "Transform3D:translation"] == FILMED + 1


def test_the_blueprint_refers_to_existing_entities_and_has_all_views(run: Path) -> None:
    topics = shown(run / "foxglove.mcap")
    variables = {"main": tuple(topics["/cluster/main/variables"][0][1].DESCRIPTOR.fields_by_name)}
    content = ConvertedRun(dict.fromkeys(topics, 1), variables, {drone: [] for drone in DRONES}, 0)
    curves = [curve for _, curves in plots(content) for curve in curves]
    assert {curve.topic for curve in curves} == {"/cluster/main/variables", *(f"/drone/{d}/numbers" for d in DRONES)}
    for curve in curves:
        described = topics[curve.topic][0][1].DESCRIPTOR
        assert curve.field in described.fields_by_name
        assert curve.component == f"{described.full_name}:message"
    assert {f"desired_{name}" for name in ("x_c", "beta")} <= {curve.field for curve in curves}
    blueprint = run / "foxglove.rbl"
    assert has_terms(rerun(run / "home", "rrd", "verify", str(blueprint)), "verified", "without error")
    printed = rerun(run / "home", "rrd", "print", "-vvv", str(blueprint)).replace("\\", "")
    for kind in ("3D", "TimeSeries", "TextLog"):
        assert f"[{kind}]" in printed
    for name in DRONES:
        assert re.search(rf"overrides\S*/drone/{re.escape(name)}/pose", printed), name
    assert "Mesh3D:vertex_positions" in printed
    assert TIMELINE in printed


def test_a_drone_s_mesh_extends_to_the_rims_of_its_rotors() -> None:
    rotors = [RotorDisc(0.2, 0.1, 0.1), RotorDisc(-0.2, -0.1, 0.05)]
    mesh = drone_mesh(rotors, "#0072b2")
    assert mesh.vertices_m[:, 0].max() == pytest.approx(0.3)
    assert mesh.vertices_m[:, 0].min() == pytest.approx(-0.25)
    assert len(mesh.colours) == len(mesh.vertices_m)
    assert set(np.unique(mesh.triangles)) == set(range(len(mesh.vertices_m)))
    corners = mesh.vertices_m[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (area > 0).all()


def test_no_blueprint_is_written_without_rerun_s_library(
    filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(filmed / "run.mcap", tmp_path)
    monkeypatch.setattr(viewers, "has_rerun", lambda: False)
    assert [path.name for path in export(tmp_path, Format.FOXGLOVE).paths] == ["foxglove.mcap", "foxglove-layout.json"]
