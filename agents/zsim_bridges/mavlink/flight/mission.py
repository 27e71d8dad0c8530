"""A mission of waypoints: its items, and where a vehicle is in them.

Source of the items: https://mavlink.io/en/messages/common.html#mav_commands and the mission protocol.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from zsim.math.rotation import Vector
from zsim_bridges.mavlink.autopilot import ned_axes
from zsim_bridges.mavlink.autopilot.enums import Cmd, MavFrame
from zsim_bridges.mavlink.autopilot.personality import Settings
from zsim_bridges.mavlink.autopilot.vehicle_state import VehicleState
from zsim_bridges.mavlink.flight.position_guidance import Target, distance_m

JUMPS_MAX = 1000  # at once without a waypoint between them: a circle of jumps
ABSOLUTE = (MavFrame.GLOBAL, MavFrame.GLOBAL_INT)
RELATIVE = (
    MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_RELATIVE_ALT_INT,
    MavFrame.GLOBAL_TERRAIN_ALT,  # the ground of zsim is level
    MavFrame.GLOBAL_TERRAIN_ALT_INT,
)
LOCAL = (MavFrame.LOCAL_NED, MavFrame.LOCAL_ENU)
FRAMES = (*ABSOLUTE, *RELATIVE, *LOCAL, MavFrame.MISSION)
PLACES = (Cmd.NAV_WAYPOINT, Cmd.NAV_LOITER_UNLIM, Cmd.NAV_LOITER_TIME)
COMMANDS = (
    *PLACES,
    Cmd.NAV_RETURN_TO_LAUNCH,
    Cmd.NAV_LAND,
    Cmd.NAV_TAKEOFF,
    Cmd.NAV_DELAY,
    Cmd.DO_JUMP,
    Cmd.DO_CHANGE_SPEED,
)


DEGREES, LOCAL_M = 1e-7, 1e-4  # what one of x and y is in messages that have them as whole numbers
NO_INT = 2**31 - 1  # INT32_MAX: what NaN is among these
# https://mavlink.io/en/services/mission.html#mission_item_int


def from_int(value: int, unit: float) -> float:
    """Return a whole number of a message in a unit; NaN for the one that stands for it."""
    return math.nan if value == NO_INT else unit * value


def to_int(value: float, unit: float) -> int:
    """Return a value in a unit as the whole number of a message."""
    return round(value / unit) if math.isfinite(value) else NO_INT


class PlanItem(NamedTuple):
    """An item: x and y are latitude and longitude [deg], or [m] in local frames; z is [m]. NaN is where one is."""

    frame: int
    command: int
    params: tuple[float, float, float, float]
    x: float
    y: float
    z: float
    autocontinue: bool = True

    @property
    def has_place(self) -> bool:
        """Whether it names where, beside a height; one of x and y is enough."""
        return any(math.isfinite(value) and value for value in (self.x, self.y))


class MissionReport(NamedTuple):
    """How far a mission was flown, for the record of the run.

    Attributes:
        items: of the mission, without ArduPilot's item 0.
        done: how many of them were flown.
        reason: why it was aborted, "" where it was not.
        failsafe: whether the vehicle itself aborted it, and no client.
    """

    state: Literal["active", "finished", "aborted"]
    items: int
    done: int
    reason: str = ""
    failsafe: bool = False


class MissionStep(NamedTuple):
    """What a mission asks for now."""

    target: Target | None = None
    climb_to_m: float | None = None
    land: bool = False
    returns: bool = False
    is_over: bool = False


def place_of(item: PlanItem, state: VehicleState) -> Vector:
    """Return p_W [m] of an item; what it leaves out of x and y is where the vehicle is."""
    home = state.home_m or state.position_m
    z = item.z if math.isfinite(item.z) else 0.0
    if item.frame in LOCAL:
        x, y, up = ned_axes.ned((item.x, item.y, z)) if item.frame == MavFrame.LOCAL_NED else (item.x, item.y, z)
        own_x, own_y, _ = state.position_m
        return x if math.isfinite(x) else own_x, y if math.isfinite(y) else own_y, up
    height_m = z if item.frame in ABSOLUTE else state.to_global(home)[2] + z
    latitude_deg, longitude_deg, _ = state.to_global(state.position_m)
    if item.has_place:
        latitude_deg = item.x if math.isfinite(item.x) else latitude_deg
        longitude_deg = item.y if math.isfinite(item.y) else longitude_deg
        return state.to_local(latitude_deg, longitude_deg, height_m)
    x, y, _ = state.position_m
    return x, y, state.to_local(latitude_deg, longitude_deg, height_m)[2]


class Mission:
    """A mission and the progress in it.

    Args:
        first: item with which it begins; ArduPilot's item 0 is home.
        turns: whether the yaw of a waypoint is flown.

    Attributes:
        items: of the mission, without ArduPilot's item 0.
        reached: numbers of items that have been reached, to be reported.
        reports: of how far it was flown, to be sent to the world.
    """

    def __init__(self, first: int = 0, turns: bool = True) -> None:
        self.first = first
        self._turns = turns
        self.items: list[PlanItem] = []
        self.reached: list[int] = []
        self.reports: list[MissionReport] = []
        self._reported: int | None = None  # how many items were flown at the last report; None while it is not flown
        self._index = 0
        self._since_ns: int | None = None  # at this item
        self._speed_m_s: float | None = None
        self._jumps: dict[int, int] = {}  # left, by item
        self._climbed = False

    @property
    def current(self) -> int:
        """The number of the item that is flown to."""
        return self.first + min(self._index, max(0, len(self.items) - 1))

    def load(self, items: Sequence[PlanItem]) -> None:
        """Replace the items, and begin anew."""
        self.items = list(items)
        self.rewind()

    @property
    def is_landing(self) -> bool:
        """Whether the present item ends on the ground."""
        item = self.items[self._index] if self._index < len(self.items) else None
        return item is not None and item.command in (Cmd.NAV_LAND, Cmd.NAV_RETURN_TO_LAUNCH)

    def start(self) -> None:
        """Report that it is flown from now on, unless it is flown already."""
        if self._reported is None:
            self._reported = self._index
            self.reports.append(MissionReport("active", len(self.items), self._index))

    def note_progress(self) -> None:
        """Report what more of it has been flown; a jump back is none."""
        if self._reported is not None and self._index > self._reported:
            self._reported = self._index
            self.reports.append(MissionReport("active", len(self.items), self._index))

    def finish(self) -> None:
        """Report that all of it has been flown."""
        if self._reported is not None:
            self.reports.append(MissionReport("finished", len(self.items), len(self.items)))
            self._reported = None

    def abort(self, reason: str, failsafe: bool) -> None:
        """Report that it is flown no longer, unless it has ended already."""
        if self._reported is not None:
            self.reports.append(MissionReport("aborted", len(self.items), self._reported, reason, failsafe))
            self._reported = None

    def rewind(self) -> None:
        """Go back to the first item."""
        self._index, self._speed_m_s, self._jumps = 0, None, {}
        self._enter(0)

    def set_current(self, number: int) -> bool:
        """Go on with an item; False where there is none of that number."""
        index = max(0, number - self.first)
        if index >= len(self.items):
            return False
        self._enter(index)
        return True

    def on_climbed(self) -> None:
        """Note that the climb that was asked for is over."""
        self._climbed = True

    def takeoff_height_m(self, state: VehicleState) -> float | None:
        """Return z in W to which the mission takes off; None where it does not begin with that."""
        item = self.items[self._index] if self._index < len(self.items) else None
        return place_of(item, state)[2] if item and item.command == Cmd.NAV_TAKEOFF else None

    def step(self, state: VehicleState, settings: Settings) -> MissionStep:
        """Return what is to be done now, past the items that have been done."""
        for _ in range(JUMPS_MAX):
            if self._index >= len(self.items):
                self.rewind()
                return MissionStep(is_over=True)
            step = self._step(self.items[self._index], state, settings)
            if step is not None:
                return step
        return MissionStep(is_over=True)

    def _step(self, item: PlanItem, state: VehicleState, settings: Settings) -> MissionStep | None:
        """Return what an item asks for; None once it is done."""
        match item.command:
            case Cmd.DO_CHANGE_SPEED:
                self._speed_m_s = item.params[1] if item.params[1] > 0 else self._speed_m_s
            case Cmd.DO_JUMP:
                return self._jump(item)
            case Cmd.NAV_TAKEOFF:
                return self._take_off(item, state)
            case Cmd.NAV_RETURN_TO_LAUNCH:
                return MissionStep(returns=True)
            case Cmd.NAV_LAND:
                return self._land(item, state, settings)
            case Cmd.NAV_DELAY:
                return self._wait(Target(state.position_m), item.params[0], state)
            case _:
                return self._visit(item, state, settings)
        return self._done()

    def _take_off(self, item: PlanItem, state: VehicleState) -> MissionStep | None:
        if self._climbed:
            return self._done()
        return MissionStep(climb_to_m=place_of(item, state)[2])

    def _land(self, item: PlanItem, state: VehicleState, settings: Settings) -> MissionStep:
        if not item.has_place or self._since_ns is not None:
            return MissionStep(land=True)
        x, y, _ = place_of(item, state)
        target = Target((x, y, state.position_m[2]), speed_m_s=self._speed_m_s)
        if distance_m(target, state.position_m) < settings["acceptance_m"]:
            self._since_ns = state.t_ns
            return MissionStep(land=True)
        return MissionStep(Target((x, y, None), speed_m_s=self._speed_m_s))

    def _visit(self, item: PlanItem, state: VehicleState, settings: Settings) -> MissionStep | None:
        yaw_deg = item.params[3]
        yaw = ned_axes.yaw_ned(math.radians(yaw_deg)) if self._turns and math.isfinite(yaw_deg) else None
        target = Target(place_of(item, state), yaw_rad=yaw, speed_m_s=self._speed_m_s)
        if self._since_ns is None:
            radius_m = item.params[1] if item.command == Cmd.NAV_WAYPOINT and item.params[1] > 0 else None
            if distance_m(target, state.position_m) > (radius_m or settings["acceptance_m"]):
                return MissionStep(target)
            self.reached.append(self.first + self._index)
        stay_s = math.inf if item.command == Cmd.NAV_LOITER_UNLIM else item.params[0]
        return self._wait(target, stay_s, state)

    def _wait(self, target: Target, stay_s: float, state: VehicleState) -> MissionStep | None:
        """Stay for some time; 0 and what is no number is none."""
        if self._since_ns is None:
            self._since_ns = state.t_ns
        if (state.t_ns - self._since_ns) * 1e-9 < stay_s:
            return MissionStep(target)
        return self._done()

    def _jump(self, item: PlanItem) -> None:
        left = self._jumps.setdefault(self._index, int(max(-1.0, min(1e6, item.params[1]))))
        index = int(max(0.0, min(1e6, item.params[0]))) - self.first
        if left and 0 <= index < len(self.items):
            self._jumps[self._index] = left - 1 if left > 0 else left
            self._enter(index)
        else:
            self._done()

    def _done(self) -> None:
        self._enter(self._index + 1)

    def _enter(self, index: int) -> None:
        self._index, self._since_ns, self._climbed = index, None, False
