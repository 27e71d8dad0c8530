"""What the commands of bridges do beside bridging: the ROS package of our own messages, and what they refuse."""

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer
from refused import has_terms, refused
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from zsim.errors import RunError, install_command
from zsim_bridges.ros2.rmw_zenoh import MESSAGES, type_hash
from zsim_deploy.cli.role_commands import console, gateway, ros1, ros2


def test_the_package_has_the_types_that_go_over_the_wire(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ros2(write_package=tmp_path)
    package = tmp_path / "zsim_msgs"
    assert has_terms(capsys.readouterr().out, str(package), "colcon")
    store = get_typestore(Stores.ROS2_KILTED)
    for path in package.glob("msg/*.msg"):
        name = f"zsim_msgs/msg/{path.stem}"
        store.register(get_types_from_msg(path.read_text(), name))
        assert store.hash_rihs01(name) == type_hash(name)
        assert f'"msg/{path.name}"' in (package / "CMakeLists.txt").read_text()
    assert {f"zsim_msgs/msg/{path.stem}" for path in package.glob("msg/*.msg")} == MESSAGES.keys()
    assert "<name>zsim_msgs</name>" in (package / "package.xml").read_text()


def test_a_secured_world_needs_a_router_for_ros_and_its_package_a_folder(tmp_path: Path) -> None:
    with refused(typer.BadParameter, "--tls", "--router"):
        ros2(tls=tmp_path)
    (tmp_path / "zsim_msgs").write_text("a file is there")
    with refused(RunError, "written", "--write-package"):
        ros2(write_package=tmp_path)


def test_a_console_gives_way_to_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """An operator's emergency goes through it; and one that gives way is late with its health, and reported silent."""
    pytest.importorskip("viser", reason="viser is not installed; pip install '.[console]'")
    own = os.nice(0), os.sched_getscheduler(0)
    served: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "nice", lambda more: own[0] + more)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: served.append((-1, -1)))
    monkeypatch.setattr("zsim_deploy.roles.stop_channel.lower_priority", lambda *_, **__: served.append((-1, -1)))
    monkeypatch.setattr(
        "zsim_deploy.roles.roles.serve_runs", lambda *_, **__: served.append((os.nice(0), os.sched_getscheduler(0)))
    )
    console()
    assert served == [own]


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        (console, "viser", "console"),
        (gateway, "aiohttp", "gateway"),
        (ros1, "rosbags", "ros1"),
        (ros2, "xxhash", "ros2"),
    ],
)
def test_a_bridge_without_its_extra_is_a_line(
    monkeypatch: pytest.MonkeyPatch, command: Callable[[], None], module: str, extra: str
) -> None:
    monkeypatch.setattr("zsim_deploy.arguments.find_spec", lambda name: None if name == module else find_spec(name))
    with refused(RunError, extra, module, install_command([extra])):
        command()
