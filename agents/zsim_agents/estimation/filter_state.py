"""The state of the estimators of N drones: arrays with one row per drone, and their columns.

Compiled code reads the columns as constants. A sensor's number is its index in `zsim.contract.keys.SENSORS`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.keys import SENSORS
from zsim.math.compiled import Field, columns, inlined
from zsim.math.rotation import Matrix, Quaternion, Vector

Array = np.ndarray
IMU, GPS, MAG, BARO, SONAR, FLOW = (SENSORS.index(name) for name in ("imu", "gps", "mag", "baro", "sonar", "flow"))
SIZES = (6, 6, 3, 1, 1, 3)  # number of values in a reading of each sensor
VALUES_MAX = max(SIZES)
CHANNELS = 4  # maximum number of biases per sensor: two per channel, a constant or random walk and a Gauss-Markov one

_MOMENT_FIELDS = (
    Field("t", "s"),
    Field("p_WB", "m", 3),
    Field("v_WB", "m/s", 3),
    Field("q_WB", "1", 4),
    Field("w_WB_B", "rad/s", 3),  # from the last IMU sample, minus the bias
    Field("p_corrected", "m", 3),  # sum of the filter's corrections
    Field("v_corrected", "m/s", 3),  # likewise
)
MOMENT = columns("Moment", _MOMENT_FIELDS)
NOMINAL = columns(  # starts with the fields of a moment, so that one function reads both
    "Nominal",
    (
        *_MOMENT_FIELDS,
        Field("a_WB", "m/s^2", 3),
        Field("f_B", "m/s^2", 3),  # from the last IMU sample, minus the bias
        Field("gyro_bias", "rad/s", 3),
        Field("accel_bias", "m/s^2", 3),
        Field("t_start", "s"),  # start of the interval since the last gate, which the next four fields describe
        Field("v_start", "m/s", 3),
        Field("dt_squared", "s^2"),  # sum of the squared times between IMU samples
        Field("lost_velocity", "m^2/s^2"),  # variance added for missing samples and jolts
        Field("lost_turn", "rad^2"),  # variance added for missing samples
        Field("t_first_gate", "s"),  # NaN before the first gate
        Field("t_sample", "s", len(SENSORS)),  # time of each sensor's last reading
        Field("refused_since", "s", len(SENSORS)),  # NaN while a sensor is trusted
    ),
)

CLONE = columns(  # past position and velocity whose errors are in the error state, for late readings
    "Clone",
    (
        Field("t", "s"),  # NaN for an unused clone
        Field("p_corrected", "m", 3),  # sum of the corrections up to t
        Field("v_corrected", "m/s", 3),
    ),
)
CLONED = 6  # number of states of a clone: copies of the first states, position and velocity

SENSOR = columns(  # settings of a sensor
    "Sensor",
    (
        Field("variance", "unit^2", VALUES_MAX),
        Field("p_BS", "m", 3),
        Field("R_BS", "1", 9),
        Field("down_B", "1", 3),
        Field("patience", "s"),
        Field("correlated", "unit^2"),  # variance of the GPS position's Gauss-Markov process
    ),
)

SETTING = columns(
    "Setting",
    (
        Field("gravity", "m/s^2"),
        Field("beta", "rad/s"),  # Madgwick's gain
        Field("period", "s"),  # sampling period of the IMU
        Field("coast_after", "s"),
        Field("jolt", "m/s^2"),
        Field("age_max", "s"),  # maximum age of a reading
        Field("set_down_yaw", "rad"),
        Field("accel_variance", "m^2/s^4"),
        Field("gyro_variance", "rad^2/s^2"),
        Field("tilt_density", "rad^2/s"),
        Field("levelling", "s"),
        Field("clone_every", "s"),
        Field("field_W", "uT", 3),
        Field("floor", "m"),  # z of the surface under the start, to which the sonar measures the range
        Field("sensors", "1", len(SENSORS) * SENSOR.size),
    ),
)

BIAS = columns("Bias", (Field("state", "1"), Field("row", "1"), Field("axes", "1")))  # state is -1 for no bias

LAYOUT = columns(
    "Layout",
    (
        Field("states", "1"),  # size of the error state, clones included
        Field("clones", "1"),
        Field("first_clone", "1"),  # index of the first clone's first state; clones are the last states
        Field("history", "1"),  # number of entries of the history's ring
        Field("imu_displaced", "1"),  # whether the IMU is rotated or away from the centre of mass
        Field("accel_bias", "1"),  # whether an accelerometer bias is estimated
        Field("aiding_biases", "1"),  # whether there are biases of aiding sensors, or clones
        Field("correlated", "1"),  # whether any bias is a Gauss-Markov process
        Field("magnetometer", "1"),  # whether the magnetometer is used
        Field("compass", "1"),  # whether a magnetometer reading can initialise the heading
        Field("flow", "1"),  # whether optical flow is used
        Field("biases", "1", len(SENSORS) * CHANNELS * BIAS.size),
    ),
)

COUNT = columns(
    "Count",
    (
        Field("running", "1"),  # 0 or 1, like the next field
        Field("heading_known", "1"),
        Field("kept", "1"),  # number of history entries in use
        Field("newest", "1"),  # index of the newest history entry
        Field("used", "1", len(SENSORS)),  # used readings by sensor
        Field("refused", "1", len(SENSORS)),
        Field("sightings_used", "1"),
        Field("sightings_refused", "1"),
    ),
)

READING = columns(
    "Reading",
    (
        Field("drone", "1"),
        Field("sensor", "1"),
        Field("t_arrival", "s"),
        Field("t_sample", "s"),
        Field("values", "unit", VALUES_MAX),
        Field("extra", "1", 2),  # GPS: sigma [m], fix; sonar: valid; flow: quality
    ),
)

ESTIMATE = columns(
    "Estimate",
    (
        Field("p_WB", "m", 3),
        Field("v_WB", "m/s", 3),
        Field("q_WB", "1", 4),
        Field("yaw", "rad"),
        Field("covariance", "SI", 36),
        Field("yaw_sigma", "rad"),
        Field("gyro_bias", "rad/s", 3),
    ),
)

Reckoning = tuple[Vector, Vector, Quaternion, Vector, Vector, Vector]
"""p_WB [m], v_WB [m/s], q_WB, a_WB [m/s^2; W]; rate [rad/s] and specific force [m/s^2] in B, bias-free."""
Moment = tuple[float, Vector, Vector, Quaternion, Vector, Vector, Vector]
"""t [s], p, v, q, w, and the sums of the filter's corrections of p and v up to t."""


class Rows(NamedTuple):
    """All data of the estimators of N drones; n is the size of the largest error state."""

    nominal: NDArray[np.float64]  # (N, NOMINAL.size)
    counts: NDArray[np.int64]  # (N, COUNT.size)
    covariance: NDArray[np.float64]  # (N, n, n), covariance of the error state
    bias: NDArray[np.float64]  # (N, n), biases of aiding sensors, and the corrections of clones since their creation
    history: NDArray[np.float64]  # (N, entries, MOMENT.size), a ring of past gates
    clones: NDArray[np.float64]  # (N, maximum number of clones of a drone, CLONE.size)
    setting: NDArray[np.float64]  # (N, SETTING.size)
    layout: NDArray[np.int64]  # (N, LAYOUT.size)
    walk: NDArray[np.float64]  # (N, n), random walks of biases [unit^2/s]
    decay: NDArray[np.float64]  # (N, n), decay of Gauss-Markov biases [1/s]; zero elsewhere
    limits: NDArray[np.float64]  # (7,), limits of the innovation gates by number of rows
    joint: NDArray[np.float64]  # (N n, N n), joint covariance of all drones; (0, 0) for separate filters
    sighted: NDArray[np.float64]  # (N, N), time of the last used sighting between two drones [s]; (0, 0) as above


STATES = (
    "nominal",
    "counts",
    "covariance",
    "bias",
    "history",
    "clones",
    "joint",
    "sighted",
)  # the other fields are settings


@inlined
def vector(row: Array, at: int) -> Vector:
    return float(row[at]), float(row[at + 1]), float(row[at + 2])


@inlined
def put(row: Array, at: int, a: Vector) -> None:
    row[at], row[at + 1], row[at + 2] = a[0], a[1], a[2]


@inlined
def increase(row: Array, at: int, error: Array, first: int) -> None:
    for k in range(3):
        row[at + k] += error[first + k]


@inlined
def quaternion(row: Array, at: int) -> Quaternion:
    return float(row[at]), float(row[at + 1]), float(row[at + 2]), float(row[at + 3])


@inlined
def put_quaternion(row: Array, at: int, q: Quaternion) -> None:
    row[at], row[at + 1], row[at + 2], row[at + 3] = q[0], q[1], q[2], q[3]


@inlined
def matrix_at(row: Array, at: int) -> Matrix:
    return vector(row, at), vector(row, at + 3), vector(row, at + 6)


@inlined
def reckoning(row: Array) -> Reckoning:
    return (
        vector(row, NOMINAL.p_WB), vector(row, NOMINAL.v_WB), quaternion(row, NOMINAL.q_WB),
        vector(row, NOMINAL.a_WB), vector(row, NOMINAL.w_WB_B), vector(row, NOMINAL.f_B),
    )  # fmt: skip


@inlined
def put_reckoning(row: Array, state: Reckoning) -> None:
    put(row, NOMINAL.p_WB, state[0])
    put(row, NOMINAL.v_WB, state[1])
    put_quaternion(row, NOMINAL.q_WB, state[2])
    put(row, NOMINAL.a_WB, state[3])
    put(row, NOMINAL.w_WB_B, state[4])
    put(row, NOMINAL.f_B, state[5])


@inlined
def put_moment(row: Array, m: Moment) -> None:
    row[MOMENT.t] = m[0]
    put(row, MOMENT.p_WB, m[1])
    put(row, MOMENT.v_WB, m[2])
    put_quaternion(row, MOMENT.q_WB, m[3])
    put(row, MOMENT.w_WB_B, m[4])
    put(row, MOMENT.p_corrected, m[5])
    put(row, MOMENT.v_corrected, m[6])


@inlined
def moment(row: Array) -> Moment:
    """Return a moment of the history, or the present moment from a nominal row."""
    return (
        float(row[MOMENT.t]), vector(row, MOMENT.p_WB), vector(row, MOMENT.v_WB), quaternion(row, MOMENT.q_WB),
        vector(row, MOMENT.w_WB_B), vector(row, MOMENT.p_corrected), vector(row, MOMENT.v_corrected),
    )  # fmt: skip
