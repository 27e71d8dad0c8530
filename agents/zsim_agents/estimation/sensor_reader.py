"""Reads the sensors of several drones out of a gate's messages, straight into the rows of an EstimatorBank."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract import encoding, keys, messages
from zsim.contract.encoding import GAP, Layouts, Program
from zsim.contract.framing import GateMessages
from zsim.contract.keys import SENSORS
from zsim.math.compiled import Held, hold, inlined, portable
from zsim_agents.estimation.filter_state import BARO, FLOW, GPS, IMU, READING, SIZES, SONAR, VALUES_MAX

NOBODY = -1
NS_S = 1e-9  # s/ns
BARO_ALTITUDE, GPS_POSITION, GPS_SIGMA, FLOW_QUALITY = 1, 3, 9, 3  # floats of these messages
RANK = tuple(sorted(SENSORS).index(kind) for kind in SENSORS)  # of keys in the order in which runners hand over
GPS_FIX, SONAR_VALID = 3, 3  # whole numbers of these messages

read = inlined(encoding.read)


class ReaderTables(NamedTuple):
    """What compiled code knows of the messages of a gate, and where it reads one into."""

    program: Program
    owner: NDArray[np.int64]  # (keys, 2): drone and sensor of each key of the table, or NOBODY
    ints: NDArray[np.int64]
    floats: NDArray[np.float64]
    bits: NDArray[np.uint64]  # of the floats


class GateReader:
    """Knows whose each key of a table is.

    Args:
        drones: in the order in which the bank counts them.
    """

    def __init__(self, drones: Sequence[str]) -> None:
        self._whose = {
            keys.sensor(drone, kind): (i, SENSORS.index(kind)) for i, drone in enumerate(drones) for kind in SENSORS
        }
        self._table: Sequence[str] = ()
        kinds = [messages.type_of(keys.sensor("any", sensor)) for sensor in SENSORS]
        layouts = Layouts(kind for kind in kinds if kind)
        floats, owner = np.zeros(layouts.floats), np.empty((0, 2), dtype=np.int64)
        ints = np.zeros(layouts.ints, dtype=np.int64)
        self._tables = ReaderTables(layouts.program, owner, ints, floats, floats.view(np.uint64))
        self._held = hold(self._tables)

    def take(self, gate: GateMessages, readings: NDArray[np.float64], count: int) -> int:
        """Write readings from row `count` on; return how many rows there are then, -1 if a message must be decoded.

        Args:
            readings: (M, READING.size), with room for all messages of the gate.
        """
        if gate.table is not self._table:
            self._learn(gate.table)
        data = np.frombuffer(gate.buffer, dtype=np.uint8)
        if gate.which.flags.writeable:
            for array in (gate.which, gate.ends, data):
                array.setflags(write=False)  # as off the wire: what may be written is compiled anew
        return collect(self._held, gate.which, gate.ends, data, readings, count)

    def _learn(self, table: Sequence[str]) -> None:
        self._table = table
        owner = np.array([self._whose.get(key, (NOBODY, NOBODY)) for key in table], dtype=np.int64)
        self._held = hold(self._tables._replace(owner=owner))


@portable
def collect(held: Held, which: NDArray, ends: NDArray, data: NDArray, readings: NDArray, count: int) -> int:
    """Write what a gate has of sensors as readings, of each drone by time and name; see GateReader.take.

    Args:
        held: ReaderTables, by `hold`.
    """
    program, owner, ints, floats, bits = held.content
    start, first = 0, count
    marks = np.empty(which.shape[0], np.int64)
    for m in range(which.shape[0]):
        if not (0 <= which[m] < owner.shape[0] and start + GAP <= ends[m] <= data.shape[0]):
            return -1
        i, kind = owner[which[m], 0], owner[which[m], 1]
        if i >= 0:
            if not read(program, kind, data, start + GAP, ends[m], ints, bits):
                return -1
            place = count
            mark = ints[0] * len(RANK) + RANK[kind]
            while place > first and readings[place - 1, READING.drone] == i and marks[place - 1 - first] > mark:
                readings[place], marks[place - first] = readings[place - 1], marks[place - 1 - first]
                place -= 1
            fill(readings[place], i, kind, ints, floats)
            marks[place - first] = mark
            count += 1
        start = ends[m]
    return count


@inlined
def fill(reading: NDArray, i: int, kind: int, ints: NDArray, floats: NDArray) -> None:
    """Write one message of drone i as a reading; the columns as in EstimatorBank."""
    reading[READING.drone], reading[READING.sensor] = i, kind
    reading[READING.t_arrival], reading[READING.t_sample] = ints[0] * NS_S, ints[2] * NS_S
    first = BARO_ALTITUDE if kind == BARO else GPS_POSITION if kind == GPS else 0
    for k in range(VALUES_MAX):
        reading[READING.values + k] = floats[first + k] if k < SIZES[kind] else 0.0
    reading[READING.extra], reading[READING.extra + 1] = 0.0, 0.0
    if kind == IMU:
        reading[READING.t_arrival] = reading[READING.t_sample]
    elif kind == GPS:
        reading[READING.extra], reading[READING.extra + 1] = floats[GPS_SIGMA], ints[GPS_FIX]
    elif kind == SONAR:
        reading[READING.extra] = ints[SONAR_VALID]
    elif kind == FLOW:
        reading[READING.extra] = floats[FLOW_QUALITY]
