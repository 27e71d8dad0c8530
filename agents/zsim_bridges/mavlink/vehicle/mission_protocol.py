"""Upload and download of missions, fences and rally points, item by item.

Source: https://mavlink.io/en/services/mission.html.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

from zsim_bridges.mavlink.autopilot.enums import (
    ALL_MISSION_TYPES,
    FENCE,
    MISSION,
    Cmd,
    MavFrame,
    MissionResult,
)
from zsim_bridges.mavlink.flight.mission import COMMANDS, DEGREES, FRAMES, LOCAL, LOCAL_M, PlanItem, from_int, to_int
from zsim_bridges.mavlink.flight.position_guidance import is_place
from zsim_bridges.mavlink.wire import dialect
from zsim_bridges.mavlink.wire.wire_message import WireMessage

ITEMS_MAX = 1000  # chosen: of one mission; autopilots keep some hundreds
RETRY_NS = 500_000_000  # ns of wall time until an item is requested again
TRIES_MAX = 10
PLACED = (
    Cmd.FENCE_RETURN_POINT,
    Cmd.FENCE_POLYGON_INCLUSION,
    Cmd.FENCE_POLYGON_EXCLUSION,
    Cmd.FENCE_CIRCLE_INCLUSION,
    Cmd.FENCE_CIRCLE_EXCLUSION,
)
Loaded = Callable[[int, list[PlanItem]], None]


class MissionProtocol:
    """The transfers of one vehicle.

    Args:
        send: sends a message.
        loaded: called with the type and the items of an upload that is complete, or of a removal.
        home: returns item 0 of ArduPilot's missions; None where item 0 is the first waypoint.
        asks_int: whether items are asked for as MISSION_ITEM_INT at first.
    """

    def __init__(
        self,
        send: Callable[[WireMessage], None],
        loaded: Loaded,
        home: Callable[[], PlanItem] | None,
        asks_int: bool,
    ) -> None:
        self._send = send
        self._loaded = loaded
        self._home = home
        self._asks_int = asks_int
        self._items: dict[int, list[PlanItem]] = {}
        self._upload: _Upload | None = None

    def stored(self, type_: int) -> list[PlanItem]:
        """Return all items of a type, ArduPilot's item 0 included."""
        items = self._items.get(type_, [])
        return [self._home(), *items] if self._home and type_ == MISSION else items

    def on_message(self, message: WireMessage, sender: tuple[int, int], wall_ns: int) -> bool:
        """Take a message of the protocol; False for any other.

        Args:
            sender: system and component id.
            wall_ns: wall time, of any zero.
        """
        match message:
            case dialect.MissionCount():
                self._begin(message, sender, wall_ns)
            case dialect.MissionItemInt() | dialect.MissionItem():
                self._take(message, sender, wall_ns)
            case dialect.MissionRequestList():
                count = len(self.stored(message.mission_type))
                self._send(dialect.MissionCount(*sender, count=count, mission_type=message.mission_type))
            case dialect.MissionRequestInt() | dialect.MissionRequest():
                self._answer(message, sender)
            case dialect.MissionClearAll():
                self._clear(message.mission_type, sender)
            case dialect.MissionAck():
                pass
            case _:
                return False
        return True

    def tick(self, wall_ns: int) -> None:
        """Ask again for an item that has not come."""
        upload = self._upload
        if upload is None or wall_ns - upload.asked_ns < RETRY_NS:
            return
        upload.tries += 1
        if upload.tries > TRIES_MAX:
            self._end(upload, MissionResult.OPERATION_CANCELLED)
        else:
            self._request(upload, wall_ns)

    def _begin(self, count: dialect.MissionCount, sender: tuple[int, int], wall_ns: int) -> None:
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
        as_int = self._asks_int != bool(upload.tries % 2)  # some clients know one of the two only
        kind = dialect.MissionRequestInt if as_int else dialect.MissionRequest
        self._send(kind(*upload.sender, seq=len(upload.items), mission_type=upload.type))

    def _take(self, message: dialect.MissionItemInt | dialect.MissionItem, sender: tuple[int, int], now: int) -> None:
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
            self._request(upload, now)

    def _finish(self, upload: "_Upload") -> None:
        items = upload.items[1:] if self._home and upload.type == MISSION else upload.items
        self._items[upload.type] = items
        self._loaded(upload.type, items)
        self._end(upload, MissionResult.ACCEPTED)

    def _end(self, upload: "_Upload", result: MissionResult) -> None:
        self._upload = None
        self._send(dialect.MissionAck(*upload.sender, type=result, mission_type=upload.type))

    def _answer(self, request: dialect.MissionRequestInt | dialect.MissionRequest, sender: tuple[int, int]) -> None:
        items = self.stored(request.mission_type)
        if request.seq >= len(items):
            result = MissionResult.INVALID_SEQUENCE
            self._send(dialect.MissionAck(*sender, type=result, mission_type=request.mission_type))
            return
        as_int = isinstance(request, dialect.MissionRequestInt)
        self._send(message_of(items[request.seq], request, sender, as_int))

    def _clear(self, type_: int, sender: tuple[int, int]) -> None:
        for each in (MISSION, FENCE) if type_ == ALL_MISSION_TYPES else (type_,):
            self._items[each] = []
            self._loaded(each, [])
        self._send(dialect.MissionAck(*sender, type=MissionResult.ACCEPTED, mission_type=type_))


class _Upload:
    """An upload under way."""

    def __init__(self, sender: tuple[int, int], type_: int, count: int) -> None:
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
    """Return what is wrong with an item, None if nothing is."""
    known: Sequence[Any] = COMMANDS if type_ == MISSION else PLACED
    if item.command not in known:
        return MissionResult.UNSUPPORTED
    if item.frame not in FRAMES:
        return MissionResult.UNSUPPORTED_FRAME
    is_whole = item.has_place and math.isfinite(item.x) and math.isfinite(item.y)
    return None if _has_good_place(item) and (type_ != FENCE or is_whole) else MissionResult.INVALID


def _has_good_place(item: PlanItem) -> bool:
    """Return whether the place of an item is left out, or is one."""
    z = 0.0 if math.isnan(item.z) and item.command == Cmd.NAV_LAND else item.z
    x, y = (0.0 if math.isnan(value) else value for value in (item.x, item.y))
    if item.frame in LOCAL:
        return is_place((x, y, z))
    return is_place((None, None, z)) and abs(x) <= 90.0 and abs(y) <= 180.0


def message_of(item: PlanItem, request: Any, sender: tuple[int, int], as_int: bool) -> WireMessage:
    """Return the message of an item, as MISSION_ITEM_INT or MISSION_ITEM."""
    fields: dict[str, Any] = {
        **dict(zip(("target_system", "target_component"), sender, strict=True)),
        **{f"param{i + 1}": value for i, value in enumerate(item.params)},
        "seq": request.seq,
        "frame": item.frame,
        "command": item.command,
        "autocontinue": int(item.autocontinue),
        "z": item.z,
        "mission_type": request.mission_type,
    }
    if not as_int:
        return dialect.MissionItem(**fields, x=item.x, y=item.y)
    unit = LOCAL_M if item.frame in LOCAL else DEGREES
    return dialect.MissionItemInt(**fields, x=to_int(item.x, unit), y=to_int(item.y, unit))


def home_item(latitude_deg: float, longitude_deg: float, height_m: float) -> PlanItem:
    """Return item 0 of ArduPilot's missions."""
    return PlanItem(MavFrame.GLOBAL, Cmd.NAV_WAYPOINT, (0.0, 0.0, 0.0, 0.0), latitude_deg, longitude_deg, height_m)
