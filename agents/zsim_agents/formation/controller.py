"""The cluster controller as an agent: estimates and states in, velocity commands and cluster state out.

Order of this file: the agent, `receive`, `step`, requests, warm start, pure parts.
"""

import math
from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from struct import Struct as Packing
from typing import Any

import numpy as np

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.contract.snapshot import State
from zsim.contract.views import cluster_view
from zsim.errors import RunError
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.engagement_setup import engagement_of
from zsim_agents.formation.flight_check import GateInput, GateOutput
from zsim_agents.formation.flight_plan import RequestError, read_request

REQUESTS_MAX = 1000  # between two gates, as in a run that is paused; the next gate publishes them

variances_of = itemgetter(0, 7, 14)  # of the position, in the 6 x 6 covariance, row-major


class GateTable:
    """The numbers of a GateInput of n drones; they hold until the next gate fills them anew.

    Attributes:
        p_W, v_W, sigma_m: (n, 3); yaw, yaw_sigma, age_s: (n,).
        fill: takes all numbers of p_W, then of v_W, sigma_m, yaw, yaw_sigma and age_s, drone by drone.
    """

    def __init__(self, n: int) -> None:
        table = np.empty((12, n))
        self.p_W, self.v_W, self.sigma_m = table[:9].reshape(3, n, 3)
        self.yaw, self.yaw_sigma, self.age_s = table[9:]
        self.fill = partial(Packing(f"={table.size}d").pack_into, table.data, 0)  # numpy takes three times as long


class Controller(Agent):
    """Flies one cluster.

    Args:
        info: of the run.
        scenario: the resolved one that the info carries.
        cluster: name.

    Raises:
        RunError: the scenario has no such cluster, or its plan can never be flown.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, cluster: str) -> None:
        super().__init__()
        if cluster not in {c.name for c in scenario.clusters}:
            known = ", ".join(c.name for c in scenario.clusters) or "none"
            raise RunError(f"controller: cluster is {cluster!r}; must be one of {known}")
        spec = scenario.cluster(cluster)
        self.name = f"controller.{cluster}"
        self.period_ns = info.gate_ns
        self.drones = tuple(spec.drones)
        estimates = tuple(keys.estimate(drone) for drone in spec.drones)
        states = tuple(keys.status(drone) for drone in spec.drones)
        self.gate_keys = states + estimates
        self.reads = self.gate_keys
        self.writes = (keys.cluster_state(cluster),)
        self._state_key = keys.cluster_state(cluster)
        self._view_key = keys.cluster_view(cluster)
        self._control_key = keys.cluster_control(cluster)
        self._place = {key: i for of_drones in (states, estimates) for i, key in enumerate(of_drones)}
        self._velocity_keys = [keys.command(drone, "velocity") for drone in spec.drones]
        self._estimates = [_UNKNOWN] * len(spec.drones)
        self._table = GateTable(len(spec.drones))
        self._states: list[str] = ["landed"] * len(spec.drones)
        self._status_ns = [0] * len(spec.drones)
        self._engagement = engagement_of(scenario, spec)
        self._last_state: flight_messages.ClusterState | None = None
        self._stepped_ns: int | None = None
        self._request_key = keys.cluster_request(cluster)
        self.repeats = (self._request_key,)
        self._answered: list[tuple[ControlRequest, ControlAnswer]] = []  # since the last gate

    def receive(self, key: str, message: Any) -> None:
        place = self._place[key]
        if type(message) is flight_messages.Estimate:
            former = self._estimates[place]
            if former is _UNKNOWN or message.t_ns >= former.t_ns:  # in realtime an older one may come later
                self._estimates[place] = message
        elif message.t_ns >= self._status_ns[place]:  # over a link that jitters, too
            self._states[place], self._status_ns[place] = message.state, message.t_ns

    def step(self, t_ns: int) -> list[Output]:
        self._stepped_ns = t_ns
        output = self._engagement.step(self._gate(t_ns))
        commands = [*self._modes(t_ns, output), *self._velocities(t_ns, output)]
        return [*self._requests(t_ns), *commands, *self._state(t_ns, output)]

    def _requests(self, t_ns: int) -> list[Output]:
        """Return the requests since the last gate; a re-run of the record makes them before this one."""
        answered, self._answered = self._answered, []
        key, by = self._request_key, self.source
        return [
            Output(
                key,
                run_messages.ClusterRequest(
                    t_ns, self.next_seq(key), request.op, request.args, request.source, answer.ok, answer.error, by
                ),
            )
            for request, answer in answered
        ]

    def _gate(self, t_ns: int) -> GateInput:
        positions, velocities, variances, yaws, yaw_sigmas, ages_s = [], [], [], [], [], []
        for e in self._estimates:
            positions += e.position_m
            velocities += e.velocity_m_s
            variances += variances_of(e.covariance)
            yaws.append(e.yaw_rad)
            yaw_sigmas.append(e.yaw_sigma_rad)
            ages_s.append((t_ns - e.t_ns) * 1e-9 if e is not _UNKNOWN else math.inf)
        table = self._table
        table.fill(*positions, *velocities, *variances, *yaws, *yaw_sigmas, *ages_s)
        np.sqrt(table.sigma_m, table.sigma_m)
        p_W = ahead(table.p_W, table.v_W, table.age_s) if any(ages_s) else table.p_W
        sigmas = table.sigma_m, table.yaw_sigma
        return GateInput(t_ns * 1e-9, p_W, table.yaw, table.v_W, *sigmas, table.age_s, tuple(self._states))

    def _modes(self, t_ns: int, output: GateOutput) -> list[Output]:
        outputs = []
        for drone, mode in output.modes:
            key = keys.command(drone, "mode")
            outputs.append(Output(key, flight_messages.Mode(t_ns, self.next_seq(key), self.source, mode)))  # type: ignore[arg-type]
        return outputs

    def _velocities(self, t_ns: int, output: GateOutput) -> list[Output]:
        outputs, source = [], self.source
        for key, setpoint, estimate in zip(self._velocity_keys, output.setpoints, self._estimates, strict=True):
            if setpoint is None or estimate is _UNKNOWN:
                continue
            velocity = in_heading(setpoint.v_W, estimate.yaw_rad)
            message = flight_messages.Velocity(t_ns, self.next_seq(key), source, velocity, setpoint.yaw_rate)
            outputs.append(Output(key, message))
        return outputs

    def _state(self, t_ns: int, output: GateOutput) -> list[Output]:
        names = self._engagement.space.names
        value, desired = _finite(output.value), _finite(output.desired)
        state = flight_messages.ClusterState(
            t_ns=t_ns,
            seq=self.next_seq(self._state_key),
            phase=output.phase,  # type: ignore[arg-type]
            drones=self.drones,
            names=names,
            value=value,
            desired=desired,
            desired_rate=_finite(output.desired_rate),
            trajectory_t_s=output.trajectory_t_s,
            margin=output.margin if math.isfinite(output.margin) else 0.0,
            reason=output.reason,
            source=self.source,
            plan_step=output.plan_step,
        )
        self._last_state = state
        return [Output(self._state_key, state)]

    def views(self, t_ns: int) -> list[Output]:
        state = self._last_state
        if state is None:
            return []
        seq = self.next_seq(self._view_key)
        return [Output(self._view_key, cluster_view(state, t_ns, seq))]

    def control_keys(self) -> tuple[str, ...]:
        return (self._control_key,)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        if len(self._answered) >= REQUESTS_MAX:
            return ControlAnswer(ok=False, error=f"{key}: {REQUESTS_MAX} requests wait for the next gate; ask after it")
        try:
            refusal = self._engagement.request(read_request(request.op, request.args))
        except RequestError as error:
            refusal = str(error)
        answer = ControlAnswer(ok=refusal is None, error=refusal or "")
        self._answered.append((request, answer))
        return answer

    def repeat(self, key: str, message: run_messages.ClusterRequest) -> None:
        self.control(self._control_key, ControlRequest(message.op, message.args, message.source))

    def snapshot(self) -> State | None:
        engagement = self._engagement.snapshot()
        if engagement is None:
            return None
        return {
            "estimates": [None if e is _UNKNOWN else messages.encode(e) for e in self._estimates],
            "states": self._states,
            "status_ns": self._status_ns,
            "stepped_ns": self._stepped_ns,
            "engagement": engagement,
        }

    def restore(self, state: State) -> None:
        pairs = zip(self.gate_keys[len(self.drones) :], state["estimates"], strict=True)
        self._estimates = [messages.decode(key, payload) if payload else _UNKNOWN for key, payload in pairs]
        self._states, self._status_ns = state["states"], state["status_ns"]
        self._stepped_ns = state["stepped_ns"]
        gate = None if self._stepped_ns is None else self._gate(self._stepped_ns)
        self._engagement.restore(state["engagement"], gate)

    def warm_start_keys(self) -> tuple[str, ...]:
        return (self._state_key,)

    def warm_start(self, key: str, message: flight_messages.ClusterState) -> None:
        self._engagement.warm_start(message.phase, np.array(message.desired), message.plan_step)


_UNKNOWN = flight_messages.Estimate(
    0,
    0,
    (math.nan, math.nan, math.nan),
    (math.nan, math.nan, math.nan),
    (1.0, 0.0, 0.0, 0.0),
    math.nan,
    (math.inf,) * 36,
    math.inf,
    (0.0, 0.0, 0.0),
    {},
)


def in_heading(v_W: Sequence[float], yaw: float) -> tuple[float, float, float]:
    """Return a velocity of W in the heading frame: x forward, y left, z up."""
    c, s = math.cos(yaw), math.sin(yaw)
    return (c * v_W[0] + s * v_W[1], -s * v_W[0] + c * v_W[1], v_W[2])


def _finite(values: np.ndarray) -> tuple[float, ...]:
    """Return values for the wire, where nothing unknown may travel: zeros in its place."""
    numbers = values.tolist()
    if not math.isfinite(sum(numbers)):  # one of them is not, or they are too large for a sum
        numbers = [number if math.isfinite(number) else 0.0 for number in numbers]
    return tuple(numbers)


def ahead(p_W: np.ndarray, v_W: np.ndarray, age_s: np.ndarray) -> np.ndarray:
    """Return where drones are by now whose estimates are old, as behind a slow link: at constant velocity.

    Args:
        p_W, v_W: (n, 3) of the estimates.
        age_s: (n,); infinite where there is none.
    """
    return p_W + v_W * np.where(np.isfinite(age_s), age_s, 0.0)[:, None]
