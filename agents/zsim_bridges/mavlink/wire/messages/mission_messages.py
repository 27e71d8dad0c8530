"""Messages of the mission protocol: missions, geofences and rally points, item by item.

Definitions: https://mavlink.io/en/messages/common.html and ardupilotmega.html; units as written there.
"""

from zsim_bridges.mavlink.wire.wire_message import Float, Int16, Int32, UInt8, UInt16, WireMessage, message


@message(39, extensions=1)
class MissionItem(WireMessage):
    """An item with its place in degrees, of the old protocol."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    seq: UInt16 = 0
    frame: UInt8 = 0
    command: UInt16 = 0
    current: UInt8 = 0
    autocontinue: UInt8 = 0
    param1: Float = 0.0
    param2: Float = 0.0
    param3: Float = 0.0
    param4: Float = 0.0
    x: Float = 0.0
    y: Float = 0.0
    z: Float = 0.0
    mission_type: UInt8 = 0


@message(73, extensions=1)
class MissionItemInt(WireMessage):
    """An item with its place in 1e-7 degrees, or 1e-4 m in local frames."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    seq: UInt16 = 0
    frame: UInt8 = 0
    command: UInt16 = 0
    current: UInt8 = 0
    autocontinue: UInt8 = 0
    param1: Float = 0.0
    param2: Float = 0.0
    param3: Float = 0.0
    param4: Float = 0.0
    x: Int32 = 0
    y: Int32 = 0
    z: Float = 0.0
    mission_type: UInt8 = 0


@message(40, extensions=1)
class MissionRequest(WireMessage):
    """Ask for an item, of the old protocol."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    seq: UInt16 = 0
    mission_type: UInt8 = 0


@message(51, extensions=1)
class MissionRequestInt(WireMessage):
    """Ask for an item."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    seq: UInt16 = 0
    mission_type: UInt8 = 0


@message(43, extensions=1)
class MissionRequestList(WireMessage):
    """Ask for the number of items."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    mission_type: UInt8 = 0


@message(37, extensions=1)
class MissionRequestPartialList(WireMessage):
    """Ask for some items."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    start_index: Int16 = 0
    end_index: Int16 = 0
    mission_type: UInt8 = 0


@message(38, extensions=1)
class MissionWritePartialList(WireMessage):
    """Replace some items."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    start_index: Int16 = 0
    end_index: Int16 = 0
    mission_type: UInt8 = 0


@message(44, extensions=1)
class MissionCount(WireMessage):
    """The number of items that are there, or are to come."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    count: UInt16 = 0
    mission_type: UInt8 = 0


@message(41)
class MissionSetCurrent(WireMessage):
    """Go on with an item."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    seq: UInt16 = 0


@message(42, extensions=3)
class MissionCurrent(WireMessage):
    """The item that is flown to."""

    seq: UInt16 = 0
    total: UInt16 = 0
    mission_state: UInt8 = 0
    mission_mode: UInt8 = 0


@message(45, extensions=1)
class MissionClearAll(WireMessage):
    """Remove all items."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    mission_type: UInt8 = 0


@message(46)
class MissionItemReached(WireMessage):
    """An item has been reached."""

    seq: UInt16 = 0


@message(47, extensions=1)
class MissionAck(WireMessage):
    """How an upload, a download or a removal ended."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    type: UInt8 = 0
    mission_type: UInt8 = 0
