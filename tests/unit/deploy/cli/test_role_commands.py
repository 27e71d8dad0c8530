"""What the bridge commands do besides bridging: they write the ROS package of zsim's messages, and refuse bad options."""

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


def test_the_ros_package_has_the_message_types_of_the_bridge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_ros2_needs_a_router_with_tls_and_a_writable_package_folder(tmp_path: Path) -> None:
    with refused(typer.BadParameter, "--tls", "--router"):
        ros2(tls=tmp_path)
    (tmp_path / "zsim_msgs").write_text("a file is there")
    with refused(RunError, "written", "--write-package"):
        ros2(write_package=tmp_path)


def test_a_console_does_not_lower_its_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    """Emergency orders pass through it, and at a lower priority its health would be late and be taken for silence."""
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
def test_a_bridge_without_its_extra_is_refused_with_the_install_command(
    monkeypatch: pytest.MonkeyPatch, command: Callable[[], None], module: str, extra: str
) -> None:
    monkeypatch.setattr("zsim_deploy.arguments.find_spec", lambda name: None if name == module else find_spec(name))
    with refused(RunError, extra, module, install_command([extra])):
        command()
