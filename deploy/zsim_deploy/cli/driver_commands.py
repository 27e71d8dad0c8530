"""`zsim mavlink drive` and `zsim ardrone drive`: a real aircraft is a drone of a run."""

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim_deploy.arguments import WorldAccess, finite, participant_options, positive
from zsim_deploy.cli.mavlink_commands import read_key

if TYPE_CHECKING:
    from zsim_bridges.vehicle_links.driver import SessionMaker
    from zsim_bridges.vehicle_links.driver_options import DriverOptions

DroneName = Annotated[str, typer.Argument(help="The drone of the run that it is; `body: external` in the scenario.")]
Armed = Annotated[bool, typer.Option("--armed", help="Obey from the start; else an operator asks `arm` first.")]
Speed = Annotated[float, typer.Option(callback=positive, help="Greatest horizontal speed, m/s.")]
Climb = Annotated[float, typer.Option(callback=positive, help="Greatest vertical speed, m/s.")]
Radius = Annotated[float | None, typer.Option(callback=positive, help="Fence about the origin of W, m.")]
Ceiling = Annotated[float | None, typer.Option(callback=positive, help="Greatest height over the origin of W, m.")]


@participant_options
def drive_mavlink(
    reach: WorldAccess,
    drone: DroneName,
    address: Annotated[str, typer.Argument(help="UDP port of the vehicle: udp://HOST:PORT.")],
    local_port: Annotated[int, typer.Option(min=0, max=65535, help="UDP port here; 0 for any.")] = 0,
    system: Annotated[int, typer.Option(min=0, max=255, help="Its system id; 0 for the first that shows itself.")] = 0,
    signing_key: Annotated[
        Path | None, typer.Option(help="File with the key of MAVLink 2 signatures; unsigned messages are refused.")
    ] = None,
    origin: Annotated[
        str | None, typer.Option(help="Where its local frame begins, X,Y,Z m in W (default: as it says).")
    ] = None,
    armed: Armed = False,
    speed: Speed = 2.0,
    climb: Climb = 1.0,
    radius: Radius = None,
    ceiling: Ceiling = None,
) -> None:
    """Let a MAVLink vehicle (PX4, ArduPilot, or its simulator) fly as a drone of the run."""
    from zsim_bridges.mavlink.autopilot_session import AutopilotSession
    from zsim_bridges.vehicle_links.driver_options import check_host, udp_channel

    options = _options(drone, (speed, climb), (radius, ceiling), armed, origin, None)
    channel = udp_channel(address, local_port)
    check_host(channel.host)
    key = read_key(signing_key) if signing_key else None
    make_session = partial(AutopilotSession.of_run, channel=channel, system=system, key=key)
    _serve(make_session, options, reach)


@participant_options
def drive_ardrone(
    reach: WorldAccess,
    drone: DroneName,
    address: Annotated[str, typer.Argument(help="Address of the aircraft, such as 192.168.1.12.")],
    origin: Annotated[
        str | None, typer.Option(help="Where it stands at the start, X,Y,Z m in W (default: the scenario's place).")
    ] = None,
    yaw: Annotated[
        float | None,
        typer.Option(callback=finite, help="Its heading at the start, deg from east (default: by its magnetometer)."),
    ] = None,
    ultrasound: Annotated[
        int, typer.Option(min=7, max=8, help="Of its sonar, 7 or 8; neighbours that differ disturb each other less.")
    ] = 8,
    armed: Armed = False,
    speed: Speed = 2.0,
    climb: Climb = 1.0,
    radius: Radius = None,
    ceiling: Ceiling = None,
) -> None:
    """Let an AR.Drone 2.0 fly as a drone of the run."""

    from zsim_bridges.ardrone.aircraft_session import AircraftSession, AircraftSettings
    from zsim_bridges.vehicle_links.driver_options import aircraft_host, check_host

    options = _options(drone, (speed, climb), (radius, ceiling), armed, origin, yaw)
    check_host(aircraft_host(address))
    settings = AircraftSettings(ultrasound=ultrasound)
    _serve(partial(AircraftSession.of_run, host=address, settings=settings), options, reach)


def _options(
    drone: str,
    speeds: tuple[float, float],
    fence: tuple[float | None, float | None],
    armed: bool,
    origin: str | None,
    yaw_deg: float | None,
) -> "DriverOptions":
    from zsim_bridges.vehicle_links.driver_options import DriverOptions, position
    from zsim_bridges.vehicle_links.failsafe import FlightLimits

    speed, climb = speeds
    radius, ceiling = (math.inf if limit is None else limit for limit in fence)
    limits = FlightLimits(speed, climb, radius_m=radius, ceiling_m=ceiling)
    return DriverOptions(drone, limits, armed, position(origin) if origin else None, yaw_deg)


def _serve(make_session: "SessionMaker", options: "DriverOptions", reach: WorldAccess) -> None:
    from zsim_bridges.vehicle_links.driver import drive
    from zsim_deploy.roles.process_identity import process_name
    from zsim_deploy.roles.roles import serve_runs

    name = process_name("driver", "", reach.who, options.drone)
    serve_runs(name, partial(drive, options=options, make_session=make_session), reach)
