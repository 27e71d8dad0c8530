"""A recorded flight as arrays."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.contract.messages import Info
from zsim.contract.run_messages import Event
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
    """

    name: str
    t_ns: Times
    truth: Array
    status_t_ns: Times
    states: list[str]
    battery_percent: Array

    @property
    def p_W(self) -> Array:
        return self.truth[:, :3]

    @property
    def yaw(self) -> Array:
        """Return the heading (T,) [rad]."""
        w, x, y, z = self.truth[:, 6:10].T
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@dataclass
class ClusterStates:
    """What the controller of one cluster published: K instants, n names."""

    name: str
    drones: tuple[str, ...]
    names: tuple[str, ...] = ()
    t_ns: Times = field(default_factory=lambda: np.zeros(0, np.int64))
    value: Array = field(default_factory=lambda: np.zeros((0, 0)))
    desired: Array = field(default_factory=lambda: np.zeros((0, 0)))
    phases: list[str] = field(default_factory=list)


@dataclass
class RunParticipant:
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
        complete: the record was closed, not cut.
        wall_s: wall time from the first truth to the last, as they reached the recorder.
        undecoded: payloads that are not of the type of their key.
        damaged: chunks of the record that cannot be read.
    """

    info: Info | None
    scenario: Scenario | None
    tracks: list[Track]
    clusters: list[ClusterStates]
    events: list[Event]
    participants: list[RunParticipant]
    messages: int
    complete: bool
    wall_s: float
    undecoded: int = 0
    damaged: int = 0

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
