"""`zsim console`, `gateway`, `ros1` and `ros2`: the processes that show a run, and translate it for other programs."""

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim.errors import RunError, SessionError, printable
from zsim_bridges.ros1.master_api import DEFAULT_MASTER, own_address
from zsim_deploy.arguments import (
    CONSOLE_NEEDS,
    CONSOLE_PORT,
    LOOK_S,
    WorldAccess,
    participant_options,
    positive,
    require,
)

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from zsim.contract.messages import Info
    from zsim.transport.session import Session
    from zsim.transport.tls import Identity

OPERATE, TRANSLATE = "Watch and steer", "Others come in"  # panels of the help
TOKEN = "ZSIM_TOKEN"  # in the environment: a command line can be read by everybody on the machine
DOMAIN_MAX = 232  # the highest ROS_DOMAIN_ID that ROS 2 takes

GATEWAY_NEEDS = {"gateway": ("aiohttp",)}  # modules by extra
ROS1_NEEDS = {"ros1": ("rosbags",)}
ROS2_NEEDS = {"ros2": ("rosbags", "xxhash")}

app = typer.Typer()


@app.command(rich_help_panel=OPERATE)
@participant_options
def console(
    reach: WorldAccess,
    listen: Annotated[str, typer.Option(help="Address on which the page is served.")] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(
            help=f"Port of the page ({CONSOLE_PORT}, or another where that is taken).",
            min=1,
            max=65535,
            show_default=False,
        ),
    ] = None,
    token: Annotated[
        str | None, typer.Option(envvar=TOKEN, help="What operators must show; needed off loopback.")
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            callback=positive, help="Pictures a second (20; 10 from 20 drones or 4 × real time on).", show_default=False
        ),
    ] = None,
    name: Annotated[
        str,
        typer.Option(help="Process name (default the certificate's, or console.1, .2, …)."),
    ] = "",
    folder: Annotated[
        Path | None, typer.Option(help="Folder of the run, named on the page when it is over.", show_default=False)
    ] = None,
) -> None:
    """Show a run in the browser, and steer it: scene, plots, events, faults."""
    require("console", CONSOLE_NEEDS)
    from zsim.runtime.progress import JsonProgress
    from zsim.transport.zenoh_settings import SERVER_FILES, require_files
    from zsim_bridges.console.console_server import Console
    from zsim_bridges.console.server.http_proxy import ListenAddress
    from zsim_deploy.roles.roles import log_printer, process_name, serve_runs

    # Of normal priority: an operator's emergency goes through it, and one that gave way would be reported as silent.
    own_name = process_name("console", name, reach.who, "*")
    say = JsonProgress().say if reach.launched else log_printer(None)
    require_files(SERVER_FILES, "a console and its pages")
    world = f"federation {reach.federation!r} on {reach.endpoint}"
    address = ListenAddress(listen, port or CONSOLE_PORT, or_any=port is None)
    shown = Console(address, own_name.removesuffix(".*"), token, rate_hz, say, world, folder)
    with shown.open():
        serve_runs(own_name, shown.serve, reach, remain=shown.remain)


@app.command(rich_help_panel=TRANSLATE)
@participant_options
def gateway(
    reach: WorldAccess,
    listen: Annotated[str, typer.Option(help="Address on which clients come in.")] = "127.0.0.1",
    http: Annotated[int, typer.Option(help="Port of HTTP and WebSocket.", min=1, max=65535)] = 8000,
    lines: Annotated[int, typer.Option(help="Port of JSON lines on TCP.", min=1, max=65535)] = 7470,
    token: Annotated[
        str | None, typer.Option(envvar=TOKEN, help="What clients must show; needed off loopback.")
    ] = None,
    name: Annotated[str, typer.Option(help="Process name (default gateway.main, or the certificate's).")] = "",
) -> None:
    """Let in MATLAB, Octave, C, JavaScript, scripts: JSON lines, WebSocket, REST."""
    require("gateway", GATEWAY_NEEDS)
    from zsim.transport.connection import find_world
    from zsim.transport.zenoh_settings import SERVER_FILES, allow_files, require_files
    from zsim_bridges.gateway.gateway_server import CLIENTS_MAX, Gateway, GatewayPorts
    from zsim_bridges.web.http_connections import CONNECTIONS_MAX
    from zsim_deploy.roles.roles import log_printer, process_name, serve_runs
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()
    who = reach.who
    own_name = process_name("gateway", name, reach.who)

    def connect_as(process: str) -> "AbstractContextManager[tuple[Session, Info]]":
        return find_world(reach.endpoint, reach.federation, LOOK_S, identity=_client_identity(who, process))

    require_files(SERVER_FILES, "a gateway and its clients")
    allow_files(SERVER_FILES + CONNECTIONS_MAX + CLIENTS_MAX)
    ports = GatewayPorts(listen, http, lines)
    served = Gateway(ports, own_name, token, connect_as, log_printer(reach.launched), secured=reach.tls is not None)
    with served.open():
        serve_runs(own_name, served.serve, reach)


def _client_identity(who: "Identity", process: str) -> "Identity":
    """Return the identity of a gateway's client on the network: its certificate lies beside the gateway's."""
    if who.tls is None:
        return who
    folder: Path = who.tls.parent / process
    if not folder.is_dir():
        raise SessionError(
            f"{process}: has no certificate here ({folder}); name it in the scenario and in the inventory"
        )
    return who._replace(tls=folder, process=process)


@app.command(rich_help_panel=TRANSLATE)
@participant_options
def ros1(
    reach: WorldAccess,
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
    require("ros1", ROS1_NEEDS)
    from zsim_bridges.ros1.ros1_bridge import NodeShutdownError, serve
    from zsim_deploy.roles.roles import process_name, serve_runs
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()
    own_name = process_name("ros1", name, reach.who)
    bridge = partial(serve, master_uri=master, host=ros_host or own_address(master))
    try:
        serve_runs(own_name, bridge, reach)
    except NodeShutdownError as error:
        print(printable(str(error)))


@app.command(rich_help_panel=TRANSLATE)
@participant_options
def ros2(
    reach: WorldAccess,
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
    require("ros2", ROS2_NEEDS)
    if write_package is not None:
        _write_package(write_package / "zsim_msgs")
        return
    from zsim.transport.tls import Identity, is_tls
    from zsim_bridges.ros2.ros2_bridge import RosNetwork, serve
    from zsim_deploy.roles.roles import process_name, serve_runs
    from zsim_deploy.roles.stop_channel import lower_priority

    if reach.tls and router is None:
        why = "the world's access control lets no ROS keys pass"
        raise typer.BadParameter(f"--tls needs --router, the endpoint of a rmw_zenohd: {why}")
    lower_priority()
    who = reach.who
    to_router = who if router and is_tls(router) else Identity(host=who.host, insecure=reach.insecure)
    network = RosNetwork(domain, router, to_router)
    own_name = process_name("ros2", name, reach.who)
    serve_runs(own_name, partial(serve, network=network, wall_ns=time.time_ns), reach)


def _write_package(folder: Path) -> None:
    """Write a ROS package, whose build makes ROS know our own messages.

    Raises:
        RunError: the folder cannot be written.
    """
    from zsim_bridges.ros2.ros_types import PACKAGE

    try:
        for name, text in PACKAGE.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    except OSError as error:
        why = f"cannot be written ({error.strerror}); give --write-package another folder"
        raise RunError(f"{folder}: {why}") from error
    print(printable(f"wrote {folder}; build it with colcon in a ROS workspace"))
