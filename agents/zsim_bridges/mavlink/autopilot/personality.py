"""What differs between PX4 and ArduPilot as their clients see it: modes, parameters, and the rules of offboard flight.

Sources: PX4-Autopilot, src/modules/commander/px4_custom_mode.h and the parameter reference; ArduPilot,
ArduCopter/mode.h and the parameter list of Copter.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Literal, NamedTuple

from zsim.scenario.scenario import Drone
from zsim_bridges.mavlink.autopilot.enums import Autopilot, ParamType
from zsim_bridges.mavlink.autopilot.parameters import Parameters, ParameterSpec

REAL, INT, BYTE = ParamType.REAL32, ParamType.INT32, ParamType.INT8
CM = 0.01  # m; ArduPilot's parameters of places and speeds


class SpeedLimits(NamedTuple):
    """Of what is asked of the drone [m/s]."""

    horizontal_m_s: float
    up_m_s: float
    down_m_s: float


class FlightMode(Enum):
    """What a vehicle is to do, in words of its own."""

    MANUAL = "MANUAL"
    ALTITUDE = "ALTITUDE"
    POSITION = "POSITION"
    HOLD = "HOLD"
    BRAKE = "BRAKE"
    TAKEOFF = "TAKEOFF"
    LAND = "LAND"
    RETURN = "RETURN"
    MISSION = "MISSION"
    OFFBOARD = "OFFBOARD"


BY_STICKS = (FlightMode.MANUAL, FlightMode.ALTITUDE, FlightMode.POSITION)
HOLDING = (*BY_STICKS, FlightMode.HOLD, FlightMode.BRAKE)


def px4_mode(main: int, sub: int = 0) -> int:
    """Return a custom mode of PX4."""
    return main << 16 | sub << 24


PX4_MODES = {
    FlightMode.MANUAL: px4_mode(1),
    FlightMode.ALTITUDE: px4_mode(2),
    FlightMode.POSITION: px4_mode(3),
    FlightMode.TAKEOFF: px4_mode(4, 2),
    FlightMode.HOLD: px4_mode(4, 3),
    FlightMode.MISSION: px4_mode(4, 4),
    FlightMode.RETURN: px4_mode(4, 5),
    FlightMode.LAND: px4_mode(4, 6),
    FlightMode.OFFBOARD: px4_mode(6),
}
COPTER_MODES = {
    FlightMode.MANUAL: 0,  # STABILIZE
    FlightMode.ALTITUDE: 2,  # ALT_HOLD
    FlightMode.MISSION: 3,  # AUTO
    FlightMode.OFFBOARD: 4,  # GUIDED
    FlightMode.HOLD: 5,  # LOITER
    FlightMode.RETURN: 6,  # RTL
    FlightMode.LAND: 9,
    FlightMode.POSITION: 16,  # POSHOLD
    FlightMode.BRAKE: 17,
}
Meaning = Literal[
    "speed_m_s",
    "up_m_s",
    "down_m_s",
    "return_altitude_m",
    "takeoff_altitude_m",
    "acceptance_m",
    "stream_s",
    "disarm_s",
    "fence_radius_m",
    "fence_altitude_m",
    "fence_action",
]
Names = Mapping[Meaning, tuple[str, float]]
"""The parameter that has a meaning, and its unit in that of the meaning."""

PX4_NAMES: Names = {
    "speed_m_s": ("MPC_XY_VEL_MAX", 1.0),
    "up_m_s": ("MPC_Z_VEL_MAX_UP", 1.0),
    "down_m_s": ("MPC_Z_VEL_MAX_DN", 1.0),
    "return_altitude_m": ("RTL_RETURN_ALT", 1.0),
    "takeoff_altitude_m": ("MIS_TAKEOFF_ALT", 1.0),
    "acceptance_m": ("NAV_ACC_RAD", 1.0),
    "stream_s": ("COM_OF_LOSS_T", 1.0),
    "disarm_s": ("COM_DISARM_PRFLT", 1.0),
    "fence_radius_m": ("GF_MAX_HOR_DIST", 1.0),
    "fence_altitude_m": ("GF_MAX_VER_DIST", 1.0),
    "fence_action": ("GF_ACTION", 1.0),
}
COPTER_NAMES: Names = {
    "speed_m_s": ("WPNAV_SPEED", CM),
    "up_m_s": ("WPNAV_SPEED_UP", CM),
    "down_m_s": ("WPNAV_SPEED_DN", CM),
    "return_altitude_m": ("RTL_ALT", CM),
    "takeoff_altitude_m": ("PILOT_TKOFF_ALT", CM),
    "acceptance_m": ("WPNAV_RADIUS", CM),
    "stream_s": ("GUID_TIMEOUT", 1.0),
    "disarm_s": ("DISARM_DELAY", 1.0),
    "fence_radius_m": ("FENCE_RADIUS", 1.0),
    "fence_altitude_m": ("FENCE_ALT_MAX", 1.0),
    "fence_action": ("FENCE_ACTION", 1.0),
}


class FenceAction(Enum):
    """What a vehicle does beyond its fence."""

    NONE = 0
    WARN = 1
    HOLD = 2
    RETURN = 3
    LAND = 5


PX4_FENCE = {  # GF_ACTION
    0: FenceAction.NONE,
    1: FenceAction.WARN,
    2: FenceAction.HOLD,
    3: FenceAction.RETURN,
    4: FenceAction.WARN,  # terminate: not taken, see docs
    5: FenceAction.LAND,
}
COPTER_FENCE = {  # FENCE_ACTION
    0: FenceAction.WARN,
    1: FenceAction.RETURN,
    2: FenceAction.LAND,
    3: FenceAction.RETURN,
    4: FenceAction.HOLD,  # brake, or land
}


class Personality(NamedTuple):
    """An autopilot as clients see it.

    Attributes:
        autopilot: in heartbeats.
        modes: custom modes of those that it has.
        first_mode: at the start.
        names: parameters by meaning.
        fence_actions: by the value of the parameter.
        needs_stream: whether OFFBOARD begins only while setpoints come, and ends in a hold without them.
        version: flight_sw_version, major, minor, patch and type.
    """

    name: Literal["px4", "ardupilot"]
    autopilot: Autopilot
    modes: Mapping[FlightMode, int]
    first_mode: FlightMode
    names: Names
    fence_actions: Mapping[int, FenceAction]
    needs_stream: bool
    version: tuple[int, int, int, int]

    def mode_of(self, custom_mode: int) -> FlightMode | None:
        """Return the mode of a number; None for one that is not offered."""
        return next((mode for mode, number in self.modes.items() if number == custom_mode), None)


PERSONALITIES = {
    "px4": Personality("px4", Autopilot.PX4, PX4_MODES, FlightMode.HOLD, PX4_NAMES, PX4_FENCE, True, (1, 15, 4, 255)),
    "ardupilot": Personality(
        "ardupilot",
        Autopilot.ARDUPILOTMEGA,
        COPTER_MODES,
        FlightMode.MANUAL,
        COPTER_NAMES,
        COPTER_FENCE,
        False,
        (4, 5, 7, 255),
    ),
}


def parameters(personality: Personality, drone: Drone, system_id: int) -> Parameters:
    """Return the parameters of a vehicle at the start."""
    specs = _px4(drone, system_id) if personality.name == "px4" else _copter(drone, system_id)
    return Parameters(specs, bytewise=personality.name == "px4")


class Settings:
    """The parameters of a vehicle by their meanings."""

    def __init__(self, personality: Personality, parameters: Parameters) -> None:
        self._personality = personality
        self._parameters = parameters

    def __getitem__(self, meaning: Meaning) -> float:
        name, unit = self._personality.names[meaning]
        return unit * self._parameters[name]

    def put(self, meaning: Meaning, value: float) -> str | None:
        """Set a parameter by its meaning; return why not."""
        name, unit = self._personality.names[meaning]
        return self._parameters.put(name, value / unit)

    @property
    def speeds(self) -> SpeedLimits:
        return SpeedLimits(self["speed_m_s"], self["up_m_s"], self["down_m_s"])

    @property
    def fence_action(self) -> FenceAction:
        """What is done beyond the fence; ArduPilot's is there only while FENCE_ENABLE is 1."""
        if not self._parameters.value_of("FENCE_ENABLE", 1.0):
            return FenceAction.NONE
        return self._personality.fence_actions.get(int(self["fence_action"]), FenceAction.WARN)


def _px4(drone: Drone, system_id: int) -> list[ParameterSpec]:
    most = drone.limits
    level, climb = most.horizontal_speed_m_s, most.vertical_speed_m_s
    return [
        ParameterSpec("SYS_AUTOSTART", INT, 4001, 0, 9999999, fixed=True),  # generic quadcopter
        ParameterSpec("MAV_SYS_ID", INT, system_id, 1, 255, fixed=True),
        ParameterSpec("MAV_TYPE", INT, 2, 0, 45, fixed=True),
        ParameterSpec("MPC_XY_VEL_MAX", REAL, level, 0.1, level),
        ParameterSpec("MPC_XY_CRUISE", REAL, level, 0.1, level),
        ParameterSpec("MPC_Z_VEL_MAX_UP", REAL, climb, 0.1, climb),
        ParameterSpec("MPC_Z_VEL_MAX_DN", REAL, climb, 0.1, climb),
        ParameterSpec("MPC_THR_HOVER", REAL, 0.5, 0.5, 0.5, fixed=True),
        ParameterSpec("MIS_TAKEOFF_ALT", REAL, 2.5, 0.5, most.altitude_m),
        ParameterSpec("NAV_ACC_RAD", REAL, 1.0, 0.2, 200.0),
        ParameterSpec("RTL_RETURN_ALT", REAL, 10.0, 0.5, most.altitude_m),
        ParameterSpec("COM_OF_LOSS_T", REAL, 1.0, 0.1, 60.0),
        ParameterSpec("COM_DISARM_PRFLT", REAL, 10.0, -1.0, 600.0),
        ParameterSpec("GF_ACTION", INT, 2, 0, 5),
        ParameterSpec("GF_MAX_HOR_DIST", REAL, 0.0, 0.0, 10000.0),
        ParameterSpec("GF_MAX_VER_DIST", REAL, 0.0, 0.0, 10000.0),
        ParameterSpec("BAT1_N_CELLS", INT, 3, 0, 16, fixed=True),
    ]


def _copter(drone: Drone, system_id: int) -> list[ParameterSpec]:
    most = drone.limits
    level, climb, altitude = most.horizontal_speed_m_s / CM, most.vertical_speed_m_s / CM, most.altitude_m
    return [
        ParameterSpec("SYSID_THISMAV", ParamType.INT16, system_id, 1, 255, fixed=True),
        ParameterSpec("FRAME_CLASS", BYTE, 1, 0, 17, fixed=True),  # quad
        ParameterSpec("FRAME_TYPE", BYTE, 1, 0, 18, fixed=True),  # x
        ParameterSpec("WPNAV_SPEED", REAL, level, 10.0, level),
        ParameterSpec("WPNAV_SPEED_UP", REAL, climb, 10.0, climb),
        ParameterSpec("WPNAV_SPEED_DN", REAL, climb, 10.0, climb),
        ParameterSpec("WPNAV_RADIUS", REAL, 100.0, 5.0, 1000.0),
        ParameterSpec("PILOT_TKOFF_ALT", REAL, 250.0, 0.0, altitude / CM),
        ParameterSpec("RTL_ALT", REAL, 1000.0, 30.0, altitude / CM),
        ParameterSpec("GUID_TIMEOUT", REAL, 3.0, 0.1, 5.0),
        ParameterSpec("DISARM_DELAY", BYTE, 10, 0, 127),
        ParameterSpec("FENCE_ENABLE", BYTE, 0, 0, 1),
        ParameterSpec("FENCE_ACTION", BYTE, 1, 0, 8),
        ParameterSpec("FENCE_RADIUS", REAL, 150.0, 1.0, 10000.0),
        ParameterSpec("FENCE_ALT_MAX", REAL, 100.0, 1.0, 1000.0),
        ParameterSpec("ARMING_CHECK", INT, 1, 0, 1048575),
    ]
