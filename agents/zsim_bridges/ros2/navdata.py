"""The summary that ardrone_autonomy calls navdata: what a drone's sensors told last, in that driver's units."""

import math
from typing import Any

import numpy as np

from zsim.contract import keys
from zsim.math.frames import rpy_from_quaternion
from zsim.scenario.sensor_presets import G_M_S2
from zsim_bridges.ros2.conversions import header

STATES = {"landed": 2, "taking_off": 6, "hovering": 4, "flying": 3, "landing": 8, "emergency": 0}
"""ardrone_autonomy's numbers; an emergency it shows as unknown."""
NOTHING = (math.nan, math.nan, math.nan)


class NavdataSummary:
    """Collects what a drone tells, and makes a message of it when its status comes, last of a gate.

    Args:
        kind: class of zsim_msgs/Navdata.
        frame: of the message.
    """

    def __init__(self, kind: Any, frame: str) -> None:
        self._kind = kind
        self._frame = frame
        self._last: dict[str, Any] = {}

    def update(self, key: str, message: Any) -> Any | None:
        """Take in a message of the drone; return the summary if it was the status."""
        what = keys.leaf(key)
        if what != "status":
            self._last[what] = message
            return None
        return self._kind(
            header=header(message.t_ns, self._frame),
            battery_percent=message.battery_percent,
            state=STATES[message.state],
            **_named("mag_{}", self._scaled("mag", "field_ut", 1.0)),
            pressure=self._rounded("baro", "pressure_pa", 1.0),
            **_named("rot_{}", self._attitude()),
            altd=self._rounded("sonar", "range_m", 1000.0),
            **_named("v{}", self._scaled("flow", "velocity_m_s", 1000.0)),
            **_named("a{}", self._scaled("imu", "accel_m_s2", 1.0 / G_M_S2)),
            tm=message.t_ns / 1000.0,
        )

    def _scaled(self, sensor: str, field: str, factor: float) -> tuple[float, ...]:
        found = getattr(self._last.get(sensor), field, NOTHING)
        return tuple(factor * each for each in found)

    def _rounded(self, sensor: str, field: str, factor: float) -> int:
        return round(factor * getattr(self._last.get(sensor), field, 0.0))

    def _attitude(self) -> tuple[float, ...]:
        estimate = self._last.get("estimate")
        return tuple(np.degrees(rpy_from_quaternion(estimate.orientation_wxyz))) if estimate else NOTHING


def _named(pattern: str, values: tuple[float, ...]) -> dict[str, float]:
    return {pattern.format(axis): value for axis, value in zip("xyz", values, strict=True)}
