"""From the fleet's arrays to the encoded messages of a gate, in the contract's order.

Per drone: its samples in time order, truth, and status last, which counts them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim import encoding, keys, messages
from zsim.bundle import Bundle
from zsim.encoding import GAP, Layouts, Program, Words
from zsim_world import battery, firmware, fleet, rigid_body, samples, sensor_set, vehicle
from zsim_world.arrays import Boards, Bodies
from zsim_world.battery import percent
from zsim_world.compiled import compiled, kernel
from zsim_world.fleet import GPS_FIX, GPS_SATELLITES, Fleet
from zsim_world.samples import Sampled

KINDS = (
    messages.Imu,
    messages.Gps,
    messages.Mag,
    messages.Baro,
    messages.Sonar,
    messages.Flow,
    messages.Truth,
    messages.Status,
)
TRUTH, STATUS = 6, 7  # after the six sensors
COMMANDER = len(firmware.MODES)  # the first commander among the words: nobody
MODULES = (encoding, fleet, firmware, rigid_body, samples, sensor_set, battery, vehicle)
SOURCES = (Path(__file__), *(Path(str(module.__file__)) for module in MODULES))

write = compiled(encoding.write)


class Written(NamedTuple):
    """M messages, and room for more."""

    which: NDArray[np.int64]  # (M,), place of each one's key in the table
    stamps: NDArray[np.int64]  # (M,), ns
    ends: NDArray[np.int64]  # (M,), in `data`
    data: NDArray[np.uint8]


class Row(NamedTuple):
    """What one message is made of."""

    ints: NDArray[np.int64]
    floats: NDArray[np.float64]
    bits: NDArray[np.uint64]  # the same floats


class Fleetwide(NamedTuple):
    """What the messages tell of N drones beside their arrays."""

    touching: NDArray[np.bool_]  # (N,), whether a hull touched another in this gate
    sigma_m: NDArray[np.float64]  # (N,), of each one's GPS
    commanders: NDArray[np.int64]  # (N,), number of the word that names each one's
    counts: NDArray[np.int64]  # (N, kinds), messages that each key has had


class Publication:
    """Writes the messages of each gate and counts them per key."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        kinds = (*keys.SENSORS, "truth", "status")
        self.table = tuple(_key(name, kind) for name in fleet.names for kind in kinds)
        self._layouts = Layouts(KINDS)
        floats = np.zeros(self._layouts.floats)
        self._row = Row(np.zeros(self._layouts.ints, dtype=np.int64), floats, floats.view(np.uint64))
        whole = np.zeros(fleet.count, dtype=np.int64)
        counts = np.zeros((fleet.count, len(kinds)), dtype=np.int64)
        self._fleetwide = Fleetwide(fleet.touching, np.array(fleet.gps_sigma_m), whole, counts)
        self._known: dict[str | None, int] = {None: COMMANDER}
        self._words = encoding.words((*firmware.MODES, None))
        self._make_room(16 * fleet.count)

    def gate(self, holder: Callable[[int], str | None]) -> Bundle:
        """Return the messages of the gate that the fleet stands at."""
        fleet, wide = self._fleet, self._fleetwide
        count = len(fleet.sampled.whose) + 2 * fleet.count
        if count > len(self._written.which):
            self._make_room(2 * count)
        for i in range(fleet.count):
            wide.commanders[i] = self._number(holder(i))
        out, program = self._written, self._layouts.program
        size = publish(
            program, self._words, fleet.sampled, fleet.bodies, fleet.boards, wide, fleet.t_ns, self._row, out
        )
        which, stamps, ends = out.which[:count].copy(), out.stamps[:count].copy(), out.ends[:count].copy()
        seq = int(wide.counts[0, STATUS]) - 1
        return Bundle(fleet.t_ns, seq, self.table, which, stamps, ends, bytearray(out.data[:size].data))

    def _number(self, commander: str | None) -> int:
        """Return the number of a word; a new one is learnt."""
        if commander not in self._known:
            self._known[commander] = COMMANDER + len(self._known)
            self._words = encoding.words((*firmware.MODES, *self._known))
            self._make_room(len(self._written.which))
        return self._known[commander]

    def _make_room(self, count: int) -> None:
        which, stamps, ends = (np.zeros(count, dtype=np.int64) for _ in range(3))
        self._written = Written(which, stamps, ends, np.zeros(count * self._layouts.room(self._words), dtype=np.uint8))


def _key(drone: str, kind: str) -> str:
    return keys.truth(drone) if kind == "truth" else keys.sensor(drone, kind)


@compiled
def _fill_sample(row: Row, sampled: Sampled, m: int, seq: int, sigma_m: float) -> None:
    """Put sample m of a gate into a row."""
    s, ints, floats = sampled.whose[m, samples.SENSOR], row.ints, row.floats
    ints[0], ints[1], ints[2] = sampled.whose[m, samples.STAMP], seq, sampled.whose[m, samples.SAMPLED]
    for k in range(samples.VALUE_COLUMNS):
        floats[k] = sampled.values[m, k]
    if s == sensor_set.GPS:
        floats[samples.VALUE_COLUMNS], ints[3], ints[4] = sigma_m, GPS_FIX, GPS_SATELLITES
    elif s == sensor_set.SONAR:
        ints[3] = sampled.values[m, 1] != 0.0


@compiled
def _fill_truth(row: Row, state: NDArray, accel: NDArray) -> None:
    for k in range(rigid_body.ROTOR):
        row.floats[k] = state[k]
    for k in range(3):
        row.floats[rigid_body.ROTOR + k] = accel[k]
    for k in range(4):
        row.floats[rigid_body.ROTOR + 3 + k] = state[rigid_body.ROTOR + k]


@compiled
def _by_drone(index: NDArray, drones: int) -> NDArray:
    """Return where the messages of each drone begin, (N + 1,): its samples, truth and status."""
    first = np.zeros(drones + 1, np.int64)
    for m in range(index.shape[0]):
        first[index[m, samples.DRONE] + 1] += 1
    for i in range(drones):
        first[i + 1] += first[i] + 2
    return first


@compiled
def _in_order(index: NDArray, first: NDArray) -> NDArray:
    """Return which sample, or -1 for truth and -2 for status, stands at each place."""
    drones = len(first) - 1
    order, free = np.empty(first[drones], np.int64), first.copy()
    for m in range(index.shape[0]):
        i = index[m, samples.DRONE]
        order[free[i]] = m
        free[i] += 1
    for i in range(drones):
        order[free[i]], order[free[i] + 1] = -1, -2
    return order


@kernel(SOURCES)
def publish(
    program: Program,
    words: Words,
    sampled: Sampled,
    bodies: Bodies,
    boards: Boards,
    wide: Fleetwide,
    now_ns: int,
    row: Row,
    out: Written,
) -> int:
    """Write the messages of a gate, drone by drone, and count them; return how many bytes that were."""
    drones, kinds = wide.counts.shape
    first, at = _by_drone(sampled.whose, drones), 0
    order = _in_order(sampled.whose, first)
    for i in range(drones):
        for place in range(first[i], first[i + 1]):
            m = order[place]
            kind = sampled.whose[m, samples.SENSOR] if m >= 0 else TRUTH if m == -1 else STATUS
            row.ints[0], row.ints[1] = now_ns, wide.counts[i, kind]
            if m >= 0:
                _fill_sample(row, sampled, m, wide.counts[i, kind], wide.sigma_m[i])
            elif kind == TRUTH:
                _fill_truth(row, bodies.state[i], bodies.accel[i])
            else:
                row.ints[2], row.ints[3] = int(boards.memory[i, firmware.MODE]), wide.touching[i]
                row.ints[4], row.ints[5] = wide.commanders[i], first[i + 1] - first[i] - 1
                row.floats[0] = percent(bodies.vehicle[i], bodies.energy[i])
            wide.counts[i, kind] += 1
            at = write(program, words, kind, row.ints, row.bits, out.data, at + GAP)
            out.which[place], out.stamps[place], out.ends[place] = i * kinds + kind, row.ints[0], at
    return at
