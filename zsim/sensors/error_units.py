"""Error models in the words and units of data sheets and of Kalibr, as a scenario may give them: read into the fields
of `zsim.sensors.sensor.ErrorModel`, which are in the channel's unit.

    imu: {accel_m_s2: {density_ug_sqrt_hz: 175}, gyro_deg_s: {bias_instability_deg_h: 2, correlation_s: 300}}
    imu: {accelerometer_noise_density: 0.0017, gyroscope_random_walk: 2.0e-5, update_rate: 200}

White noise of density N is what an Allan deviation of slope -1/2 shows at 1 s, in the units of an angle or velocity
random walk 60 N; a random walk K of the bias has slope +1/2 and K at 3 s (IEEE Std 952-1997, annex C). Kalibr's
`noise_density` and `random_walk` are these two in SI units (ethz-asl/kalibr, wiki, "IMU Noise Model").
"""

import math
from typing import Any, NamedTuple

from zsim.schema.checker import Fault, faults
from zsim.schema.quantities import G_M_S2, NonNegative
from zsim.sensors.sensor import RateHz
from zsim.sensors.sensor_catalogue import STOCK

DEG = 180.0 / math.pi  # deg/rad
HOUR_S = 3600.0  # s


class Unit(NamedTuple):
    """A field of the error model in another unit."""

    field: str
    factor: float  # the field in the channel's unit, for one of this


EVERY = {"noise_density": Unit("density", 1.0), "random_walk": Unit("bias_walk", 1.0)}  # of channels in SI units, or uT
BY_UNIT: dict[str, dict[str, Unit]] = {  # by the unit of the channel
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
KALIBR = {  # keys of Kalibr's imu.yaml, by the path in the section of the IMU
    "accelerometer_noise_density": ("accel_m_s2", "noise_density"),
    "accelerometer_random_walk": ("accel_m_s2", "random_walk"),
    "gyroscope_noise_density": ("gyro_deg_s", "noise_density"),
    "gyroscope_random_walk": ("gyro_deg_s", "random_walk"),
    "update_rate": ("rate_hz",),
}


def in_channel_units(sensors: dict[str, Any], where: str) -> tuple[Any, list[Fault]]:
    """Return a `sensors:` section with its error models converted to the fields of ErrorModel, and the faults.

    Args:
        sensors: by name; what is no map, and a user's own sensors, are returned as they are.
        where: path of the section.
    """
    wrong: list[Fault] = []
    read = dict(sensors)
    for name, kind in STOCK.items():
        section = sensors.get(name)
        if not isinstance(section, dict):
            continue
        read[name] = section = _of_kalibr(section, f"{where}.{name}", wrong) if name == "imu" else dict(section)
        for channel in kind.channels:
            model, path = section.get(channel.settings), f"{where}.{name}.{channel.settings}"
            if isinstance(model, dict):
                section[channel.settings] = _in_unit(model, BY_UNIT[channel.unit], path, wrong)
    return read, wrong


def _of_kalibr(section: dict[str, Any], where: str, wrong: list[Fault]) -> dict[str, Any]:
    read = {key: value for key, value in section.items() if key not in KALIBR}
    for key, place in KALIBR.items():
        if key not in section:
            continue
        found = [*faults(section[key], RateHz if len(place) == 1 else NonNegative, f"{where}.{key}")]
        inside = read if len(place) == 1 else read.get(place[0], {})
        if isinstance(inside, dict) and place[-1] in inside:
            found.append((f"{where}.{key}", f"is given beside {'.'.join(place)}; must be one of them"))
        wrong += found
        if found or not isinstance(inside, dict):
            continue
        if len(place) == 1:
            read[place[0]] = section[key]
        else:
            read[place[0]] = {**inside, place[1]: section[key]}
    return read


def _in_unit(model: dict[str, Any], units: dict[str, Unit], where: str, wrong: list[Fault]) -> dict[str, Any]:
    read = {key: value for key, value in model.items() if key not in units}
    for key, unit in units.items():
        if key in model:
            found = [*faults(model[key], NonNegative, f"{where}.{key}")]
            if unit.field in read:
                text = f"says what another of the fields for {unit.field} says; must be the only one"
                found.append((f"{where}.{key}", text))
            wrong += found
            if not found:
                read[unit.field] = unit.factor * model[key]
    return read
