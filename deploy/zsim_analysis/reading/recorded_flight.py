"""A flight as arrays: what was recorded of its drones, its formations, its events and its processes. Pure."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.contract.messages import Info
from zsim.contract.run_messages import ClusterRequest, Event
from zsim.record import Completeness
from zsim.scenario.scenario import Scenario

Array = NDArray[np.float64]
Times = NDArray[np.int64]

TRUTH_WIDTH = 13  # position, velocity, orientation, angular velocity


@dataclass
class Track:
    """One drone as it truly flew, W and B as in the contract.

    Attributes:
        t_ns: (T,) instants of truth, ascending, without doubles.
        truth: (T, 13) position [m], velocity [m/s], orientation w first, angular velocity [rad/s; B].
        status_t_ns: (S,) instants of status.
        states: (S,) state of the firmware by name.
        battery_percent: (S,).
        external: whether it is the pose that a driver has published: the best that it had, not the truth.
    """

    name: str
    t_ns: Times
    truth: Array
    status_t_ns: Times
    states: list[str]
    battery_percent: Array
    external: bool = False

    @property
    def p_W(self) -> Array:
        return self.truth[:, :3]

    @property
    def yaw(self) -> Array:
        """Return the heading (T,) [rad]."""
        w, x, y, z = self.truth[:, 6:10].T
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    @property
    def yaw_rate(self) -> Array:
        """Return the rate (T,) [rad/s] at which it turns about the vertical."""
        w, x, y, z = self.truth[:, 6:10].T
        up_B = np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
        return np.sum(up_B * self.truth[:, 10:13], axis=1)


@dataclass
class DroneEstimates:
    """What the estimator of one drone published.

    Attributes:
        t_ns: (E,) ascending, without doubles.
        p_W: (E, 3) position [m].
        v_W: (E, 3) velocity [m/s].
        yaw, yaw_sigma: (E,) heading and its standard deviation [rad].
        covariance: (E, 6, 6) of position and velocity [SI].
    """

    t_ns: Times
    p_W: Array
    v_W: Array
    yaw: Array
    yaw_sigma: Array
    covariance: Array


@dataclass
class VelocityCommands:
    """The velocities that one drone was to fly, sent by those who flew it.

    Attributes:
        t_ns: (C,) ascending, without doubles.
        velocity: (C, 3) [m/s] as sent.
        yaw_rate: (C,) [rad/s].
        in_W: (C,) the velocity is in W; else x is forward and y left by the sender's idea of the heading.
    """

    t_ns: Times
    velocity: Array
    yaw_rate: Array
    in_W: NDArray[np.bool_]


@dataclass
class ClusterStates:
    """What the controller of one cluster published: K instants, n names.

    Attributes:
        reasons: (K,) why it waits or is held.
        requests: that it took, from others than its plan.
    """

    name: str
    drones: tuple[str, ...]
    names: tuple[str, ...] = ()
    t_ns: Times = field(default_factory=lambda: np.zeros(0, np.int64))
    value: Array = field(default_factory=lambda: np.zeros((0, 0)))
    desired: Array = field(default_factory=lambda: np.zeros((0, 0)))
    phases: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    requests: list[ClusterRequest] = field(default_factory=list)


@dataclass
class RecordedProcess:
    """A process that joined."""

    name: str
    role: str = ""
    host: str = ""
    pid: int = 0
    version: str = ""
    fingerprint: str = ""
    incarnations: int = 0
    left: str = ""


@dataclass
class RecordedFlight:
    """Everything of a record that a report needs; what is not on record is None or empty.

    Attributes:
        messages: on record, all keys.
        completeness: of the record.
        wall_s: wall time from the first truth to the last, as they reached the recorder.
        began_ns: wall time of the first truth, nanoseconds since 1970; None where nothing flew.
        undecoded: payloads that are not of the type of their key.
        estimates, commands: by drone; empty where they were not asked for.
    """

    info: Info | None
    scenario: Scenario | None
    tracks: list[Track]
    clusters: list[ClusterStates]
    events: list[Event]
    processes: list[RecordedProcess]
    messages: int
    completeness: Completeness
    wall_s: float
    undecoded: int = 0
    began_ns: int | None = None
    estimates: dict[str, DroneEstimates] = field(default_factory=dict)
    commands: dict[str, VelocityCommands] = field(default_factory=dict)

    @property
    def end(self) -> dict[str, Any] | None:
        """Return the data of the world's last `end` event, None if there is none on record."""
        return next((event.data for event in reversed(self.events) if event.kind == "end"), None)

    @property
    def replay_of(self) -> str:
        """Return the run_id of the run that was played back, "" for a flight."""
        return self.info.replay_of if self.info else ""

    @property
    def first_ns(self) -> int:
        """Return the first instant of truth."""
        return min((int(track.t_ns[0]) for track in self.tracks if len(track.t_ns)), default=0)

    @property
    def last_ns(self) -> int:
        """Return the last instant of truth."""
        return max((int(track.t_ns[-1]) for track in self.tracks if len(track.t_ns)), default=0)
