"""An estimator of one's own: a plain Agent on the Runner, with fixed gains instead of a Kalman filter.

zsim world scenarios/step.yaml --set 'processes.expect=[my.drone1]' --duration 60
python examples/my_estimator.py drone1
"""

import argparse
import math
from typing import Any

from zsim.contract import keys, messages
from zsim.runtime.agent import Agent, Output
from zsim.runtime.runner import Runner
from zsim.scenario import scenario_file
from zsim.scenario.scenario import Scenario
from zsim.transport.connection import find_world

GPS_GAIN = 0.02  # of a fix, once that many have come
HEIGHT_GAIN, HEADING_GAIN = 0.1, 0.05  # of a barometer and of a magnetometer sample
GPS_SIGMA_M, HEIGHT_SIGMA_M, SPEED_SIGMA_M_S, YAW_SIGMA_RAD = 2.0, 0.03, 0.1, 0.02  # preset `paper`


class MyEstimator(Agent):
    """Position from GPS and the flow's velocity, height from the barometer, heading from gyro and magnetometer.

    The name is not `estimator.drone1`: `zsim run` then starts no estimator of its own for the drone.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, drone: str) -> None:
        super().__init__()
        self.name = f"my.{drone}"
        self.period_ns = info.gate_ns
        self.reads = (keys.sensors(drone),)
        self.gate_keys = (keys.status(drone),)
        self.counted = (drone,)
        self._key = keys.estimate(drone)
        self._dt = info.gate_ns / 1e9
        east, north, _ = scenario.environment.magnetic_field_ut
        self._bearing = math.atan2(north, east)
        self._p, self._v = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._yaw = self._rate = 0.0
        self._used = dict.fromkeys(keys.SENSORS, 0)

    def receive(self, key: str, message: Any) -> None:
        kind = keys.leaf(key)
        if kind in self._used:
            self._used[kind] += 1
            getattr(self, f"_on_{kind}", lambda m: None)(message)

    def _on_imu(self, m: messages.Imu) -> None:
        self._rate = m.gyro_rad_s[2]

    def _on_mag(self, m: messages.Mag) -> None:
        seen = self._bearing - math.atan2(m.field_ut[1], m.field_ut[0])  # as if level
        gain = max(HEADING_GAIN, 1 / self._used["mag"])
        self._yaw += gain * math.remainder(seen - self._yaw, math.tau)

    def _on_flow(self, m: messages.Flow) -> None:
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        forward, left, up = m.velocity_m_s
        self._v = [c * forward - s * left, s * forward + c * left, up]

    def _on_gps(self, m: messages.Gps) -> None:
        gain = self._gps_gain()
        for k in (0, 1):
            self._p[k] += gain * (m.position_m[k] - self._p[k])

    def _on_baro(self, m: messages.Baro) -> None:
        self._p[2] += max(HEIGHT_GAIN, 1 / self._used["baro"]) * (m.altitude_m - self._p[2])

    def _gps_gain(self) -> float:
        return max(GPS_GAIN, 1 / max(1, self._used["gps"]))

    def step(self, t_ns: int) -> list[Output]:
        self._yaw = math.remainder(self._yaw + self._rate * self._dt, math.tau)
        self._p = [p + v * self._dt for p, v in zip(self._p, self._v, strict=True)]
        message = messages.Estimate(
            t_ns=t_ns,
            seq=self.next_seq(self._key),
            position_m=(self._p[0], self._p[1], self._p[2]),
            velocity_m_s=(self._v[0], self._v[1], self._v[2]),
            orientation_wxyz=(math.cos(self._yaw / 2), 0.0, 0.0, math.sin(self._yaw / 2)),
            yaw_rad=self._yaw,
            covariance=self._covariance(),
            yaw_sigma_rad=YAW_SIGMA_RAD,
            gyro_bias_rad_s=(0.0, 0.0, 0.0),
            sensors={name: (count, 0) for name, count in self._used.items()},
            source=self.name,
        )
        return [Output(self._key, message)]

    def _covariance(self) -> tuple[float, ...]:
        """Return the variances of white fixes under the present gain, on the diagonal of a 6 x 6 matrix."""
        gain = self._gps_gain()
        level, up, speed = gain / (2 - gain) * GPS_SIGMA_M**2, HEIGHT_SIGMA_M**2, SPEED_SIGMA_M_S**2
        diagonal = (level, level, up, speed, speed, speed)
        return tuple(diagonal[i] if i == j else 0.0 for i in range(6) for j in range(6))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("drone")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    args = parser.parse_args()
    with find_world(args.connect, "zsim", wait_s=60.0, say=print) as (link, info):
        agent = MyEstimator(info, scenario_file.from_text(info.scenario), args.drone)
        print(f"{agent.name}: in run {info.run_id}", flush=True)
        print(f"{agent.name}: left, {Runner(link, info, agent, say=print).run()}")


if __name__ == "__main__":
    main()
