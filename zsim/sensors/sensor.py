"""Definition of a sensor: message, settings, channels with error models, and, for a user's sensor, its equation.

    SENSOR = SensorType(message=Airspeed, settings=AirspeedConfig, channels=(...), equation=dynamic_pressure)

The sensor's scenario section, validation, defaults, latency, noise, faults, key, schema, recording and message counts
follow from it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.linear import product
from zsim.schema.message import FieldName, FieldType, Message, MessageName, Whole, declared_type, field_types
from zsim.schema.quantities import Fraction, NonNegative, Vector3

VALUES_MAX = 6  # maximum count of numbers in a reading
RateHz = Annotated[float, Meta(ge=0.01, le=1000)]
LatencyMs = Annotated[float, Meta(ge=0, le=10_000)]
CorrelationS = Annotated[float, Meta(ge=0, le=1e6)]
UNSENSED = ("text", "number[]")  # field types not allowed in a sensor's message, which has a fixed number of values


class ErrorModel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Errors of one channel, in its unit; `sensor_catalogue` converts the units of data sheets and of Kalibr."""

    noise: NonNegative = 0.0  # standard deviation per sample; white, or with `correlation_s` a Gauss-Markov process
    density: NonNegative = 0.0  # white noise per sqrt(Hz); its standard deviation per sample is density * sqrt(rate)
    bias: NonNegative = 0.0  # standard deviation between runs, per axis, of a bias that is constant in a run
    bias_walk: NonNegative = 0.0  # random walk of the bias, per sqrt(s)
    bias_instability: NonNegative | UnsetType = UNSET
    """Standard deviation of a Gauss-Markov process, added in quadrature to a correlated `noise`; unset: none."""
    correlation_s: CorrelationS | UnsetType = UNSET
    """Correlation time of the Gauss-Markov process; unset or 0: `noise` is white."""
    quantum: NonNegative = 0.0  # step of the converter; 0: none

    @property
    def correlation_time_s(self) -> float:
        return 0.0 if self.correlation_s is UNSET else self.correlation_s

    @property
    def correlated_sigma(self) -> float:
        if not self.correlation_time_s:
            return 0.0
        return el.hypot(self.noise, 0.0 if self.bias_instability is UNSET else self.bias_instability)

    def white_sigma(self, rate_hz: float) -> float:
        """Return the standard deviation of the white noise per sample, excluding quantisation."""
        return el.hypot(0.0 if self.correlation_time_s else self.noise, self.density * math.sqrt(rate_hz))


class Mount(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pose of the sensor in the body, X_BS: position in B, and Euler angles of the rotation from S to B."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)


class Sensor(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings common to all sensors."""

    rate_hz: RateHz
    latency_ms: LatencyMs = 0.0
    dropout: Fraction = 0.0  # probability that a sample is lost, independent per sample
    mount: Mount = Mount()


class Sample(Message, frozen=True):
    """Base of every sensor's message; `t_sample_ns` is the simulated time of the measurement."""

    t_sample_ns: Whole


class Channel(Struct, frozen=True, omit_defaults=True):
    """Consecutive numbers of a reading that share an ErrorModel.

    Attributes:
        settings: name of the field of the sensor's settings that contains the ErrorModel.
        unit: unit of the ErrorModel and of the bias added by a fault.
        width: count of the numbers.
        to_si: factor from `unit` to the unit of the equation's values, e.g. pi / 180 where settings are in deg/s and
            values in rad/s.
        part: first word of the channel's fault kinds; empty if they concern the whole sensor.
        label: display name of the part.
        axes: phrase for the axes or quantity of a fault's bias, e.g. "east, north, up" or "of height".
        bias_max: maximum bias that a fault may add to each number, in `unit`.
    """

    settings: FieldName
    unit: str = "1"
    width: Annotated[int, Meta(ge=1, le=VALUES_MAX)] = 1
    to_si: float = 1.0
    part: str = ""
    label: str = ""
    axes: str = "of each number"
    bias_max: float = 1e6


class SensorTruth(Struct, frozen=True):
    """The true state of the drone and pose of the sensor at one time. W: world (east, north, up); B: body; S: sensor.

    Attributes:
        t_s: simulated time [s].
        p_WB, v_WB, a_WB: position [m], velocity [m/s], acceleration [m/s^2] of the centre of mass in W, (3,).
            The acceleration is that of the board's last step, at most 5 ms old.
        R_WB: rotation from body to world components, (3, 3).
        w_WB_B, alpha_B: body rate [rad/s] and its derivative [rad/s^2] in B, (3,).
        air_W: velocity of the air at the drone in W [m/s], (3,): steady wind, gusts and other drones' downwash.
        p_BS, R_BS: position of the sensor in B [m], (3,), and rotation from sensor to body components, (3, 3).
    """

    t_s: float
    p_WB: NDArray[np.float64]
    v_WB: NDArray[np.float64]
    a_WB: NDArray[np.float64]
    R_WB: NDArray[np.float64]
    w_WB_B: NDArray[np.float64]
    alpha_B: NDArray[np.float64]
    air_W: NDArray[np.float64]
    p_BS: NDArray[np.float64]
    R_BS: NDArray[np.float64]

    @property
    def p_WS(self) -> NDArray[np.float64]:
        """Position of the sensor in W [m]: p_WB + R_WB p_BS."""
        return self.p_WB + product(self.R_WB, self.p_BS)

    @property
    def v_WS(self) -> NDArray[np.float64]:
        """Velocity of the sensor in W [m/s]: v_WB + R_WB (w × p_BS)."""
        return self.v_WB + product(self.R_WB, np.cross(self.w_WB_B, self.p_BS))

    @property
    def a_WS(self) -> NDArray[np.float64]:
        """Acceleration of the sensor in W [m/s^2]: a_WB + R_WB (alpha × p_BS + w × (w × p_BS))."""
        turning = np.cross(self.w_WB_B, np.cross(self.w_WB_B, self.p_BS))
        return self.a_WB + product(self.R_WB, np.cross(self.alpha_B, self.p_BS) + turning)

    @property
    def R_WS(self) -> NDArray[np.float64]:
        """Rotation from sensor to world components, (3, 3)."""
        return product(self.R_WB, self.R_BS)


Equation = Callable[[SensorTruth, Any, Any], Sequence[float]]
"""(truth, settings, environment of the scenario) -> the values of all channels in order, then the exact values."""
Conversion = Callable[[Sequence[float], Any, Any], Sequence[Any]]
"""(reading, settings, environment) -> the numbers of the message's fields, in order."""


class SensorType(Struct, frozen=True, kw_only=True):
    """A kind of sensor.

    Attributes:
        message: subclass of Sample; its own fields are numbers, tuples of numbers, whole numbers or booleans.
        settings: subclass of Sensor, with an ErrorModel for each channel.
        channels: channels in the order of the equation's values.
        exact: count of values without error, which follow those of the channels.
        label: name of the sensor in tables; empty for its name in the scenario.
        equation: equation of a user's sensor; those of the stock sensors are compiled in zsim_world.sensors.
        convert: conversion of a user's sensor from reading to message; None if the values are the message's numbers.
        presets: sections of a stock sensor by preset name.
    """

    message: type[Sample]
    settings: type[Sensor]
    channels: tuple[Channel, ...]
    exact: int = 0
    label: str = ""
    equation: Equation | None = None
    convert: Conversion | None = None
    presets: dict[str, dict[str, Any]] = {}

    @property
    def width(self) -> int:  # count of numbers with an error model
        return sum(channel.width for channel in self.channels)

    @property
    def values(self) -> int:  # count of numbers in a reading
        return self.width + self.exact

    def errors(self, settings: Sensor) -> list[ErrorModel]:
        """Return the error model, in SI units, of each number that has one."""
        models = [
            (scaled(getattr(settings, channel.settings), channel.to_si), channel.width) for channel in self.channels
        ]
        return [model for model, width in models for _ in range(width)]


class Declaration(Struct, frozen=True, omit_defaults=True):
    """Description of a user's sensor for processes without its module; part of the resolved scenario."""

    message: MessageName
    fields: dict[FieldName, FieldType]
    channels: tuple[Channel, ...]
    label: str = ""

    @classmethod
    def of(cls, kind: SensorType) -> "Declaration":
        return cls(kind.message.__name__, field_types(kind.message, Sample, UNSENSED), kind.channels, kind.label)


def scaled(model: ErrorModel, to_si: float) -> ErrorModel:
    """Return an error model converted to SI units by the factor `to_si`."""
    if to_si == 1.0:
        return model
    scales = {field: value for field, value in msgspec.structs.asdict(model).items() if field != "correlation_s"}
    return msgspec.structs.replace(model, **{f: value * to_si for f, value in scales.items() if value is not UNSET})


def noise_sigma(model: ErrorModel, rate_hz: float) -> float:
    """Return the standard deviation of a sample's white and correlated noise, excluding the bias."""
    white, correlated = model.white_sigma(rate_hz), model.correlated_sigma
    return el.hypot(white, correlated) if correlated else white


def message_type(name: str, fields: Mapping[str, str], sensor: str = "") -> type[Sample]:
    """Return the message class of a user's sensor; equal arguments give the same class."""
    return declared_type(name, fields, Sample, (("__sensor__", sensor),))


def sensor_of(message: type[Struct]) -> str:
    """Return the name of the user's sensor to which a message class belongs; empty for other messages."""
    return getattr(message, "__sensor__", "")


def as_fields(numbers: Sequence[Any], fields: Mapping[str, str]) -> list[Any]:
    """Return a flat sequence of numbers grouped into the values of a message's fields.

    Raises:
        ValueError: the fields need a different count of numbers.
    """
    values, at = [], 0
    for type_name in fields.values():
        count = int(type_name[7:-1]) if type_name.startswith("number[") else 1
        part = numbers[at : at + count]
        at += len(part)
        if len(part) < count:
            break
        if type_name in ("number", "whole", "flag"):
            values.append({"number": float, "whole": int, "flag": bool}[type_name](part[0]))
        else:
            values.append(tuple(map(float, part)))
    if at != len(numbers) or len(values) < len(fields):
        raise ValueError(f"gets {len(numbers)} numbers; must get those of {', '.join(fields)}")
    return values
