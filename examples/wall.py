"""A control law that keeps a formation off an unmapped wall, using the `range` sensors of its drones.

zsim run examples/wall.yaml
python examples/wall.py

Each horizontal beam limits how fast the formation may approach what the beam hits: v . u <= a (r - keep), where r is
the range along the beam's direction u. If r >= keep initially, it remains so: a control barrier function of first order
(Ames, Xu, Grizzle and Tabuada, Control barrier function based quadratic programs for safety critical systems, IEEE
Trans. Automatic Control 62(8), 2017).
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

import zsim
from zsim.sensors.scanner import Range
from zsim_agents.formation.spaces.cluster_space import Array

OLD_NS = 500_000_000  # older measurements are ignored
TURNED = {"front": 0.0, "left": np.pi / 2, "back": np.pi, "right": -np.pi / 2}  # rad, from the drone's heading


class OffTheWall(zsim.ControlLaw):
    """The proportional law, with the approach speed limited by the beams; stateless."""

    class Parameters(zsim.Parameters):
        keep_m: Annotated[float, Meta(gt=0, le=10)] = 2.0
        approach_1_s: Annotated[float, Meta(gt=0, le=2)] = 0.5

    parameters: Parameters

    def rates(self, c: Array, p_W: Array, v_W: Array, c_des: Array, c_dot_des: Array) -> Array:
        c_dot = c_dot_des + self.gains.k_1_s * self.space.difference(c_des, c)
        centre = [self.space.index("x_c"), self.space.index("y_c")]
        _, yaw = self.space.inverse(c)
        for heading, sample in zip(yaw, self.samples("range", Range), strict=True):
            if sample is None or self.now_ns - sample.t_sample_ns > OLD_NS:
                continue
            for beam, range_m in zip(sample.beams, sample.ranges_m, strict=True):
                if beam in TURNED and range_m > 0.0:  # 0 means that there was no echo
                    u_W = np.array([np.cos(heading + TURNED[beam]), np.sin(heading + TURNED[beam])])
                    most = self.parameters.approach_1_s * (range_m - self.parameters.keep_m)
                    c_dot[centre] -= max(float(u_W @ c_dot[centre]) - most, 0.0) * u_W
        return self.space.motion(c, c_dot)


if __name__ == "__main__":
    run = zsim.run(Path(__file__).with_suffix(".yaml"), set={"clusters.main.law_parameters.keep_m": 3.0})
    for drone, distance_m in run.summary.obstacle_distance_m.items():
        print(f"{drone} came within {distance_m:.2f} m of the wall")
