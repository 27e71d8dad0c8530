# pyright: reportMissingImports=false, reportOptionalMemberAccess=false
"""A flight of two vehicles at once, as MAVSDK users write it: arm, take off, fly a square in offboard mode, land.

Knows nothing of zsim. Run: python mavsdk_square.py PORT1 PORT2; prints its observations as JSON.
"""

import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.offboard import Offboard, PositionNedYaw, VelocityBodyYawspeed
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

PATIENCE_S = 100.0
TAKEOFF_M = 3.0
SIDE_M = 3.0
SILENCE_S = (
    5.0  # tolerated gap between setpoints in simulated time, which may run faster than the wall clock that paces them
)


class Watch:
    """The newest value of a telemetry stream."""

    def __init__(self, subscribe):
        self.value = None
        self._news = threading.Condition()
        subscribe(self._on_value)

    def _on_value(self, value, _):
        with self._news:
            self.value = value
            self._news.notify_all()

    def until(self, true, what):
        with self._news:
            if not self._news.wait_for(lambda: self.value is not None and true(self.value), PATIENCE_S):
                raise SystemExit(f"{what} did not come; the last value was {self.value}")
        return self.value


class Pilot:
    """A vehicle on a port of its own."""

    def __init__(self, port):
        self.mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
        self.mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        self.system = self.mavsdk.first_autopilot(PATIENCE_S)
        if self.system is None:
            raise SystemExit(f"nobody on port {port}")
        self.action, self.offboard = Action(self.system), Offboard(self.system)
        self.telemetry = Telemetry(self.system)
        self.health = Watch(self.telemetry.subscribe_health)
        self.place = Watch(self.telemetry.subscribe_position_velocity_ned)
        self.armed = Watch(self.telemetry.subscribe_armed)
        self.in_air = Watch(self.telemetry.subscribe_in_air)
        self.battery = Watch(self.telemetry.subscribe_battery)
        self.home = Watch(self.telemetry.subscribe_home)
        self.seen = {}

    def fly(self):
        self.health.until(lambda h: h.is_global_position_ok and h.is_home_position_ok and h.is_armable, "health")
        self.battery.until(lambda b: b.remaining_percent > 10, "a battery")
        self.home.until(lambda h: abs(h.latitude_deg) > 0, "a home")
        here = self.place.until(lambda _: True, "a position").position
        Param(self.system).set_param_float("COM_OF_LOSS_T", SILENCE_S)
        self.action.set_takeoff_altitude(TAKEOFF_M)
        self.action.arm()
        self.action.takeoff()
        self.until_near(here.north_m, here.east_m, -TAKEOFF_M)
        self.fly_square(here.north_m, here.east_m)
        self.turn()
        self.action.land()
        self.in_air.until(lambda in_air: not in_air, "the ground")
        self.armed.until(lambda armed: not armed, "disarming")
        return {"system": self.system.get_system_id(), **self.seen}

    def fly_square(self, north, east):
        corners = [(SIDE_M, 0), (SIDE_M, SIDE_M), (0, SIDE_M), (0, 0)]
        self.offboard.set_position_ned(PositionNedYaw(north, east, -TAKEOFF_M, 90.0))
        self.offboard.start()
        for d_north, d_east in corners:
            self.offboard.set_position_ned(PositionNedYaw(north + d_north, east + d_east, -TAKEOFF_M, 90.0))
            self.until_near(north + d_north, east + d_east, -TAKEOFF_M)
        self.seen["corners"] = len(corners)

    def turn(self):
        """Climb while turning, at a velocity in body axes, and stop."""
        self.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, -0.8, 30.0))
        self.place.until(lambda p: p.position.down_m < -TAKEOFF_M - 1.0, "the climb")
        self.offboard.stop()
        self.seen["top_m"] = -self.place.value.position.down_m

    def until_near(self, north, east, down):
        def near(p):
            off = (p.position.north_m - north, p.position.east_m - east, p.position.down_m - down)
            return sum(each * each for each in off) < 0.5**2

        self.place.until(near, f"({north:.1f}, {east:.1f}, {down:.1f})")


def main():
    pilots = [Pilot(int(port)) for port in sys.argv[1:]]
    with ThreadPoolExecutor(len(pilots)) as pool:
        print(json.dumps(list(pool.map(Pilot.fly, pilots))), flush=True)


if __name__ == "__main__":
    main()
