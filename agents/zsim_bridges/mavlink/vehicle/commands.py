"""COMMAND_LONG and COMMAND_INT: each is answered, what is not known with UNSUPPORTED.

Source: https://mavlink.io/en/services/command.html.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from zsim.math.rotation import Vector
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.autopilot.enums import FORCE, Cmd, MavFrame, Result
from zsim_bridges.mavlink.autopilot.parameters import Parameters
from zsim_bridges.mavlink.autopilot.personality import FlightMode, Personality, Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.mission import (
    ABSOLUTE,
    DEGREES,
    FRAMES,
    LOCAL,
    LOCAL_M,
    PlanItem,
    from_int,
    place_of,
)
from zsim_bridges.mavlink.flight.position_guidance import Target, is_place
from zsim_bridges.mavlink.flight.vehicle_flight import Flight
from zsim_bridges.mavlink.telemetry.telemetry import Telemetry
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.wire_message import WireMessage

AUTOPILOT_VERSION, PROTOCOL_VERSION = 148, 300  # ids of messages that are sent on request alone
NAN = math.nan


class Request(NamedTuple):
    """A command: seven parameters, x and y in degrees or metres, and the frame of the place."""

    command: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int

    @property
    def place(self) -> PlanItem:
        p = self.params
        return PlanItem(self.frame, self.command, p[:4], p[4], p[5], p[6])


class Answer(NamedTuple):
    """How a command was taken, and why."""

    result: Result
    reason: str = ""


ACCEPTED, UNSUPPORTED = Answer(Result.ACCEPTED), Answer(Result.UNSUPPORTED)


def request_of(message: dialect.CommandLong | dialect.CommandInt) -> Request:
    """Return the command in a message."""
    m = message
    if isinstance(m, dialect.CommandLong):
        place = m.param5, m.param6, m.param7
        return Request(m.command, (m.param1, m.param2, m.param3, m.param4, *place), frame=0)
    unit = LOCAL_M if m.frame in LOCAL else DEGREES
    place = from_int(m.x, unit), from_int(m.y, unit), m.z
    return Request(m.command, (m.param1, m.param2, m.param3, m.param4, *place), m.frame)


def answered(refusal: str | None) -> Answer:
    """Return the answer to what was done, or refused with a reason."""
    return ACCEPTED if refusal is None else Answer(Result.DENIED, refusal)


class Commands:
    """Carries out the commands of clients.

    Args:
        send: sends a message.
        version: returns AUTOPILOT_VERSION.
    """

    def __init__(
        self,
        personality: Personality,
        settings: Settings,
        parameters: Parameters,
        state: VehicleState,
        flight: Flight,
        telemetry: Telemetry,
        send: Callable[[WireMessage], None],
        version: Callable[[], WireMessage],
    ) -> None:
        self._personality = personality
        self._settings = settings
        self._parameters = parameters
        self._state = state
        self._flight = flight
        self._telemetry = telemetry
        self._send = send
        self._version = version
        self._handlers: dict[int, Callable[[Request], Answer]] = {
            Cmd.COMPONENT_ARM_DISARM: self._arm,
            Cmd.NAV_TAKEOFF: self._take_off,
            Cmd.NAV_LAND: lambda _: answered(flight.set_mode(FlightMode.LAND)),
            Cmd.NAV_RETURN_TO_LAUNCH: lambda _: answered(flight.set_mode(FlightMode.RETURN)),
            Cmd.NAV_LOITER_UNLIM: lambda _: answered(flight.set_mode(FlightMode.HOLD)),
            Cmd.DO_SET_MODE: self._set_mode,
            Cmd.DO_REPOSITION: self._reposition,
            Cmd.DO_PAUSE_CONTINUE: self._pause,
            Cmd.DO_CHANGE_SPEED: self._change_speed,
            Cmd.DO_SET_HOME: self._set_home,
            Cmd.DO_FLIGHTTERMINATION: self._terminate,
            Cmd.DO_SET_MISSION_CURRENT: self._set_mission_current,
            Cmd.DO_FENCE_ENABLE: self._enable_fence,
            Cmd.MISSION_START: self._start_mission,
            Cmd.CONDITION_YAW: self._turn,
            Cmd.PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            Cmd.GET_HOME_POSITION: lambda _: self._message(242),
            Cmd.REQUEST_MESSAGE: lambda request: self._message(_id(request.params[0])),
            Cmd.REQUEST_AUTOPILOT_CAPABILITIES: lambda _: self._message(AUTOPILOT_VERSION),
            Cmd.SET_MESSAGE_INTERVAL: self._set_interval,
            Cmd.GET_MESSAGE_INTERVAL: self._get_interval,
        }

    def carry_out(self, request: Request) -> Answer:
        """Carry out a command; return how it was taken."""
        handler = self._handlers.get(request.command)
        return handler(request) if handler else UNSUPPORTED

    def _arm(self, request: Request) -> Answer:
        force = request.params[1] == FORCE
        if request.params[0] not in (0.0, 1.0):
            return Answer(Result.DENIED, f"arm or disarm? {request.params[0]:g}")
        arm = self._flight.arm if request.params[0] else self._flight.disarm
        return answered(arm(force))

    def _take_off(self, request: Request) -> Answer:
        height_m = request.params[6]
        if not math.isfinite(height_m) or (self._personality.needs_stream and height_m == 0.0):
            altitude_m = self._settings["takeoff_altitude_m"]
        elif self._personality.needs_stream:  # PX4 has it over the sea
            altitude_m = height_m - self._state.to_global(self._state.home_m or self._state.position_m)[2]
        else:
            altitude_m = height_m
        if not 0.0 < altitude_m <= 10_000.0:
            return Answer(Result.DENIED, f"take-off to {altitude_m:.1f} m over home")
        return answered(self._flight.take_off(altitude_m))

    def _set_mode(self, request: Request) -> Answer:
        main, sub = _id(request.params[1]), _id(request.params[2])
        custom = main << 16 | sub << 24 if self._personality.name == "px4" else main
        if not int(request.params[0] if math.isfinite(request.params[0]) else 0) & 1:
            return Answer(Result.DENIED, "a mode must be a custom mode")
        return self.put_custom_mode(custom)

    def put_custom_mode(self, custom: int) -> Answer:
        """Change the mode by its number."""
        mode = self._personality.mode_of(custom)
        if mode is None:
            return Answer(Result.UNSUPPORTED, f"no mode {custom:#x}")
        return answered(self._flight.set_mode(mode))

    def _reposition(self, request: Request) -> Answer:
        speed_m_s, _, _, yaw = request.params[:4]
        place = self._place(request)
        if place is None:
            return Answer(Result.DENIED, "no place to go to")
        yaw_rad = ned_axes.yaw_ned(yaw) if math.isfinite(yaw) else None
        speed = speed_m_s if math.isfinite(speed_m_s) and speed_m_s > 0 else None
        return answered(self._flight.go_to(Target(place, yaw_rad=yaw_rad, speed_m_s=speed)))

    def _place(self, request: Request) -> Vector | None:
        """Return the place of a command in W; what is not finite of it is where the vehicle is."""
        item = request.place
        if request.frame not in FRAMES or (abs(item.x) > 180.0 and request.frame not in LOCAL):
            return None
        own = self._state.position_m
        if not math.isfinite(item.z):
            if request.frame in LOCAL:
                item = item._replace(z=-own[2] if request.frame == MavFrame.LOCAL_NED else own[2])
            else:
                item = item._replace(z=self._state.to_global(own)[2], frame=ABSOLUTE[0])
        place = place_of(item, self._state)
        return place if is_place(place) else None

    def _pause(self, request: Request) -> Answer:
        if request.params[0] == 0.0:
            return answered(self._flight.set_mode(FlightMode.HOLD))
        return answered(self._flight.start_mission())

    def _change_speed(self, request: Request) -> Answer:
        speed_m_s = request.params[1]
        if not math.isfinite(speed_m_s) or speed_m_s <= 0.0:
            return Answer(Result.DENIED, f"a speed of {speed_m_s} m/s")
        meaning = {2: "up_m_s", 3: "down_m_s"}.get(_id(request.params[0]), "speed_m_s")
        return answered(self._settings.put(meaning, speed_m_s))  # type: ignore[arg-type]

    def _set_home(self, request: Request) -> Answer:
        place = self._state.position_m if request.params[0] == 1.0 else self._place(request)
        if place is None:
            return Answer(Result.DENIED, "no place for home")
        self._state.home_m = place
        return self._message(242)

    def _terminate(self, request: Request) -> Answer:
        if request.params[0] > 0.5:
            self._flight.terminate()
        return ACCEPTED

    def _set_mission_current(self, request: Request) -> Answer:
        return answered(None if self._flight.mission.set_current(_id(request.params[0])) else "no such item")

    def _enable_fence(self, request: Request) -> Answer:
        if "FENCE_ENABLE" not in self._parameters:
            return UNSUPPORTED
        return answered(self._parameters.put("FENCE_ENABLE", float(request.params[0] == 1.0)))

    def _start_mission(self, request: Request) -> Answer:
        first = _id(request.params[0])
        return answered(self._flight.start_mission(first or None))

    def _turn(self, request: Request) -> Answer:
        """CONDITION_YAW: to an angle [deg] from north, or by one, in a direction; the position is held."""
        angle, _, direction, relative = request.params[:4]
        if not math.isfinite(angle) or not self._state.is_steerable:
            return Answer(Result.DENIED, "not flying" if math.isfinite(angle) else "no angle")
        turn = math.radians(angle) * (-1.0 if direction >= 0 else 1.0)
        yaw = ned_axes.wrapped(self._state.yaw_rad + turn) if relative == 1.0 else ned_axes.yaw_ned(math.radians(angle))
        return answered(self._flight.go_to(Target(self._state.position_m, yaw_rad=yaw)))

    def _reboot(self, request: Request) -> Answer:
        return answered(self._flight.reboot()) if request.params[0] in (1.0, 3.0) else UNSUPPORTED

    def _message(self, message_id: int) -> Answer:
        message = self._version() if message_id == AUTOPILOT_VERSION else self._telemetry.build(message_id)
        if message is None:
            return UNSUPPORTED
        self._send(message)
        return ACCEPTED

    def _set_interval(self, request: Request) -> Answer:
        interval_us = request.params[1]
        if not math.isfinite(interval_us):
            return Answer(Result.DENIED, f"an interval of {interval_us} us")
        known = self._telemetry.put_interval(_id(request.params[0]), interval_us)
        return ACCEPTED if known else UNSUPPORTED

    def _get_interval(self, request: Request) -> Answer:
        message_id = _id(request.params[0])
        self._send(dialect.MessageInterval(message_id & 0xFFFF, self._telemetry.interval_us(message_id)))
        return ACCEPTED


def _id(value: float) -> int:
    """Return a number that came as a float; -1 for what is none."""
    return int(value) if math.isfinite(value) and 0 <= value < 2**31 else -1
