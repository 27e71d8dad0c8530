"""External drones as published by their drivers: pose, state and accepted commands. No clock.

A driver publishes a pose from time to time. Between poses the drone is extrapolated with its velocity until the pose is
too old; then it stands still.
"""

from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.flight_messages import (
    POSE_AGE_MAX_NS,
    DroneState,
    Status,
    Truth,
    moved_on,
    state_refusal,
    truth_fault,
)
from zsim.math import elementary as el
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE, VEHICLE
from zsim_world.run_state import Saved


class Pose(NamedTuple):
    """A row of a fleet's states, and its gate [ns]."""

    t_ns: int
    row: NDArray[np.float64]  # (STATE.size + rotors of the drone,)


class ExternalDrones:
    """The external drones of a fleet, which follow published poses; `i` is the index of a drone in the fleet."""

    SAVED: ClassVar[Saved] = {"_poses": dict[int, Pose], "_statuses": dict[int, Status]}

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._index = {fleet.names[i]: i for i in fleet.external}
        self.names = frozenset(self._index)
        self._poses: dict[int, Pose] = {}
        self._statuses: dict[int, Status] = {}

    def __contains__(self, i: int) -> bool:
        return i in self._fleet.external

    def take(self, drone: str, message: Any, now_ns: int) -> str | None:
        """Handle a Truth or Status of a driver; return why it is refused, or None.

        `now_ns` is the newest gate. Of other messages only the stamp is checked.
        """
        i, t_ns = self._index[drone], message.t_ns
        former = self._poses.get(i) if isinstance(message, Truth) else self._statuses.get(i)
        if t_ns > now_ns:
            return f"t_ns is {t_ns}; must be <= {now_ns}, the newest gate"
        if isinstance(message, Truth | Status) and former is not None and t_ns < former.t_ns:
            return f"t_ns is {t_ns}; must be >= {former.t_ns}, that of the last one"
        if isinstance(message, Status):
            self._statuses[i] = message
        if not isinstance(message, Truth):
            return None
        if now_ns - t_ns > POSE_AGE_MAX_NS:
            return f"t_ns is {t_ns}; must be >= {now_ns - POSE_AGE_MAX_NS}, {POSE_AGE_MAX_NS / 1e9:g} s ago"
        if fault := truth_fault(message, self._fleet.rotors[i]):
            return fault
        row = np.empty(STATE.size + len(message.rotor_rad_s))
        row[STATE.p_WB : STATE.p_WB + 3], row[STATE.v_WB : STATE.v_WB + 3] = message.position_m, message.velocity_m_s
        length = el.length(message.orientation_wxyz)
        row[STATE.q_WB : STATE.q_WB + 4] = np.divide(message.orientation_wxyz, length)
        row[STATE.w_WB_B : STATE.w_WB_B + 3] = message.angular_velocity_rad_s
        most = self._fleet.bodies.vehicle.item(i, VEHICLE.rotor_max)
        row[STATE.size :] = np.clip(message.rotor_rad_s, 0.0, most)
        self._poses[i] = Pose(t_ns, row)
        return None

    def lead(self) -> None:
        """Extrapolate every drone whose driver has published a pose to the present, before the fleet advances.

        The velocity is constant, and zero once the pose is too old.
        """
        p, v = slice(STATE.p_WB, STATE.p_WB + 3), slice(STATE.v_WB, STATE.v_WB + 3)
        for i, pose in self._poses.items():
            row, age_ns = pose.row.copy(), self._fleet.t_ns - pose.t_ns
            row[p] = moved_on(row[p].tolist(), row[v].tolist(), age_ns)
            if age_ns >= POSE_AGE_MAX_NS:
                row[v] = row[STATE.w_WB_B : STATE.w_WB_B + 3] = 0.0
            self._fleet.lead(i, row)

    def status(self, i: int) -> Status | None:
        """Return the newest status, None before the first."""
        return self._statuses.get(i)

    def command_refusal(self, i: int, kind: str, message: Any) -> str | None:
        """Return why a command is not passed on to the driver, None if it is.

        Stopping the rotors is always passed on; other commands depend on the newest state published by the driver.
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
