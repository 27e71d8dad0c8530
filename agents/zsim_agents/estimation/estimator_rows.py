"""What an estimator of many drones consists of: a row per drone in each array, and what stands in which column."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import portable
from zsim_agents.estimation.dead_reckoning import Reckoning
from zsim_agents.estimation.madgwick import Quaternion, Rotation, Vector

KINDS = ("imu", "gps", "mag", "baro", "sonar", "flow")
IMU, GPS, MAG, BARO, SONAR, FLOW = range(6)
SIZES = (6, 6, 3, 1, 1, 3)  # values of a reading

# Columns of `nominal`
T, P, V, Q, A, W, F = 0, 1, 4, 7, 11, 14, 17  # s; state as a Reckoning
GYRO_OFF, ACCEL_OFF, P_CORRECTED, V_CORRECTED = 20, 23, 26, 29  # biases taken off; what the filter put in, in all
FROM, V_BEFORE, SQUARE, LOST_VELOCITY, LOST_TURN = 32, 33, 36, 37, 38  # the interval since the last gate
START = 39  # s, first gate; not a number before
T_SAMPLE, REFUSED_SINCE = 40, 46  # s, of each kind: last reading; not a number while it is believed
NOMINAL_COLUMNS = 52

# Columns of `setting`
GRAVITY, BETA, PERIOD, COAST_AFTER, JOLT, AGE_MAX, SET_DOWN_YAW = range(7)
ACCEL_VARIANCE, GYRO_VARIANCE, TILT_DENSITY, LEVELLING = 7, 8, 9, 10
FIELD_W, IMU_TURN, IMU_ARM = 11, 14, 23
AID, AID_COLUMNS = 26, 22  # of each kind: variance (6), arm (3), R_BS (9), down in B (3), patience [s]
VARIANCE, ARM, TURN, DOWN, PATIENCE = 0, 6, 9, 18, 21
SETTING_COLUMNS = AID + len(KINDS) * AID_COLUMNS

# Columns of `fixed`
SIZE, HISTORY, ASIDE, WITH_ACCEL_BIAS, AIDING_BIASES, MAGNETOMETER, USES_FLOW = range(7)
BIAS, BIAS_COLUMNS = 7, 6  # of each kind, twice: first state of a channel's bias or -1, its row, its size
FIXED_COLUMNS = BIAS + len(KINDS) * BIAS_COLUMNS

# Columns of `tally`
RUNNING, HEADING_KNOWN, KEPT, NEWEST = range(4)  # the last two of the history, a ring
USED, REFUSED = 4, 10  # of each kind
TALLY_COLUMNS = 16

# Columns of a moment in `history`
MOMENT_Q, MOMENT_W, MOMENT_P_CORRECTED, MOMENT_V_CORRECTED, MOMENT_COLUMNS = 7, 11, 14, 17, 20  # after T, P, V

# Columns of a reading: drone, kind, instants of arrival and of the sample [s], values, and what else it says
DRONE, KIND, ARRIVED, SAMPLED, VALUE, EXTRA = 0, 1, 2, 3, 4, 10
READING_COLUMNS = 12

# Columns of an estimate, in the order of the message
YAW, COVARIANCE, YAW_SIGMA, GYRO_BIAS_B, ESTIMATE_COLUMNS = 10, 11, 47, 48, 51

Moment = tuple[float, Vector, Vector, Quaternion, Vector, Vector, Vector]
"""t [s], p, v, q, w, and the filter's corrections of p and v in all by then."""


class Rows(NamedTuple):
    """All that the estimators of N drones are; n is the size of the largest error state."""

    nominal: NDArray[np.float64]  # (N, NOMINAL_COLUMNS)
    tally: NDArray[np.int64]  # (N, TALLY_COLUMNS)
    covariance: NDArray[np.float64]  # (N, n, n)
    bias: NDArray[np.float64]  # (N, n), of the aiding sensors
    history: NDArray[np.float64]  # (N, moments, MOMENT_COLUMNS)
    setting: NDArray[np.float64]  # (N, SETTING_COLUMNS)
    fixed: NDArray[np.int64]  # (N, FIXED_COLUMNS)
    walk: NDArray[np.float64]  # (N, n), unit^2/s
    limits: NDArray[np.float64]  # (DOF_MAX + 1,), of the innovation gates by number of rows


@portable
def vector(row: np.ndarray, at: int) -> Vector:
    """Return three columns."""
    return float(row[at]), float(row[at + 1]), float(row[at + 2])


@portable
def put(row: np.ndarray, at: int, a: Vector) -> None:
    """Write three columns."""
    row[at], row[at + 1], row[at + 2] = a[0], a[1], a[2]


@portable
def add(row: np.ndarray, at: int, more: np.ndarray, first: int) -> None:
    """Add three places of an array to three columns."""
    for k in range(3):
        row[at + k] += more[first + k]


@portable
def quaternion(row: np.ndarray, at: int) -> Quaternion:
    """Return four columns."""
    return float(row[at]), float(row[at + 1]), float(row[at + 2]), float(row[at + 3])


@portable
def put_quaternion(row: np.ndarray, at: int, q: Quaternion) -> None:
    """Write four columns."""
    row[at], row[at + 1], row[at + 2], row[at + 3] = q[0], q[1], q[2], q[3]


@portable
def matrix(row: np.ndarray, at: int) -> Rotation:
    """Return nine columns."""
    return (
        float(row[at]), float(row[at + 1]), float(row[at + 2]),
        float(row[at + 3]), float(row[at + 4]), float(row[at + 5]),
        float(row[at + 6]), float(row[at + 7]), float(row[at + 8]),
    )  # fmt: skip


@portable
def reckoning(row: np.ndarray) -> Reckoning:
    """Return the nominal state."""
    return vector(row, P), vector(row, V), quaternion(row, Q), vector(row, A), vector(row, W), vector(row, F)


@portable
def put_reckoning(row: np.ndarray, state: Reckoning) -> None:
    """Set the nominal state."""
    put(row, P, state[0])
    put(row, V, state[1])
    put_quaternion(row, Q, state[2])
    put(row, A, state[3])
    put(row, W, state[4])
    put(row, F, state[5])


@portable
def moment(row: np.ndarray) -> Moment:
    """Return the present instant of the nominal state."""
    return (
        float(row[T]), vector(row, P), vector(row, V), quaternion(row, Q), vector(row, W),
        vector(row, P_CORRECTED), vector(row, V_CORRECTED),
    )  # fmt: skip


@portable
def put_moment(row: np.ndarray, m: Moment) -> None:
    """Write a moment of the history."""
    row[T] = m[0]
    put(row, P, m[1])
    put(row, V, m[2])
    put_quaternion(row, MOMENT_Q, m[3])
    put(row, MOMENT_W, m[4])
    put(row, MOMENT_P_CORRECTED, m[5])
    put(row, MOMENT_V_CORRECTED, m[6])


@portable
def moment_at(row: np.ndarray) -> Moment:
    """Return a moment of the history."""
    return (
        float(row[T]), vector(row, P), vector(row, V), quaternion(row, MOMENT_Q), vector(row, MOMENT_W),
        vector(row, MOMENT_P_CORRECTED), vector(row, MOMENT_V_CORRECTED),
    )  # fmt: skip
