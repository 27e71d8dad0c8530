"""The interface of estimators: one object per drone receives its sensor readings and returns an estimate at every gate.

A scenario selects the estimator by `estimation: {algorithm: …}`: `ekf`, this package's default; `paper`; or
`package.module:Class`, a user's class with the methods of `DroneEstimator`. Such a class sees only plain objects:
sections of the scenario, messages of the contract, and numbers. For the search path of its module, see
`zsim.schema.plugin`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from zsim.contract.snapshot import State, checked
from zsim.errors import UserCodeError
from zsim.math import elementary as el
from zsim.scenario.scenario import ESTIMATORS, Drone, Environment, Estimation
from zsim.schema import plugin
from zsim.schema.checker import show

CLASSES = {"paper": "zsim_agents.estimation.paper_estimator:PaperEstimator"}
SIZES = {"position_m": 3, "velocity_m_s": 3, "orientation_wxyz": 4, "covariance": 36, "gyro_bias_rad_s": 3}
STATES = 6  # rows of the covariance
NORM_TOLERANCE = 1e-3  # maximum error of a quaternion's norm; design choice: far above rounding in single precision
Numbers = Sequence[float] | NDArray[np.float64]


class StateEstimate(NamedTuple):
    """State of a drone at one time."""

    position_m: Numbers  # p_WB
    velocity_m_s: Numbers  # v_WB, in W
    orientation_wxyz: Numbers  # q_WB
    yaw_rad: float
    covariance: Numbers  # covariance of position and velocity, 6 x 6, row-major, SI units
    yaw_sigma_rad: float
    gyro_bias_rad_s: Numbers = (0.0, 0.0, 0.0)  # in B
    sensors: Mapping[str, tuple[int, int]] = {}  # numbers of used and refused readings since the start, by sensor


class DroneEstimator(Protocol):
    """Estimates the state of one drone.

    A class may have three more methods, which let a process take over from one that died. `snapshot(self)`
    returns the state of the estimator as a map of plain values and arrays (`zsim.contract.snapshot.State`), and
    `restore(self, state)` restores it in a new object, which then continues bit-identically. If these two are missing,
    `warm_start(self, last)` is called with the last published `zsim.contract.flight_messages.Estimate`.

    Args:
        drone: the drone's section of the scenario: sensors with mounts, rates and error models; start position.
        environment: the section of the scenario with gravity and magnetic field.
        estimation: settings of the scenario's estimators.
        gate_s: interval between gates [s].
    """

    def __init__(self, drone: Drone, environment: Environment, estimation: Estimation, gate_s: float) -> None: ...

    def receive(self, sensor: str, message: Any) -> None:
        """Receive a reading.

        The readings of a gate come in order of arrival, then of sensor name; some may be late or missing.

        Args:
            sensor: "imu", "gps", "mag", "baro", "sonar", "flow", "sightings", or a user's sensor.
            message: the sensor's message, such as `zsim.contract.messages.Imu`, measured at its `t_sample_ns`.
        """
        ...

    def estimate(self, t_s: float) -> StateEstimate:
        """Return the estimate at `t_s` [s], the end of a gate, after all readings of the gate have been received."""
        ...


def estimator_class(algorithm: str, where: str = "estimation.algorithm") -> Callable[..., DroneEstimator] | None:
    """Return the class that an algorithm names; None for `ekf`, for which all drones share one `EstimatorBank`.

    Raises:
        DocumentError: the module, the class or one of its methods does not exist; the text begins with `where`.
    """
    if algorithm == ESTIMATORS[0]:
        return None
    return plugin.load(CLASSES.get(algorithm, algorithm), where, DroneEstimator, is_constructed=True)


class EstimatorSet:
    """Estimators of several drones, one object of the same class for each, with the methods of an `EstimatorBank`."""

    def __init__(
        self,
        make: Callable[..., DroneEstimator],
        drones: Sequence[Drone],
        environment: Environment,
        estimation: Estimation,
        gate_s: float,
    ) -> None:
        self._drones = [drone.name for drone in drones]
        self._estimators = [make(drone, environment, estimation, gate_s) for drone in drones]

    def receive(self, i: int, sensor: str, message: Any, t_arrival_s: float) -> None:
        try:
            self._estimators[i].receive(sensor, message)
        except plugin.RAISED as error:
            self._raise(error, i)

    def receive_gate(self, gate: Any) -> bool:
        return False  # the messages must be passed one by one

    def estimate(self, t_s: float) -> list[StateEstimate]:
        """Return the estimates at `t_s` [s], as plain numbers.

        Raises:
            UserCodeError: the user's class raised an error, or returned an invalid estimate.
        """
        estimates = []
        for i, estimator in enumerate(self._estimators):
            try:
                estimate = estimator.estimate(t_s)
            except plugin.RAISED as error:
                self._raise(error, i)
            estimates.append(_plain(estimate, estimator, self._drones[i]))
        return estimates

    def _raise(self, error: BaseException, i: int) -> NoReturn:
        """Raise an error of a user's class with the drone's name in its text, any other error unchanged."""
        failure = plugin.user_code_error(error, "")
        if failure is None:
            raise error
        raise UserCodeError(f"{failure.text}, for {self._drones[i]}") from error

    def snapshot(self) -> State | None:
        """Return the states of all estimators; None if their class does not provide them."""
        if not all(hasattr(each, "snapshot") for each in self._estimators):
            return None
        states = []
        for i, each in enumerate(cast("list[Any]", self._estimators)):
            try:
                states.append(checked(each.snapshot(), type(each)))
            except plugin.RAISED as error:
                self._raise(error, i)
        return None if None in states else {"estimators": states}

    def restore(self, state: State) -> None:
        for each, saved in zip(cast("list[Any]", self._estimators), state["estimators"], strict=True):
            each.restore(saved)

    def warm_start(self, i: int, last: Any) -> None:
        warm_start = getattr(self._estimators[i], "warm_start", None)
        if warm_start:
            warm_start(last)


def _plain(estimate: StateEstimate, estimator: DroneEstimator, drone: str) -> StateEstimate:
    """Return an estimate as plain numbers, after validating it."""
    context = f"{plugin.full_name(type(estimator))}.estimate returns for {drone}"
    values = {}
    for field in (*SIZES, "yaw_rad", "yaw_sigma_rad"):
        size, given = SIZES.get(field, 1), getattr(estimate, field, None)
        try:
            numbers = plugin.numbers(given).ravel().tolist()
        except ValueError:
            numbers = []
        if len(numbers) != size or not all(map(math.isfinite, numbers)):
            found = f"{field} = {show(given)}" if hasattr(estimate, field) else f"{show(estimate)} without {field}"
            raise UserCodeError(
                f"{context} {found}; must be {f'{size} finite numbers' if size > 1 else 'a finite number'}"
            )
        fault = ""
        if field in ("covariance", "yaw_sigma_rad") and (smallest := min(numbers[:: STATES + 1])) < 0.0:
            fault = f"{'variance' if field == 'covariance' else 'value'} {smallest:g}; must be >= 0"
        elif field == "orientation_wxyz" and abs((norm := el.length(numbers)) - 1.0) > NORM_TOLERANCE:
            fault = f"norm {norm:g}; must be 1"
        if fault:
            raise UserCodeError(f"{context} {field} with {fault}")
        values[field] = tuple(numbers)
    yaw, yaw_sigma = values.pop("yaw_rad"), values.pop("yaw_sigma_rad")
    try:
        sensors = {name: (int(used), int(refused)) for name, (used, refused) in estimate.sensors.items()}
    except (AttributeError, TypeError, ValueError) as error:
        found = f"sensors = {show(getattr(estimate, 'sensors', None))}"
        raise UserCodeError(f"{context} {found}; must be a map of (used, refused) by sensor") from error
    return StateEstimate(**values, yaw_rad=yaw[0], yaw_sigma_rad=yaw_sigma[0], sensors=sensors)
