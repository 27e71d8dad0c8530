"""External drones, as their drivers publish them: pose, state, and which commands they accept. No clock.

A driver publishes a pose for a gate now and then. Between two poses the drone moves on with its velocity, for as long
as a pose is trusted; then it stands still.
"""

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import DroneState, Status, Truth
from zsim.contract.state_rules import state_refusal
from zsim.scenario.external_bodies import POSE_AGE_MAX_NS, moved_on, truth_fault
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE, VEHICLE
from zsim_world.run_state import Saved


class Pose(NamedTuple):
    """A row of a fleet's states, and its gate [ns]."""

    t_ns: int
    row: NDArray[np.float64]  # (STATE.size + rotors of the drone,)


class ExternalDrones:
    """The external drones of a fleet; `i` counts them among all its drones.

    Args:
        fleet: follows their poses.
    """

    SAVED: ClassVar[Saved] = {"_poses": dict[int, Pose], "_statuses": dict[int, Status]}

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._index = {fleet.names[i]: i for i in fleet.external}
        self._poses: dict[int, Pose] = {}
        self._statuses: dict[int, Status] = {}

    def __contains__(self, i: int) -> bool:
        return i in self._fleet.external

    @property
    def names(self) -> frozenset[str]:
        return frozenset(self._index)

    def take(self, drone: str, message: Any, now_ns: int) -> str | None:
        """Take a message of a driver; return why it is refused.

        Args:
            message: a Truth or a Status; of others only the stamp is judged.
            now_ns: newest gate.
        """
        i = self._index[drone]
        if message.t_ns > now_ns:
            return f"t_ns is {message.t_ns}; must be <= {now_ns}, the newest gate"
        if isinstance(message, Truth):
            return self._take_truth(i, message, now_ns)
        if isinstance(message, Status):
            former = self._statuses.get(i)
            if former is not None and message.t_ns < former.t_ns:
                return f"t_ns is {message.t_ns}; must be >= {former.t_ns}, that of the last one"
            self._statuses[i] = message
        return None

    def _take_truth(self, i: int, truth: Truth, now_ns: int) -> str | None:
        former = self._poses.get(i)
        if former is not None and truth.t_ns < former.t_ns:
            return f"t_ns is {truth.t_ns}; must be >= {former.t_ns}, that of the last one"
        if now_ns - truth.t_ns > POSE_AGE_MAX_NS:
            return f"t_ns is {truth.t_ns}; must be >= {now_ns - POSE_AGE_MAX_NS}, {POSE_AGE_MAX_NS / 1e9:g} s ago"
        fault = truth_fault(truth, self._fleet.rotors[i])
        if fault is None:
            self._poses[i] = Pose(truth.t_ns, self._row(i, truth))
        return fault

    def _row(self, i: int, truth: Truth) -> NDArray[np.float64]:
        """Return a truth as a row of state: a unit quaternion, and rotor speeds within the drone's limits."""
        row = np.empty(STATE.size + len(truth.rotor_rad_s))
        row[STATE.p_WB : STATE.p_WB + 3], row[STATE.v_WB : STATE.v_WB + 3] = truth.position_m, truth.velocity_m_s
        row[STATE.q_WB : STATE.q_WB + 4] = np.divide(truth.orientation_wxyz, math.hypot(*truth.orientation_wxyz))
        row[STATE.w_WB_B : STATE.w_WB_B + 3] = truth.angular_velocity_rad_s
        most = self._fleet.bodies.vehicle.item(i, VEHICLE.rotor_max)
        row[STATE.size :] = np.clip(truth.rotor_rad_s, 0.0, most)
        return row

    def lead(self) -> None:
        """Move every drone whose driver has published a pose to the present, before the fleet advances."""
        now_ns = self._fleet.t_ns
        for i, pose in self._poses.items():
            self._fleet.lead(i, ahead(pose, now_ns))

    def status(self, i: int) -> Status | None:
        """Return the newest status, None before the first."""
        return self._statuses.get(i)

    def command_refusal(self, i: int, kind: str, message: Any) -> str | None:
        """Return why a command is not passed on to the driver, None if it is.

        A stop of the rotors always is; everything else depends on the state that the driver has published last.
        """
        name, asked = self._fleet.names[i], message.mode if kind == "mode" else "setpoint"
        if asked == "emergency":
            return None
        if i not in self._statuses:
            return f"{name} has no state: its driver has published none; start driver.{name}"
        state: DroneState = self._statuses[i].state
        refusal = state_refusal(name, state, asked)
        if refusal is None and kind == "rotors":
            refusal = self._fleet.rotors_fault(i, message.speed_rad_s)
        if refusal is None and kind == "attitude":
            refusal = self._fleet.orientation_fault(i, message.orientation_wxyz)
        return refusal


def ahead(pose: Pose, t_ns: int) -> NDArray[np.float64]:
    """Return the state at t_ns extrapolated from a pose: at constant velocity, at rest once the pose is too old."""
    row, age_ns = pose.row.copy(), t_ns - pose.t_ns
    p, v = slice(STATE.p_WB, STATE.p_WB + 3), slice(STATE.v_WB, STATE.v_WB + 3)
    row[p] = moved_on(row[p].tolist(), row[v].tolist(), age_ns)
    if age_ns >= POSE_AGE_MAX_NS:
        row[v] = row[STATE.w_WB_B : STATE.w_WB_B + 3] = 0.0
    return row
