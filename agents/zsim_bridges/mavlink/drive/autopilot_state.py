"""What the heartbeats of an autopilot and its landed state say of a flight. Pure."""

from typing import Any

from zsim.contract.flight_messages import DroneState
from zsim_bridges.mavlink.drive.autopilot_modes import command
from zsim_bridges.mavlink.wire import dialect

SAFETY_ARMED = 128  # MAV_MODE_FLAG
UNDEFINED, ON_GROUND, IN_AIR, TAKING_OFF, LANDING = range(5)  # MAV_LANDED_STATE
TERMINATED = 8  # MAV_STATE_FLIGHT_TERMINATION
CLIMBED = 0.85  # chosen: of the height of a take-off, from which on it counts as up


class AutopilotState:
    """Of one autopilot.

    Attributes:
        address: its system and component.
        autopilot: its MAV_AUTOPILOT.
        armed, custom_mode: by its last heartbeat.
        landed: its MAV_LANDED_STATE.
        sea_height_m: over the sea, by its GPS.
    """

    def __init__(self, system: int, component: int, autopilot: int) -> None:
        self.address = system, component
        self.autopilot = autopilot
        self.armed = False
        self.custom_mode = 0
        self.landed = UNDEFINED
        self.sea_height_m = 0.0
        self._terminated = False

    def receive(self, message: Any) -> bool:
        """Take a message; return whether it is one that is read here."""
        match message:
            case dialect.Heartbeat():
                self.armed = bool(message.base_mode & SAFETY_ARMED)
                self.custom_mode = message.custom_mode
                self._terminated = message.system_status == TERMINATED
            case dialect.ExtendedSysState():
                self.landed = message.landed_state
            case dialect.GlobalPositionInt():
                self.sea_height_m = message.alt / 1e3
            case _:
                return False
        return True

    @property
    def is_flying(self) -> bool:
        """Whether it is up, or on its way down."""
        return self.armed and self.landed in (IN_AIR, LANDING)

    def command(self, number: int, *parameters: float) -> dialect.CommandLong:
        """Return a command to it."""
        return command(*self.address, number, *parameters)

    def state(self, flies: bool, climbed: bool) -> DroneState:
        """Return its state as the contract names it.

        Args:
            flies: whether it has a setpoint to fly.
            climbed: whether it has reached the height of its take-off.
        """
        if self._terminated:
            return "emergency"
        if not self.armed or self.landed in (UNDEFINED, ON_GROUND):
            return "landed"
        if self.landed == LANDING:
            return "landing"
        if self.landed == TAKING_OFF or not climbed:
            return "taking_off"
        return "flying" if flies else "hovering"
