"""Messages that ask for something, and the answers.

Definitions: https://mavlink.io/en/messages/common.html and ardupilotmega.html; units as written there.
"""

from typing import Annotated

from zsim_bridges.mavlink.wire.wire_message import Float, Int16, Int32, UInt8, UInt16, UInt32, WireMessage, message


@message(75)
class CommandInt(WireMessage):
    """A command with a place in 1e-7 degrees, or 1e-4 m in local frames."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
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


@message(76)
class CommandLong(WireMessage):
    """A command with seven numbers."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    command: UInt16 = 0
    confirmation: UInt8 = 0
    param1: Float = 0.0
    param2: Float = 0.0
    param3: Float = 0.0
    param4: Float = 0.0
    param5: Float = 0.0
    param6: Float = 0.0
    param7: Float = 0.0


@message(77, extensions=4)
class CommandAck(WireMessage):
    """How a command was taken."""

    command: UInt16 = 0
    result: UInt8 = 0
    progress: UInt8 = 0
    result_param2: Int32 = 0
    target_system: UInt8 = 0
    target_component: UInt8 = 0


@message(11)
class SetMode(WireMessage):
    """Change the mode, of the old protocol."""

    target_system: UInt8 = 0
    base_mode: UInt8 = 0
    custom_mode: UInt32 = 0


@message(66)
class RequestDataStream(WireMessage):
    """Ask for a group of messages at a rate, of the old protocol."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    req_stream_id: UInt8 = 0
    req_message_rate: UInt16 = 0  # [Hz]
    start_stop: UInt8 = 0


@message(67)
class DataStream(WireMessage):
    """The rate of a group of messages."""

    stream_id: UInt8 = 0
    message_rate: UInt16 = 0  # [Hz]
    on_off: UInt8 = 0


@message(244)
class MessageInterval(WireMessage):
    """The interval of a message."""

    message_id: UInt16 = 0
    interval_us: Int32 = 0  # [us]


@message(20)
class ParamRequestRead(WireMessage):
    """Ask for a parameter by name, or by index where that is not -1."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    param_id: Annotated[str, "char[16]"] = ""
    param_index: Int16 = 0


@message(21)
class ParamRequestList(WireMessage):
    """Ask for all parameters."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0


@message(22)
class ParamValue(WireMessage):
    """The value of a parameter."""

    param_id: Annotated[str, "char[16]"] = ""
    param_value: Float = 0.0
    param_type: UInt8 = 0
    param_count: UInt16 = 0
    param_index: UInt16 = 0


@message(23)
class ParamSet(WireMessage):
    """Set a parameter; the answer is its PARAM_VALUE."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    param_id: Annotated[str, "char[16]"] = ""
    param_value: Float = 0.0
    param_type: UInt8 = 0


@message(345)
class ParamError(WireMessage):
    """Why a parameter was not read or set."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    param_id: Annotated[str, "char[16]"] = ""
    param_index: Int16 = 0
    error: UInt8 = 0


@message(5)
class ChangeOperatorControl(WireMessage):
    """Ask for control of a system."""

    target_system: UInt8 = 0
    control_request: UInt8 = 0
    version: UInt8 = 0
    passkey: Annotated[str, "char[25]"] = ""


@message(117)
class LogRequestList(WireMessage):
    """Ask for the logs that there are."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    start: UInt16 = 0
    end: UInt16 = 0


@message(118)
class LogEntry(WireMessage):
    """A log that there is."""

    id: UInt16 = 0
    num_logs: UInt16 = 0
    last_log_num: UInt16 = 0
    time_utc: UInt32 = 0  # [s]
    size: UInt32 = 0  # [bytes]


@message(183)
class AutopilotVersionRequest(WireMessage):
    """Ask for the version of an ArduPilot, of the old protocol."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0


@message(80)
class CommandCancel(WireMessage):
    """Cancel a command that is under way."""

    target_system: UInt8 = 0
    target_component: UInt8 = 0
    command: UInt16 = 0
