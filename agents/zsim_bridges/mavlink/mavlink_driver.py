"""`zsim mavlink drive`: a MAVLink vehicle as a drone of a run."""

import asyncio
from collections.abc import Callable

from zsim.contract.messages import Info
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import Session
from zsim_bridges.mavlink.drive.autopilot_session import AutopilotSession
from zsim_bridges.vehicle_links.driver_options import DriverOptions, check_run
from zsim_bridges.vehicle_links.driver_process import DriverProcess
from zsim_bridges.vehicle_links.vehicle_session import UdpChannel


def drive(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    options: DriverOptions,
    channel: UdpChannel,
    system: int = 0,
    key: bytes | None = None,
) -> None:
    """Drive one vehicle in one run until that is over.

    Args:
        link: an open session.
        info: of the run.
        observer: of this process in it.
        stopped: called now and then; True ends the run.
        say: prints a line.
        options: of the driver.
        channel: UDP port of the vehicle.
        system: its system id; 0 for the first autopilot that shows itself.
        key: of signatures; None for none.

    Raises:
        RunError: the drone is not external, or the run does not keep the pace of the wall clock.
    """
    check_run(info, observer.name, options.drone)
    drone = scenario_file.from_text(info.scenario).drone(options.drone)
    origin = info.origin.latitude_deg, info.origin.longitude_deg, info.origin.height_m
    session = AutopilotSession(channel, origin, drone.takeoff_height_m, system, options.origin_m, key)
    asyncio.run(DriverProcess(link, info, observer, options, session, say).run(stopped))
