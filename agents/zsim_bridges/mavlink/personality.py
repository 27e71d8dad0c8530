"""How PX4 and ArduPilot differ for clients: modes, parameters, fence actions, and rules for offboard flight.

Sources: PX4-Autopilot, src/modules/commander/px4_custom_mode.h and the parameter reference; ArduPilot,
ArduCopter/mode.h and the parameter list of Copter.
"""

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from typing import Literal, NamedTuple

from zsim.scenario.scenario import Drone
from zsim_agents.references.cruise import Cruise
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import Autopilot, ParamType

REAL, INT, SHORT, BYTE = ParamType.REAL32, ParamType.INT32, ParamType.INT16, ParamType.INT8
CM = 0.01  # unit of ArduPilot's lengths [m] and speeds [m/s]
ID_MAX = 16  # maximum number of characters in a parameter's name


FlightMode = Enum("FlightMode", "MANUAL ALTITUDE POSITION HOLD BRAKE TAKEOFF LAND RETURN MISSION OFFBOARD")
"""The modes of both autopilots, under common names."""


MANUAL_MODES = (FlightMode.MANUAL, FlightMode.ALTITUDE, FlightMode.POSITION)
HOLD_MODES = (*MANUAL_MODES, FlightMode.HOLD, FlightMode.BRAKE)


def px4_mode(main: int, sub: int = 0) -> int:
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


FenceAction = Enum("FenceAction", "NONE WARN HOLD RETURN LAND")
"""What a vehicle does outside its fence."""


PX4_FENCE = {  # GF_ACTION
    0: FenceAction.NONE,
    1: FenceAction.WARN,
    2: FenceAction.HOLD,
    3: FenceAction.RETURN,
    4: FenceAction.WARN,  # "terminate" only warns; see docs/mavlink.md
    5: FenceAction.LAND,
}
COPTER_FENCE = {  # FENCE_ACTION
    0: FenceAction.WARN,
    1: FenceAction.RETURN,
    2: FenceAction.LAND,
    3: FenceAction.RETURN,
    4: FenceAction.HOLD,  # brake, or land if that is impossible
}
Setting = Literal[
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
"""Parameters that affect the flight, under names common to both autopilots."""


class ParameterSpec(NamedTuple):
    """A parameter, its initial value and range; a fixed one cannot be set. The setting is the value times `unit`."""

    name: str
    type: ParamType
    value: float
    low: float
    high: float
    setting: Setting | None = None
    unit: float = 1.0
    fixed: bool = False


def _px4(drone: Drone, system_id: int) -> list[ParameterSpec]:
    limits = drone.limits
    horizontal, climb, altitude = limits.horizontal_speed_m_s, limits.vertical_speed_m_s, limits.altitude_m
    return [
        ParameterSpec("SYS_AUTOSTART", INT, 4001, 0, 9999999, fixed=True),  # generic quadcopter
        ParameterSpec("MAV_SYS_ID", INT, system_id, 1, 255, fixed=True),
        ParameterSpec("MAV_TYPE", INT, 2, 0, 45, fixed=True),
        ParameterSpec("MPC_XY_VEL_MAX", REAL, horizontal, 0.1, horizontal, "speed_m_s"),
        ParameterSpec("MPC_XY_CRUISE", REAL, horizontal, 0.1, horizontal),
        ParameterSpec("MPC_Z_VEL_MAX_UP", REAL, climb, 0.1, climb, "up_m_s"),
        ParameterSpec("MPC_Z_VEL_MAX_DN", REAL, climb, 0.1, climb, "down_m_s"),
        ParameterSpec("MPC_THR_HOVER", REAL, 0.5, 0.5, 0.5, fixed=True),
        ParameterSpec("MIS_TAKEOFF_ALT", REAL, 2.5, 0.5, altitude, "takeoff_altitude_m"),
        ParameterSpec("NAV_ACC_RAD", REAL, 1.0, 0.2, 200.0, "acceptance_m"),
        ParameterSpec("RTL_RETURN_ALT", REAL, 10.0, 0.5, altitude, "return_altitude_m"),
        ParameterSpec("COM_OF_LOSS_T", REAL, 1.0, 0.1, 60.0, "stream_s"),
        ParameterSpec("COM_DISARM_PRFLT", REAL, 10.0, -1.0, 600.0, "disarm_s"),
        ParameterSpec("GF_ACTION", INT, 2, 0, 5, "fence_action"),
        ParameterSpec("GF_MAX_HOR_DIST", REAL, 0.0, 0.0, 10000.0, "fence_radius_m"),
        ParameterSpec("GF_MAX_VER_DIST", REAL, 0.0, 0.0, 10000.0, "fence_altitude_m"),
        ParameterSpec("BAT1_N_CELLS", INT, 3, 0, 16, fixed=True),
    ]


def _copter(drone: Drone, system_id: int) -> list[ParameterSpec]:
    limits = drone.limits
    horizontal, climb = limits.horizontal_speed_m_s / CM, limits.vertical_speed_m_s / CM
    altitude = limits.altitude_m / CM
    return [
        ParameterSpec("SYSID_THISMAV", SHORT, system_id, 1, 255, fixed=True),
        ParameterSpec("FRAME_CLASS", BYTE, 1, 0, 17, fixed=True),  # quad
        ParameterSpec("FRAME_TYPE", BYTE, 1, 0, 18, fixed=True),  # x
        ParameterSpec("WPNAV_SPEED", REAL, horizontal, 10.0, horizontal, "speed_m_s", CM),
        ParameterSpec("WPNAV_SPEED_UP", REAL, climb, 10.0, climb, "up_m_s", CM),
        ParameterSpec("WPNAV_SPEED_DN", REAL, climb, 10.0, climb, "down_m_s", CM),
        ParameterSpec("WPNAV_RADIUS", REAL, 100.0, 5.0, 1000.0, "acceptance_m", CM),
        ParameterSpec("PILOT_TKOFF_ALT", REAL, 250.0, 0.0, altitude, "takeoff_altitude_m", CM),
        ParameterSpec("RTL_ALT", REAL, 1000.0, 30.0, altitude, "return_altitude_m", CM),
        ParameterSpec("GUID_TIMEOUT", REAL, 3.0, 0.1, 5.0, "stream_s"),
        ParameterSpec("DISARM_DELAY", BYTE, 10, 0, 127, "disarm_s"),
        ParameterSpec("FENCE_ENABLE", BYTE, 0, 0, 1),
        ParameterSpec("FENCE_ACTION", BYTE, 1, 0, 8, "fence_action"),
        ParameterSpec("FENCE_RADIUS", REAL, 150.0, 1.0, 10000.0, "fence_radius_m"),
        ParameterSpec("FENCE_ALT_MAX", REAL, 100.0, 1.0, 1000.0, "fence_altitude_m"),
        ParameterSpec("ARMING_CHECK", INT, 1, 0, 1048575),
    ]


class Personality(NamedTuple):
    """An autopilot as its clients see it.

    Attributes:
        specs: returns the parameters of a drone, given its system id.
        fence_actions: fence actions by the value of the parameter that sets them.
        is_px4: PX4 enters OFFBOARD only while it receives setpoints, holds when they stop, sends integer parameters as
            their bytes, and has no item 0 for home in its missions.
        version: flight_sw_version: major, minor, patch and type.
    """

    autopilot: Autopilot
    modes: Mapping[FlightMode, int]
    first_mode: FlightMode
    specs: Callable[[Drone, int], list[ParameterSpec]]
    fence_actions: Mapping[int, FenceAction]
    is_px4: bool
    version: tuple[int, int, int, int]

    def mode_of(self, custom_mode: int) -> FlightMode | None:
        return next((mode for mode, number in self.modes.items() if number == custom_mode), None)


PERSONALITIES = {
    "px4": Personality(Autopilot.PX4, PX4_MODES, FlightMode.HOLD, _px4, PX4_FENCE, True, (1, 15, 4, 255)),
    "ardupilot": Personality(
        Autopilot.ARDUPILOTMEGA, COPTER_MODES, FlightMode.MANUAL, _copter, COPTER_FENCE, False, (4, 5, 7, 255)
    ),
}
_INTEGER_FORMATS = {
    ParamType.UINT8: "<B3x",
    ParamType.INT8: "<b3x",
    ParamType.UINT16: "<H2x",
    ParamType.INT16: "<h2x",
    ParamType.UINT32: "<I",
    ParamType.INT32: "<i",
}


class Parameters:
    """The parameters of one vehicle: `parameters["speed_m_s"]` is a setting, whatever the autopilot calls it."""

    def __init__(self, personality: Personality, drone: Drone, system_id: int) -> None:
        self._personality = personality
        self._specs = {spec.name: spec for spec in sorted(personality.specs(drone, system_id))}
        self._settings = {spec.setting: spec for spec in self._specs.values()}
        self._names = list(self._specs)
        self.values = {name: spec.value for name, spec in self._specs.items()}

    def __getitem__(self, setting: Setting) -> float:
        spec = self._settings[setting]
        return spec.unit * self.values[spec.name]

    @property
    def speeds(self) -> Cruise:
        return Cruise(self["speed_m_s"], self["up_m_s"], self["down_m_s"])

    @property
    def fence_action(self) -> FenceAction:
        """The action to take outside the fence; ArduPilot's fence is active only while FENCE_ENABLE is 1."""
        if not self.values.get("FENCE_ENABLE", 1.0):
            return FenceAction.NONE
        return self._personality.fence_actions.get(int(self["fence_action"]), FenceAction.WARN)

    def put_setting(self, setting: Setting, value: float) -> str | None:
        spec = self._settings[setting]
        return self.put(spec.name, value / spec.unit)

    def put(self, name: str, value: float) -> str | None:
        """Set a parameter, clipped to its range; return the reason for a refusal, or None."""
        spec = self._specs.get(name)
        if spec is None:
            return f"{name[:ID_MAX]}: no such parameter"
        if spec.fixed:
            return f"{name} is {self.values[name]:g} and cannot be set"
        if not math.isfinite(value):
            return f"{name}: {value} is not a finite number"
        value = min(spec.high, max(spec.low, value))
        self.values[name] = value if spec.type == ParamType.REAL32 else float(round(value))
        return None

    def messages(self) -> Iterator[dialect.ParamValue]:
        return map(self.message, self._names)

    def find(self, name: str, index: int) -> str | None:
        """Return the name of the parameter with this index or, if it is negative, this name; None if there is none."""
        if index >= 0:
            return self._names[index] if index < len(self._names) else None
        return name if name in self._specs else None

    def message(self, name: str) -> dialect.ParamValue:
        type_, value = self._specs[name].type, self.values[name]
        if self._is_bytewise(type_):
            (value,) = struct.unpack("<f", struct.pack(_INTEGER_FORMATS[type_], int(value)))
        return dialect.ParamValue(name, value, type_, len(self._names), self._names.index(name))

    def decode_value(self, message: dialect.ParamSet) -> float:
        """Decode the value in a message by the parameter's type, or by the message's for an unknown parameter."""
        spec = self._specs.get(message.param_id)
        type_ = spec.type if spec else message.param_type
        if not self._is_bytewise(type_):
            return message.param_value
        (value,) = struct.unpack(_INTEGER_FORMATS[ParamType(type_)], struct.pack("<f", message.param_value))
        return float(value)

    def _is_bytewise(self, type_: int) -> bool:
        """Return whether values of a type are sent as the bytes of an integer in a float field."""
        return self._personality.is_px4 and type_ in _INTEGER_FORMATS
