"""The command that lets ROS 1 nodes in."""

from functools import partial
from typing import Annotated

import typer

from zsim_bridges.ros1.master_api import DEFAULT_MASTER, own_address
from zsim_deploy.options.reach import Reach, takes_part

PANEL = "Others come in"

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
@takes_part
def ros1(
    reach: Reach,
    master: Annotated[str, typer.Option(envvar="ROS_MASTER_URI", help="The ROS master.")] = DEFAULT_MASTER,
    ros_host: Annotated[
        str | None,
        typer.Option(
            "--ros-host",
            "--ip",
            help="Name or address under which ROS nodes reach this host (default $ROS_HOSTNAME, $ROS_IP, or found).",
        ),
    ] = None,
    name: Annotated[str, typer.Option(help="Process name (default ros1.main, or the certificate's).")] = "",
) -> None:
    """Offer the drones to ROS 1 nodes as ardrone_autonomy does, without ROS here."""
    from zsim_bridges.ros1.bridge import NodeShutdownError, serve
    from zsim_deploy.roles.priority import give_way
    from zsim_deploy.roles.service_loop import named, visit

    give_way()
    mine = named("ros1", name, reach.tls)
    bridge = partial(serve, master_uri=master, host=ros_host or own_address(master))
    try:
        visit(mine, bridge, reach)
    except NodeShutdownError as error:
        print(error)
