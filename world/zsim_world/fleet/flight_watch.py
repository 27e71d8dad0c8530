"""Incidents of drones: stops and landings of their own accord, flips, impacts, touchdowns, empty batteries.

The kernel detects them in every step of the firmware (5 ms), regardless of the gate interval, without influencing the
flight; they are described in words once per gate.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.math.compiled import Field, columns, inlined
from zsim.math.rotation import add, rotate
from zsim.schema.quantities import G_M_S2
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, Arrays, Bodies, Watched, four, vector
from zsim_world.physics.surfaces import FEET, PLANE, POINTS, contact_point, nearest, plane_depth
from zsim_world.vehicles.firmware import EMERGENCY, FLYING, HOVERING, LANDING, MEMORY, SETTING, TAKING_OFF
from zsim_world.vehicles.observer import STEP_S

IMPACT_STEPS = 4  # steps over which a change of velocity is measured: 20 ms, about half of a foot contact
IMPACT_G = 5.0  # mean acceleration over them; design choice: twice what rotors and drag cause; a 0.4 m fall reaches it
IMPACT_M_S = IMPACT_G * G_M_S2 * IMPACT_STEPS * STEP_S  # m/s, largest change of velocity without an impact
RIGHTED_COSINE = 0.5  # cosine of 60 deg of tilt; design choice: well below 90 deg, so that a flip is reported once
QUIET_STEPS = round(1.0 / STEP_S)  # design choice: contacts within 1 s of an impact are taken as bounces
MODE, FLIP, IMPACT, EMPTY, TOUCHDOWN = 1, 2, 4, 8, 16  # incident bits of a drone
NOTHING, GROUND, FIRST_OBSTACLE = 0, 1, 2  # what a drone touches; from FIRST_OBSTACLE on: obstacles, surfaces, drones

SEEN = columns(
    "SeenColumns",
    (
        Field("mode", "1"),  # last mode, commanded or detected
        Field("flipped", "1"),
        Field("empty", "1"),
        Field("quiet", "steps"),  # remaining steps without detection of impacts
        Field("external", "1"),  # 1: external drone
        Field("airborne", "1"),  # has been clear of ground and obstacles since it last touched one
        Field("grounded", "1"),  # its touchdown in flight has been detected
        Field("surface", "see NOTHING"),  # surface of that touchdown
        Field("touched", "see NOTHING"),  # what it touched last
        Field("speed", "m/s"),  # speed before its last impact
        Field("v_WB", "m/s", 3 * IMPACT_STEPS),  # velocities of the last steps, a ring buffer
    ),
)


class Incident(NamedTuple):
    """An incident of a drone, to be published as an event; `data` contains its cause or numbers."""

    drone: int
    kind: str
    text: str
    data: dict[str, Any]


class FlightWatch:
    """Describes the incidents of a fleet's drones; `drones` and `objects` are names."""

    def __init__(self, arrays: Arrays, drones: Sequence[str], objects: Sequence[str]) -> None:
        self._bodies, self._boards = arrays.bodies, arrays.boards
        self._seen, self._found = arrays.watched
        self._names = drones
        self._object_names = ("", "the ground", *objects, *drones)  # indexed by `SEEN.touched`

    def note_command(self, i: int, mode: int) -> None:
        """Note a commanded mode: entering it is not an incident."""
        self._seen[i, SEEN.mode] = mode

    def incidents(self) -> list[Incident]:
        incidents = []
        for i in np.flatnonzero(self._found).tolist():
            bits, name, seen = int(self._found[i]), self._names[i], self._seen[i]
            if bits & EMPTY:
                incidents.append(Incident(i, "battery", f"{name} has no charge left", {"charge_percent": 0.0}))
            if bits & MODE:
                incidents.append(self._own_mode(i, name))
            if bits & FLIP:
                incidents.append(Incident(i, "flip", f"{name} turns upside down", {}))
            if bits & IMPACT:
                speed_m_s, other = float(seen[SEEN.speed]), self._object_names[int(seen[SEEN.touched])]
                data = {"speed_m_s": round(speed_m_s, 3), "other": other}
                incidents.append(Incident(i, "impact", f"{name} hits {other} at {speed_m_s:.1f} m/s", data))
            if bits & TOUCHDOWN:
                other = self._object_names[int(seen[SEEN.surface])]
                text = f"{name} touches {other} in flight: no landing was commanded"
                incidents.append(Incident(i, "touchdown", text, {"other": other}))
        return incidents

    def _own_mode(self, i: int, name: str) -> Incident:
        """Return the incident of a drone whose firmware has changed the mode of its own accord, with the reason."""
        if self._boards.memory[i, MEMORY.mode] == EMERGENCY:
            tilt_deg = math.degrees(el.acos(self._boards.setting[i, SETTING.tilt_cut]))
            text = f"{name} stops its rotors: it finds itself tilted by more than {tilt_deg:.0f} deg"
            return Incident(i, "emergency", text, {"cause": "tilt"})
        charge = 100.0 * float(self._bodies.energy[i] / self._bodies.vehicle[i, VEHICLE.capacity])
        if charge < self._boards.setting[i, SETTING.low_battery]:
            data = {"cause": "battery", "charge_percent": round(charge, 2)}
            return Incident(i, "landing", f"{name} lands by itself: it has {charge:.1f} % of charge", data)
        text = f"{name} lands by itself: no command has taken effect for too long"
        return Incident(i, "landing", text, {"cause": "silence"})


@inlined
def watch(bodies: Bodies, memory: NDArray, watched: Watched, step: int) -> None:
    """Add the incident bits of all simulated drones in firmware step number `step` to those of the gate."""
    seen, found = watched
    oldest = SEEN.v_WB + 3 * (step % IMPACT_STEPS)
    for i in range(found.size):
        if seen[i, SEEN.external] != 0.0:
            continue
        bits, mode = 0, memory[i, MEMORY.mode]
        if mode != seen[i, SEEN.mode]:
            seen[i, SEEN.mode] = mode
            if mode in (EMERGENCY, LANDING):
                bits |= MODE
        bits |= _touchdown(bodies, seen, i, mode)
        x, y = bodies.state[i, STATE.q_WB + 1], bodies.state[i, STATE.q_WB + 2]
        up = 1.0 - 2.0 * (x * x + y * y)
        if up < 0.0 and seen[i, SEEN.flipped] == 0.0:
            seen[i, SEEN.flipped] = 1.0
            bits |= FLIP
        elif up > RIGHTED_COSINE:
            seen[i, SEEN.flipped] = 0.0
        change, former = 0.0, 0.0
        for k in range(3):
            previous, current = seen[i, oldest + k], bodies.state[i, STATE.v_WB + k]
            change += (current - previous) * (current - previous)
            former += previous * previous
            seen[i, oldest + k] = current
        if seen[i, SEEN.quiet] > 0.0:
            seen[i, SEEN.quiet] -= 1.0
        elif change > IMPACT_M_S * IMPACT_M_S:
            seen[i, SEEN.speed], seen[i, SEEN.quiet] = math.sqrt(former), QUIET_STEPS
            bits |= IMPACT
        if bodies.energy[i] <= 0.0 and seen[i, SEEN.empty] == 0.0:
            seen[i, SEEN.empty] = 1.0
            bits |= EMPTY
        found[i] |= bits


@inlined
def _touchdown(bodies: Bodies, seen: NDArray, i: int, mode: float) -> int:
    """Note what drone i touches; return TOUCHDOWN when it first touches the ground or an obstacle in flight, else 0."""
    if bodies.braced[i] == 0 and bodies.state[i, STATE.p_WB + 2] > bodies.vehicle[i, VEHICLE.contact_reach]:
        seen[i, SEEN.airborne], seen[i, SEEN.grounded] = 1.0, 0.0
        return 0
    surface = _surface(bodies, i)
    touched, object_count = surface, bodies.bumping.shape[1]
    if bodies.braced[i] != 0:
        for m in range(object_count):
            if bodies.bumping[i, m] != 0:
                touched = FIRST_OBSTACLE + m
        for j in range(bodies.state.shape[0]):
            if bodies.touching[min(i, j), max(i, j)] != 0:
                touched = FIRST_OBSTACLE + object_count + j
    if touched != NOTHING:
        seen[i, SEEN.touched] = touched
    if surface == NOTHING:
        return 0
    has_lifted_off = mode == TAKING_OFF and seen[i, SEEN.airborne] != 0.0  # in take-off, once off the ground
    seen[i, SEEN.airborne] = 0.0
    if seen[i, SEEN.grounded] != 0.0 or not (has_lifted_off or mode in (HOVERING, FLYING)):
        return 0
    seen[i, SEEN.grounded], seen[i, SEEN.surface] = 1.0, surface
    return TOUCHDOWN


@inlined
def _surface(bodies: Bodies, i: int) -> int:
    """Return the code (see NOTHING) of a surface that a contact point of drone i has penetrated."""
    row, state = bodies.vehicle[i], bodies.state[i]
    p_WB, q_WB = vector(state, STATE.p_WB), four(state, STATE.q_WB)
    if p_WB[2] <= row[VEHICLE.contact_reach]:
        for k in range(POINTS):
            if p_WB[2] + rotate(q_WB, contact_point(row, k))[2] < 0.0:
                return GROUND
    for s in range(bodies.solid.shape[1]):
        m = bodies.solid[i, s]
        if m >= 0:
            for k in range(FEET):
                x = add(p_WB, rotate(q_WB, contact_point(row, k)))
                if nearest(bodies.obstacle[m], x[0], x[1], x[2])[0] < 0.0:
                    return FIRST_OBSTACLE + m
    if bodies.plane.shape[1] > 0:
        for k in range(FEET):
            if plane_depth(bodies.plane[i, k], 0.0) > 0.0:
                return FIRST_OBSTACLE + bodies.obstacle.shape[0] + int(bodies.plane[i, k, PLANE.surface])
    return NOTHING
