"""How an autopilot is flown from outside: PX4's and ArduCopter's modes, and what they need before they obey. Pure.

Sources: PX4 px4_custom_mode.h; ArduPilot Copter mode.h; https://mavlink.io/en/messages/common.html#MAV_CMD_DO_SET_MODE.
"""

from typing import NamedTuple

from zsim_bridges.mavlink.wire import dialect

DO_SET_MODE, ARM_DISARM, NAV_LAND, NAV_TAKEOFF = 176, 400, 21, 22  # MAV_CMD
CUSTOM_MODE_ENABLED = 1  # MAV_MODE_FLAG
FORCED = 21_196  # param2 of ARM_DISARM: in flight, too
PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT


class ExternalControl(NamedTuple):
    """A mode in which an autopilot flies velocities that it is sent.

    Attributes:
        custom_mode: as its heartbeats show it.
        parameters: of DO_SET_MODE that leads there, from the second on.
        takes_off: whether it takes off in it; else in a mode of its own.
        relative_takeoff: whether the height of a take-off is over home; else over the sea.
        own: further modes in which it is when nobody but this driver has control: it may be led back from them.
        landing: in which it lands; its pilot's, or its own failsafe, where this driver does not land it.
    """

    custom_mode: int
    parameters: tuple[float, ...]
    takes_off: bool
    relative_takeoff: bool
    own: tuple[int, ...]
    landing: int

    def is_taken_over(self, custom_mode: int, lands: bool) -> bool:
        """Tell whether somebody else, its pilot first of all, has chosen a mode.

        Args:
            lands: whether this driver lands it.
        """
        own = custom_mode in (self.custom_mode, *self.own)
        return not (own or (lands and custom_mode == self.landing))

    def is_on(self, custom_mode: int) -> bool:
        return custom_mode == self.custom_mode

    def enter(self, system: int, component: int) -> dialect.CommandLong:
        """Return the command that leads there."""
        return command(system, component, DO_SET_MODE, CUSTOM_MODE_ENABLED, *self.parameters)


_AUTO = 4 << 16  # PX4_CUSTOM_MAIN_MODE_AUTO
OFFBOARD = ExternalControl(
    6 << 16,  # PX4_CUSTOM_MAIN_MODE_OFFBOARD
    (6, 0),
    takes_off=False,
    relative_takeoff=False,
    own=(_AUTO | 2 << 24, _AUTO | 3 << 24),  # take-off, loiter (also where setpoints stay away)
    landing=_AUTO | 6 << 24,
)
GUIDED = ExternalControl(4, (4,), takes_off=True, relative_takeoff=True, own=(), landing=9)  # Mode::Number
CONTROL = {PX4: OFFBOARD, ARDUPILOT: GUIDED}


def command(system: int, component: int, number: int, *parameters: float) -> dialect.CommandLong:
    """Return a command with its parameters from the first on."""
    return dialect.CommandLong(system, component, number, 0, *parameters)
