"""Messages about a system and its link: life, time, versions, texts, files, signing.

Definitions: https://mavlink.io/en/messages/common.html and ardupilotmega.html; units as written there.
"""

from typing import Annotated

from zsim_bridges.mavlink.wire.wire_message import (
    Int8,
    Int16,
    Int32,
    Int64,
    UInt8,
    UInt16,
    UInt32,
    UInt64,
    WireMessage,
    message,
)


@message(0)
class Heartbeat(WireMessage):
    """A component is alive: what it is, its mode and state."""

    type: UInt8 = 0
    autopilot: UInt8 = 0
    base_mode: UInt8 = 0
    custom_mode: UInt32 = 0
    system_status: UInt8 = 0
    mavlink_version: UInt8 = 0


@message(1, extensions=3)
class SysStatus(WireMessage):
    """Which sensors a system has and how they are, load, battery, losses of the link."""

    onboard_control_sensors_present: UInt32 = 0
    onboard_control_sensors_enabled: UInt32 = 0
    onboard_control_sensors_health: UInt32 = 0
    load: UInt16 = 0  # [d%]
    voltage_battery: UInt16 = 0  # [mV]
    current_battery: Int16 = 0  # [cA]
    battery_remaining: Int8 = 0  # [%]
    drop_rate_comm: UInt16 = 0  # [c%]
    errors_comm: UInt16 = 0
    errors_count1: UInt16 = 0
    errors_count2: UInt16 = 0
    errors_count3: UInt16 = 0
    errors_count4: UInt16 = 0
    onboard_control_sensors_present_extended: UInt32 = 0
    onboard_control_sensors_enabled_extended: UInt32 = 0
    onboard_control_sensors_health_extended: UInt32 = 0


@message(2)
class SystemTime(WireMessage):
    """Time of the system: since 1970, and since its start."""

    time_unix_usec: UInt64 = 0  # [us]
    time_boot_ms: UInt32 = 0  # [ms]


@message(4)
class Ping(WireMessage):
    """A question for the round-trip time, with target 0, or the answer to one."""

    time_usec: UInt64 = 0  # [us]
    seq: UInt32 = 0
    target_system: UInt8 = 0
    target_component: UInt8 = 0


@message(111)
class Timesync(WireMessage):
    """A question for the time of the other side, with tc1 0, or the answer to one."""

    tc1: Int64 = 0  # [ns]
    ts1: Int64 = 0  # [ns]


@message(148, extensions=1)
class AutopilotVersion(WireMessage):
    """Capabilities and versions of an autopilot."""

    capabilities: UInt64 = 0
    flight_sw_version: UInt32 = 0
    middleware_sw_version: UInt32 = 0
    os_sw_version: UInt32 = 0
    board_version: UInt32 = 0
    flight_custom_version: Annotated[bytes, "uint8_t[8]"] = b""
    middleware_custom_version: Annotated[bytes, "uint8_t[8]"] = b""
    os_custom_version: Annotated[bytes, "uint8_t[8]"] = b""
    vendor_id: UInt16 = 0
    product_id: UInt16 = 0
    uid: UInt64 = 0
    uid2: Annotated[bytes, "uint8_t[18]"] = b""


@message(253, extensions=2)
class Statustext(WireMessage):
    """A text for the operator, with a severity."""

    severity: UInt8 = 0
    text: Annotated[str, "char[50]"] = ""
    id: UInt16 = 0
    chunk_seq: UInt8 = 0


@message(245)
class ExtendedSysState(WireMessage):
    """Whether an aircraft is landed or in the air."""

    vtol_state: UInt8 = 0
    landed_state: UInt8 = 0


@message(147, extensions=5)
class BatteryStatus(WireMessage):
    """State of a battery."""

    id: UInt8 = 0
    battery_function: UInt8 = 0
    type: UInt8 = 0
    temperature: Int16 = 0  # [cdegC]
    voltages: Annotated[tuple[int, ...], "uint16_t[10]"] = (0,) * 10  # [mV]
    current_battery: Int16 = 0  # [cA]
    current_consumed: Int32 = 0  # [mAh]
    energy_consumed: Int32 = 0  # [hJ]
    battery_remaining: Int8 = 0  # [%]
    time_remaining: Int32 = 0  # [s]
    charge_state: UInt8 = 0
    voltages_ext: Annotated[tuple[int, ...], "uint16_t[4]"] = (0,) * 4  # [mV]
    mode: UInt8 = 0
    fault_bitmask: UInt32 = 0


@message(125)
class PowerStatus(WireMessage):
    """Voltages of the supplies."""

    Vcc: UInt16 = 0  # [mV]
    Vservo: UInt16 = 0  # [mV]
    flags: UInt16 = 0


@message(152, extensions=1)
class Meminfo(WireMessage):
    """Free memory of an ArduPilot."""

    brkval: UInt16 = 0
    freemem: UInt16 = 0  # [bytes]
    freemem32: UInt32 = 0  # [bytes]


@message(110)
class FileTransferProtocol(WireMessage):
    """A part of a session of MAVLink FTP."""

    target_network: UInt8 = 0
    target_system: UInt8 = 0
    target_component: UInt8 = 0
    payload: Annotated[bytes, "uint8_t[251]"] = b""


@message(256)
class SetupSigning(WireMessage):
    """A new key for signing; to be sent on a safe link alone."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    secret_key: Annotated[bytes, "uint8_t[32]"] = b""
    initial_timestamp: UInt64 = 0


@message(109)
class RadioStatus(WireMessage):
    """State of a telemetry radio."""

    rssi: UInt8 = 0
    remrssi: UInt8 = 0
    txbuf: UInt8 = 0  # [%]
    noise: UInt8 = 0
    remnoise: UInt8 = 0
    rxerrors: UInt16 = 0
    fixed: UInt16 = 0
