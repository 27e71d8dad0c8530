"""What befalls drones: the firmware stops or lands one by itself, one turns over, hits something, has no charge left.

Found once a gate on the arrays of the fleet by one compiled pass, which reads and compares and changes nothing of the
flight; what is found is put into words only then.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zsim.contract.snapshot import State
from zsim.math.columns import Field, columns
from zsim.math.compiled import Held, hold, kernel
from zsim.schema.quantities import G_M_S2
from zsim_world.state.fleet_arrays import STATE, VEHICLE, Bodies
from zsim_world.vehicles.firmware import EMERGENCY, LANDING, MEMORY
from zsim_world.vehicles.firmware_settings import SETTING

IMPACT_G = 5.0  # chosen: twice what rotors and drag give a drone, on average over a gate; a fall from 0.4 m has it
UPRIGHT_AGAIN = 0.5  # chosen: cosine of the tilt below which one that was upside down may turn over again
QUIET_S = 1.0  # chosen: contacts that follow one sooner are its bounces
MODE, FLIP, IMPACT, EMPTY = 1, 2, 4, 8  # bits of what befell a drone

SEEN = columns(
    "SeenColumns",
    (
        Field("mode", "1"),  # that it was asked for, or that was found
        Field("flipped", "1"),
        Field("empty", "1"),
        Field("quiet", "gates"),  # in which no impact is found any more
        Field("external", "1"),  # its body is
        Field("v_WB", "m/s", 3),  # at the last gate
        Field("speed", "m/s"),  # at the gate before that, as a contact may last for two; from an impact on: of it
    ),
)


class Mishap(NamedTuple):
    """What befell a drone, as an event: `data` has its cause or its figures."""

    drone: int
    kind: str
    text: str
    data: dict[str, Any]


class WatchedArrays(NamedTuple):
    """What of N drones is compared from gate to gate."""

    state: NDArray[np.float64]  # of Bodies
    memory: NDArray[np.float64]  # of the firmware
    energy: NDArray[np.float64]  # of Bodies
    seen: NDArray[np.float64]  # (N, SEEN.size), written
    found: NDArray[np.int64]  # (N,), bits of what befell each, written


class FlightWatch:
    """Watches the drones of a fleet from gate to gate.

    Args:
        bodies, memory, setting: arrays of the fleet; `memory` and `setting` are the firmware's.
        names: of the drones.
        external: those whose bodies are external, which are not watched.
        gate_s: between two gates.
    """

    def __init__(
        self,
        bodies: Bodies,
        memory: NDArray[np.float64],
        setting: NDArray[np.float64],
        names: Sequence[str],
        external: Sequence[int],
        gate_s: float,
    ) -> None:
        self._bodies, self._memory, self._setting, self._names = bodies, memory, setting, names
        self._seen = np.zeros((len(names), SEEN.size))
        self._seen[:, SEEN.external] = [i in external for i in range(len(names))]
        self._found = np.zeros(len(names), np.int64)
        self._change_m_s = IMPACT_G * G_M_S2 * gate_s
        self._quiet_gates = math.ceil(QUIET_S / gate_s)
        self._held = hold(WatchedArrays(bodies.state, memory, bodies.energy, self._seen, self._found))
        self.look()  # loads or compiles it

    def snapshot(self) -> State:
        """Return what was seen."""
        return {"seen": self._seen}

    def restore(self, state: State) -> None:
        """Take over what `snapshot` returned."""
        self._seen[:] = state["seen"]

    def ask(self, i: int, mode: int) -> None:
        """Note that a drone was asked to enter a mode: that is no mishap."""
        self._seen[i, SEEN.mode] = mode

    def look(self) -> bool:
        """Compare the drones with what was seen at the last gate; return whether anything befell one."""
        return find(self._held, self._change_m_s, self._quiet_gates) > 0

    def mishaps(self, touching: NDArray[np.bool_]) -> list[Mishap]:
        """Return what befell drones in the last gate; `touching` (N,) are those whose hulls touch another body."""
        found = []
        for i in np.flatnonzero(self._found).tolist():
            bits, name = int(self._found[i]), self._names[i]
            if bits & EMPTY:
                found.append(Mishap(i, "battery", f"{name} has no charge left", {"charge_percent": 0.0}))
            if bits & MODE:
                found.append(self._own_mode(i, name))
            if bits & FLIP:
                found.append(Mishap(i, "flip", f"{name} turns upside down", {}))
            if bits & IMPACT:
                speed_m_s, what = float(self._seen[i, SEEN.speed]), "another body" if touching[i] else "the ground"
                data = {"speed_m_s": round(speed_m_s, 3), "other": what}
                found.append(Mishap(i, "impact", f"{name} hits {what} at {speed_m_s:.1f} m/s", data))
        return found

    def _own_mode(self, i: int, name: str) -> Mishap:
        """Return the mode that the firmware of a drone entered by itself, with its reason."""
        if self._memory[i, MEMORY.mode] == EMERGENCY:
            tilt_deg = math.degrees(math.acos(self._setting[i, SETTING.tilt_cut]))
            text = f"{name} stops its rotors: it finds itself tilted by more than {tilt_deg:.0f} deg"
            return Mishap(i, "emergency", text, {"cause": "tilt"})
        charge = 100.0 * float(self._bodies.energy[i] / self._bodies.vehicle[i, VEHICLE.capacity])
        if charge < self._setting[i, SETTING.low_battery]:
            data = {"cause": "battery", "charge_percent": round(charge, 2)}
            return Mishap(i, "landing", f"{name} lands by itself: it has {charge:.1f} % of charge", data)
        return Mishap(i, "landing", f"{name} lands by itself: nobody has commanded it for long", {"cause": "silence"})


@kernel()
def find(held: Held, change_m_s: float, quiet_gates: int) -> int:
    """Set what befell each of N drones since the last call (bits, (N,)); return how many it befell.

    Args:
        held: WatchedArrays, by `hold`.
        change_m_s: greatest change of velocity over a gate without an impact.
        quiet_gates: after an impact, gates in which no other one is found.
    """
    state, memory, energy, seen, found = held.content
    count = 0
    for i in range(found.size):
        found[i] = 0
        if seen[i, SEEN.external] != 0.0:
            continue
        bits, mode = 0, memory[i, MEMORY.mode]
        if mode != seen[i, SEEN.mode]:
            seen[i, SEEN.mode] = mode
            if mode in (EMERGENCY, LANDING):
                bits |= MODE
        x, y = state[i, STATE.q_WB + 1], state[i, STATE.q_WB + 2]
        up = 1.0 - 2.0 * (x * x + y * y)
        if up < 0.0 and seen[i, SEEN.flipped] == 0.0:
            seen[i, SEEN.flipped] = 1.0
            bits |= FLIP
        elif up > UPRIGHT_AGAIN:
            seen[i, SEEN.flipped] = 0.0
        change, former = 0.0, 0.0
        for k in range(3):
            was, now = seen[i, SEEN.v_WB + k], state[i, STATE.v_WB + k]
            change += (now - was) * (now - was)
            former += was * was
            seen[i, SEEN.v_WB + k] = now
        former = math.sqrt(former)
        if seen[i, SEEN.quiet] > 0.0:
            seen[i, SEEN.quiet] -= 1.0
        elif change > change_m_s * change_m_s:
            seen[i, SEEN.speed] = max(seen[i, SEEN.speed], former)
            seen[i, SEEN.quiet] = quiet_gates
            bits |= IMPACT
        if seen[i, SEEN.quiet] <= 0.0:
            seen[i, SEEN.speed] = former
        if energy[i] <= 0.0 and seen[i, SEEN.empty] == 0.0:
            seen[i, SEEN.empty] = 1.0
            bits |= EMPTY
        found[i] = bits
        count += bits != 0
    return count
