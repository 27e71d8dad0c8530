# pyright: reportMissingImports=false, reportOptionalMemberAccess=false, reportOptionalOperand=false
# pyright: reportCallIssue=false, reportArgumentType=false
"""A flight as DroneKit users write it: arm in GUIDED mode, take off, go to a place, fly an uploaded mission, land.

Knows nothing of zsim. Run: python dronekit_goto.py CONNECTION; prints its observations as JSON.
"""

import json
import sys
import threading
import warnings

warnings.simplefilter("ignore")

import dronekit  # noqa: E402
from pymavlink import mavutil  # noqa: E402

PATIENCE_S = 100.0
TAKEOFF_M = 3.0
NORTH_DEG = 4e-5  # about 4.4 m


class Waiter:
    """Waits for a condition, which it checks whenever an attribute of the vehicle has changed."""

    def __init__(self, vehicle):
        self._vehicle = vehicle
        self._news = threading.Condition()
        vehicle.add_attribute_listener("*", self._on_change)

    def _on_change(self, *_):
        with self._news:
            self._news.notify_all()

    def until(self, true, what):
        with self._news:
            if not self._news.wait_for(true, PATIENCE_S):
                raise SystemExit(f"{what} did not come")


def main():
    vehicle = dronekit.connect(sys.argv[1], wait_ready=True, timeout=PATIENCE_S, heartbeat_timeout=PATIENCE_S)
    waiter, seen = Waiter(vehicle), {}
    waiter.until(lambda: vehicle.is_armable, "is_armable")
    seen["parameters"] = {name: vehicle.parameters[name] for name in ("SYSID_THISMAV", "WPNAV_SPEED")}
    vehicle.parameters["WPNAV_SPEED"] = 300
    seen["firmware"] = str(vehicle.version)
    vehicle.mode = dronekit.VehicleMode("GUIDED")
    waiter.until(lambda: vehicle.mode.name == "GUIDED", "GUIDED")
    vehicle.armed = True
    waiter.until(lambda: vehicle.armed, "arming")
    vehicle.simple_takeoff(TAKEOFF_M)
    waiter.until(lambda: abs(vehicle.location.global_relative_frame.alt - TAKEOFF_M) < 0.5, "the height")
    here = vehicle.location.global_relative_frame
    north = here.lat + NORTH_DEG
    vehicle.simple_goto(dronekit.LocationGlobalRelative(north, here.lon, TAKEOFF_M))
    waiter.until(lambda: abs(vehicle.location.global_relative_frame.lat - north) < 5e-6, "the place")
    seen["north_m"] = round(vehicle.location.local_frame.north, 1)
    fly_mission(vehicle, waiter, here, seen)
    waiter.until(lambda: not vehicle.armed, "disarming")
    vehicle.close()
    print(json.dumps(seen), flush=True)


def fly_mission(vehicle, waiter, home, seen):
    """Upload a mission of one waypoint and a landing, and fly it."""
    commands = vehicle.commands
    commands.download()  # item 0 is home, which stays
    commands.wait_ready()
    commands.clear()
    frame = mavutil.mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    for command, place in (
        (mavutil.mavlink.MAV_CMD_NAV_WAYPOINT, (home.lat, home.lon + NORTH_DEG, 4.0)),
        (mavutil.mavlink.MAV_CMD_NAV_LAND, (0, 0, 0)),
    ):
        commands.add(dronekit.Command(0, 0, 0, frame, command, 0, 0, 0, 0, 0, 0, *place))
    commands.upload()
    commands.download()
    commands.wait_ready()
    seen["items"] = commands.count
    vehicle.mode = dronekit.VehicleMode("AUTO")
    waiter.until(lambda: commands.next == 2, "the second item")
    seen["east"] = vehicle.location.global_relative_frame.lon > home.lon + 0.8 * NORTH_DEG


if __name__ == "__main__":
    main()
