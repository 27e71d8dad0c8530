"""What a driver knows of its aircraft, whichever wire it came by."""

from typing import NamedTuple

from zsim.contract.flight_messages import DroneState
from zsim.math.rotation import LEVEL, Quaternion, Vector

AIRBORNE: tuple[DroneState, ...] = ("hovering", "flying")
STANDING: tuple[DroneState, ...] = ("landed", "emergency")  # states in which no rotor turns
STILL: Vector = (0.0, 0.0, 0.0)


class AircraftPose(NamedTuple):
    """Where an aircraft is, and how it moves.

    Attributes:
        taken_ns: when, by the clock of this process.
        position_m, velocity_m_s: of its centre of mass [W].
        q_WB: its attitude.
        w_WB_B: its rate [rad/s; B].
    """

    taken_ns: int
    position_m: Vector
    velocity_m_s: Vector = STILL
    q_WB: Quaternion = LEVEL
    w_WB_B: Vector = STILL


class Reading(NamedTuple):
    """A measurement of one of its sensors.

    Attributes:
        sensor: name of the sensor, the last part of its key.
        taken_ns: when, by the clock of this process.
        values: the fields of its message behind `t_sample_ns`.
    """

    sensor: str
    taken_ns: int
    values: tuple


class AircraftState(NamedTuple):
    """What is shown of an aircraft.

    Attributes:
        state: as the contract names it.
        battery_percent: of its charge.
        pose: newest; None while nothing is known of it.
        received_ns: when something of it arrived last, by the clock of this process; None for never.
    """

    state: DroneState = "landed"
    battery_percent: float = 0.0
    pose: AircraftPose | None = None
    received_ns: int | None = None
