"""Each sensor's truth to measurement, with lever arms and turned mounts."""

import math
from typing import Any

import numpy as np
import pytest

from zsim.math.frames import quaternion_from_rpy
from zsim_world.sensors.sensor_set import (
    BodyTruth,
    MountedSensor,
    Site,
    baro,
    flow,
    gps,
    imu,
    mag,
    pressure,
    rounded,
    sonar,
)

NOWHERE, STILL = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
STRAIGHT = (1.0, 0.0, 0.0, 0.0)
SITE = Site(9.8, (0.0, 20.0, -10.0))


def body(p=NOWHERE, v=STILL, q=STRAIGHT, w=STILL, a=STILL, alpha=STILL):
    """Return the truth of a drone; whole numbers as floats, as compiled code has them."""
    vectors: Any = [tuple(map(float, each)) for each in (p, v, q, w, a, alpha)]
    return BodyTruth(*vectors)


def mounted(p=NOWHERE, q=STRAIGHT, range_max=6.0):
    return MountedSensor((float(p[0]), float(p[1]), float(p[2])), q, range_max)


def turn(roll=0.0, pitch=0.0, yaw=0.0):
    return tuple(quaternion_from_rpy((roll, pitch, yaw)).tolist())


LEFT = turn(yaw=math.pi / 2)
SINE, COSINE = 9.8 * math.sin(0.1), 9.8 * math.cos(0.1)
# sensor, truth, mount, values worked out by hand
CASES: dict[str, tuple[Any, BodyTruth, MountedSensor, Any]] = {
    "at rest, gravity is felt upwards": (imu, body(), mounted((0.1, 0.2, 0.3)), ((0, 0, 9.8), STILL)),
    # a real landed packet: theta +2.97 deg, accel x +80 mg
    "nose up: specific force along the nose": (imu, body(q=turn(pitch=-0.1)), mounted(), ((SINE, 0, COSINE), STILL)),
    "spinning at 3 rad/s about z, faster by 2 rad/s^2, 0.1 m ahead": (
        imu, body(a=(0, 0, -9.8), w=(0, 0, 3), alpha=(0, 0, 2)), mounted((0.1, 0, 0)), ((-0.9, 0.2, 0), (0, 0, 3)),
    ),
    "a board turned a quarter to the left: ahead is to its right": (
        imu, body(a=(1, 0, -9.8), w=(0.5, 0, 0)), mounted(q=LEFT), ((0, -1, 0), (0, -0.5, 0)),
    ),
    "an antenna off the centre": (
        gps, body((1, 2, 3), (1, 0, 0), LEFT, (0, 0, 2)), mounted((0.1, 0, 0.05)), ((1.0, 2.1, 3.05), (0.8, 0, 0)),
    ),
    "the field turns against the body": (mag, body(q=LEFT), mounted(), ((20, 0, -10), STILL)),
    "and against the mount": (mag, body(q=LEFT), mounted(q=LEFT), ((0, -20, -10), STILL)),
    "the barometer's height is that of its mount": (
        baro, body((0, 0, 5), q=turn(pitch=-math.pi / 2)), mounted((0.2, 0, 0)), ((5.2, 0, 0), STILL),
    ),
    "a beam from its mount": (sonar, body((0, 0, 2)), mounted((0, 0, -0.05)), ((1.95, 1, 0), STILL)),
    "a slanted beam": (sonar, body((0, 0, 2), q=turn(0.3)), mounted(), ((2 / math.cos(0.3), 1, 0), STILL)),
    "an upright beam of a slanted body": (
        sonar, body((0, 0, 2), q=turn(0.3)), mounted(q=turn(-0.3)), ((2.0, 1, 0), STILL),
    ),
    "no echo from afar": (sonar, body((0, 0, 6.1)), mounted(), ((6.0, 0, 0), STILL)),
    "no echo from aside": (sonar, body((0, 0, 1), q=turn(1.2)), mounted(), ((6.0, 0, 0), STILL)),
    "no echo from above": (sonar, body((0, 0, 1), q=turn(3.0)), mounted(), ((6.0, 0, 0), STILL)),
    "flow is in the heading frame": (
        flow, body(v=(1, 2, 0.5), q=turn(0.2, -0.1, math.pi / 2)), mounted(),
        ((2.0, -1.0, 0.5), (math.cos(0.2) * math.cos(0.1), 0, 0)),
    ),
    "flow of a turning sensor": (flow, body(q=LEFT, w=(0, 0, 2)), mounted((0.1, 0, 0)), ((0, 0.2, 0), (1, 0, 0))),
    "upside down flow sees nothing": (flow, body(q=turn(roll=3.0)), mounted(), (STILL, STILL)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_sensor_measures_what_its_mount_is_exposed_to(name: str):
    sensor, truth, mount, expected = CASES[name]
    np.testing.assert_allclose(sensor(truth, mount, SITE), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("altitude", "pascals"),
    # ISO 2533, table of the standard atmosphere (geopotential heights)
    [(0, 101325.0), (1000, 89874.6), (2000, 79495.2), (5000, 54019.9), (11000, 22632.0)],
)
def test_pressure_of_the_standard_atmosphere(altitude, pascals):
    assert pressure(altitude) == pytest.approx(pascals, rel=2e-4)


def test_pressure_is_finite_at_any_height():
    pressures = [pressure(z) for z in (-1e6, -1e4, 2e4, 44_330.0, 44_331.0, 1e6, 1e9)]
    assert all(map(math.isfinite, pressures))
    assert pressures == sorted(pressures, reverse=True)


@pytest.mark.parametrize(
    ("value", "bias", "white", "quantum", "shown"),
    [
        (1.26, 0.0, 0.0, 0.5, 1.5),
        (-1.26, 0.0, 0.0, 0.5, -1.5),
        (1.24, 0.0, 0.0, 0.5, 1.0),
        (1.26, 0.0, 0.0, 0.0, 1.26),
        (1.0, 0.2, 0.1, 0.5, 1.5),
    ],
)
def test_a_reading_is_rounded_to_the_quantum_after_bias_and_noise(value, bias, white, quantum, shown):
    assert rounded(value, bias, white, quantum) == shown
