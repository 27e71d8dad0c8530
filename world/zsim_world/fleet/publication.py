"""The encoded messages of a gate, in the order of the contract.

Per drone: its samples in time order, its truth, and last its status, which counts the others.
"""

import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract import flight_messages, framing, messages
from zsim.contract.framing import GAP, GateMessages, Layouts, Program, TextTable, key_table
from zsim.contract.snapshot import IN_PLACE, Saved
from zsim.errors import UserCodeError, reason_of
from zsim.math.compiled import compiled, inlined, kernel
from zsim.math.held import Held, hold
from zsim.schema import plugin
from zsim.schema.message import field_types
from zsim.sensors.sensor import Sample, as_fields, message_type
from zsim.sensors.sensor_catalogue import STOCK
from zsim.vehicles.vehicle import ROTORS_MAX, ROTORS_MIN
from zsim_world.fleet.fleet import GPS_FIX, GPS_SATELLITES, Fleet
from zsim_world.physics.fleet_arrays import STATE
from zsim_world.physics.rigid_body import charge_percent
from zsim_world.sensors import sampler, sensor_set
from zsim_world.sensors.sampler import WHOSE, Sampled
from zsim_world.vehicles import firmware
from zsim_world.vehicles.firmware import MEMORY

MESSAGES = (  # in the order of their kinds' numbers
    *(kind.message for kind in STOCK.values()),
    (flight_messages.Truth, ROTORS_MIN),
    flight_messages.Status,
)
STOCK_SENSORS = len(STOCK)
TRUTH, STATUS = STOCK_SENSORS, STOCK_SENSORS + 1
OWN_MESSAGES = 2  # messages of a simulated drone in every gate besides its samples: truth and status
WHICH, STAMPS, ENDS = 0, 1, 2  # rows of `columns`
OTHER_TRUTHS = tuple((flight_messages.Truth, rotors) for rotors in range(ROTORS_MIN + 1, ROTORS_MAX + 1))
LAYOUTS = Layouts((*MESSAGES, *OTHER_TRUTHS))
INTS, FLOATS = LAYOUTS.ints, LAYOUTS.floats
OPS, FIRST, LITERALS = LAYOUTS.program  # constants of the compiled code
COMMANDER = len(firmware.MODES)  # number of the first word after the modes: no commander

write = inlined(framing.write)


class PublicationBuffers(NamedTuple):
    """Buffers for M encoded messages."""

    columns: NDArray[np.int64]  # (3, M): WHICH, STAMPS, ENDS
    first: NDArray[np.int64]  # (N + 1,), where the messages of each drone begin
    data: NDArray[np.uint8]


class MessageRow(NamedTuple):
    ints: NDArray[np.int64]
    floats: NDArray[np.float64]
    bits: NDArray[np.uint64]  # the bits of `floats`


class PublishedArrays(NamedTuple):
    """The arrays of a fleet that are published; see `zsim_world.physics.fleet_arrays`."""

    state: NDArray[np.float64]
    accel: NDArray[np.float64]
    energy: NDArray[np.float64]
    vehicle: NDArray[np.float64]
    memory: NDArray[np.float64]


class PublishedState(NamedTuple):
    """The other published values of N drones."""

    touching: NDArray[np.bool_]  # (N,), whether a hull touched another, an obstacle or a surface in this gate
    sigma_m: NDArray[np.float64]  # (N,), standard deviation of each drone's GPS fixes
    commanders: NDArray[np.int64]  # (N,), number of the word that names each drone's commander
    counts: NDArray[np.int64]  # (N, kinds), messages published so far per key
    rotors: NDArray[np.int64]  # (N,), number of rotors
    own: NDArray[np.int64]  # (N,), messages other than samples: truth and status, or none for an external drone


class UserPayloads(NamedTuple):
    """Messages encoded in Python (users' sensors, sightings, scans) among the M samples of a gate, concatenated."""

    data: NDArray[np.uint8]
    ends: NDArray[np.int64]  # (M,), end of each sample's message; messages of stock sensors are empty here


NO_PAYLOADS = UserPayloads(np.empty(0, dtype=np.uint8), np.empty(0, dtype=np.int64))


class PublicationState(NamedTuple):
    words: TextTable
    seen: PublishedArrays
    wide: PublishedState
    out: PublicationBuffers


class GatePublication:
    """Writes the messages of each gate and counts them per key."""

    SAVED: ClassVar[Saved] = {"counts": IN_PLACE}

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        names = [*fleet.sensors.names[STOCK_SENSORS:], *fleet.extra_sensors]
        self._encoder = UserMessages(fleet) if names else None
        self.table = key_table(fleet.names, names)
        bodies = fleet.bodies
        self._seen = PublishedArrays(bodies.state, bodies.accel, bodies.energy, bodies.vehicle, fleet.boards.memory)
        self._commanders: list[str | None] = []  # commanders at the last gate
        commanders = np.zeros(fleet.count, dtype=np.int64)
        self.counts = np.zeros((fleet.count, len(self.table) // fleet.count), dtype=np.int64)
        rotors = np.array(fleet.rotors, dtype=np.int64)
        own_messages = np.array([0 if i in fleet.external else OWN_MESSAGES for i in range(fleet.count)])
        self._first = int(np.argmax(own_messages))  # a drone whose status has the number of the gate as `seq`
        self._own_count = int(own_messages.sum())
        sigmas_m = np.array(fleet.gps_sigma_m)
        self._fleetwide = PublishedState(fleet.touching, sigmas_m, commanders, self.counts, rotors, own_messages)
        self._known: dict[str | None, int] = {None: COMMANDER}
        self._words = framing.text_table((*firmware.MODES, None))
        payloads = self._payloads()
        self._user_room = 2 * len(payloads.data)  # bytes reserved for messages encoded in Python
        self._make_room(16 * fleet.count)
        # Load or compile the functions that the first gate needs, without counting messages.
        uncounted = self._fleetwide._replace(counts=self.counts.copy())
        state = PublicationState(self._words, self._seen, uncounted, self._written)
        publish(hold(state), *fleet.sampled, *payloads, 0)

    def gate(self, commanders: list[str | None]) -> GateMessages:
        """Return the messages of the current gate; `commanders`: each drone's commander, or None."""
        fleet, wide = self._fleet, self._fleetwide
        count = len(fleet.sampled.whose) + self._own_count
        payloads = self._payloads()
        if count > self._written.columns.shape[1] or len(payloads.data) > self._user_room:
            self._user_room = 2 * len(payloads.data)
            self._make_room(2 * count)
        if commanders != self._commanders:
            wide.commanders[:] = [self._number(commander) for commander in commanders]
            self._commanders = commanders
        out = self._written
        size = publish(self._held, *fleet.sampled, *payloads, fleet.t_ns)
        columns = out.columns[:, :count].copy()
        columns.setflags(write=False)
        which, stamps, ends = columns
        seq = int(wide.counts[self._first, STATUS]) - 1
        data = out.data[:size].tobytes()
        return GateMessages(fleet.t_ns, seq, self.table, which, stamps, ends, data, out.first.tolist())

    def _payloads(self) -> UserPayloads:
        return self._encoder.encoded(self._fleetwide.counts) if self._encoder else NO_PAYLOADS

    def _number(self, commander: str | None) -> int:
        """Return the number of the word for a commander, adding the word if it is new."""
        if commander not in self._known:
            self._known[commander] = COMMANDER + len(self._known)
            self._words = framing.text_table((*firmware.MODES, *self._known))
            self._make_room(self._written.columns.shape[1])
        return self._known[commander]

    def _make_room(self, count: int) -> None:
        columns, first = np.zeros((3, count), dtype=np.int64), np.zeros(self._fleet.count + 1, dtype=np.int64)
        size = count * LAYOUTS.room(self._words) + self._user_room
        self._written = PublicationBuffers(columns, first, np.zeros(size, dtype=np.uint8))
        self._held = hold(PublicationState(self._words, self._seen, self._fleetwide, self._written))


class UserMessages:
    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._fields = [field_types(kind.message, Sample) for kind in fleet.sensors.types[STOCK_SENSORS:]]
        kinds = zip(fleet.sensors.types[STOCK_SENSORS:], self._fields, strict=True)
        self._messages = [message_type(kind.message.__name__, fields) for kind, fields in kinds]

    def encoded(self, counts: NDArray[np.int64]) -> UserPayloads:
        """Return the messages of a gate; `counts`: messages published so far by drone and kind, (N, kinds)."""
        seen = self._fleet.observations
        if not (seen or self._messages):
            return NO_PAYLOADS
        whose, values = self._fleet.sampled
        indices = [*seen]
        if self._messages:
            indices = np.flatnonzero(whose[:, WHOSE.sensor] >= STOCK_SENSORS).tolist()
        sizes, data = np.zeros(len(whose), dtype=np.int64), bytearray()
        seq: dict[tuple[int, int], int] = {}
        for m in indices:
            s, i, t_ns, t_sample_ns = whose[m].tolist()
            number = seq.get((i, s), counts.item(i, s + 2))
            seq[i, s] = number + 1
            if m in seen:
                message = seen[m].message(number)
            else:
                message = self._message(s, i, (t_ns, number, t_sample_ns), values[m])
            payload = messages.encode(message)
            sizes[m] = len(payload)
            data += payload
        return UserPayloads(np.frombuffer(data, dtype=np.uint8), sizes.cumsum())

    def _message(self, s: int, i: int, stamps: tuple[int, int, int], values: NDArray[np.float64]) -> Sample:
        """Return the message of a reading.

        Raises:
            UserCodeError: the sensor's conversion fails, or returns values that the message cannot hold.
        """
        kind, settings = self._fleet.sensors.types[s], self._fleet.sensors.settings[i][s]
        numbers = values[: kind.values].tolist()
        try:
            if kind.convert is not None:
                numbers = kind.convert(numbers, settings, self._fleet.environment)
            fields = as_fields(numbers, self._fields[s - STOCK_SENSORS])
            if not all(map(math.isfinite, numbers)):
                raise ValueError(f"is {list(numbers)}; must be finite")
        except plugin.RAISED as error:
            where = f"{self._fleet.names[i]}: sensors.{self._fleet.sensors.names[s]} at {stamps[0] / 1e9:.3f} s"
            if (failure := plugin.user_code_error(error, where)) is not None:
                raise failure from error
            text = f"its reading cannot be published as a {kind.message.__name__} ({reason_of(error)})"
            raise UserCodeError(text, where) from error
        return self._messages[s - STOCK_SENSORS](*stamps, *fields)


@inlined
def _fill_sample(row: MessageRow, sampled: Sampled, m: int, sigma_m: float) -> None:
    """Put sample m of a gate into a row."""
    s, ints, floats = sampled.whose[m, WHOSE.sensor], row.ints, row.floats
    ints[0], ints[2] = sampled.whose[m, WHOSE.t], sampled.whose[m, WHOSE.t_sample]
    for k in range(sampler.VALUE_COLUMNS):
        floats[k] = sampled.values[m, k]
    if s == sensor_set.GPS:
        floats[sampler.VALUE_COLUMNS], ints[3], ints[4] = sigma_m, GPS_FIX, GPS_SATELLITES
    elif s == sensor_set.SONAR:
        ints[3] = sampled.values[m, 1] != 0.0


@inlined
def _fill_truth(row: MessageRow, state: NDArray, accel: NDArray, rotors: int) -> None:
    for k in range(STATE.size):
        row.floats[k] = state[k]
    for k in range(3):
        row.floats[STATE.size + k] = accel[k]
    for r in range(rotors):
        row.floats[STATE.size + 3 + r] = state[STATE.size + r]


@compiled
def _by_drone(whose: NDArray, own: NDArray, first: NDArray) -> None:
    """Set `first`, (N + 1,), to where the messages of each drone begin: its samples, then its `own` others."""
    first[:] = 0
    for m in range(whose.shape[0]):
        first[whose[m, WHOSE.drone] + 1] += 1
    for i in range(len(first) - 1):
        first[i + 1] += first[i] + own[i]


@compiled
def _in_order(whose: NDArray, own: NDArray, first: NDArray) -> NDArray:
    """Return, for each message in order, the index of its sample, or -1 for a truth, or -2 for a status."""
    drones = len(first) - 1
    order, free = np.empty(first[drones], np.int64), first.copy()
    for m in range(whose.shape[0]):
        i = whose[m, WHOSE.drone]
        order[free[i]] = m
        free[i] += 1
    for i in range(drones):
        if own[i] > 0:
            order[free[i]], order[free[i] + 1] = -1, -2
    return order


@inlined
def _kind(sensor: int) -> int:
    """Return the number of a sensor's kind of message; those of users' sensors come after the status."""
    return sensor if sensor < STOCK_SENSORS else sensor + 2


@inlined
def _copy(user: UserPayloads, m: int, out: NDArray, start: int) -> int:
    """Copy the message of sample m, encoded in Python; return where the copy ends."""
    begin = user.ends[m - 1] if m > 0 else 0
    for k in range(user.ends[m] - begin):
        out[start + k] = user.data[begin + k]
    return start + user.ends[m] - begin


@inlined
def _fill(
    row: MessageRow,
    m: int,
    i: int,
    sampled: Sampled,
    seen: PublishedArrays,
    wide: PublishedState,
    now_ns: int,
    count: int,
) -> int:
    """Put sample m of drone i (m = -1: its truth, -2: its status) into a row, and count it; return its kind."""
    kind = _kind(sampled.whose[m, WHOSE.sensor]) if m >= 0 else TRUTH if m == -1 else STATUS
    row.ints[0], row.ints[1] = now_ns, wide.counts[i, kind]
    if m >= 0:
        _fill_sample(row, sampled, m, wide.sigma_m[i])
    elif kind == TRUTH:
        _fill_truth(row, seen.state[i], seen.accel[i], wide.rotors[i])
    else:
        row.ints[2], row.ints[3] = int(seen.memory[i, MEMORY.mode]), wide.touching[i]
        row.ints[4], row.ints[5] = wide.commanders[i], count
        row.floats[0] = charge_percent(seen.vehicle[i], seen.energy[i])
    wide.counts[i, kind] += 1
    return kind


@kernel()
def publish(held: Held, whose: NDArray, values: NDArray, data: NDArray, ends: NDArray, now_ns: int) -> int:
    """Write the messages of a gate, drone by drone, and count them; return the number of bytes.

    Args:
        held: a PublicationState, wrapped by `hold`.
        whose, values: fields of Sampled.
        data, ends: fields of UserPayloads.
    """
    words, seen, wide, out = held.content
    sampled, user = Sampled(whose, values), UserPayloads(data, ends)
    floats = np.zeros(FLOATS)
    row, program = MessageRow(np.zeros(INTS, np.int64), floats, floats.view(np.uint64)), Program(OPS, FIRST, LITERALS)
    drones, kinds = wide.counts.shape
    first, columns, at = out.first, out.columns, 0
    _by_drone(whose, wide.own, first)
    order = _in_order(whose, wide.own, first)
    for i in range(drones):
        for n in range(first[i], first[i + 1]):
            kind = _fill(row, order[n], i, sampled, seen, wide, now_ns, first[i + 1] - first[i] - 1)
            layout = kind
            if kind == TRUTH and wide.rotors[i] > ROTORS_MIN:
                layout = STATUS + wide.rotors[i] - ROTORS_MIN
            if kind <= STATUS:
                at = write(program, words, layout, row.ints, row.bits, out.data, at + GAP)
            else:
                at = _copy(user, order[n], out.data, at + GAP)
            columns[WHICH, n], columns[STAMPS, n], columns[ENDS, n] = i * kinds + kind, row.ints[0], at
    return at
