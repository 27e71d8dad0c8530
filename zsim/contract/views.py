"""Messages for displays, and how they are made of an estimate and of the state of a formation; they never gate."""

from collections.abc import Sequence
from operator import itemgetter
from typing import Protocol

from msgspec import Struct

from zsim.contract.flight_messages import ClusterState, Phase, Quaternion, Rotors, length_fault
from zsim.schema.message import Count, Message, Number, Vector3

_triangle = itemgetter(0, 1, 2, 7, 8, 14)  # of the position, in the 6 x 6 covariance, row-major


class DroneView(Struct, frozen=True):
    """A drone as it is displayed: position in W, attitude B to W."""

    name: str
    position_m: Vector3
    orientation_wxyz: Quaternion
    rotor_rad_s: Rotors
    state: str
    battery_percent: Number
    commander: str | None = None


class ViewDrones(Message, frozen=True):
    """All drones at one instant, and the wind at each in W; never gates and may skip."""

    drones: tuple[DroneView, ...]
    wind_m_s: tuple[Vector3, ...] = ()


class EstimateView(Struct, frozen=True):
    """An estimate as it is displayed; fields as in Estimate.

    `covariance_m2` is that of the position in W, the upper triangle row by row: xx, xy, xz, yy, yz, zz.
    """

    name: str
    position_m: Vector3
    covariance_m2: tuple[Number, Number, Number, Number, Number, Number]
    yaw_rad: Number
    yaw_sigma_rad: Number
    sensors: dict[str, tuple[Count, Count]]


class ViewEstimates(Message, frozen=True):
    """What an estimator believes of all its drones, for displays; never gates and may skip."""

    estimates: tuple[EstimateView, ...]


class ViewCluster(Message, frozen=True):
    """A formation as it is displayed; fields as in ClusterState; never gates and may skip."""

    phase: Phase
    names: tuple[str, ...]
    value: tuple[Number, ...]
    desired: tuple[Number, ...]
    reason: str

    def fault(self) -> str | None:
        """Return what the types do not say."""
        return length_fault(self, ("value", "desired"), len(self.names))


class Estimated(Protocol):
    """An estimate, on the wire or within an estimator; units and frames as in the message Estimate."""

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
    """Return a drone's estimate for displays."""
    e = estimate
    return EstimateView(drone, e.position_m, _triangle(e.covariance), e.yaw_rad, e.yaw_sigma_rad, e.sensors)


def cluster_view(state: ClusterState, t_ns: int, seq: int) -> ViewCluster:
    """Return a formation's state for displays, as message number `seq` of the view."""
    return ViewCluster(t_ns, seq, state.phase, state.names, state.value, state.desired, state.reason)
