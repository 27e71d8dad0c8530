"""From the fleet's arrays to the messages of a gate, in the contract's order.

Per drone: its samples in time order, truth, and status last, which counts them.
"""

from collections.abc import Callable, Iterator
from typing import Any

from zsim import keys, messages
from zsim_world.fleet import GPS_FIX, GPS_SATELLITES, Fleet, Sample

Outgoing = tuple[str, Any]  # key and message; a plain tuple, for a fleet has thousands of them a second


class _Slot:
    """A sensor of a drone: its key, its message, how many there were."""

    __slots__ = ("build", "key", "seq")

    def __init__(self, key: str, build: Callable[[Sample, int], Any]) -> None:
        self.key, self.build, self.seq = key, build, 0


class Publication:
    """Builds the messages of each gate and counts them per key."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        names = fleet.names
        self._status_keys = [keys.status(name) for name in names]
        self._truth_keys = [keys.truth(name) for name in names]
        self._gate = 0
        build = {"imu": _imu, "gps": self._gps, "mag": _mag, "baro": _baro, "sonar": _sonar, "flow": _flow}
        self._slots = [{kind: _Slot(keys.sensor(name, kind), build[kind]) for kind in keys.SENSORS} for name in names]

    def gate(self, truth: Any, holder: Callable[[int], str | None]) -> Iterator[Outgoing]:
        """Yield the messages of the gate that the fleet stands at."""
        by_drone: list[list[Outgoing]] = [[] for _ in self._status_keys]
        for sample in self._fleet.samples():
            slot = self._slots[sample.drone][sample.sensor]
            by_drone[sample.drone].append((slot.key, slot.build(sample, slot.seq)))
            slot.seq += 1
        truths = self._truths(truth)
        for drone, outputs in enumerate(by_drone):
            yield from outputs
            yield self._truth_keys[drone], truths[drone]
            yield self._status_keys[drone], self._status(drone, len(outputs) + 1, holder(drone))
        self._gate += 1

    def _gps(self, s: Sample, seq: int) -> messages.Gps:
        v: Any = s.values
        return messages.Gps(
            s.t_ns, seq, s.t_sample_ns, v[0], v[1], v[2], v[3:6], v[6:9],
            self._fleet.gps_sigma_m[s.drone], GPS_FIX, GPS_SATELLITES,
        )  # fmt: skip

    def _status(self, drone: int, count: int, commander: str | None) -> messages.Status:
        state, battery_percent, collision = self._fleet.status(drone)
        return messages.Status(self._fleet.t_ns, self._gate, state, battery_percent, collision, commander, count)  # type: ignore[arg-type]

    def _truths(self, truth: Any) -> list[messages.Truth]:
        t_ns, seq = self._fleet.t_ns, self._gate
        columns = zip(
            truth.position_m.tolist(),
            truth.velocity_m_s.tolist(),
            truth.orientation_wxyz.tolist(),
            truth.angular_velocity_rad_s.tolist(),
            truth.accel_m_s2.tolist(),
            truth.rotor_rad_s.tolist(),
            strict=True,
        )
        return [messages.Truth(t_ns, seq, *map(tuple, row)) for row in columns]  # type: ignore[arg-type]


def _imu(s: Sample, seq: int) -> messages.Imu:
    v: Any = s.values
    return messages.Imu(s.t_ns, seq, s.t_sample_ns, v[0:3], v[3:6])


def _mag(s: Sample, seq: int) -> messages.Mag:
    v: Any = s.values
    return messages.Mag(s.t_ns, seq, s.t_sample_ns, v)


def _baro(s: Sample, seq: int) -> messages.Baro:
    v: Any = s.values
    return messages.Baro(s.t_ns, seq, s.t_sample_ns, *v)


def _sonar(s: Sample, seq: int) -> messages.Sonar:
    v: Any = s.values
    return messages.Sonar(s.t_ns, seq, s.t_sample_ns, v[0], bool(v[1]))


def _flow(s: Sample, seq: int) -> messages.Flow:
    v: Any = s.values
    return messages.Flow(s.t_ns, seq, s.t_sample_ns, v[0:3], v[3])
