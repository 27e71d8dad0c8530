"""The messages `view/**` of a replay, made of the last values of truth, status, estimate and state. Pure."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from zsim.contract import keys, messages
from zsim.contract.views import DroneView, EstimateView, ViewDrones, ViewEstimates, cluster_view, estimate_view
from zsim.errors import DecodeError
from zsim.runtime.agent import Output


class PlaybackViews:
    """Makes `view/**` of what a record has.

    Args:
        drones, clusters: names.
    """

    def __init__(self, drones: Sequence[str], clusters: Sequence[str]) -> None:
        self._drones = tuple(drones)
        self._clusters = tuple(clusters)
        self.sources = frozenset(
            key for drone in drones for key in (keys.truth(drone), keys.status(drone), keys.estimate(drone))
        ) | {keys.VIEW_DRONES, *map(keys.cluster_state, clusters)}
        """Keys whose last values are needed."""

    def views(self, last: Mapping[str, bytes], t_ns: int, seq: int) -> Iterator[Output]:
        """Yield the views of the gate t_ns, as far as the last values go."""
        drones = tuple(self._drone_views(last))
        if drones:
            wind = _read(last, keys.VIEW_DRONES)
            wind_m_s = wind.wind_m_s if wind is not None and len(wind.wind_m_s) == len(drones) else ()
            yield Output(keys.VIEW_DRONES, ViewDrones(t_ns, seq, drones, wind_m_s))
        for cluster in self._clusters:
            state = _read(last, keys.cluster_state(cluster))
            if state is not None:
                yield Output(keys.cluster_view(cluster), cluster_view(state, t_ns, seq))
        for process, estimates in self._estimates(last).items():
            yield Output(keys.estimates_view(process), ViewEstimates(t_ns, seq, tuple(estimates)))

    def _drone_views(self, last: Mapping[str, bytes]) -> Iterator[DroneView]:
        for drone in self._drones:
            truth, status = _read(last, keys.truth(drone)), _read(last, keys.status(drone))
            if truth is not None and status is not None:
                pose = (truth.position_m, truth.orientation_wxyz, truth.rotor_rad_s)
                yield DroneView(drone, *pose, status.state, status.battery_percent, status.commander)

    def _estimates(self, last: Mapping[str, bytes]) -> dict[str, list[EstimateView]]:
        """Return the estimates by the estimator of each drone."""
        estimates: defaultdict[str, list[EstimateView]] = defaultdict(list)
        for drone in self._drones:
            estimate = _read(last, keys.estimate(drone))
            if estimate is not None:
                estimates[f"estimator.{drone}"].append(estimate_view(drone, estimate))
        return estimates


def _read(last: Mapping[str, bytes], key: str) -> Any:
    """Return the last message on a key, None where there is none that can be read."""
    payload = last.get(key)
    try:
        return messages.decode(key, payload) if payload is not None else None
    except DecodeError:
        return None
