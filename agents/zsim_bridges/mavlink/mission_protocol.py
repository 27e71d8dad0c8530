"""Upload and download of missions, fences and rally points, item by item.

Source: https://mavlink.io/en/services/mission.html.
"""

import math
from collections.abc import Callable
from typing import Any

from zsim_bridges.mavlink import dialect
from zsim_bridges.mavlink.conversions import DEGREES, LOCAL_M, from_int, to_int
from zsim_bridges.mavlink.dialect import WireMessage
from zsim_bridges.mavlink.enums import ALL_MISSION_TYPES, FENCE, MISSION, Cmd, MavFrame, MissionResult
from zsim_bridges.mavlink.flight_control import is_place
from zsim_bridges.mavlink.mission import COMMANDS, FRAMES, LOCAL, PlanItem

ITEMS_MAX = 1000  # chosen: of one mission; autopilots keep some hundreds
RETRY_NS = 500_000_000  # ns of wall time until an item is requested again
TRIES_MAX = 10
FENCE_COMMANDS = (
    Cmd.FENCE_RETURN_POINT,
    Cmd.FENCE_POLYGON_INCLUSION,
    Cmd.FENCE_POLYGON_EXCLUSION,
    Cmd.FENCE_CIRCLE_INCLUSION,
    Cmd.FENCE_CIRCLE_EXCLUSION,
)
Address = tuple[int, int]
"""System and component id."""


class MissionProtocol:
    """The transfers of one vehicle.

    Args:
        send: sends a message.
        loaded: called with the type and the items of a complete upload, or of a removal.
        home: returns item 0 of ArduPilot's missions; None for PX4, whose item 0 is the first waypoint, and which asks
            for items as MISSION_ITEM_INT first.
    """

    def __init__(
        self,
        send: Callable[[WireMessage], None],
        loaded: Callable[[int, list[PlanItem]], None],
        home: Callable[[], PlanItem] | None,
    ) -> None:
        self._send = send
        self._loaded = loaded
        self._home = home
        self._items: dict[int, list[PlanItem]] = {}
        self._upload: _Upload | None = None

    def on_message(self, message: WireMessage, sender: Address, wall_ns: int) -> bool:
        """Take a message of the protocol; False for any other.

        Args:
            wall_ns: wall time, of any zero.
        """
        match message:
            case dialect.MissionCount():
                self._begin(message, sender, wall_ns)
            case dialect.MissionItemInt() | dialect.MissionItem():
                self._take(message, sender, wall_ns)
            case dialect.MissionRequestList(mission_type=type_):
                self._send(dialect.MissionCount(*sender, count=len(self._stored(type_)), mission_type=type_))
            case dialect.MissionRequestInt() | dialect.MissionRequest():
                self._answer(message, sender)
            case dialect.MissionClearAll(mission_type=type_):
                for each in (MISSION, FENCE) if type_ == ALL_MISSION_TYPES else (type_,):
                    self._items[each] = []
                    self._loaded(each, [])
                self._acknowledge(sender, type_, MissionResult.ACCEPTED)
            case dialect.MissionAck():
                pass
            case _:
                return False
        return True

    def tick(self, wall_ns: int) -> None:
        """Request an item again that has not come."""
        upload = self._upload
        if upload is None or wall_ns - upload.asked_ns < RETRY_NS:
            return
        upload.tries += 1
        if upload.tries > TRIES_MAX:
            self._end(upload, MissionResult.OPERATION_CANCELLED)
        else:
            self._request(upload, wall_ns)

    # Uploads

    def _begin(self, count: dialect.MissionCount, sender: Address, wall_ns: int) -> None:
        upload = _Upload(sender, count.mission_type, count.count)
        if count.count > ITEMS_MAX:
            self._end(upload, MissionResult.NO_SPACE)
        elif count.mission_type not in (MISSION, FENCE):
            self._end(upload, MissionResult.UNSUPPORTED)
        elif count.count == 0:
            self._finish(upload)
        else:
            self._upload = upload
            self._request(upload, wall_ns)

    def _request(self, upload: "_Upload", wall_ns: int) -> None:
        upload.asked_ns = wall_ns
        as_int = (self._home is None) != bool(upload.tries % 2)  # some clients know one of the two only
        kind = dialect.MissionRequestInt if as_int else dialect.MissionRequest
        self._send(kind(*upload.sender, seq=len(upload.items), mission_type=upload.type))

    def _take(self, message: dialect.MissionItemInt | dialect.MissionItem, sender: Address, wall_ns: int) -> None:
        upload = self._upload
        if upload is None or upload.sender != sender or message.seq != len(upload.items):
            return  # repeated, or not asked for
        item = item_of(message)
        is_home = upload.type == MISSION and self._home is not None and message.seq == 0
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

    def _finish(self, upload: "_Upload") -> None:
        items = upload.items[1:] if self._home and upload.type == MISSION else upload.items
        self._items[upload.type] = items
        self._loaded(upload.type, items)
        self._end(upload, MissionResult.ACCEPTED)

    def _end(self, upload: "_Upload", result: MissionResult) -> None:
        self._upload = None
        self._acknowledge(upload.sender, upload.type, result)

    def _acknowledge(self, sender: Address, type_: int, result: MissionResult) -> None:
        self._send(dialect.MissionAck(*sender, type=result, mission_type=type_))

    # Downloads

    def _stored(self, type_: int) -> list[PlanItem]:
        """Return all items of a type, including ArduPilot's item 0."""
        items = self._items.get(type_, [])
        return [self._home(), *items] if self._home and type_ == MISSION else items

    def _answer(self, request: dialect.MissionRequestInt | dialect.MissionRequest, sender: Address) -> None:
        items = self._stored(request.mission_type)
        if request.seq >= len(items):
            self._acknowledge(sender, request.mission_type, MissionResult.INVALID_SEQUENCE)
            return
        item, kind, x, y = items[request.seq], dialect.MissionItem, items[request.seq].x, items[request.seq].y
        if isinstance(request, dialect.MissionRequestInt):
            unit = LOCAL_M if item.frame in LOCAL else DEGREES
            kind, x, y = dialect.MissionItemInt, to_int(item.x, unit), to_int(item.y, unit)
        begin = *sender, request.seq, item.frame, item.command, 0, int(item.autocontinue)
        self._send(kind(*begin, *item.params, x, y, item.z, request.mission_type))


class _Upload:
    """An upload under way."""

    def __init__(self, sender: Address, type_: int, count: int) -> None:
        self.sender = sender
        self.type = type_
        self.count = count
        self.items: list[PlanItem] = []
        self.asked_ns = 0
        self.tries = 0


def item_of(message: dialect.MissionItemInt | dialect.MissionItem) -> PlanItem:
    """Return the item in a message."""
    x, y = message.x, message.y
    if isinstance(message, dialect.MissionItemInt):
        unit = LOCAL_M if message.frame in LOCAL else DEGREES
        x, y = from_int(message.x, unit), from_int(message.y, unit)
    params = message.param1, message.param2, message.param3, message.param4
    return PlanItem(message.frame, message.command, params, x, y, message.z, bool(message.autocontinue))


def item_fault(item: PlanItem, type_: int) -> MissionResult | None:
    """Return what is wrong with an item; None if nothing is."""
    known: tuple[Any, ...] = COMMANDS if type_ == MISSION else FENCE_COMMANDS
    if item.command not in known:
        return MissionResult.UNSUPPORTED
    if item.frame not in FRAMES:
        return MissionResult.UNSUPPORTED_FRAME
    is_whole = item.has_place and math.isfinite(item.x) and math.isfinite(item.y)
    z = 0.0 if math.isnan(item.z) and item.command == Cmd.NAV_LAND else item.z
    x, y = (0.0 if math.isnan(value) else value for value in (item.x, item.y))  # left out
    if item.frame in LOCAL:
        is_good = is_place((x, y, z))
    else:
        is_good = is_place((None, None, z)) and abs(x) <= 90.0 and abs(y) <= 180.0
    return None if is_good and (type_ != FENCE or is_whole) else MissionResult.INVALID


def home_item(latitude_deg: float, longitude_deg: float, height_m: float) -> PlanItem:
    """Return item 0 of ArduPilot's missions."""
    return PlanItem(MavFrame.GLOBAL, Cmd.NAV_WAYPOINT, (0.0, 0.0, 0.0, 0.0), latitude_deg, longitude_deg, height_m)
