"""The parameters of a vehicle: what ground stations list, read and set, in the personality's names."""

import math
import struct
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from zsim_bridges.mavlink.autopilot.enums import ParamType
from zsim_bridges.mavlink.wire import dialect

ID_MAX = 16  # characters of a name
_INTEGERS = {
    ParamType.UINT8: "<B3x",
    ParamType.INT8: "<b3x",
    ParamType.UINT16: "<H2x",
    ParamType.INT16: "<h2x",
    ParamType.UINT32: "<I",
    ParamType.INT32: "<i",
}


class ParameterSpec(NamedTuple):
    """A parameter: name, type, value at the start, and the range that is kept; fixed: it cannot be set."""

    name: str
    type: ParamType
    value: float
    low: float
    high: float
    fixed: bool = False


class Parameters:
    """The parameters of one vehicle.

    Args:
        specs: what there is.
        bytewise: whether integers travel as their bytes in the field of a float (PX4), or as numbers (ArduPilot).
    """

    def __init__(self, specs: Iterable[ParameterSpec], bytewise: bool) -> None:
        self._specs = {spec.name: spec for spec in sorted(specs)}
        self._names = list(self._specs)
        self._values = {name: spec.value for name, spec in self._specs.items()}
        self._bytewise = bytewise

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def value_of(self, name: str, otherwise: float) -> float:
        """Return a parameter that not every personality has."""
        return self._values.get(name, otherwise)

    def put(self, name: str, value: float) -> str | None:
        """Set a parameter, within its range; return why not."""
        spec = self._specs.get(name)
        if spec is None:
            return f"{name[:ID_MAX]}: no such parameter"
        if spec.fixed:
            return f"{name} is {self._values[name]:g} and cannot be set"
        if not math.isfinite(value):
            return f"{name}: {value} is no finite number"
        value = min(spec.high, max(spec.low, value))
        self._values[name] = value if spec.type == ParamType.REAL32 else float(round(value))
        return None

    def messages(self) -> Iterator[dialect.ParamValue]:
        """Yield all of them."""
        return map(self.message, self._names)

    def find(self, name: str, index: int) -> str | None:
        """Return the name of a parameter that is asked for by index, or by name where that is -1; None: no such."""
        if index >= 0:
            return self._names[index] if index < len(self._names) else None
        return name if name in self._specs else None

    def message(self, name: str) -> dialect.ParamValue:
        """Return the value of one."""
        spec = self._specs[name]
        return dialect.ParamValue(
            param_id=name,
            param_value=self._encoded(spec.type, self._values[name]),
            param_type=spec.type,
            param_count=len(self._names),
            param_index=self._names.index(name),
        )

    def decoded(self, message: dialect.ParamSet) -> float:
        """Return the value that a message sets; by the type that the parameter has, or the message gives."""
        spec = self._specs.get(message.param_id)
        type_ = spec.type if spec else message.param_type
        if not self._bytewise or type_ not in _INTEGERS:
            return message.param_value
        (value,) = struct.unpack(_INTEGERS[ParamType(type_)], struct.pack("<f", message.param_value))
        return float(value)

    def _encoded(self, type_: ParamType, value: float) -> float:
        if not self._bytewise or type_ not in _INTEGERS:
            return value
        (number,) = struct.unpack("<f", struct.pack(_INTEGERS[type_], int(value)))
        return number
