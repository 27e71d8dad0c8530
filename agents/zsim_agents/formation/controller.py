"""The cluster controller as an agent: turns estimates and drone states into velocity commands and a cluster state."""

import math
from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from struct import Struct as Packing
from typing import Any

import numpy as np

from zsim.contract import flight_messages, keys, messages, run_messages
from zsim.contract.flight_messages import cluster_view
from zsim.contract.run_messages import ControlAnswer, ControlRequest
from zsim.contract.snapshot import State
from zsim.errors import RunError
from zsim.math import elementary as el
from zsim.runtime.agent import Agent, Output
from zsim.scenario.scenario import Scenario
from zsim_agents.formation.engagement_setup import engagement_of
from zsim_agents.formation.flight_check import GateInput
from zsim_agents.formation.flight_plan import RequestError, read_request

REQUESTS_MAX = 1000  # maximum number of requests between two gates, e.g. in a pause; the next gate publishes them

_variances_of = itemgetter(0, 7, 14)  # variances of the position in the row-major 6 x 6 covariance


class Controller(Agent):
    """Flies one cluster.

    Raises:
        RunError: the scenario has no such cluster, or its plan is impossible.
    """

    def __init__(self, info: messages.Info, scenario: Scenario, cluster: str) -> None:
        super().__init__()
        if cluster not in {c.name for c in scenario.clusters}:
            known = ", ".join(c.name for c in scenario.clusters)
            allowed = f"must be one of {known}" if known else "the scenario has none"
            raise RunError(f"controller: cluster is {cluster!r}; {allowed}")
        spec = scenario.cluster(cluster)
        self.name = f"controller.{cluster}"
        self.period_ns = info.gate_ns
        self._set_drones(spec.drones)
        estimates, states = (tuple(map(key, spec.drones)) for key in (keys.estimate, keys.status))
        self._engagement = engagement_of(scenario, spec)
        self._grants = self._engagement.law.grants
        self.gate_keys = states + estimates
        self.reads = self.gate_keys + self._grants.keys
        self._state_key, self._view_key = keys.cluster_state(cluster), keys.cluster_view(cluster)
        self._control_key, self._request_key = keys.cluster_control(cluster), keys.cluster_request(cluster)
        self.writes, self.repeats = (self._state_key,), (self._request_key,)
        self._estimates = [_UNKNOWN] * len(spec.drones)
        table = np.empty((12, len(spec.drones)))  # arrays of the GateInput, overwritten at the next gate
        self._p_W, self._v_W, self._sigma_m = table[:9].reshape(3, len(spec.drones), 3)
        self._yaw, self._yaw_sigma, self._age_s = table[9:]
        self._fill = partial(Packing(f"={table.size}d").pack_into, table.data, 0)  # NumPy takes three times as long
        self._states: list[str] = ["landed"] * len(spec.drones)
        self._status_ns = [0] * len(spec.drones)
        self._last_state: flight_messages.ClusterState | None = None
        self._stepped_ns: int | None = None
        self._answered: list[tuple[ControlRequest, ControlAnswer]] = []  # requests since the last gate

    def receive(self, key: str, message: Any) -> None:
        index = self._index_of.get(key)
        if index is None:
            self._grants.put(key, message)
        elif type(message) is flight_messages.Estimate:
            former = self._estimates[index]
            if former is _UNKNOWN or message.t_ns >= former.t_ns:  # in real time, messages may arrive out of order
                self._estimates[index] = message
        elif message.t_ns >= self._status_ns[index]:  # as for estimates
            self._states[index], self._status_ns[index] = message.state, message.t_ns

    def step(self, t_ns: int) -> list[Output]:
        self._stepped_ns = self._grants.t_ns = t_ns
        output = self._engagement.step(self._gate(t_ns))
        self._reorder(self._engagement.drones)
        source, outputs = self.source, []
        answered, self._answered = self._answered, []
        for request, answer in answered:  # published at this gate: a re-run repeats these requests before it
            key, request_fields = self._request_key, (request.op, request.args, request.source)
            message = run_messages.ClusterRequest(
                t_ns, self.next_seq(key), *request_fields, answer.ok, answer.error, source
            )
            outputs.append(Output(key, message))
        for drone, mode in output.modes:
            key = keys.command(drone, "mode")
            outputs.append(Output(key, flight_messages.Mode(t_ns, self.next_seq(key), source, mode)))  # type: ignore[arg-type]
        for key, setpoint, estimate in zip(self._velocity_keys, output.setpoints, self._estimates, strict=True):
            if setpoint is not None and estimate is not _UNKNOWN:
                (x, y, z), (s, c) = setpoint.v_W, el.sin_cos(estimate.yaw_rad)
                velocity = (c * x + s * y, -s * x + c * y, z)  # forward, left, up
                message = flight_messages.Velocity(t_ns, self.next_seq(key), source, velocity, setpoint.yaw_rate)
                outputs.append(Output(key, message))
        self._last_state = state = flight_messages.ClusterState(
            t_ns=t_ns,
            seq=self.next_seq(self._state_key),
            phase=output.phase,  # type: ignore[arg-type]
            drones=self.drones,
            names=self._engagement.space.names,
            value=_finite(output.value),
            desired=_finite(output.desired),
            desired_rate=_finite(output.desired_rate),
            trajectory_t_s=output.trajectory_t_s,
            margin=output.margin if math.isfinite(output.margin) else 0.0,
            reason=output.reason,
            source=source,
            plan_step=output.plan_step,
        )
        outputs.append(Output(self._state_key, state))
        return outputs

    def _reorder(self, drones: Sequence[str]) -> None:
        """Assign the drones to rows in the order of the robots, which an assembly changes."""
        if drones == self.drones:
            return
        indices = [self.drones.index(drone) for drone in drones]
        self._estimates = [self._estimates[k] for k in indices]
        self._states = [self._states[k] for k in indices]
        self._status_ns = [self._status_ns[k] for k in indices]
        self._set_drones(drones)
        self._grants.reorder(drones)

    def _set_drones(self, drones: Sequence[str]) -> None:
        self.drones = tuple(drones)
        self._velocity_keys = [keys.command(drone, "velocity") for drone in drones]
        self._index_of = {key(drone): i for i, drone in enumerate(drones) for key in (keys.status, keys.estimate)}

    def _gate(self, t_ns: int) -> GateInput:
        positions, velocities, variances, yaws, yaw_sigmas, ages_s = [], [], [], [], [], []
        for e in self._estimates:
            positions += e.position_m
            velocities += e.velocity_m_s
            variances += _variances_of(e.covariance)
            yaws.append(e.yaw_rad)
            yaw_sigmas.append(e.yaw_sigma_rad)
            ages_s.append((t_ns - e.t_ns) * 1e-9 if e is not _UNKNOWN else math.inf)
        self._fill(*positions, *velocities, *variances, *yaws, *yaw_sigmas, *ages_s)
        np.sqrt(self._sigma_m, self._sigma_m)
        p_W = self._p_W
        if any(ages_s):  # old estimates are extrapolated at constant velocity; the age is infinite without an estimate
            p_W = p_W + self._v_W * np.where(np.isfinite(self._age_s), self._age_s, 0.0)[:, None]
        sigmas = self._sigma_m, self._yaw_sigma
        return GateInput(t_ns * 1e-9, p_W, self._yaw, self._v_W, *sigmas, self._age_s, tuple(self._states))

    def views(self, t_ns: int) -> list[Output]:
        if self._last_state is None:
            return []
        return [Output(self._view_key, cluster_view(self._last_state, t_ns, self.next_seq(self._view_key)))]

    def control_keys(self) -> tuple[str, ...]:
        return (self._control_key,)

    def control(self, key: str, request: ControlRequest) -> ControlAnswer:
        if len(self._answered) >= REQUESTS_MAX:
            error = f"{key}: {REQUESTS_MAX} requests are already waiting for the next gate; repeat the request after it"
            return ControlAnswer(ok=False, error=error)
        try:
            refusal = self._engagement.request(read_request(request.op, request.args))
            self._reorder(self._engagement.drones)
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
            "grants": self._grants.snapshot(),
        }

    def restore(self, state: State) -> None:
        self._reorder(state["engagement"]["drones"])
        pairs = zip(map(keys.estimate, self.drones), state["estimates"], strict=True)
        self._estimates = [messages.decode(key, payload) if payload else _UNKNOWN for key, payload in pairs]
        self._states, self._status_ns = state["states"], state["status_ns"]
        self._stepped_ns = state["stepped_ns"]
        self._grants.restore(state["grants"])
        gate = None if self._stepped_ns is None else self._gate(self._stepped_ns)
        self._engagement.restore(state["engagement"], gate)

    def warm_start_keys(self) -> tuple[str, ...]:
        return (self._state_key,)

    def warm_start(self, key: str, message: flight_messages.ClusterState) -> None:
        drones = message.drones if sorted(message.drones) == sorted(self.drones) else self.drones
        self._engagement.warm_start(message.phase, np.array(message.desired), message.plan_step, drones)
        self._reorder(self._engagement.drones)


_UNKNOWN = flight_messages.Estimate(
    t_ns=0,
    seq=0,
    position_m=(math.nan, math.nan, math.nan),
    velocity_m_s=(math.nan, math.nan, math.nan),
    orientation_wxyz=(1.0, 0.0, 0.0, 0.0),
    yaw_rad=math.nan,
    covariance=(math.inf,) * 36,
    yaw_sigma_rad=math.inf,
    gyro_bias_rad_s=(0.0, 0.0, 0.0),
    sensors={},
)


def _finite(values: np.ndarray) -> tuple[float, ...]:
    """Return values for a message, with non-finite ones replaced by zeros."""
    numbers = values.tolist()
    if not math.isfinite(sum(numbers)):  # a value is not finite, or the sum overflows
        numbers = [number if math.isfinite(number) else 0.0 for number in numbers]
    return tuple(numbers)
