"""One aiding sensor of a drone as its filter knows it: mount, noise, bias states and counts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from zsim.scenario.scenario import ErrorModel, Mount, Sensors
from zsim_agents.estimation.error_state import BiasPrior
from zsim_agents.estimation.madgwick import Vector
from zsim_agents.estimation.mount import mount_rotation
from zsim_agents.estimation.sensor_noise import has_bias, white_sigma

# Errors of the model itself, so that a scenario without noise does not ask for infinite trust.
SIGMA_MIN = {
    "gps": (0.01, 0.01),  # m, m/s: interpolation of the past state
    "mag": (0.02,),  # uT: 1 mrad of an 18 uT horizontal field
    "baro": (0.005,),  # m
    "sonar": (0.003,),  # m
    "flow": (0.005,),  # m/s
}
VALUE_MAX = 1e7  # m, m/s or uT: no sensor reads more, and squares of more would drown the rest
SQUARE_MAX = 1e8  # of an innovation, in its unit; more would cost the covariance its digits
# A sensor refused for this long without a break is believed again, its states losing their certainty [s].
# Height and velocity are lost quickly where they are wrong; a field may be disturbed in passing.
PATIENCE_S = {"gps": 10.0, "mag": 10.0, "baro": 5.0, "sonar": math.inf, "flow": 1.0}


class Measurement(NamedTuple):
    """A reading that waits for the end of its gate."""

    aid: Aid
    t_sample_s: float
    values: Sequence[float]
    variance: Sequence[float]


class Aid:
    """What the filter knows of one sensor, and what became of its readings.

    Args:
        name: of the sensor, as in a scenario.
        channels: (name of the bias states, error model, axes) in the order of the reading.
        rate_hz: rate of the sensor.
        mount: pose in the body.
    """

    def __init__(
        self, name: str, channels: Sequence[tuple[str, ErrorModel, int]], rate_hz: float, mount: Mount
    ) -> None:
        self.name = name
        self.arm: Vector = mount.position_m
        self.R_BS = mount_rotation(mount)
        self.down_B: Vector = (-self.R_BS[2], -self.R_BS[5], -self.R_BS[8])
        self.used = 0
        self.refused = 0
        self.t_sample_s = -math.inf
        self.refused_since_s: float | None = None
        self.variance: tuple[float, ...] = ()
        self.biases: dict[str, BiasPrior] = {}
        self.bias_rows: list[tuple[str, int]] = []
        for (channel, error, axes), floor in zip(channels, SIGMA_MIN[name], strict=True):
            if has_bias(error):
                self.biases[channel] = BiasPrior(axes, error.bias, error.bias_walk)
                self.bias_rows.append((channel, len(self.variance)))
            self.variance += (max(white_sigma(error, rate_hz), floor) ** 2,) * axes

    def accept(self, t_s: float, t_sample_s: float, values: Sequence[float], age_max_s: float) -> bool:
        """Whether a reading is new, in order, of a usable age and a number; counted as refused if not.

        A duplicate is not counted at all.

        Args:
            t_s, t_sample_s: instants of arrival and of the sample [s].
            values: the reading.
            age_max_s: oldest age that the estimator can use [s].
        """
        if t_sample_s == self.t_sample_s:
            return False
        if (
            t_sample_s > self.t_sample_s
            and 0.0 <= t_s - t_sample_s <= age_max_s
            and sum(map(abs, values)) < VALUE_MAX  # false if one is NaN
        ):
            self.t_sample_s = t_sample_s
            return True
        self.refused += 1
        return False

    def judge(self, passed: bool, t_s: float) -> None:
        """Count a reading that went through its gate, or did not."""
        if passed:
            self.used += 1
            self.refused_since_s = None
            return
        self.refused += 1
        if self.refused_since_s is None:
            self.refused_since_s = t_s

    def out_of_patience(self, t_s: float) -> bool:
        """Whether the sensor has been refused without a break for longer than one should insist."""
        return self.refused_since_s is not None and t_s - self.refused_since_s > PATIENCE_S[self.name]


def aids(sensors: Sensors) -> dict[str, Aid]:
    """Return the aiding sensors of a drone by name."""
    gps, mag, baro, sonar, flow = sensors.gps, sensors.mag, sensors.baro, sensors.sonar, sensors.flow
    found = (
        Aid(
            "gps",
            [("gps_position", gps.position_m, 3), ("gps_velocity", gps.velocity_m_s, 3)],
            gps.rate_hz,
            gps.mount,
        ),
        Aid("mag", [("mag", mag.field_ut, 3)], mag.rate_hz, mag.mount),
        Aid("baro", [("baro", baro.altitude_m, 1)], baro.rate_hz, baro.mount),
        Aid("sonar", [("sonar", sonar.range_m, 1)], sonar.rate_hz, sonar.mount),
        Aid("flow", [("flow", flow.velocity_m_s, 3)], flow.rate_hz, flow.mount),
    )
    return {aid.name: aid for aid in found}
