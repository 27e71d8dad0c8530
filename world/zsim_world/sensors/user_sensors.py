"""The users' sensors of a fleet: equations and errors, applied after a gate to what the kernel logged of the truth."""

import numpy as np
from numpy.typing import NDArray

from zsim.contract.snapshot import State
from zsim.errors import UserCodeError, reason_of
from zsim.math.frames import rotation_matrix
from zsim.math.random_streams import stream
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim.sensors.sensor import Sensor, SensorTruth, SensorType
from zsim_world.physics.fleet_arrays import EXPOSED, STATE, Senses
from zsim_world.physics.normal_variates import place, words
from zsim_world.sensors.reading import read
from zsim_world.sensors.sensor_set import CHANNELS_MAX, CONFIG, SENSORS, FleetSensors, noise_width


class UserSensors:
    """Makes readings. Each drone and sensor has a random stream, as the stock sensors have.

    Args:
        scenario: resolved.
        sensors: of its drones.
        senses: of the kernel.
    """

    def __init__(self, scenario: Scenario, sensors: FleetSensors, senses: Senses) -> None:
        self._senses = senses
        self._environment = scenario.environment
        self._tick_s = scenario.time.physics_dt_ms / 1000.0
        self._sensors: dict[tuple[int, int], _UserSensor] = {}
        for i, drone in enumerate(scenario.drones):
            for s in range(len(SENSORS), len(sensors.names)):
                settings = sensors.settings[i][s]
                if settings is not None:
                    name, rng = sensors.names[s], stream(scenario.seed, f"{drone.name}/{sensors.names[s]}")
                    what = f"{drone.name}: sensors.{name}"
                    self._sensors[s, i] = _UserSensor(what, sensors.types[s], settings, rng, senses.config[i, s])

    def snapshot(self) -> list[State]:
        """Return bias and random stream of each."""
        return [sensor.snapshot() for sensor in self._sensors.values()]

    def restore(self, states: list[State]) -> None:
        """Take over what `snapshot` returned."""
        for sensor, state in zip(self._sensors.values(), states, strict=True):
            sensor.restore(state)

    def readings(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return whose (M, 3) and values (M, 6) of what the kernel logged in a gate, without what is lost.

        Raises:
            UserCodeError: an equation fails, or returns what is no reading.
        """
        senses, kept = self._senses, []
        count = int(senses.exposed_count[0])
        values = np.zeros((count, CHANNELS_MAX))
        for m in range(count):
            s, i, tick = senses.exposed_whose[m].tolist()
            sensor = self._sensors[s, i]
            truth = sensor.truth(senses.exposed[m], tick * self._tick_s)
            sensor.measure(truth, self._environment, values[m])
            if read(sensor.width, values[m], senses.config[i, s], sensor.bias, senses.fault[i, s], sensor.numbers()):
                kept.append(m)
        return senses.exposed_whose[kept], values[kept]


class _UserSensor:
    """One sensor of one drone: settings, present bias and random stream."""

    def __init__(
        self, what: str, kind: SensorType, settings: Sensor, rng: np.random.Generator, config: NDArray[np.float64]
    ) -> None:
        self._what, self._kind, self._settings, self._rng = what, kind, settings, rng
        self.width = kind.width
        models = kind.errors(settings)
        self.bias = np.zeros(2 * CHANNELS_MAX)
        self.bias[: self.width] = np.array([model.bias for model in models]) * rng.standard_normal(self.width)
        self._numbers = noise_width(self.width, models)
        if self._numbers > 2 * self.width + 1:
            sigma = np.array([model.correlated_sigma for model in models])
            self.bias[CHANNELS_MAX : CHANNELS_MAX + self.width] = sigma * rng.standard_normal(self.width)
        self._p_BS = config[CONFIG.p_BS : CONFIG.p_BS + 3].copy()
        self._R_BS = rotation_matrix(config[CONFIG.q_BS : CONFIG.q_BS + 4])

    def snapshot(self) -> State:
        return {"bias": self.bias, "stream": words(self._rng)}

    def restore(self, state: State) -> None:
        self.bias[:] = state["bias"]
        place(self._rng, state["stream"])

    def truth(self, row: NDArray[np.float64], t_s: float) -> SensorTruth:
        """Return what it is exposed to, by a row of EXPOSED."""
        state, accel = row[EXPOSED.state : EXPOSED.accel].copy(), row[EXPOSED.accel : EXPOSED.air].copy()
        return SensorTruth(
            t_s=t_s,
            p_WB=state[STATE.p_WB : STATE.p_WB + 3],
            v_WB=state[STATE.v_WB : STATE.v_WB + 3],
            a_WB=accel[0:3],
            R_WB=rotation_matrix(state[STATE.q_WB : STATE.q_WB + 4]),
            w_WB_B=state[STATE.w_WB_B : STATE.w_WB_B + 3],
            alpha_B=accel[3:6],
            air_W=row[EXPOSED.air : EXPOSED.air + 3].copy(),
            p_BS=self._p_BS,
            R_BS=self._R_BS,
        )

    def measure(self, truth: SensorTruth, environment: object, values: NDArray[np.float64]) -> None:
        """Write the errorless values into a row (6,)."""
        assert self._kind.equation is not None  # a module without one is refused
        count = self._kind.values
        equation, where = self._kind.equation, f"{self._what} at {truth.t_s:.3f} s"
        name = f"{equation.__module__}:{getattr(equation, '__qualname__', type(equation).__qualname__)}"
        try:
            returned = equation(truth, self._settings, environment)
        except plugin.RAISED as error:
            failure = plugin.user_code_error(error, where)
            raise failure or UserCodeError(f"{name} raised {reason_of(error)}", where) from error
        try:
            values[:count] = np.reshape(plugin.numbers(returned), (count,))
        except ValueError as error:
            raise UserCodeError(f"{name} returns {show(returned)}; must be {count} numbers", where) from error
        if not np.isfinite(values).all():
            numbers = [float(value) for value in values[:count]]
            raise UserCodeError(f"{name} returns {numbers}; must be finite", where)

    def numbers(self) -> NDArray[np.float64]:
        """Return the standard normal numbers of one sample, see `noise_width`."""
        return self._rng.standard_normal(self._numbers)
