"""`zsim ardrone drive`: an AR.Drone 2.0 as a drone of a run."""

import asyncio
import math
from collections.abc import Callable

from zsim.contract.messages import Info
from zsim.runtime.participant import Participant
from zsim.scenario import scenario_file
from zsim.transport.session import Session
from zsim_bridges.ardrone.drive.aircraft_session import AircraftSession, AircraftSettings
from zsim_bridges.ardrone.drive.navdata_readings import NavdataReadings
from zsim_bridges.vehicle_links.driver_options import DriverOptions, check_run
from zsim_bridges.vehicle_links.driver_process import DriverProcess


def drive(
    link: Session,
    info: Info,
    observer: Participant,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    options: DriverOptions,
    address: str,
    settings: AircraftSettings,
) -> None:
    """Drive one aircraft in one run until that is over.

    Args:
        link: an open session.
        info: of the run.
        observer: of this process in it.
        stopped: called now and then; True ends the run.
        say: prints a line.
        options: of the driver.
        address: of the aircraft.
        settings: that it is given.

    Raises:
        RunError: the drone is not external, or the run does not keep the pace of the wall clock.
    """
    check_run(info, observer.name, options.drone)
    scenario = scenario_file.from_text(info.scenario)
    place = options.origin_m or scenario.drone(options.drone).position_m
    origin = info.origin.latitude_deg, info.origin.longitude_deg, info.origin.height_m
    yaw_rad = None if options.yaw_deg is None else math.radians(options.yaw_deg)
    readings = NavdataReadings(origin, place, scenario.environment.magnetic_field_ut, yaw_rad)
    session = AircraftSession(address, readings, settings)
    asyncio.run(DriverProcess(link, info, observer, options, session, say).run(stopped))
