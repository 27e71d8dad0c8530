"""The sensor samples that a fleet has published in its last gate."""

from typing import NamedTuple

from zsim_world.fleet.fleet import Fleet
from zsim_world.sensors.sampler import VALUE_COLUMNS
from zsim_world.sensors.sensor_set import GPS


class SensorSample(NamedTuple):
    """One measurement; `values` as in zsim_world.sensors.sampler."""

    sensor: str
    drone: int
    t_ns: int
    t_sample_ns: int
    values: tuple[float, ...]


def samples_of(fleet: Fleet) -> list[SensorSample]:
    """Return the samples, except sightings, ordered by (t_ns, drone, sensor)."""
    names, sizes = fleet.sensors.names, [kind.values for kind in fleet.sensors.types]
    sizes[GPS] = VALUE_COLUMNS
    rows = zip(fleet.sampled.whose.tolist(), fleet.sampled.values.tolist(), strict=True)
    return [SensorSample(names[s], i, t, at, tuple(row[: sizes[s]])) for (s, i, t, at), row in rows if s < len(names)]
