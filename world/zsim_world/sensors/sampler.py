"""What the sensors of a fleet give in a gate: rows of arrays, delayed until their latency is over.

Values in the contract's order of fields. imu: ax, ay, az [m/s^2], gx, gy, gz [rad/s]; gps: latitude, longitude [deg],
altitude [m], e, n, u [m], ve, vn, vu [m/s]; mag: x, y, z [uT]; baro: pressure [Pa], altitude [m]; sonar: range [m],
valid 0 or 1; flow: forward, left, up [m/s], quality.
"""

from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from zsim.math import geodetic
from zsim.math.columns import Field, columns
from zsim.math.compiled import kernel
from zsim.scenario.scenario import Scenario
from zsim_world.sensors import sensor_set
from zsim_world.sensors.sensor_set import SENSORS, VALUES, SensorName
from zsim_world.state.fleet_arrays import Senses

WHOSE = columns("WhoseColumns", (Field("sensor", "1"), Field("drone", "1"), Field("t", "ns"), Field("t_sample", "ns")))
VALUE_COLUMNS = 9  # of a GPS fix, with its place on the Earth


class SensorSample(Struct, frozen=True, gc=False):
    """One measurement; `values` as above."""

    sensor: SensorName
    drone: int
    t_ns: int
    t_sample_ns: int
    values: tuple[float, ...]


class Sampled(NamedTuple):
    """Measurements in the order of (t_ns, drone, sensor)."""

    whose: NDArray[np.int64]  # (M, WHOSE.size)
    values: NDArray[np.float64]  # (M, VALUE_COLUMNS), the first ones of each kind's

    def each(self) -> list[SensorSample]:
        """Return them one by one."""
        rows = zip(self.whose.tolist(), self.values.tolist(), strict=True)
        return [SensorSample(SENSORS[s], i, t, at, tuple(row[: SIZES[s]])) for (s, i, t, at), row in rows]


SIZES = tuple(9 if name == "gps" else size for name, size in zip(SENSORS, VALUES, strict=True))
NONE = Sampled(np.empty((0, WHOSE.size), dtype=np.int64), np.empty((0, VALUE_COLUMNS)))


class Sampler:
    """Makes samples of what the kernel logged, and keeps back those that are delayed."""

    def __init__(self, scenario: Scenario) -> None:
        place = scenario.environment
        self._anchor = geodetic.anchor(place.latitude_deg, place.longitude_deg, place.height_m)
        self._latency_ns = _latencies(scenario)
        self._delayed = bool(self._latency_ns.any())
        self._tick_ns = round(scenario.time.physics_dt_ms * 1_000_000)
        self._later = NONE

    def due(self, senses: Senses, logged: int, now_ns: int) -> Sampled:
        """Return what falls due up to now of what was logged and of what waits."""
        rows, place = self._anchor
        whose, value = senses.whose[:logged], senses.value[:logged]
        fresh = Sampled(*stamped(whose, value, self._latency_ns, self._tick_ns, rows, place))
        return self._sort_out(fresh, now_ns) if self._delayed else fresh

    def _sort_out(self, fresh: Sampled, now_ns: int) -> Sampled:
        index = np.concatenate((self._later.whose, fresh.whose))
        values = np.concatenate((self._later.values, fresh.values))
        late = index[:, WHOSE.t] > now_ns
        self._later, due, due_values = Sampled(index[late], values[late]), index[~late], values[~late]
        order = np.lexsort((due[:, WHOSE.sensor], due[:, WHOSE.drone], due[:, WHOSE.t]))
        return Sampled(due[order], due_values[order])


@kernel()
def stamped(
    whose: NDArray, value: NDArray, latency_ns: NDArray, tick_ns: int, rows: NDArray, place: NDArray
) -> tuple[NDArray, NDArray]:
    """Return index and values of what the kernel logged as (sensor, drone, tick); see Sampled and geodetic.anchor."""
    count = whose.shape[0]
    index, values = np.empty((count, WHOSE.size), np.int64), np.empty((count, VALUE_COLUMNS))
    for m in range(count):
        s, i, first = whose[m, 0], whose[m, 1], 0
        index[m, WHOSE.sensor], index[m, WHOSE.drone], index[m, WHOSE.t_sample] = s, i, whose[m, 2] * tick_ns
        index[m, WHOSE.t] = index[m, WHOSE.t_sample] + latency_ns[i, s]
        if s == sensor_set.GPS:
            values[m, 0:3] = geodetic.geodetic(value[m : m + 1, 0:3], rows, place)[0]
            first = 3
        for k in range(sensor_set.CHANNELS_MAX):
            values[m, first + k] = value[m, k]
    return index, values


def _latencies(scenario: Scenario) -> NDArray[np.int64]:
    """Return t_ns - t_sample_ns of each drone and sensor [ns], (N, 6)."""
    sensors = [drone.sensors for drone in scenario.drones]
    return np.array([[round(getattr(each, name).latency_ms * 1_000_000) for name in SENSORS] for each in sensors])
