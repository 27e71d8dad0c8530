"""The way home: up to the height of returns, over home, down."""

from zsim_bridges.mavlink.autopilot.personality import Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.flight_control import FlightControl
from zsim_bridges.mavlink.flight.position_guidance import Target


class ReturnCourse:
    """The return of one vehicle.

    Args:
        control: sends what it asks for.
    """

    def __init__(self, settings: Settings, state: VehicleState, control: FlightControl) -> None:
        self._settings = settings
        self._state = state
        self._control = control
        self._stage = 0

    def rewind(self) -> None:
        """Begin with the climb."""
        self._stage = 0

    def step(self) -> None:
        """Go on: climb, go home, land, one after the other."""
        home_x, home_y, home_z = self._state.home_m or self._state.position_m
        x, y, z = self._state.position_m
        target = self._control.target
        if self._stage == 0:
            self._stage = 1
            self._control.hold(Target((x, y, max(z, home_z + self._settings["return_altitude_m"]))))
        elif self._stage == 1 and isinstance(target, Target) and self._control.has_arrived():
            self._stage = 2
            self._control.hold(Target((home_x, home_y, target.position_m[2])))
        elif self._stage == 2 and (target is None or self._control.has_arrived()):
            self._control.ask("land")
