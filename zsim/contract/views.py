"""What eyes are shown of an estimate, and of the state of a formation. Pure."""

from collections.abc import Sequence
from operator import itemgetter
from typing import Protocol

from zsim.contract.messages import ClusterState, EstimateView, Vector3, ViewCluster

_triangle = itemgetter(0, 1, 2, 7, 8, 14)  # of the position, in the 6 x 6 covariance, row-major


class Estimated(Protocol):
    """An estimate, on the wire or within an estimator; units and frames as in zsim.contract.messages.Estimate."""

    @property
    def position_m(self) -> Vector3: ...
    @property
    def covariance(self) -> Sequence[float]: ...
    @property
    def yaw_rad(self) -> float: ...
    @property
    def yaw_sigma_rad(self) -> float: ...
    @property
    def sensors(self) -> dict[str, tuple[int, int]]: ...


def estimate_view(drone: str, estimate: Estimated) -> EstimateView:
    """Return a drone's estimate as eyes see it."""
    e = estimate
    return EstimateView(drone, e.position_m, _triangle(e.covariance), e.yaw_rad, e.yaw_sigma_rad, e.sensors)


def cluster_view(state: ClusterState, t_ns: int, seq: int) -> ViewCluster:
    """Return a formation's state as eyes see it, as message number `seq` of the view."""
    return ViewCluster(t_ns, seq, state.phase, state.names, state.value, state.desired, state.reason)
