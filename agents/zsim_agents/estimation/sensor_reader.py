"""Reads the sensors of several drones out of a gate's messages, straight into the rows of an EstimatorBank."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from zsim.contract import encoding, keys, messages
from zsim.contract.encoding import GAP, Layouts, Program
from zsim.contract.framing import GateMessages
from zsim.math.compiled import portable
from zsim_agents.estimation import estimator_rows as er

NOBODY = -1
NS_S = 1e-9  # s/ns
MESSAGES = {"imu": messages.Imu, "gps": messages.Gps, "mag": messages.Mag, "baro": messages.Baro,
            "sonar": messages.Sonar, "flow": messages.Flow}  # fmt: skip
BARO_ALTITUDE, GPS_POSITION, GPS_SIGMA, FLOW_QUALITY = 1, 3, 9, 3  # floats of these messages
RANK = tuple(sorted(er.KINDS).index(kind) for kind in er.KINDS)  # of keys in the order in which runners hand over
GPS_FIX, SONAR_VALID = 3, 3  # whole numbers of these messages

read = portable(encoding.read)


class GateReader:
    """Knows whose each key of a table is.

    Args:
        drones: in the order in which the bank counts them.
    """

    def __init__(self, drones: Sequence[str]) -> None:
        self._whose = {
            keys.sensor(drone, kind): (i, er.KINDS.index(kind)) for i, drone in enumerate(drones) for kind in er.KINDS
        }
        self._table: Sequence[str] = ()
        self._owner = np.empty((0, 2), dtype=np.int64)
        layouts = Layouts(MESSAGES[kind] for kind in er.KINDS)
        self._program = layouts.program
        self._ints = np.zeros(layouts.ints, dtype=np.int64)
        self._floats = np.zeros(layouts.floats)
        self._bits = self._floats.view(np.uint64)

    def take(self, gate: GateMessages, readings: NDArray[np.float64], came: int) -> int:
        """Write readings from row `came` on; return how many rows there are then, -1 if a message must be decoded.

        Args:
            readings: (M, READING_COLUMNS), with room for all messages of the gate.
        """
        if gate.table is not self._table:
            self._learn(gate.table)
        data = np.frombuffer(gate.buffer, dtype=np.uint8)
        for array in (gate.which, gate.ends, data):
            array.setflags(write=False)  # as off the wire: what may be written is compiled anew
        row = (self._ints, self._floats, self._bits)
        return collect(self._program, self._owner, gate.which, gate.ends, data, row, readings, came)

    def _learn(self, table: Sequence[str]) -> None:
        self._table = table
        self._owner = np.array([self._whose.get(key, (NOBODY, NOBODY)) for key in table], dtype=np.int64)


@portable
def collect(
    program: Program,
    owner: NDArray,
    which: NDArray,
    ends: NDArray,
    data: NDArray,
    row: tuple[NDArray, NDArray, NDArray],
    readings: NDArray,
    came: int,
) -> int:
    """Write what a gate has of sensors as readings, of each drone by time and name; see GateReader.take."""
    ints, floats, bits = row
    start, first = 0, came
    marks = np.empty(which.shape[0], np.int64)
    for m in range(which.shape[0]):
        if not (0 <= which[m] < owner.shape[0] and start + GAP <= ends[m] <= data.shape[0]):
            return -1
        i, kind = owner[which[m], 0], owner[which[m], 1]
        if i >= 0:
            if not read(program, kind, data, start + GAP, ends[m], ints, bits):
                return -1
            place = came
            mark = ints[0] * len(RANK) + RANK[kind]
            while place > first and readings[place - 1, er.DRONE] == i and marks[place - 1 - first] > mark:
                readings[place], marks[place - first] = readings[place - 1], marks[place - 1 - first]
                place -= 1
            fill(readings[place], i, kind, ints, floats)
            marks[place - first] = mark
            came += 1
        start = ends[m]
    return came


@portable
def fill(reading: NDArray, i: int, kind: int, ints: NDArray, floats: NDArray) -> None:
    """Write one message of drone i as a reading; the columns as in EstimatorBank."""
    reading[er.DRONE], reading[er.KIND] = i, kind
    reading[er.ARRIVED], reading[er.SAMPLED] = ints[0] * NS_S, ints[2] * NS_S
    first = BARO_ALTITUDE if kind == er.BARO else GPS_POSITION if kind == er.GPS else 0
    for k in range(6):
        reading[er.VALUE + k] = floats[first + k] if k < er.SIZES[kind] else 0.0
    reading[er.EXTRA], reading[er.EXTRA + 1] = 0.0, 0.0
    if kind == er.IMU:
        reading[er.ARRIVED] = reading[er.SAMPLED]
    elif kind == er.GPS:
        reading[er.EXTRA], reading[er.EXTRA + 1] = floats[GPS_SIGMA], ints[GPS_FIX]
    elif kind == er.SONAR:
        reading[er.EXTRA] = ints[SONAR_VALID]
    elif kind == er.FLOW:
        reading[er.EXTRA] = floats[FLOW_QUALITY]
