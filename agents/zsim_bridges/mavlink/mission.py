"""Waypoint missions: their items, a vehicle's progress through them, and the transfer of mission and fence items.

Sources: https://mavlink.io/en/messages/common.html#mav_commands for the items, and
https://mavlink.io/en/services/mission.html for the protocol.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from zsim.math.rotation import Vector
from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.dialect import FENCE, MISSION, Cmd, MavFrame, MissionResult
from zsim_bridges.mavlink.personality import Parameters
from zsim_bridges.mavlink.vehicle_state import Target, VehicleState, is_valid_position

JUMPS_MAX = 1000  # items skipped in succession before a mission is taken for an endless loop of jumps
ABSOLUTE = (MavFrame.GLOBAL, MavFrame.GLOBAL_INT)
RELATIVE = (
    MavFrame.GLOBAL_RELATIVE_ALT,
    MavFrame.GLOBAL_RELATIVE_ALT_INT,
    MavFrame.GLOBAL_TERRAIN_ALT,  # zsim's ground is level
    MavFrame.GLOBAL_TERRAIN_ALT_INT,
)
LOCAL = (MavFrame.LOCAL_NED, MavFrame.LOCAL_ENU)
FRAMES = (*ABSOLUTE, *RELATIVE, *LOCAL, MavFrame.MISSION)
COMMANDS: tuple[Any, ...] = (
    *(Cmd.NAV_WAYPOINT, Cmd.NAV_LOITER_UNLIM, Cmd.NAV_LOITER_TIME, Cmd.NAV_RETURN_TO_LAUNCH, Cmd.NAV_LAND),
    *(Cmd.NAV_TAKEOFF, Cmd.NAV_DELAY, Cmd.DO_JUMP, Cmd.DO_CHANGE_SPEED),
)
ITEMS_MAX = 1000  # items in one mission; design choice: autopilots store several hundred
RETRY_NS = 500_000_000  # ns of wall time after which a missing item is requested again
TRIES_MAX = 10
FENCE_COMMANDS: tuple[Any, ...] = (
    *(Cmd.FENCE_RETURN_POINT, Cmd.FENCE_POLYGON_INCLUSION, Cmd.FENCE_POLYGON_EXCLUSION),
    *(Cmd.FENCE_CIRCLE_INCLUSION, Cmd.FENCE_CIRCLE_EXCLUSION),
)
Address = tuple[int, int]
"""System and component id."""


class PlanItem(NamedTuple):
    """An item: x and y are latitude and longitude [deg], or [m] in local frames; z is in m. NaN: not given."""

    frame: int
    command: int
    params: tuple[float, float, float, float]
    x: float
    y: float
    z: float
    autocontinue: bool = True

    @property
    def has_position(self) -> bool:
        """Whether the item has a horizontal position, for which one of x and y is enough.

        A latitude and longitude of zero are none, as in ArduPilot; in a local frame they are the origin.
        """
        return any(math.isfinite(value) and (value or self.frame in LOCAL) for value in (self.x, self.y))


class MissionReport(NamedTuple):
    """A mission's progress, for the run's record: `done` of `items` items, not counting ArduPilot's item 0.

    Attributes:
        reason: why the mission was aborted; "" if it was not.
        failsafe: whether the vehicle aborted it, rather than a client.
    """

    state: Literal["active", "finished", "aborted"]
    items: int
    done: int
    reason: str = ""
    failsafe: bool = False


class MissionStep(NamedTuple):
    """The current action of a mission: flying to a target, climbing to `z_m` in W, or another action."""

    action: Literal["fly", "climb", "land", "return", "over"]
    target: Target = Target()
    z_m: float = 0.0


def position_of(item: PlanItem, state: VehicleState) -> Vector:
    """Return an item's position in W [m]; a missing x or y is the vehicle's, a missing z is 0 in the item's frame."""
    current_x, current_y, _ = state.position_m
    z = item.z if math.isfinite(item.z) else 0.0
    if item.frame in LOCAL:
        x, y, up = dialect.ned((item.x, item.y, z)) if item.frame == MavFrame.LOCAL_NED else (item.x, item.y, z)
        return x if math.isfinite(x) else current_x, y if math.isfinite(y) else current_y, up
    height_m = z if item.frame in ABSOLUTE else state.to_global(state.home_or_current_m)[2] + z
    latitude_deg, longitude_deg, _ = state.to_global(state.position_m)
    if item.has_position:
        latitude_deg = item.x if math.isfinite(item.x) else latitude_deg
        longitude_deg = item.y if math.isfinite(item.y) else longitude_deg
        return state.to_local(latitude_deg, longitude_deg, height_m)
    return current_x, current_y, state.to_local(latitude_deg, longitude_deg, height_m)[2]


class Mission:
    """A mission and the progress through it.

    Args:
        first: number of the first item; 1 for ArduPilot, whose item 0 is home.
        turns: whether the vehicle turns to the yaw of a waypoint.

    Attributes:
        reached: numbers of items that have been reached, yet to be reported to clients.
        reports: reports of the progress, yet to be sent to the world.
        has_climbed: whether the requested climb has ended.
    """

    def __init__(self, first: int = 0, turns: bool = True) -> None:
        self.first = first
        self._turns = turns
        self.items: list[PlanItem] = []
        self.reached: list[int] = []
        self.reports: list[MissionReport] = []
        self._reported: int | None = None  # items done at the last report; None while the mission is not being flown
        self._index = 0
        self._reached_ns: int | None = None  # simulated time at which the vehicle reached the current item
        self._delay_position: Vector = (0.0, 0.0, 0.0)  # position held during a delay [m; W]
        self._speed_m_s: float | None = None
        self._jumps: dict[int, int] = {}  # jumps left, by item index
        self.has_climbed = False

    @property
    def current(self) -> int:
        return self.first + min(self._index, max(0, len(self.items) - 1))

    @property
    def _item(self) -> PlanItem | None:
        return self.items[self._index] if self._index < len(self.items) else None

    @property
    def is_landing(self) -> bool:
        """Whether the current item ends on the ground."""
        item = self._item
        return item is not None and item.command in (Cmd.NAV_LAND, Cmd.NAV_RETURN_TO_LAUNCH)

    def load(self, items: Sequence[PlanItem]) -> None:
        self.items = list(items)
        self._rewind()

    def _rewind(self) -> None:
        self._index, self._speed_m_s, self._jumps = 0, None, {}
        self._enter(0)

    def set_current(self, number: int) -> bool:
        """Continue with an item; return False if there is no item of that number."""
        index = max(0, number - self.first)
        if index >= len(self.items):
            return False
        self._enter(index)
        return True

    # Reports

    def start(self) -> None:
        """Report that the mission has started, unless it is already being flown."""
        if self._reported is None:
            self._report_active()

    def note_progress(self) -> None:
        """Report further progress; a jump back is not progress."""
        if self._reported is not None and self._index > self._reported:
            self._report_active()

    def _report_active(self) -> None:
        self._reported = self._index
        self.reports.append(MissionReport("active", len(self.items), self._index))

    def finish(self) -> None:
        """Report that the mission has been completed."""
        if self._reported is not None:
            self.reports.append(MissionReport("finished", len(self.items), len(self.items)))
            self._reported = None

    def abort(self, reason: str, failsafe: bool) -> None:
        """Report that the mission has been aborted, unless it has already ended."""
        if self._reported is not None:
            self.reports.append(MissionReport("aborted", len(self.items), self._reported, reason, failsafe))
            self._reported = None

    # Steps

    def takeoff_height_m(self, state: VehicleState) -> float | None:
        """Return the height z in W at which the current item's take-off ends; None if the item is another one."""
        item = self._item
        return position_of(item, state)[2] if item and item.command == Cmd.NAV_TAKEOFF else None

    def step(self, state: VehicleState, parameters: Parameters) -> MissionStep:
        """Return the current action, skipping completed items."""
        for _ in range(JUMPS_MAX):
            item = self._item
            if item is None:
                self._rewind()
                break
            step = self._step(item, state, parameters)
            if step is not None:
                return step
        return MissionStep("over")

    def _step(self, item: PlanItem, state: VehicleState, parameters: Parameters) -> MissionStep | None:
        match item.command:
            case Cmd.DO_CHANGE_SPEED:
                self._speed_m_s = item.params[1] if item.params[1] > 0 else self._speed_m_s
            case Cmd.DO_JUMP:
                remaining = self._jumps.setdefault(self._index, int(max(-1.0, min(1e6, item.params[1]))))
                index = int(max(0.0, min(1e6, item.params[0]))) - self.first
                if remaining and 0 <= index < len(self.items):
                    self._jumps[self._index] = remaining - 1 if remaining > 0 else remaining
                    self._enter(index)
                    return None
            case Cmd.NAV_TAKEOFF:
                if not self.has_climbed:
                    return MissionStep("climb", z_m=position_of(item, state)[2])
            case Cmd.NAV_RETURN_TO_LAUNCH:
                return MissionStep("return")
            case Cmd.NAV_LAND:
                return self._land(item, state, parameters)
            case Cmd.NAV_DELAY:
                if self._reached_ns is None:
                    self._delay_position = state.position_m
                return self._wait(Target(self._delay_position), item.params[0], state)
            case _:
                return self._visit(item, state, parameters)
        self._enter(self._index + 1)
        return None

    def _land(self, item: PlanItem, state: VehicleState, parameters: Parameters) -> MissionStep:
        if not item.has_position or self._reached_ns is not None:
            return MissionStep("land")
        x, y, _ = position_of(item, state)
        target = Target((x, y, None), speed_m_s=self._speed_m_s)
        if target.distance_m(state.position_m) < parameters["acceptance_m"]:
            self._reached_ns = state.t_ns
            return MissionStep("land")
        return MissionStep("fly", target)

    def _visit(self, item: PlanItem, state: VehicleState, parameters: Parameters) -> MissionStep | None:
        yaw_deg = item.params[3]
        yaw = dialect.yaw_ned(math.radians(yaw_deg)) if self._turns and math.isfinite(yaw_deg) else None
        target = Target(position_of(item, state), yaw_rad=yaw, speed_m_s=self._speed_m_s)
        if self._reached_ns is None:
            radius_m = item.params[1] if item.command == Cmd.NAV_WAYPOINT and item.params[1] > 0 else None
            if target.distance_m(state.position_m) > (radius_m or parameters["acceptance_m"]):
                return MissionStep("fly", target)
            self.reached.append(self.first + self._index)
        stay_s = math.inf if item.command == Cmd.NAV_LOITER_UNLIM else item.params[0]
        return self._wait(target, stay_s, state)

    def _wait(self, target: Target, stay_s: float, state: VehicleState) -> MissionStep | None:
        """Stay for some time; 0 and NaN mean no delay."""
        if self._reached_ns is None:
            self._reached_ns = state.t_ns
        if (state.t_ns - self._reached_ns) * 1e-9 < stay_s:
            return MissionStep("fly", target)
        self._enter(self._index + 1)
        return None

    def _enter(self, index: int) -> None:
        self._index, self._reached_ns, self.has_climbed = index, None, False


@dataclass(slots=True)
class _Upload:
    sender: Address
    type: int
    count: int
    items: list[PlanItem] = field(default_factory=list)
    requested_ns: int = 0
    tries: int = 0


class MissionProtocol:
    """The item transfers of one vehicle.

    Args:
        on_loaded: called with the type and the items of a complete upload, or with no items after a removal.
        home_item: returns item 0 of ArduPilot's missions; None for PX4, whose item 0 is the first waypoint, and which
            first requests an item as MISSION_ITEM_INT.
    """

    def __init__(
        self,
        send: Callable[[dialect.WireMessage], None],
        on_loaded: Callable[[int, list[PlanItem]], None],
        home_item: Callable[[], PlanItem] | None,
    ) -> None:
        self._send = send
        self._on_loaded = on_loaded
        self._home_item = home_item
        self._items: dict[int, list[PlanItem]] = {}
        self._upload: _Upload | None = None

    def on_message(self, message: dialect.WireMessage, sender: Address, wall_ns: int) -> bool:
        """Process a message of the protocol; return False for any other. `wall_ns` has an arbitrary epoch."""
        match message:
            case dialect.MissionCount():
                upload = _Upload(sender, message.mission_type, message.count)
                if message.count > ITEMS_MAX:
                    self._end(upload, MissionResult.NO_SPACE)
                elif message.mission_type not in (MISSION, FENCE):
                    self._end(upload, MissionResult.UNSUPPORTED)
                elif message.count == 0:
                    self._finish(upload)
                else:
                    self._upload = upload
                    self._request(upload, wall_ns)
            case dialect.MissionItemInt() | dialect.MissionItem():
                upload = self._upload
                if upload is not None and upload.sender == sender and message.seq == len(upload.items):
                    self._accept_item(upload, message, wall_ns)  # other items are repetitions, or were not requested
            case dialect.MissionRequestList(mission_type=type_):
                self._send(dialect.MissionCount(*sender, count=len(self._stored(type_)), mission_type=type_))
            case dialect.MissionRequestInt() | dialect.MissionRequest():
                items = self._stored(message.mission_type)
                if message.seq >= len(items):
                    self._acknowledge(sender, message.mission_type, MissionResult.INVALID_SEQUENCE)
                    return True
                item, kind = items[message.seq], dialect.MissionItem
                x, y = item.x, item.y
                if isinstance(message, dialect.MissionRequestInt):
                    unit = dialect.LOCAL_M if item.frame in LOCAL else dialect.DEGREES
                    kind, x, y = dialect.MissionItemInt, dialect.to_int(item.x, unit), dialect.to_int(item.y, unit)
                leading_fields = *sender, message.seq, item.frame, item.command, 0, int(item.autocontinue)
                self._send(kind(*leading_fields, *item.params, x, y, item.z, message.mission_type))
            case dialect.MissionClearAll(mission_type=type_):
                for each in (MISSION, FENCE) if type_ == dialect.ALL_MISSION_TYPES else (type_,):
                    self._items[each] = []
                    self._on_loaded(each, [])
                self._acknowledge(sender, type_, MissionResult.ACCEPTED)
            case dialect.MissionAck():
                pass
            case _:
                return False
        return True

    def tick(self, wall_ns: int) -> None:
        """Request a missing item again, or cancel the upload after TRIES_MAX repetitions."""
        upload = self._upload
        if upload is None or wall_ns - upload.requested_ns < RETRY_NS:
            return
        upload.tries += 1
        if upload.tries > TRIES_MAX:
            self._end(upload, MissionResult.OPERATION_CANCELLED)
        else:
            self._request(upload, wall_ns)

    def _request(self, upload: _Upload, wall_ns: int) -> None:
        upload.requested_ns = wall_ns
        as_int = (self._home_item is None) != bool(upload.tries % 2)  # some clients support only one of the two
        kind = dialect.MissionRequestInt if as_int else dialect.MissionRequest
        self._send(kind(*upload.sender, seq=len(upload.items), mission_type=upload.type))

    def _accept_item(
        self, upload: _Upload, message: dialect.MissionItemInt | dialect.MissionItem, wall_ns: int
    ) -> None:
        item = item_of(message)
        is_home = upload.type == MISSION and self._home_item is not None and message.seq == 0
        fault = None if is_home else item_fault(item, upload.type)
        if fault is not None:
            self._end(upload, fault)
            return
        upload.items.append(item)
        upload.tries = 0
        if len(upload.items) == upload.count:
            self._finish(upload)
        else:
            self._request(upload, wall_ns)

    def _finish(self, upload: _Upload) -> None:
        items = upload.items[1:] if self._home_item and upload.type == MISSION else upload.items
        self._items[upload.type] = items
        self._on_loaded(upload.type, items)
        self._end(upload, MissionResult.ACCEPTED)

    def _end(self, upload: _Upload, result: MissionResult) -> None:
        self._upload = None
        self._acknowledge(upload.sender, upload.type, result)

    def _acknowledge(self, sender: Address, type_: int, result: MissionResult) -> None:
        self._send(dialect.MissionAck(*sender, type=result, mission_type=type_))

    def _stored(self, type_: int) -> list[PlanItem]:
        """Return all items of a type, including ArduPilot's item 0."""
        items = self._items.get(type_, [])
        return [self._home_item(), *items] if self._home_item and type_ == MISSION else items


def item_of(message: dialect.MissionItemInt | dialect.MissionItem) -> PlanItem:
    x, y = message.x, message.y
    if isinstance(message, dialect.MissionItemInt):
        unit = dialect.LOCAL_M if message.frame in LOCAL else dialect.DEGREES
        x, y = dialect.from_int(message.x, unit), dialect.from_int(message.y, unit)
    params = message.param1, message.param2, message.param3, message.param4
    return PlanItem(message.frame, message.command, params, x, y, message.z, bool(message.autocontinue))


def item_fault(item: PlanItem, type_: int) -> MissionResult | None:
    """Return what is wrong with an item; None if it is valid."""
    if item.command not in (COMMANDS if type_ == MISSION else FENCE_COMMANDS):
        return MissionResult.UNSUPPORTED
    if item.frame not in FRAMES:
        return MissionResult.UNSUPPORTED_FRAME
    has_full_position = item.has_position and math.isfinite(item.x) and math.isfinite(item.y)
    z = 0.0 if math.isnan(item.z) and item.command == Cmd.NAV_LAND else item.z
    x, y = (0.0 if math.isnan(value) else value for value in (item.x, item.y))  # NaN: not given
    if item.frame in LOCAL:
        is_valid = is_valid_position((x, y, z))
    else:
        is_valid = is_valid_position((None, None, z)) and abs(x) <= 90.0 and abs(y) <= 180.0
    return None if is_valid and (type_ != FENCE or has_full_position) else MissionResult.INVALID
