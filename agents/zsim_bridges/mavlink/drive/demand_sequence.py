"""From what an aircraft is to do to the commands and setpoints that make an autopilot do it. Pure.

Commands are repeated until the telemetry shows their effect; setpoints are sent at once when they change, and again and
again while they hold.
"""

import math
from collections.abc import Iterator
from typing import Any

from zsim.math.rotation import Vector
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.drive.autopilot_modes import (
    ARM_DISARM,
    FORCED,
    NAV_LAND,
    NAV_TAKEOFF,
    ExternalControl,
)
from zsim_bridges.mavlink.drive.autopilot_state import IN_AIR, LANDING, ON_GROUND, AutopilotState
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.vehicle_links.failsafe import Demand

REPEAT_NS = 1_000_000_000  # chosen: an autopilot answers a command within some 0.1 s
KILL_REPEAT_NS = 200_000_000  # chosen: the one command that may not be lost
SETPOINT_NS = 40_000_000  # 25 Hz: PX4 takes 2 Hz for silence
CHANGED_NS = 15_000_000  # chosen: less than a gate, in which a controller commands once
STREAMED_NS = 600_000_000  # PX4 wants more than 0.5 s of setpoints before OFFBOARD
VELOCITY_AND_YAW_RATE = 0b0101_1100_0111  # POSITION_TARGET_TYPEMASK: position, acceleration and yaw are ignored
LOCAL_NED = 1  # MAV_FRAME
STANDING: Vector = (0.0, 0.0, 0.0)


class DemandSequence:
    """What is sent to one autopilot.

    Args:
        takeoff_height_m: over the ground.
    """

    def __init__(self, takeoff_height_m: float) -> None:
        self._takeoff_height_m = takeoff_height_m
        self._action = "none"
        self._commanded_ns: dict[str, int] = {}
        self._setpoint: Demand | None = None
        self._setpoint_ns = self._stream_ns = 0

    def advance(
        self, now_ns: int, demand: Demand, autopilot: AutopilotState, control: ExternalControl
    ) -> Iterator[Any]:
        """Yield the messages that are due."""
        if demand.action != self._action:
            self._action = demand.action
            self._commanded_ns.clear()
        taken_over = autopilot.is_flying and control.is_taken_over(autopilot.custom_mode, demand.action == "land")
        match demand.action:
            case "hold" | "fly" | "land" if taken_over:
                return
            case "take_off":
                yield from self._take_off(now_ns, autopilot, control)
            case "hold" | "fly":
                yield from self._fly(now_ns, demand, autopilot, control)
            case "land" if autopilot.landed not in (LANDING, ON_GROUND):
                yield from self._repeat("land", now_ns, autopilot.command(NAV_LAND, *_HERE, 0.0))
            case "kill":
                kill = autopilot.command(ARM_DISARM, 0, FORCED)
                yield from self._repeat("kill", now_ns, kill, KILL_REPEAT_NS if autopilot.armed else REPEAT_NS)

    def _take_off(self, now_ns: int, autopilot: AutopilotState, control: ExternalControl) -> Iterator[Any]:
        """Yield the next command: mode where it takes off in it, arm, take off."""
        if control.takes_off and not control.is_on(autopilot.custom_mode):
            yield from self._repeat("mode", now_ns, control.enter(*autopilot.address))
        elif not autopilot.armed:
            yield from self._repeat("arm", now_ns, autopilot.command(ARM_DISARM, 1))
        elif autopilot.landed == ON_GROUND:
            above_m = 0.0 if control.relative_takeoff else autopilot.sea_height_m
            height_m = above_m + self._takeoff_height_m
            yield from self._repeat("take off", now_ns, autopilot.command(NAV_TAKEOFF, *_HERE, height_m))

    def _fly(self, now_ns: int, demand: Demand, autopilot: AutopilotState, control: ExternalControl) -> Iterator[Any]:
        """Yield a setpoint, and the command for the mode in which it is obeyed."""
        if now_ns - self._setpoint_ns > STREAMED_NS:
            self._stream_ns = now_ns
        age_ns = now_ns - self._setpoint_ns
        if age_ns >= (CHANGED_NS if demand != self._setpoint else SETPOINT_NS):
            self._setpoint, self._setpoint_ns = demand, now_ns
            yield setpoint(demand, autopilot)
        streamed = now_ns - self._stream_ns >= STREAMED_NS
        if streamed and autopilot.landed == IN_AIR and not control.is_on(autopilot.custom_mode):
            yield from self._repeat("mode", now_ns, control.enter(*autopilot.address))

    def _repeat(self, name: str, now_ns: int, message: Any, period_ns: int = REPEAT_NS) -> Iterator[Any]:
        if now_ns - self._commanded_ns.get(name, -REPEAT_NS) >= period_ns:
            self._commanded_ns[name] = now_ns
            yield message


_HERE = (0.0, 0.0, 0.0, math.nan, math.nan, math.nan)  # the first parameters of NAV_LAND and NAV_TAKEOFF: no place


def setpoint(demand: Demand, autopilot: AutopilotState) -> dialect.SetPositionTargetLocalNed:
    """Return the setpoint of a velocity and a yaw rate."""
    velocity = demand.velocity_m_s if demand.action == "fly" else STANDING
    vx, vy, vz = ned_axes.ned(velocity)
    system, component = autopilot.address
    return dialect.SetPositionTargetLocalNed(
        target_system=system,
        target_component=component,
        coordinate_frame=LOCAL_NED,
        type_mask=VELOCITY_AND_YAW_RATE,
        vx=vx,
        vy=vy,
        vz=vz,
        yaw_rate=-demand.yaw_rate_rad_s if demand.action == "fly" else 0.0,
    )
