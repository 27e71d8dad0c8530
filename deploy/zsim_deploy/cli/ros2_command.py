"""The command that shows a run to ROS 2."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from zsim_deploy.options.reach import Reach, takes_part

PANEL = "Others come in"
DOMAIN_MAX = 232  # the highest ROS_DOMAIN_ID that ROS 2 takes

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
@takes_part
def ros2(
    reach: Reach,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", min=0, max=DOMAIN_MAX, help="ROS_DOMAIN_ID.")] = 0,
    router: Annotated[
        str | None, typer.Option(help="Where ROS's own router (rmw_zenohd) listens; the world's hub if not given.")
    ] = None,
    name: Annotated[str, typer.Option(help="Process name (default ros2.main, or the certificate's).")] = "",
    write_package: Annotated[
        Path | None, typer.Option(help="Only write the ROS package zsim_msgs into this folder, for a ROS workspace.")
    ] = None,
) -> None:
    """Show the drones to ROS 2 (RMW_IMPLEMENTATION=rmw_zenoh_cpp) as topics and services, without ROS here."""
    if write_package is not None:
        _write_package(write_package / "zsim_msgs")
        return
    from zsim.transport.tls import Identity, is_tls
    from zsim_bridges.ros2.bridge import Door, serve
    from zsim_deploy.roles.priority import give_way
    from zsim_deploy.roles.service_loop import named, visit

    if reach.tls and router is None:
        why = "the world's access control lets no ROS keys pass"
        raise typer.BadParameter(f"--tls needs --router, the endpoint of a rmw_zenohd: {why}")
    give_way()
    who = reach.who
    to_router = who if router and is_tls(router) else Identity(host=who.host, insecure=reach.insecure)
    door = Door(domain, router, to_router)
    mine = named("ros2", name, reach.tls)
    visit(mine, partial(serve, door=door, wall_ns=time.time_ns), reach)


def _write_package(folder: Path) -> None:
    """Write a ROS package, whose build makes ROS know our own messages.

    Raises:
        RunError: the folder cannot be written.
    """
    from zsim.errors import RunError
    from zsim_bridges.ros2.definitions import PACKAGE

    try:
        for name, text in PACKAGE.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    except OSError as error:
        why = f"cannot be written ({error.strerror}); give --write-package another folder"
        raise RunError(f"{folder}: {why}") from error
    print(f"wrote {folder}; build it with colcon in a ROS workspace")
