"""The estimators of the drones of a cluster with one covariance, which use what the drones see of each other."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zsim.contract import keys, messages
from zsim.contract.flight_messages import Estimate, Sightings
from zsim.contract.framing import GateMessages, PerPattern
from zsim.contract.snapshot import State
from zsim.errors import DecodeError
from zsim.math.compiled import portable
from zsim.math.rotation import Vector
from zsim.scenario.scenario import Drone, Environment, Estimation
from zsim.sensors.camera import Hats
from zsim.sensors.camera_model import camera_pose
from zsim_agents.estimation import measurement_update, strapdown
from zsim_agents.estimation.drone_estimator import StateEstimate
from zsim_agents.estimation.estimator_bank import EstimatorBank, sort_readings, write_estimate
from zsim_agents.estimation.filter_state import COUNT, NOMINAL, Rows
from zsim_agents.estimation.joint.sighting_update import SIGHTING, use_sightings
from zsim_agents.estimation.joint_covariance import block, put_block
from zsim_agents.estimation.kalman_update import predict_jointly

SIGHTED_A_GATE = 1000  # more of one gate are a flood, and left out
PICTURES_KEPT = 256  # the last that were used; of 12 drones at 15 Hz, those of 1.4 s

NO_SIGHTINGS = np.empty((0, SIGHTING.size))

Picture = tuple[int, str, int]  # whose, of which camera, exposed when [ns]
_Row = tuple[float, ...]  # of SIGHTING


class JointBank(EstimatorBank):
    """Fuse the sensors and the sightings of the drones of a cluster.

    Args:
        drones, environment, estimation, gate_s: as of EstimatorBank.
    """

    counted = (
        *EstimatorBank.counted,
        (keys.SIGHTINGS, COUNT.sightings_used - COUNT.used, COUNT.sightings_refused - COUNT.used),
    )

    def __init__(
        self, drones: Sequence[Drone], environment: Environment, estimation: Estimation, gate_s: float
    ) -> None:
        super().__init__(drones, environment, estimation, gate_s)
        count, n = self.rows.covariance.shape[:2]
        joint = np.zeros((count * n, count * n))
        for i in range(count):
            put_block(joint, i, self.rows.covariance[i])
        self.rows = self.rows._replace(joint=joint, sighted=np.full((count, count), -math.inf))
        hats = environment.hats if isinstance(environment.hats, Hats) else Hats()
        x, y, z = hats.position_m
        self._hat_B: Vector = float(x), float(y), float(z)
        self._cameras = [{n: camera_pose(c).p_BK.tolist() for n, c in d.sensors.cameras().items()} for d in drones]
        self._drones = {keys.sensor(drone.name, keys.SIGHTINGS): i for i, drone in enumerate(drones)}
        self._places = PerPattern(self._sighting_places)
        self._sighted: dict[Picture, tuple[str, list[_Row]]] = {}  # of this gate: by whom, and what
        self._hats = 0  # of this gate, those of pictures that another detector's replaced too
        self._pictures_used: dict[Picture, None] = {}

    def receive(self, i: int, sensor: str, message: Any, t_arrival_s: float) -> None:
        if sensor == keys.SIGHTINGS:
            self._receive_sightings(i, message, t_arrival_s)
        else:
            super().receive(i, sensor, message, t_arrival_s)

    def _receive_sightings(self, i: int, message: Sightings, t_arrival_s: float) -> None:
        p_BK = self._cameras[i].get(message.camera)
        if p_BK is None or not message.seen:
            return
        picture = (i, message.camera, message.t_sample_ns)
        if self._is_taken(picture, message.source):
            return
        camera = i, t_arrival_s, message.t_sample_ns * 1e-9, *p_BK
        rows = [
            (*camera, *seen.direction_B, seen.range_m, seen.sigma_direction_rad, seen.sigma_range_m)
            for seen in message.seen[: SIGHTED_A_GATE - self._hats]
        ]
        self._hats += len(rows)
        self._sighted[picture] = (message.source, rows)

    def _is_taken(self, picture: Picture, source: str) -> bool:
        """Tell whether what is in a picture counts already: two detectors that look at it have the same errors.

        Of two at one gate it is the first by name, whichever came first: other estimators of the cluster do the same.
        """
        other = self._sighted.get(picture)
        return picture in self._pictures_used or (other is not None and other[0] <= source)

    def receive_gate(self, gate: GateMessages) -> bool:
        if not super().receive_gate(gate):
            return False
        for m, i, key in self._places.of(gate):
            try:
                message = messages.decode(key, gate.payload(m))
            except DecodeError:
                continue
            self._receive_sightings(i, message, message.t_ns * 1e-9)
        return True

    def _sighting_places(self, gate: GateMessages) -> list[tuple[int, int, str]]:
        """Return which messages of a gate are sightings, whose, and on which key."""
        by_message = ((m, gate.table[which]) for m, which in enumerate(gate.which.tolist()))
        return [(m, self._drones[key], key) for m, key in by_message if key in self._drones]

    def warm_start(self, i: int, last: StateEstimate | Estimate) -> None:
        super().warm_start(i, last)
        put_block(self.rows.joint, i, self.rows.covariance[i])

    def snapshot(self) -> State:
        return {**super().snapshot(), "pictures": [list(picture) for picture in self._pictures_used]}

    def restore(self, state: State) -> None:
        super().restore(state)
        self._pictures_used = dict.fromkeys((i, camera, t_ns) for i, camera, t_ns in state["pictures"])

    def use(self, t_s: float, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        sightings = self._taken() if self._sighted else NO_SIGHTINGS
        step_jointly(self.rows, t_s, readings, sightings, self._hat_B, self._estimates)
        return self._estimates

    def _taken(self) -> NDArray[np.float64]:
        """Return what is in the pictures of this gate, (M, SIGHTING.size), and forget it."""
        rows = sorted(row for _, of_picture in self._sighted.values() for row in of_picture)
        self._pictures_used |= dict.fromkeys(self._sighted)
        while len(self._pictures_used) > PICTURES_KEPT:
            del self._pictures_used[next(iter(self._pictures_used))]
        self._sighted, self._hats = {}, 0
        return np.array(rows) if rows else NO_SIGHTINGS


@portable
def step_jointly(
    rows: Rows, t_s: float, readings: np.ndarray, sightings: np.ndarray, hat_B: Vector, estimates: np.ndarray
) -> None:
    """Use the readings and sightings of a gate of all drones and write their estimates for `t_s`.

    Args:
        rows: of N drones; changed.
        t_s: instant of the gate [s].
        readings: (M, READING.size), each drone's in the order of their arrival.
        sightings: (M, SIGHTING.size).
        hat_B: centre of a hat in the body of its drone [m].
        estimates: (N, ESTIMATE.size), written.
    """
    count, n = rows.covariance.shape[:2]
    first, after = np.full(count, -1), np.full(readings.shape[0], -1)
    sort_readings(rows, readings, first, after)
    for i in range(count):
        _grow(rows, i, t_s)
    for i in range(count):
        P = block(rows.joint, i, n)
        if not rows.counts[i, COUNT.heading_known]:
            measurement_update.start_heading(rows, i, P, t_s, readings, first[i], after)
            put_block(rows.joint, i, P)
        measurement_update.fuse(rows, i, P, readings, first[i], after)
    use_sightings(rows, sightings, hat_B)
    for i in range(count):
        strapdown.clone(rows, i, rows.joint, i * n)
        rows.covariance[i] = block(rows.joint, i, n)
        write_estimate(rows.nominal[i], rows.setting[i], rows.covariance[i], t_s, estimates[i])


@portable
def _grow(rows: Rows, i: int, t_s: float) -> None:
    """Let the errors of a drone follow its dead reckoning since the last gate."""
    row, n = rows.nominal[i], rows.covariance.shape[1]
    if not rows.counts[i, COUNT.running]:
        strapdown.begin(row, rows.counts[i], t_s)
    strapdown.coast(row, rows.setting[i], t_s)
    if row[NOMINAL.t] > row[NOMINAL.t_start]:
        F, Q = np.eye(n), np.zeros((n, n))
        strapdown.write_growth(rows, i, F, Q)
        predict_jointly(rows.joint, i, F, Q)
    strapdown.begin_interval(row, row[NOMINAL.t])
