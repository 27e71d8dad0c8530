"""The effects of faults on the arrays of a fleet: sensors, rotors and wind. Without faults the arrays are unchanged."""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from zsim.contract.run_messages import Fault
from zsim.contract.snapshot import Saved
from zsim.math import elementary as el
from zsim.math.randomness import normal_probability, normal_quantile
from zsim.scenario.faults import sensor_parts
from zsim.sensors.scanner import SCANNERS
from zsim.vehicles.vehicle import Vehicle
from zsim_world.physics.contacts import WIND
from zsim_world.physics.fleet_arrays import STATE, Arrays
from zsim_world.sensors import sensor_set as ss
from zsim_world.sensors.scans import SCANNER, ScanSampler
from zsim_world.sensors.sensor_set import CONFIG, FAULT, FleetSensors
from zsim_world.vehicles.firmware import ACTUATOR, sound_actuators


class Impairment:
    """Applies faults to the drones of a fleet and to its wind.

    Args:
        arrays: arrays of the fleet, as before its first gate.
        drones, vehicles: names and vehicles of the drones, in scenario order.
        sensors: types and settings of the fleet's sensors.
        scans: sampler of the sensors that cast rays; None if no drone has any.

    Attributes:
        rotors: rotor names by drone.
    """

    SAVED: ClassVar[Saved] = {"_held": dict[int, tuple[float, ...]], "_gusts": tuple[Fault, ...], "_calm": bool}

    def __init__(
        self,
        arrays: Arrays,
        drones: Sequence[str],
        vehicles: Sequence[Vehicle],
        sensors: FleetSensors,
        scans: ScanSampler | None = None,
    ) -> None:
        self._w, self._scans = arrays, scans
        self._sensor = {name: s for s, name in enumerate(sensors.names)}
        self._parts = sensor_parts(dict(zip(sensors.names, sensors.types, strict=True)))
        self._index = {name: i for i, name in enumerate(drones)}
        self._config = arrays.senses.config.copy()
        self._steady = arrays.wind[WIND.steady : WIND.steady + 3].copy()
        self.rotors = {name: vehicle.rotor_names for name, vehicle in zip(drones, vehicles, strict=True)}
        self._sound = sound_actuators(len(drones), len(arrays.bodies.each))
        self._held: dict[int, tuple[float, ...]] = {}  # speeds of the rotors that a fault holds, by the fault's id
        self._gusts: tuple[Fault, ...] = ()
        self._calm = True

    def strike(self, acting: Sequence[Fault]) -> None:
        """Make exactly these faults act from now on; those already acting continue unchanged."""
        self._w.senses.config[:] = self._config
        self._w.boards.actuator[:] = self._sound
        if self._scans:
            self._scans.recover()
        self._w.senses.fault[:, :, FAULT.offset : FAULT.hold] = 0.0
        stuck: set[tuple[int, int]] = set()
        self._held = {fault.id: self._held[fault.id] for fault in acting if fault.id in self._held}
        for fault in acting:
            if fault.target in self._index:
                self._impair(fault, self._index[fault.target], stuck)
        # Newly stuck sensors hold their next sample; those no longer stuck are released.
        hold = self._w.senses.fault[:, :, FAULT.hold]
        still_stuck = {(i, s) for i, s in stuck if hold[i, s] == ss.HOLDING}
        hold[:] = ss.FREE
        for index in stuck:
            hold[index] = ss.HOLDING if index in still_stuck else ss.ARMED
        self._gusts = tuple(fault for fault in acting if fault.kind == "gust")

    def blow(self, from_ns: int, until_ns: int) -> None:
        """Set the wind between two instants: the steady wind plus the gusts halfway between them."""
        if self._calm and not self._gusts:
            return
        at_ns = (from_ns + until_ns) // 2
        steady = self._w.wind[WIND.steady : WIND.steady + 3]
        steady[:] = self._steady + sum((gust_m_s(fault, at_ns) for fault in self._gusts), np.zeros(3))
        self._calm = not self._gusts

    def _impair(self, fault: Fault, i: int, stuck: set[tuple[int, int]]) -> None:
        device, _, effect = fault.kind.rpartition("_")
        if device == "rotor":
            self._impair_rotors(fault, i, effect)
            return
        if device in SCANNERS:
            for row in self._scans.rows_of(i, device) if self._scans else ():
                _impair_scanner(row, effect, fault.parameters)
            return
        if effect in ("dropout", "stuck"):
            row = self._w.senses.config[i, self._sensor[device]]
            if effect == "stuck":
                row[CONFIG.faulty] = 1.0
                stuck.add((i, self._sensor[device]))
            else:
                row[CONFIG.drop] = dropped(row[CONFIG.drop], fault.parameters["probability"])
            return
        part = self._parts[device]
        s = self._sensor[part.sensor]
        row, first = self._w.senses.config[i, s], part.first
        if effect == "noise":
            row[CONFIG.white + first : CONFIG.white + first + part.width] *= fault.parameters["factor"]
        else:
            row[CONFIG.faulty] = 1.0
            offset = self._w.senses.fault[i, s, FAULT.offset + first : FAULT.offset + first + part.channel.width]
            (bias,) = fault.parameters.values()  # the only parameter: a number or vector, named by its unit
            offset += np.multiply(bias, part.channel.to_si)

    def _impair_rotors(self, fault: Fault, i: int, effect: str) -> None:
        row, target_rotor, count = self._w.boards.actuator[i], fault.parameters["rotor"], len(self._w.bodies.each)
        row[ACTUATOR.faulty] = 1.0
        for r, name in enumerate(self.rotors[fault.target]):
            if target_rotor in (name, "all"):
                if effect == "efficiency":  # thrust is proportional to the speed squared
                    row[ACTUATOR.size + r] *= math.sqrt(fault.parameters["value"])
                else:
                    if fault.id not in self._held:  # at speed_rad_s, or at each rotor's speed at the start of the fault
                        speed, speeds = fault.parameters["speed_rad_s"], self._w.bodies.state[i, STATE.size :].tolist()
                        self._held[fault.id] = tuple(speeds) if speed is None else (speed,) * len(speeds)
                    row[ACTUATOR.size + count + r] = self._held[fault.id][r]


def _impair_scanner(row: NDArray[np.float64], effect: str, parameters: Mapping[str, float]) -> None:
    if effect == "stuck":
        row[SCANNER.stuck] = 1.0
    elif effect == "dropout":
        row[SCANNER.drop] = dropped(row[SCANNER.drop], parameters["probability"])
    elif effect == "noise":
        row[[SCANNER.noise, SCANNER.share, SCANNER.square]] *= parameters["factor"]
    else:
        row[SCANNER.bias] += parameters["value_m"]


def dropped(limit: float, probability: float) -> float:
    """Return the value of a standard normal variate below which a sample is lost; `limit`: that without the fault."""
    if probability == 1.0:
        return math.inf
    return normal_quantile(1.0 - (1.0 - normal_probability(limit)) * (1.0 - probability))


def gust_m_s(fault: Fault, t_ns: int) -> NDArray[np.float64]:
    """Return the velocity that a gust adds [m/s], in W: v (1 - cos(2 pi t / T)) / 2, as in CS 25.341(a)(2).

    Over its duration T (in CS 25: twice the gust gradient distance) the gust rises to v and falls to zero again.
    """
    assert fault.until_ns is not None  # a gust always has an end
    phase = 2.0 * math.pi * (t_ns - fault.from_ns) / (fault.until_ns - fault.from_ns)
    return 0.5 * (1.0 - el.cos(phase)) * np.array(fault.parameters["velocity_m_s"])
