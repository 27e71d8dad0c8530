"""An FMI 3 FMU that flies a drone to a point, at a speed proportional to the distance, but at most 1 m/s.

    python -m pythonfmu3 build -f examples/waypoint_fmu.py --handle-state --serialize-state
    zsim fmu Waypoint.fmu --drone drone1 --map p=estimate.position_m --map v=velocity_m_s --frame world

Its state can be saved and restored, so that a restarted process continues where its predecessor stopped.
"""

import math
from typing import Any

from pythonfmu3 import (
    Dimension,
    Float64,
    Fmi3Causality,
    Fmi3Slave,
    Fmi3Status,
    Fmi3StepResult,
    Fmi3Variability,
    Unit,
)


class Waypoint(Fmi3Slave):
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.time, self.gain = 0.0, 0.5
        self.vectors = {"p": [0.0, 0.0, 0.0], "goal": [2.0, 1.0, 3.0], "v": [0.0, 0.0, 0.0]}
        self.register_units([Unit("s", s=1), Unit("m", m=1), Unit("m/s", m=1, s=-1), Unit("1/s", s=-1)])
        tunable, parameter = Fmi3Variability.tunable, Fmi3Causality.parameter
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, unit="s"))
        self.register_variable(Float64("gain", causality=parameter, variability=tunable, unit="1/s"))
        self.vector("p", Fmi3Causality.input, Fmi3Variability.continuous, "m")
        self.vector("goal", parameter, tunable, "m")
        self.vector("v", Fmi3Causality.output, Fmi3Variability.continuous, "m/s")

    def vector(self, name: str, causality: Fmi3Causality, variability: Fmi3Variability, unit: str) -> None:
        own = {"causality": causality, "variability": variability, "unit": unit}
        access = {"getter": lambda: self.vectors[name], "setter": lambda v: self.vectors.update({name: list(v)})}
        self.register_variable(Float64(name, dimensions=[Dimension(start="3")], **own, **access))

    def do_step(self, current_time: float, step_size: float) -> Fmi3StepResult:
        wanted = [self.gain * (g - p) for g, p in zip(self.vectors["goal"], self.vectors["p"], strict=True)]
        share = 1.0 / max(1.0, math.hypot(*wanted))
        self.vectors["v"] = [share * v for v in wanted]
        self.time = current_time + step_size
        return Fmi3StepResult(status=Fmi3Status.ok)
