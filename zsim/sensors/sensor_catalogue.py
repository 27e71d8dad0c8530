"""Sensors of a drone: the stock sensors in the contract's order, and users' sensors, found in their modules.

A scenario may specify error models with the names and units of data sheets and of Kalibr; they are converted to the
fields of `zsim.sensors.sensor.ErrorModel`, in the channel's unit:

    imu: {accel_m_s2: {density_ug_sqrt_hz: 175}, gyro_deg_s: {bias_instability_deg_h: 2, correlation_s: 300}}
    imu: {accelerometer_noise_density: 0.0017, gyroscope_random_walk: 2.0e-5, update_rate: 200}

The density N of white noise is the Allan deviation at 1 s on the line of slope -1/2; as an angle or velocity random
walk per sqrt(h) it is 60 N. The random walk K of the bias is the Allan deviation at 3 s on the line of slope +1/2 (IEEE
Std 952-1997, annex C). Kalibr's `noise_density` and `random_walk` are N and K in SI units (ethz-asl/kalibr, wiki, "IMU
Noise Model").
"""

import math
import re
from collections.abc import Iterator
from functools import cache
from typing import Any, Literal, NamedTuple, get_type_hints

import msgspec
from msgspec import UNSET, Struct, UnsetType

from zsim.errors import DocumentError, NotTrustedError
from zsim.schema import plugin
from zsim.schema.checker import Fault, faults, faults_in, field_path, show, suggestion
from zsim.schema.quantities import G_M_S2, NonNegative
from zsim.sensors import stock_sensors
from zsim.sensors.camera import CAMERAS, BottomCamera, Camera, FrontCamera, SightingModel
from zsim.sensors.scanner import SCANNERS, DepthConfig, LidarConfig, RangeConfig
from zsim.sensors.sensor import VALUES_MAX, Declaration, RateHz, Sample, Sensor, SensorType, as_fields
from zsim.sensors.stock_sensors import BaroConfig, FlowConfig, GpsConfig, ImuConfig, MagConfig, SonarConfig

DEG = 180.0 / math.pi  # deg/rad
HOUR_S = 3600.0  # s

STOCK: dict[str, SensorType] = {
    "imu": stock_sensors.IMU,
    "gps": stock_sensors.GPS,
    "mag": stock_sensors.MAG,
    "baro": stock_sensors.BARO,
    "sonar": stock_sensors.SONAR,
    "flow": stock_sensors.FLOW,
}


class Sensors(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The sensors of one drone, after its preset and overrides have been applied."""

    preset: Literal["ardrone2", "paper", "crazyflie2"]
    as_printed: bool = False  # with `paper`: accelerometer noise of 0.35 g as printed, instead of 0.35 m/s^2
    imu: ImuConfig
    gps: GpsConfig
    mag: MagConfig
    baro: BaroConfig
    sonar: SonarConfig
    flow: FlowConfig
    front_camera: FrontCamera | UnsetType = UNSET
    bottom_camera: BottomCamera | UnsetType = UNSET
    sightings: SightingModel | UnsetType = UNSET
    """Detections in the cameras' pictures, computed by the world without rendering pictures."""
    range: RangeConfig | UnsetType = UNSET
    lidar: LidarConfig | UnsetType = UNSET
    depth: DepthConfig | UnsetType = UNSET
    own: dict[str, dict[str, Any]] | UnsetType = UNSET
    """Users' sensors by name: all their settings, `module` and `declared`. A file lists them among the other sensors;
    see `flattened`."""

    def cameras(self) -> dict[str, Camera]:
        by_name = {name: getattr(self, f"{name}_camera") for name in CAMERAS}
        return {name: camera for name, camera in by_name.items() if camera is not UNSET}

    def sections(self) -> Iterator[tuple[str, SensorType, Sensor]]:
        """Yield the name, type and settings of every sensor, importing users' modules.

        Raises:
            DocumentError: a module is missing, or differs from the one used to resolve the scenario.
        """
        for name, kind in STOCK.items():
            yield name, kind, getattr(self, name)
        for name, section in ({} if self.own is UNSET else self.own).items():
            where = f"sensors.{name}"
            kind = sensor_type(section[MODULE], f"{where}.{MODULE}")
            wrong = [f"{path} {text}" for path, text in faults(_settings_of(section), kind.settings, where)]
            if section[DECLARED] != _plain(Declaration.of(kind)):
                mismatch = f"{where}.{DECLARED} is not what {section[MODULE]} declares here"
                wrong.append(f"{mismatch}; the scenario must be resolved with the same version of the module")
            if wrong:
                raise DocumentError(wrong)
            yield name, kind, msgspec.convert(_settings_of(section), kind.settings)


PRESETS = {
    preset: {name: kind.presets[preset] for name, kind in STOCK.items()}
    for preset in ("ardrone2", "paper", "crazyflie2")
}
AS_PRINTED = {"imu": stock_sensors.IMU_AS_PRINTED}

MODULE, DECLARED = "module", "declared"  # keys of a user's sensor, in addition to its settings
FIELDS = tuple(name for name in Sensors.__struct_fields__ if name != "own")
RESERVED = ("status", "truth", "own", "accel", "gyro", "rotor", "link", "process")  # names used in keys and fault kinds
NAME = r"[a-z][a-z0-9_]{0,31}"
NAME_ALLOWED = f"a letter and up to 31 of a-z 0-9 _, none of {', '.join(RESERVED)}"


@cache
def sensor_type(module_name: str, where: str = "module") -> SensorType:
    """Return the SENSOR of a user's module.

    Raises:
        DocumentError: the module defines no SENSOR, or an inconsistent one; the error has one line.
    """
    sensor = plugin.load_object(module_name, where, "SENSOR", SensorType)
    try:
        _check(sensor)
    except (NameError, TypeError, ValueError) as error:  # NameError: an annotation undefined at run time
        raise DocumentError([f"{where} is {show(module_name)}: SENSOR.{error}"]) from error
    return sensor


def _check(sensor: SensorType) -> None:
    for part, base in (("message", Sample), ("settings", Sensor)):
        kind = getattr(sensor, part)
        if not (isinstance(kind, type) and issubclass(kind, base)):
            raise TypeError(f"{part} is {show(str(kind))}; must be a subclass of {base.__name__}")
    shared, own = (get_type_hints(kind, include_extras=True) for kind in (Sensor, sensor.settings))
    for name, kind in shared.items():
        if own[name] != kind:  # another type would drop the limits of the shared setting
            fault = f"settings: {sensor.settings.__name__}.{name} has a type of its own"
            raise TypeError(f"{fault}; must have that of zsim.sensors.sensor.Sensor, e.g. RateHz, LatencyMs")
    fields = Declaration.of(sensor).fields
    if sensor.equation is None:
        raise ValueError("equation is missing; must be a function of truth, settings and environment")
    if not 1 <= sensor.values <= VALUES_MAX:
        raise ValueError(
            f"channels have {sensor.values} numbers, including the exact ones; must have 1 to {VALUES_MAX}"
        )
    for index, channel in enumerate(sensor.channels):
        if channel.settings not in sensor.settings.__struct_fields__:
            allowed = f"must be a field of {sensor.settings.__name__}"
            raise ValueError(f"channels[{index}].settings is {channel.settings!r}; {allowed}")
        if channel.part:
            raise ValueError(f"channels[{index}].part is {channel.part!r}; must be left out of a sensor of your own")
    if sensor.convert is None:
        try:
            as_fields([0.0] * sensor.values, fields)
        except ValueError as error:
            raise ValueError(f"message {error}, or `convert` must be given") from error


def separate(
    section: dict[str, Any], imports: bool = True
) -> tuple[dict[str, Any], dict[str, dict[str, Any]], list[Fault]]:
    """Return a `sensors:` section without users' sensors, the users' sensors with all settings, and their faults.

    A resolved sensor is returned unchanged, so that readers of `world/info` import nothing. Without `imports`, an
    unresolved sensor is a fault; a sensor whose module must not be imported (`plugin.names_only`) is omitted.
    """
    stock = {name: value for name, value in section.items() if name in FIELDS}
    own: dict[str, dict[str, Any]] = {}
    wrong: list[Fault] = []
    for name, value in section.items():
        if name in FIELDS:
            continue
        if not (isinstance(value, dict) and MODULE in value):
            allowed = f"allowed: {', '.join(sorted(FIELDS))}, or a sensor of your own with its module"
            wrong.append((field_path("", name), f"is not known; {suggestion(name, FIELDS)}{allowed}"))
            continue
        if not isinstance(name, str) or not re.fullmatch(NAME, name) or name in RESERVED:
            wrong.append((field_path("", name), f"is not a valid sensor name; must be {NAME_ALLOWED}"))
            continue
        section_faults = [*_section_faults(name, value, imports)]
        wrong += section_faults
        if section_faults:
            continue
        if DECLARED in value:
            own[name] = value
        elif plugin.may_import():
            kind = sensor_type(value[MODULE])
            settings = _plain(msgspec.convert(_settings_of(value), kind.settings))
            own[name] = {MODULE: value[MODULE], DECLARED: _plain(Declaration.of(kind)), **settings}
    return stock, dict(sorted(own.items())), wrong


def flattened(sensors: dict[str, Any]) -> dict[str, Any]:
    """Return a resolved `sensors:` section in the form of a file, with users' sensors among the others."""
    stock = {name: value for name, value in sensors.items() if name != "own"}
    return stock | sensors.get("own", {})


def declarations(drones: Any) -> dict[str, Declaration]:
    """Return the declarations of users' sensors on a scenario's drones, sorted by name."""
    sections: dict[str, dict[str, Any]] = {}
    for drone in drones:
        sections = own_sections(drone) | sections
    return {name: msgspec.convert(sections[name][DECLARED], Declaration) for name in sorted(sections)}


def own_sections(drone: Any) -> dict[str, dict[str, Any]]:
    """Return the sections of the users' sensors on a drone; empty if there are none or they are faulty."""
    own = drone.sensors.own if drone.sensors is not None else None
    return own if isinstance(own, dict) else {}


def sensor_names(sensors: Any) -> list[str]:
    """Return the names of the sensors in the valid part of a drone's `sensors:` section."""
    optional = [name for name in ("sightings", *SCANNERS) if getattr(sensors, name)]
    return [*STOCK, *optional, *(sensors.own or ())]


def own_rates(drone: Any) -> dict[str, float]:
    return {name: section["rate_hz"] for name, section in own_sections(drone).items()}


def _settings_of(section: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in section.items() if name not in (MODULE, DECLARED)}


def _section_faults(name: str, section: dict[str, Any], imports: bool) -> Iterator[Fault]:
    if DECLARED in section:
        yield from faults(section[DECLARED], Declaration, f"{name}.{DECLARED}")
        return
    if not imports:
        yield f"{name}.{DECLARED}", "is missing; must be present in a resolved scenario"
        return
    module = section[MODULE]
    if not isinstance(module, str) or not re.fullmatch(plugin.MODULE_NAME, module):
        yield f"{name}.{MODULE}", f"is {show(module)}; must be package.module"
        return
    try:
        kind = sensor_type(module, f"{name}.{MODULE}")
    except NotTrustedError:
        return
    except DocumentError as error:
        yield from faults_in(error)
        return
    yield from faults(_settings_of(section), kind.settings, name)


def _plain(value: Struct) -> dict[str, Any]:
    """Return a struct as plain dicts, lists, strings and numbers."""
    return msgspec.json.decode(msgspec.json.encode(value))


class Unit(NamedTuple):
    """A field of the error model, and the factor that converts a value to the channel's unit."""

    field: str
    factor: float  # channel units per unit of the given value


EVERY = {"noise_density": Unit("density", 1.0), "random_walk": Unit("bias_walk", 1.0)}  # for channels in SI units or uT
BY_UNIT: dict[str, dict[str, Unit]] = {  # by the channel's unit
    "m/s^2": {
        **EVERY,
        "density_ug_sqrt_hz": Unit("density", 1e-6 * G_M_S2),
        "velocity_random_walk_m_s_sqrt_h": Unit("density", 1.0 / math.sqrt(HOUR_S)),
        "bias_mg": Unit("bias", 1e-3 * G_M_S2),
        "bias_instability_ug": Unit("bias_instability", 1e-6 * G_M_S2),
    },
    "deg/s": {
        "noise_density": Unit("density", DEG),
        "random_walk": Unit("bias_walk", DEG),
        "density_deg_s_sqrt_hz": Unit("density", 1.0),
        "density_mdeg_s_sqrt_hz": Unit("density", 1e-3),
        "angle_random_walk_deg_sqrt_h": Unit("density", 1.0 / math.sqrt(HOUR_S)),
        "bias_deg_h": Unit("bias", 1.0 / HOUR_S),
        "bias_instability_deg_h": Unit("bias_instability", 1.0 / HOUR_S),
    },
    "uT": {**EVERY, "density_nt_sqrt_hz": Unit("density", 1e-3), "bias_nt": Unit("bias", 1e-3)},
    "m": EVERY,
    "m/s": EVERY,
}
KALIBR = {  # path in the IMU's section, by key of Kalibr's imu.yaml
    "accelerometer_noise_density": ("accel_m_s2", "noise_density"),
    "accelerometer_random_walk": ("accel_m_s2", "random_walk"),
    "gyroscope_noise_density": ("gyro_deg_s", "noise_density"),
    "gyroscope_random_walk": ("gyro_deg_s", "random_walk"),
    "update_rate": ("rate_hz",),
}


def in_channel_units(sensors: dict[str, Any], where: str) -> tuple[Any, list[Fault]]:
    """Return a `sensors:` section with its error models converted to the fields of ErrorModel, and the faults.

    Args:
        sensors: sections by sensor name; those of users' sensors, and values that are not maps, are returned unchanged.
        where: path of the section.
    """
    wrong: list[Fault] = []
    read = dict(sensors)
    for name, kind in STOCK.items():
        section = sensors.get(name)
        if not isinstance(section, dict):
            continue
        read[name] = section = _from_kalibr(section, f"{where}.{name}", wrong) if name == "imu" else dict(section)
        for channel in kind.channels:
            model, path = section.get(channel.settings), f"{where}.{name}.{channel.settings}"
            if isinstance(model, dict):
                section[channel.settings] = _in_unit(model, BY_UNIT[channel.unit], path, wrong)
    return read, wrong


def _from_kalibr(section: dict[str, Any], where: str, wrong: list[Fault]) -> dict[str, Any]:
    read = {key: value for key, value in section.items() if key not in KALIBR}
    for key, path in KALIBR.items():
        if key not in section:
            continue
        flaws = [*faults(section[key], RateHz if len(path) == 1 else NonNegative, f"{where}.{key}")]
        inside = read if len(path) == 1 else read.get(path[0], {})
        if isinstance(inside, dict) and path[-1] in inside:
            flaws.append((f"{where}.{key}", f"is given together with {'.'.join(path)}; give only one of them"))
        wrong += flaws
        if flaws or not isinstance(inside, dict):
            continue
        if len(path) == 1:
            read[path[0]] = section[key]
        else:
            read[path[0]] = {**inside, path[1]: section[key]}
    return read


def _in_unit(model: dict[str, Any], units: dict[str, Unit], where: str, wrong: list[Fault]) -> dict[str, Any]:
    read = {key: value for key, value in model.items() if key not in units}
    for key, unit in units.items():
        if key in model:
            flaws = [*faults(model[key], NonNegative, f"{where}.{key}")]
            if unit.field in read:
                text = f"is given together with another field for {unit.field}; must be the only one"
                flaws.append((f"{where}.{key}", text))
            wrong += flaws
            if not flaws:
                read[unit.field] = unit.factor * model[key]
    return read
