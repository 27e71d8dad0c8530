"""The commands that each run one process of a federation: the roles, and the bridges to other programs.

Roles    `world`, one command per kind of agent, `host`, `agent`, `record`, `router`, `camera`, `detect`
Bridges  `console`, `gateway`, `ros1`, `ros2`, `mavlink`, `ardrone`, `fmu`
"""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, BadParameter, Option

from zsim.errors import RunError, SessionError, file_fault
from zsim.scenario.roles import AGENTS, Role
from zsim_bridges.ros1.master_api import DEFAULT_MASTER, own_address
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import require, say

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from zsim.contract.messages import Info
    from zsim.transport.session import Session
    from zsim.transport.tls import Identity
    from zsim_bridges.vehicle_links.vehicle_session import FlightLimits
    from zsim_deploy.roles.roles import Remain, Serve

FIRST_ADDRESS = "127.0.0.2"  # address of the first AR.Drone; programs on this host send from 127.0.0.1
TOKEN = "ZSIM_TOKEN"  # environment variable, because a command line is visible to all users of the machine
DOMAIN_MAX = 232  # the highest ROS_DOMAIN_ID of ROS 2
KEY_BYTES = 32  # length of a signing key; MAVLink 2, "Message Signing"
GCS_PORT, GCS_LOCAL_PORT = 14550, 18570  # UDP ports of PX4's simulation: ground station, first local port
API_PORT, API_LOCAL_PORT = 14540, 14580  # the same for programs (offboard API)
GATEWAY_NEEDS = {"gateway": ("aiohttp",)}
FMU_NEEDS = {"fmu": ("fmpy",)}
ROS1_NEEDS = {"ros1": ("rosbags",)}
ROS2_NEEDS = {"ros2": ("rosbags", "xxhash")}

app = typer.Typer()
bridges = typer.Typer()
mavlink = typer.Typer(
    name="mavlink",
    no_args_is_help=True,
    help="Bridge to MAVLink: offer drones as PX4 or ArduPilot vehicles, or fly a real one as a drone.",
)
ardrone = typer.Typer(
    name="ardrone",
    help="Bridge to the AR.Drone: offer drones as AR.Drones, or fly a real one as a drone.",
    no_args_is_help=True,
)

SOME_DRONES = "Drones, or patterns such as 'drone*' (default: all with cameras)."
Drones = Annotated[list[str] | None, Argument(metavar="[DRONE]...", help=SOME_DRONES, show_default=False)]
RequestedPace = Annotated[
    float | None,
    opt.positive_option("Pace to request from the world, simulated seconds per wall second.", show_default=False),
]
SigningKey = Annotated[
    Path | None, Option(help="File with the key for MAVLink 2 signatures; unsigned messages are refused.")
]
DroneName = Annotated[str, Argument(help="Drone that the vehicle flies as, with `body: external` in the scenario.")]
Armed = Annotated[
    bool, Option("--armed", help="Accept commands from the start; otherwise an operator must first request `arm`.")
]


@app.command(rich_help_panel=opt.ROLES)
@opt.flight_options
@opt.listener_options
def world(
    flight: opt.FlightOptions,
    who: "Identity",
    listen: opt.Listen = None,
    expect: Annotated[list[str] | None, Option(help="Wait for this process too, e.g. recorder. Repeatable.")] = None,
    journal: Annotated[
        Path | None, Option(help="Folder of the run's journal, from which a restarted world continues.")
    ] = None,
    all_died: Annotated[bool, Option("--all-died", hidden=True)] = False,
    changed: Annotated[list[str] | None, Option(opt.CHANGED, hidden=True)] = None,
    launched: opt.Launched = None,
) -> None:
    """Run the world, which integrates all drones and owns simulated time."""
    require("world", {"agents": ("numba", "scipy")})
    from zsim.scenario import scenario_file
    from zsim.schema import plugin
    from zsim_deploy.roles import world_role

    path, overrides = flight.path, flight.overrides or ()
    # A launcher has written the resolved scenario into the run's folder, and passes the folders of its modules.
    modules = plugin.folders() if launched else ()
    loaded = scenario_file.load(
        path, overrides, modules, imports=not launched, seed=flight.seed, duration_s=flight.duration
    )
    mode, pace = flight.mode_and_rate()
    changes = [*(changed or ()), *flight.changed()]
    endpoints = listen or [opt.DEFAULT_ENDPOINT]
    world_role.world(loaded, mode, pace, endpoints, launched, expect, who, journal, all_died, changes)


def _agent_command(name: str, role: Role) -> Callable[..., None]:
    about = str(role.about)
    several_help = f"{about.capitalize()}s, or patterns such as '{about}*'."

    def start(things: list[str], reach: opt.WorldAccess) -> None:
        require(name, {"agents": ("scipy",)})
        from zsim_deploy.roles import roles

        roles.agent(roles.agent_of(name, things), reach, roles.process_of(name, things))

    def several(
        reach: opt.WorldAccess,
        things: Annotated[list[str], Argument(metavar=f"{about.upper()}...", help=several_help, show_default=False)],
    ) -> None:
        start(things, reach)

    def one(
        reach: opt.WorldAccess,
        thing: Annotated[str, Argument(metavar=about.upper(), help=f"Name of the {about}.")] = "main",
    ) -> None:
        start([thing], reach)

    return opt.participant_options(several if role.joint else one)


for _name, _role in AGENTS.items():
    _also = ", or of several in one process" if _role.joint else ""
    _help = f"Run the {_name} of one {_role.about}{_also}."
    app.command(_name, rich_help_panel=opt.ROLES, help=_help)(_agent_command(_name, _role))


@app.command("host", rich_help_panel=opt.ROLES)
@opt.several_options
def host_agents(
    reach: opt.WorldAccess,
    names: Annotated[
        list[str], Argument(metavar="NAME...", help="Processes, or patterns, e.g. 'estimator.*' controller.main.")
    ],
) -> None:
    """Run several estimators and controllers in one process, which is faster."""
    from zsim_deploy.roles import roles

    roles.agent(roles.host(names), reach)


@app.command("agent", rich_help_panel=opt.ROLES)
@opt.participant_options
def own_agent(
    reach: opt.WorldAccess,
    named: Annotated[
        str,
        Argument(
            metavar="MODULE:CLASS",
            help="A subclass of zsim.Agent, or the process name of one of the scenario's agents, e.g. pilot.drone1.",
            show_default=False,
        ),
    ],
    settings: Annotated[
        list[str] | None, Argument(metavar="[NAME=VALUE]...", help="Arguments of the class.", show_default=False)
    ] = None,
    name: Annotated[str, Option(help="Process name (default: that of the class).", show_default=False)] = "",
) -> None:
    """Run your own agent: a class in a module on PYTHONPATH or in this folder."""
    from zsim.schema import plugin
    from zsim_agents.hosting import AgentSpec
    from zsim_deploy.roles import roles

    if not reach.launched:
        plugin.search(Path.cwd())
    if ":" not in named and not settings:
        roles.agent(roles.host([named]), reach, named)
        return
    spec = AgentSpec.parse([named, *(settings or ())], name)
    roles.agent(spec.make, reach, spec.name)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def record(
    reach: opt.WorldAccess,
    out: Annotated[
        Path, Option(help=f"Folder for run.mcap; {opt.RUN_ID} in its name stands for the id of the run.")
    ] = Path("."),
) -> None:
    """Record every message of a federation into run.mcap."""
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()
    roles.recorder(out, reach)


@app.command(rich_help_panel=opt.ROLES)
@opt.listener_options
def router(
    who: "Identity",
    name: Annotated[str, Argument(help="Name of the router.")] = "main",
    listen: Annotated[str, Option(help="Endpoint for its clients.")] = "tcp/127.0.0.1:7448",
    connect: opt.Connect = opt.DEFAULT_ENDPOINT,
    federation: opt.Federation = "zsim",
    realtime: opt.Realtime = False,
    launched: opt.Launched = None,
) -> None:
    """Run a router, which connects the clients of one network to a world or a router in another."""
    from zsim_deploy.roles import roles

    roles.router(name, listen, connect, federation, "realtime" if realtime else "lockstep", launched, who)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def camera(
    reach: opt.WorldAccess,
    drones: Drones = None,
    name: Annotated[str, opt.process_option("camera.DRONE; camera.main for several drones")] = "",
) -> None:
    """Render the camera images of one drone, or of several in one process, as JPEG."""
    require("camera", opt.CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    roles.serve_pictures("camera", drones or (), name, reach)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def detect(
    reach: opt.WorldAccess,
    drones: Drones = None,
    diameter: Annotated[
        float | None,
        Option(callback=opt.positive, help="Diameter of a hat, m (default: the scenario's).", show_default=False),
    ] = None,
    name: Annotated[str, opt.process_option("detector.DRONE; detector.main for several drones")] = "",
) -> None:
    """Detect magenta hats in the camera images of one drone, or of several in one process."""
    require("detect", opt.CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    roles.serve_pictures("detector", drones or (), name, reach, diameter)


def serve_as(
    role: str,
    name: str,
    serve: "Serve",
    reach: opt.WorldAccess,
    thing: str = "main",
    lowered: bool = False,
    remain: "Remain | None" = None,
) -> None:
    """Serve one run after another, or only one if launched, as the process that `process_name` names.

    `lowered`: run at a lower priority than the processes that the world waits for; `remain`: called after a
    launched run.
    """
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.roles import process_name
    from zsim_deploy.roles.stop_channel import lower_priority

    if lowered:
        lower_priority()
    roles.serve_runs(process_name(role, name, reach.who, thing), serve, reach, remain=remain)


@bridges.command(rich_help_panel=opt.WATCH)
@opt.participant_options
def console(
    reach: opt.WorldAccess,
    listen: Annotated[str, Option(help="Address to serve the page on.")] = "127.0.0.1",
    port: Annotated[
        int | None,
        opt.port_option(
            f"Port of the page (default {opt.CONSOLE_PORT}, or another if that is in use).", show_default=False
        ),
    ] = None,
    token: Annotated[
        str | None, Option(envvar=TOKEN, help="Token that operators must present; required on non-loopback addresses.")
    ] = None,
    rate_hz: Annotated[
        float | None,
        opt.positive_option(
            "Frames per second (default 20; 10 with 20 or more drones, or at 4 × real time or faster).",
            show_default=False,
        ),
    ] = None,
    name: Annotated[str, Option(help="Process name (default: the certificate's, or console.1, .2, …).")] = "",
    folder: Annotated[
        Path | None, Option(help="Folder of the run, shown on the page at the end.", show_default=False)
    ] = None,
) -> None:
    """Show a run in the browser, and control it: scene, plots, events, faults."""
    require("console", opt.CONSOLE_NEEDS)
    from zsim.runtime.progress import JsonProgress
    from zsim.transport.zenoh_settings import SERVER_FILES, require_files
    from zsim_bridges.console.console_server import Console
    from zsim_bridges.console.page_server import ListenAddress
    from zsim_deploy.roles.roles import log_printer, process_name

    # The console keeps normal priority, because an operator's emergency stop goes through it.
    own_name = process_name("console", name, reach.who, "*")
    say_line = JsonProgress().say if reach.launched else log_printer(None)
    require_files(SERVER_FILES, "a console and its pages")
    world = f"federation {reach.federation!r} on {reach.endpoint}"
    address = ListenAddress(listen, port or opt.CONSOLE_PORT, or_any=port is None)
    console_process = Console(address, own_name.removesuffix(".*"), token, rate_hz, say_line, world, folder)
    with console_process.open():
        serve_as("console", own_name, console_process.serve, reach, remain=console_process.remain)


@bridges.command(rich_help_panel=opt.TRANSLATE)
@opt.participant_options
def gateway(
    reach: opt.WorldAccess,
    listen: Annotated[str, Option(help="Address to accept clients on.")] = "127.0.0.1",
    http: Annotated[int, opt.port_option("Port for HTTP and WebSocket.")] = 8000,
    lines: Annotated[int, opt.port_option("Port for JSON lines over TCP.")] = 7470,
    token: Annotated[
        str | None, Option(envvar=TOKEN, help="Token that clients must present; required on non-loopback addresses.")
    ] = None,
    name: Annotated[str, opt.process_option("gateway.main")] = "",
) -> None:
    """Serve MATLAB, Octave, C, JavaScript and scripts over JSON lines, WebSocket and REST."""
    require("gateway", GATEWAY_NEEDS)
    from zsim.transport.connection import find_world
    from zsim.transport.zenoh_settings import SERVER_FILES, allow_files, require_files
    from zsim_bridges.gateway.gateway_server import CLIENTS_MAX, Gateway, GatewayPorts
    from zsim_bridges.web.web_server import CONNECTIONS_MAX
    from zsim_deploy.roles.roles import log_printer, process_name
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()  # before the gateway's threads are started
    own_name = process_name("gateway", name, reach.who)

    def connect_as(process: str) -> "AbstractContextManager[tuple[Session, Info]]":
        identity = reach.who
        if identity.tls is not None:  # a client's certificate is kept beside the gateway's
            folder = identity.tls.parent / process
            if not folder.is_dir():
                remedy = "name it in the scenario and in the inventory"
                raise SessionError(f"{process}: has no certificate here ({folder}); {remedy}")
            identity = identity._replace(tls=folder, process=process)
        return find_world(reach.endpoint, reach.federation, opt.LOOK_S, identity=identity)

    require_files(SERVER_FILES, "a gateway and its clients")
    allow_files(SERVER_FILES + CONNECTIONS_MAX + CLIENTS_MAX)
    ports = GatewayPorts(listen, http, lines)
    served = Gateway(ports, own_name, token, connect_as, log_printer(reach.launched), secured=reach.tls is not None)
    with served.open():
        serve_as("gateway", own_name, served.serve, reach)


@bridges.command(rich_help_panel=opt.TRANSLATE)
@opt.participant_options
def ros1(
    reach: opt.WorldAccess,
    master: Annotated[str, Option(envvar="ROS_MASTER_URI", help="URI of the ROS master.")] = DEFAULT_MASTER,
    ros_host: Annotated[
        str | None,
        Option(
            "--ros-host",
            "--ip",
            help="Name or address at which ROS nodes reach this host (default $ROS_HOSTNAME, $ROS_IP, or detected).",
        ),
    ] = None,
    name: Annotated[str, opt.process_option("ros1.main")] = "",
) -> None:
    """Offer the drones to ROS 1 nodes as ardrone_autonomy does; needs no ROS here."""
    require("ros1", ROS1_NEEDS)
    from zsim_bridges.ros1.ros1_bridge import NodeShutdownError, serve

    bridge = partial(serve, master_uri=master, host=ros_host or own_address(master))
    try:
        serve_as("ros1", name, bridge, reach, lowered=True)
    except NodeShutdownError as error:
        say(str(error))


@bridges.command(rich_help_panel=opt.TRANSLATE)
@opt.participant_options
def ros2(
    reach: opt.WorldAccess,
    domain: Annotated[int, Option(envvar="ROS_DOMAIN_ID", min=0, max=DOMAIN_MAX, help="ROS_DOMAIN_ID.")] = 0,
    router: Annotated[
        str | None, Option(help="Endpoint of ROS's own router, rmw_zenohd (default: the world's hub).")
    ] = None,
    name: Annotated[str, opt.process_option("ros2.main")] = "",
    write_package: Annotated[
        Path | None, Option(help="Write the ROS package zsim_msgs into this folder of a ROS workspace, and exit.")
    ] = None,
) -> None:
    """Offer the drones to ROS 2 (RMW_IMPLEMENTATION=rmw_zenoh_cpp) as topics and services; needs no ROS here."""
    require("ros2", ROS2_NEEDS)
    if write_package is not None:
        from zsim_bridges.ros2.rmw_zenoh import PACKAGE

        folder = write_package / "zsim_msgs"
        with file_fault(folder, "cannot be written", "give --write-package another folder"):
            for file, text in PACKAGE.items():
                path = folder / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        say(f"wrote {folder}; build it with colcon in a ROS workspace")
        return
    from zsim.transport.tls import Identity, is_tls
    from zsim_bridges.ros2.ros2_bridge import RosNetwork, serve

    if reach.tls and router is None:
        reason = "the world's access control does not allow ROS keys"
        raise BadParameter(f"--tls needs --router, the endpoint of an rmw_zenohd: {reason}")
    identity = reach.who
    to_router = identity if router and is_tls(router) else Identity(host=identity.host, insecure=reach.insecure)
    network = RosNetwork(domain, router, to_router)
    serve_as("ros2", name, partial(serve, network=network, wall_ns=time.time_ns), reach, lowered=True)


@mavlink.command("serve")
@opt.participant_options
def serve_mavlink(
    reach: opt.WorldAccess,
    autopilot: Annotated[
        Literal["px4", "ardupilot"], Option(help="Autopilot whose modes and parameters are offered.")
    ] = "px4",
    gcs: Annotated[str, Option(help="Ground station, HOST:PORT.")] = f"127.0.0.1:{GCS_PORT}",
    api: Annotated[
        str | None, Option(help=f"HOST:PORT for programs of the first drone; +1 each (default 127.0.0.1:{API_PORT}).")
    ] = None,
    listen: Annotated[str, Option(help="Address to open the vehicles' ports on.")] = "127.0.0.1",
    gcs_local: Annotated[
        int | None,
        opt.port_option(f"Local port of the first drone for the ground station; +1 each (default {GCS_LOCAL_PORT})."),
    ] = None,
    api_local: Annotated[
        int | None, opt.port_option(f"Local port of the first drone for programs; +1 each (default {API_LOCAL_PORT}).")
    ] = None,
    first_system_id: Annotated[
        int, Option(min=1, max=254, help="System id of the first drone; +1 each. The default ports shift with it.")
    ] = 1,
    signing_key: SigningKey = None,
    rate: RequestedPace = None,
    telemetry: Annotated[Literal["normal", "full"], Option(help="Message rates.")] = "normal",
    protocol: Annotated[int, Option(min=1, max=2, help="Version of MAVLink to send; both are accepted.")] = 2,
    name: Annotated[str, opt.process_option("mavlink.main")] = "",
) -> None:
    """Offer each drone as a vehicle that QGroundControl, MAVSDK, DroneKit and MAVProxy can fly."""
    from zsim_bridges.mavlink.mavlink_server import MavlinkOptions, MavlinkServer

    offset = first_system_id - 1  # PX4's simulation derives its ports from the system id, too
    options = MavlinkOptions(
        autopilot=autopilot,
        level=telemetry,
        listen=listen,
        gcs=_endpoint("--gcs", gcs, listen),
        gcs_local=gcs_local or GCS_LOCAL_PORT + offset,
        api=_endpoint("--api", api or f"127.0.0.1:{API_PORT + offset}", listen),
        api_local=api_local or API_LOCAL_PORT + offset,
        key=read_key(signing_key) if signing_key else None,
        version=1 if protocol == 1 else 2,
        rate=rate,
        first_system_id=first_system_id,
    )
    if options.key and options.version == 1:
        raise BadParameter("--signing-key needs MAVLink 2; leave out --protocol 1")
    serve_as("mavlink", name, partial(MavlinkServer.serve, options=options), reach)


def _endpoint(option: str, text: str, listen: str) -> tuple[str, int]:
    from socket import gaierror, gethostbyname

    from zsim_bridges.web import is_loopback

    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= opt.PORT_MAX:
        raise BadParameter(f"{option} is {text!r}; must be HOST:PORT")
    try:
        address = gethostbyname(host)
    except (gaierror, UnicodeError) as error:
        raise BadParameter(f"{option} is {text!r}; host {host} cannot be resolved") from error
    if is_loopback(listen) and not is_loopback(address):
        raise BadParameter(f"{option} is {text!r}, which {listen} cannot reach; give --listen a non-loopback address")
    return address, int(port)


def read_key(path: Path) -> bytes:
    """Read a key from a file: 32 bytes, 64 hexadecimal digits, or a passphrase, whose SHA-256 is the key."""
    from hashlib import sha256

    with file_fault(path, "cannot be read", "give --signing-key a file with the key"):
        content = path.read_bytes()
    if len(content) == KEY_BYTES:
        return content
    text = content.strip()
    if not text:
        allowed = f"{KEY_BYTES} bytes, {2 * KEY_BYTES} hexadecimal digits, or a passphrase"
        raise RunError(f"{path}: is empty; must contain {allowed}")
    with suppress(ValueError):
        if len(key := bytes.fromhex(text.decode())) == KEY_BYTES:
            return key
    return sha256(text).digest()


@ardrone.command("serve")
@opt.participant_options
def serve_ardrone(
    reach: opt.WorldAccess,
    addresses: Annotated[
        str, Option(help="Address of the first drone; +1 each; or DRONE=ADDRESS,DRONE=ADDRESS.")
    ] = FIRST_ADDRESS,
    peer: Annotated[
        list[str] | None,
        Option(help="Host allowed to command drones on non-loopback addresses. Repeatable.", show_default=False),
    ] = None,
    rate: RequestedPace = None,
    name: Annotated[str, opt.process_option("ardrone.main")] = "",
) -> None:
    """Offer each drone as an AR.Drone 2.0 on its own address."""
    from zsim_bridges.ardrone.ardrone_server import ArdroneOptions, ArdroneServer, peer_addresses

    options = ArdroneOptions(addresses, peer_addresses(peer or ()), rate)
    serve_as("ardrone", name, partial(ArdroneServer.serve, options=options), reach)


def _bounds(armed: bool, speed: float, climb: float, radius: float, ceiling: float) -> "tuple[FlightLimits, bool]":
    from zsim_bridges.vehicle_links.vehicle_session import FlightLimits

    return FlightLimits(speed, climb, radius_m=radius or math.inf, ceiling_m=ceiling or math.inf), armed


driver_options = opt.option_group(
    "bounds",
    _bounds,
    {
        "armed": (Armed, False),
        "speed": (Annotated[float, opt.positive_option("Maximum horizontal speed, m/s.")], 2.0),
        "climb": (Annotated[float, opt.positive_option("Maximum vertical speed, m/s.")], 1.0),
        "radius": (
            Annotated[float | None, opt.positive_option("Radius of the fence around the origin of W, m.")],
            None,
        ),
        "ceiling": (Annotated[float | None, opt.positive_option("Maximum height above the origin of W, m.")], None),
    },
)


@mavlink.command("drive")
@opt.participant_options
@driver_options
def drive_mavlink(
    reach: opt.WorldAccess,
    bounds: "tuple[FlightLimits, bool]",
    drone: DroneName,
    address: Annotated[str, Argument(help="UDP port of the vehicle: udp://HOST:PORT.")],
    local_port: Annotated[int, opt.port_option("Local UDP port; 0 for any.", minimum=0)] = 0,
    system: Annotated[
        int, Option(min=0, max=255, help="System id of the vehicle; 0 for the first one that sends.")
    ] = 0,
    signing_key: SigningKey = None,
    origin: Annotated[
        str | None, Option(help="Origin of the vehicle's local frame, X,Y,Z m in W (default: as reported).")
    ] = None,
) -> None:
    """Fly a MAVLink vehicle (PX4, ArduPilot, or a simulator of one) as a drone of the run."""
    from zsim_bridges.mavlink.autopilot_session import AutopilotSession
    from zsim_bridges.vehicle_links.driver import DriverOptions, check_host, drive, position, udp_channel

    options = DriverOptions(drone, *bounds, position(origin) if origin else None, None)
    channel = udp_channel(address, local_port)
    check_host(channel.host)
    key = read_key(signing_key) if signing_key else None
    make_session = partial(AutopilotSession.from_run, channel=channel, system=system, key=key)
    serve_as("driver", "", partial(drive, options=options, make_session=make_session), reach, drone)


@ardrone.command("drive")
@opt.participant_options
@driver_options
def drive_ardrone(
    reach: opt.WorldAccess,
    bounds: "tuple[FlightLimits, bool]",
    drone: DroneName,
    address: Annotated[str, Argument(help="IP address of the aircraft, e.g. 192.168.1.12.")],
    origin: Annotated[str | None, Option(help="Initial position, X,Y,Z m in W (default: the scenario's).")] = None,
    yaw: Annotated[
        float | None,
        Option(callback=opt.finite, help="Initial heading, deg from east (default: by its magnetometer)."),
    ] = None,
    ultrasound: Annotated[
        int, Option(min=7, max=8, help="Channel of its sonar; different channels interfere less.")
    ] = 8,
) -> None:
    """Fly an AR.Drone 2.0 as a drone of the run."""
    from zsim_bridges.ardrone.aircraft_session import AircraftSession
    from zsim_bridges.vehicle_links.driver import DriverOptions, aircraft_host, check_host, drive, position

    options = DriverOptions(drone, *bounds, position(origin) if origin else None, yaw)
    check_host(aircraft_host(address))
    make_session = partial(AircraftSession.from_run, host=address, ultrasound=ultrasound)
    serve_as("driver", "", partial(drive, options=options, make_session=make_session), reach, drone)


@bridges.command(rich_help_panel=opt.TRANSLATE)
@opt.participant_options
def fmu(
    reach: opt.WorldAccess,
    path: Annotated[Path, Argument(metavar="FILE", help="FMU for co-simulation, FMI 2 or 3. Its code is run.")],
    drone: Annotated[str | None, Option(help="Drone of the PLACEs that name none.", show_default=False)] = None,
    map_: Annotated[
        list[str] | None,
        Option(
            "--map",
            metavar="NAME=PLACE",
            help="Variable and its place in zsim: vx=velocity_m_s.0, z=drone2/estimate.position_m.2. Repeatable.",
        ),
    ] = None,
    param: Annotated[
        list[str] | None, Option(metavar="NAME=VALUE", help="Start value of a parameter or an input. Repeatable.")
    ] = None,
    period: Annotated[
        float | None,
        opt.positive_option("Communication step, s (default: the FMU's, or the gate period).", show_default=False),
    ] = None,
    takeoff: Annotated[
        float | None,
        Option(
            callback=opt.not_negative,
            help="Time at which the FMU has the drones that it commands take off, s (default: never).",
        ),
    ] = None,
    frame: Annotated[Literal["heading", "world"], Option(help="Frame of velocity commands.")] = "heading",
    log: Annotated[
        bool, Option("--log", help="Print all log messages of the FMU, not just warnings and errors.")
    ] = False,
    name: Annotated[
        str,
        Option(
            help="Process name (default fmu.DRONE, or the certificate's); controller.main replaces that controller."
        ),
    ] = "",
) -> None:
    """Run an FMU from Simulink, Modelica, Dymola or pythonfmu as a controller or an estimator."""
    require("fmu", FMU_NEEDS)
    from zsim_bridges.fmu.agent import Fmu
    from zsim_deploy.roles import roles

    params = {}
    for text in param or ():
        variable, equals, value = text.partition("=")
        if not equals or not variable:
            raise BadParameter(f"--param is {text!r}; must be NAME=VALUE")
        params[variable] = value
    own_name = roles.process_name("fmu", name, reach.who, drone or "main")
    agent = Fmu(
        path,
        drone,
        map_ or (),
        name=own_name,
        period_s=period,
        param=params,
        takeoff_s=takeoff,
        frame=frame,
        log=log,
        say=roles.log_printer(reach.launched),
    )
    roles.agent(agent, reach, own_name)
