"""Settings and messages of sensors that measure along rays: what is refused, and what a reader receives."""

import math
from typing import Any

import numpy as np
import pytest
from refused import faulty_fields

from zsim.contract import messages
from zsim.contract.messages import Depth, Lidar, Range
from zsim.errors import DecodeError

FOUR = np.array([1.5, 0.0, 2.0, 3.0], dtype="<f4").tobytes()
LIDAR: dict[str, Any] = {
    "t_ns": 5,
    "seq": 0,
    "t_sample_ns": 0,
    "channels": 2,
    "columns": 2,
    "max_m": 9.0,
    "ranges_m": FOUR,
}
LIDAR.update({"elevation_rad": (0.0, 0.1), "azimuth_rad": (0.0, math.pi / 2)})


@pytest.mark.parametrize(
    ("section", "settings", "field"),
    [
        ("range", {"beams": {}}, "beams"),
        ("range", {"beams": {"Front": {}}}, "beams.Front"),
        ("range", {"min_m": 5}, "min_m"),  # beyond max_m
        ("lidar", {"channels": 100, "columns": 1001}, "columns"),  # too many rays
        ("lidar", {"azimuth_deg": [-200, 200]}, "azimuth_deg"),  # more than a turn
        ("lidar", {"azimuth_deg": [10, 10]}, "azimuth_deg"),
        ("lidar", {"module": "lidar"}, "module"),
        ("depth", {}, "cameras[0]"),  # the drone has no front camera
    ],
)
def test_invalid_settings_are_refused(section: str, settings: dict[str, Any], field: str):
    drone = {"name": "d1", "position_m": [0, 0, 0], "sensors": {"bottom_camera": {}, section: settings}}
    assert faulty_fields({"name": "t", "duration_s": 1, "drones": [drone]}, "drones[0].sensors.") == [
        f"{section}.{field}"
    ]


def test_lidar_ranges_are_read_as_an_array_with_zeros_as_infinity():
    message = messages.decode("drone/d1/sensor/lidar", messages.encode(Lidar(**LIDAR)))
    np.testing.assert_array_equal(message.ranges(), [[1.5, math.inf], [2.0, 3.0]])
    np.testing.assert_allclose(message.directions()[0], [[1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(message.directions()[1, 0], [math.cos(0.1), 0, math.sin(0.1)])


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (Lidar(**{**LIDAR, "columns": 3}), "ranges_m"),
        (Range(5, 0, 0, ("a", "b"), (1.0,), 4.0), "ranges_m"),
        (
            Depth(5, 0, 0, camera="front", columns=2, rows=1, focal_px=(1, 1), centre_px=(0, 0), max_m=9, depth_m=FOUR),
            "depth_m",
        ),
    ],
)
def test_a_message_whose_size_contradicts_its_fields_is_refused(message: Any, field: str):
    with pytest.raises(DecodeError) as refused:
        messages.decode(f"drone/d1/sensor/{type(message).__name__.lower()}", messages.encode(message))
    assert field in str(refused.value).split()
