"""The mathematics and phases of the MATLAB controller, run by GNU Octave, against those of the Python controller."""

import json
import math
from typing import Any

import numpy as np
import pytest
from octave import needs_octave, run

from zsim.scenario.scenario import Gains
from zsim_agents.formation.control_law import ProportionalLaw
from zsim_agents.formation.engagement import Engagement
from zsim_agents.formation.engagement_setup import gains_of
from zsim_agents.formation.flight_check import GateInput, GateOutput
from zsim_agents.formation.flight_plan import MoveTo, Order, Scheduled
from zsim_agents.formation.spaces.scenario_space import cluster_space

pytestmark = needs_octave

SPACE, GAINS = cluster_space(3), gains_of(Gains())
DRONES = ("drone1", "drone2", "drone3")
NEAR = 1e-9  # tolerance: both compute in doubles, but their libraries differ in the last bits
DT_S = 0.1
EQUATION_3 = {
    "x_c": 5, "y_c": -5, "z_c": 15, "roll": 0, "pitch": 0, "yaw": math.pi / 2,
    "phi_1": 0, "phi_2": 0, "phi_3": 0, "p": 4, "q": 4, "beta": math.pi / 4,
}  # fmt: skip
TURNED = {"x_c": 2.0, "yaw": -2.0, "roll": 0.2, "p": 5.0}
MODES = ("", "landed", "taking_off", "hovering", "flying", "landing", "emergency")


def random_maps(count: int) -> list[dict[str, Any]]:
    """Return robots with a well-defined cluster frame, their velocities, and their desired cluster states."""
    rng = np.random.default_rng(7)
    maps = []
    while len(maps) < count:
        p_W = rng.normal(0.0, 4.0, (3, 3))
        yaw = rng.uniform(-math.pi, math.pi, 3)
        c = SPACE.forward(p_W, yaw)
        if SPACE.spread(c) > 0.3 and abs(c[4]) < 1.4:
            maps.append(
                {
                    "p_W": p_W.tolist(),
                    "yaw": yaw.tolist(),
                    "v_W": rng.normal(0.0, 0.5, (3, 3)).tolist(),
                    "c_des": (c + rng.normal(0.0, 0.3, 12)).tolist(),
                    "c_dot_des": rng.normal(0.0, 0.1, 12).tolist(),
                    "integral": rng.normal(0.0, 0.05, 12).tolist(),
                    "dt_s": 0.02,
                }
            )
    return maps


class Air:
    """Three drones that follow velocity commands with a lag, and their noisy estimates.

    From 40 s to 42 s, the position of drone2 is lost, so that the formation holds and then continues.
    """

    def __init__(self) -> None:
        self._rng = np.random.default_rng(11)
        self._p_W = np.array([(0.0, 1.5, 0.0), (-1.5, -1.5, 0.0), (1.5, -1.5, 0.0)])
        self._v_W = np.zeros((3, 3))
        self._yaw = np.full(3, math.pi / 2)
        self._modes = [1, 1, 1]
        self._since_s = [0.0, 0.0, 0.0]
        self.t_s = 0.0

    def gate(self) -> dict[str, Any]:
        """Return the estimates of this gate."""
        sigma_m = np.full((3, 3), 2.0 if self.t_s < 3.0 else 0.3)
        if 40.0 <= self.t_s < 42.0:
            sigma_m[1] = 3.0
        return {
            "t_s": self.t_s,
            "p_W": (self._p_W + self._rng.normal(0.0, 0.02, (3, 3))).tolist(),
            "v_W": (self._v_W + self._rng.normal(0.0, 0.02, (3, 3))).tolist(),
            "yaw": (self._yaw + self._rng.normal(0.0, 0.005, 3)).tolist(),
            "sigma_m": sigma_m.tolist(),
            "age_s": [0.0, 0.0, 0.0],
            "modes": list(self._modes),
        }

    def fly(self, output: GateOutput) -> None:
        """Advance by DT_S, following the output."""
        self.t_s = round(self.t_s + DT_S, 9)
        for command in output.modes:
            self._switch(DRONES.index(command.drone), command.mode)
        for i, setpoint in enumerate(output.setpoints):
            wanted = np.array(setpoint.v_W) if setpoint is not None else np.zeros(3)
            self._v_W[i] += (wanted - self._v_W[i]) * 0.3
            self._yaw[i] += DT_S * (setpoint.yaw_rate if setpoint is not None else 0.0)
            if self._modes[i] in (2, 5) and self.t_s - self._since_s[i] > 2.0:
                self._modes[i] = 3 if self._modes[i] == 2 else 1
        self._p_W += DT_S * self._v_W

    def _switch(self, i: int, mode: str) -> None:
        self._modes[i] = 2 if mode == "takeoff" else 5
        self._since_s[i] = self.t_s


def flight() -> tuple[list[dict[str, Any]], list[GateOutput]]:
    """Fly the Python controller and return its inputs and outputs, gate by gate."""
    plan = [
        Scheduled(5.0, Order.TAKE_OFF),
        Scheduled(5.0, Order.ENGAGE),
        Scheduled(5.0, MoveTo(EQUATION_3)),
        Scheduled(60.0, MoveTo(TURNED)),
        Scheduled(85.0, Order.LAND),
    ]
    engagement, air = Engagement(SPACE, DRONES, GAINS, plan=plan), Air()
    gates, outputs = [], []
    while air.t_s < 92.0:
        gate = air.gate()
        arrays = {name: np.array(gate[name]) for name in ("p_W", "yaw", "v_W", "sigma_m", "age_s")}
        output = engagement.step(
            GateInput(t_s=gate["t_s"], **arrays, yaw_sigma=np.zeros(3), states=tuple(MODES[m] for m in gate["modes"]))
        )
        gates.append(gate)
        outputs.append(output)
        air.fly(output)
    return gates, outputs


def target(from_s: float, values: dict[str, float]) -> dict[str, Any]:
    """Return a target in the form of cluster_step, with None for every variable that it does not set."""
    named = [float(values[name]) if name in values else None for name in SPACE.names]
    return {"from_s": from_s, "values": named, "takeoff_s": 5.0, "land_s": 85.0, "over_s": math.nan}


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the cases, with the results of Python and of Octave."""
    maps = random_maps(200)
    gates, outputs = flight()
    targets = [target(0.0, EQUATION_3), target(60.0, TURNED)]
    path = tmp_path_factory.mktemp("octave") / "cases.json"
    path.write_text(json.dumps({"maps": maps, "flights": [{"gates": gates, "targets": targets}]}))
    return {"maps": maps, "outputs": outputs, "octave": json.loads(run(f"cluster_cases('{path}')"))}


def near(found: Any, wanted: Any) -> bool:
    return bool(np.allclose(np.array(found, float), np.array(wanted, float), rtol=NEAR, atol=NEAR))


def test_the_mathematics_agree_with_python(figures: dict[str, Any]) -> None:
    """The test covers both kinematics, both Jacobians, the condition number and the law, on random robots."""
    guarded = []
    for case, found in zip(figures["maps"], figures["octave"]["maps"], strict=True):
        p_W, yaw, v_W = (np.array(case[name]) for name in ("p_W", "yaw", "v_W"))
        c = SPACE.forward(p_W, yaw)
        J, J_inv = SPACE.jacobian(p_W, yaw), SPACE.inverse_jacobian(c)
        law = ProportionalLaw(SPACE, GAINS)
        law.integral = np.array(case["integral"])
        wanted = law.command(c, p_W, v_W, np.array(case["c_des"]), np.array(case["c_dot_des"]), case["dt_s"])
        assert found["sound"] is True
        assert near(found["c"], c)
        assert near(found["p_W"], p_W)
        assert near(found["yaw"], yaw)
        assert near(found["J"], J)
        assert near(found["J_inv"], J_inv)
        assert near(np.array(found["J"]) @ np.array(found["J_inv"]), np.eye(12))
        assert found["condition"] == pytest.approx(SPACE.condition(c), rel=NEAR)
        assert near(found["v_W"], wanted.v_W)
        assert near(found["yaw_rate"], wanted.yaw_rate)
        assert found["factor"] == pytest.approx(wanted.factor, rel=NEAR)
        assert near(found["integral"], law.integral)
        guarded.append((bool(wanted.guarded), wanted.factor < 1.0))
    assert set(guarded) == {(False, False), (False, True), (True, False), (True, True)}


def test_the_phases_agree_with_python(figures: dict[str, Any]) -> None:
    """The flight has a take-off, an engagement, two targets, a lost position and a landing."""
    (found,) = figures["octave"]["flights"]
    for wanted, step in zip(figures["outputs"], found, strict=True):
        assert step["phase"] == wanted.phase
        sent = {command.drone: command.mode for command in wanted.modes}
        assert [("", "takeoff", "land")[round(m)] for m in step["modes"]] == [sent.get(d, "") for d in DRONES]
        assert step["commanded"] == [setpoint is not None for setpoint in wanted.setpoints]
        for i, setpoint in enumerate(wanted.setpoints):
            if setpoint is not None:
                assert near(step["v_W"][i], setpoint.v_W)
                assert near(step["yaw_rate"][i], setpoint.yaw_rate)
        assert near(step["value"], wanted.value)
        assert near(step["desired"], wanted.desired)
        assert near(step["desired_rate"], wanted.desired_rate)
        assert near(step["margin"], wanted.margin)
        assert step["factor"] == pytest.approx(wanted.factor, rel=NEAR)


def test_the_flight_passes_through_every_phase(figures: dict[str, Any]) -> None:
    phases = list(dict.fromkeys(output.phase for output in figures["outputs"]))
    assert phases == ["idle", "taking_off", "assembling", "engaged", "held", "landing"]
    assert figures["outputs"][-1].phase == "idle"
