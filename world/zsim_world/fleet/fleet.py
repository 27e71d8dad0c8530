"""The fleet: all drones of a scenario, one gate at a time. The only thing that the rest of the world uses.

An external drone has a row as every other, so that it is run into and blows on those below; it is led, not integrated.

Heights: `baro` altitude_m is the height over the origin of W (zeroed at the field, as the aircraft does at power-up),
and pressure_pa is that of the standard atmosphere at `environment.height_m` + altitude_m.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.flight_messages import DroneState
from zsim.contract.messages import RotorInfo
from zsim.contract.snapshot import State
from zsim.contract.state_rules import state_refusal
from zsim.errors import RunError
from zsim.math.compiled import hold
from zsim.scenario.scenario import Drone, Scenario
from zsim.sensors.gps import GpsConfig
from zsim.sensors.sensor import noise_sigma
from zsim.vehicles.vehicle import Vehicle
from zsim.vehicles.vehicle_catalogue import vehicle_of
from zsim_world.fleet import kernel
from zsim_world.fleet.fault_effects import Impairment
from zsim_world.fleet.flight_watch import FlightWatch, Incident
from zsim_world.fleet.initial_state import arrays
from zsim_world.physics.air import WIND
from zsim_world.physics.fleet_arrays import ROTOR, STATE, VEHICLE, state_arrays
from zsim_world.sensors.noise import NoiseTable
from zsim_world.sensors.sampler import WHOSE, Sampled, Sampler, SensorSample, with_more
from zsim_world.sensors.sensor_set import fleet_sensors
from zsim_world.sensors.sighting_sampler import PictureSightings, SightingSampler
from zsim_world.vehicles import firmware
from zsim_world.vehicles.firmware import MEMORY, SETPOINT
from zsim_world.vehicles.firmware_settings import SETTING
from zsim_world.vehicles.observer import BELIEF

GPS_FIX = 3  # NMEA: a three-dimensional fix
GPS_SATELLITES = 9  # as in a real navdata packet of the AR.Drone
TAKEOFF_CHARGE = 2.0  # of the charge at which it lands: below, it does not take off
UPRIGHT_COSINE = 0.87  # 30 deg, beyond which it does not take off
QUATERNION_SQUARE_MIN = 1e-6  # shorter, a quaternion has no direction
NOISE_GATES = 8  # gates between two refills of the noise: that of 100 drones then fits a cache of 1 MB


class DivergedError(RunError):
    """The state of a drone is no longer finite; the text names the drone and the time."""

    def __init__(self, drone: str, t_s: float) -> None:
        super().__init__(
            f"{drone} at {t_s:.3f} s: the state is no longer finite; check its mass, inertia, rotors and dt"
        )
        self.drone = drone


class TrueState(NamedTuple):
    """The true state of N drones, copied."""

    position_m: NDArray[np.float64]  # (N, 3), W
    velocity_m_s: NDArray[np.float64]  # (N, 3), W
    orientation_wxyz: NDArray[np.float64]  # (N, 4), B to W
    angular_velocity_rad_s: NDArray[np.float64]  # (N, 3), B
    accel_m_s2: NDArray[np.float64]  # (N, 3), W
    rotor_rad_s: NDArray[np.float64]  # (N, R), 0 where a drone has fewer


_TAKES_SETPOINT = {mode for mode, state in enumerate(firmware.MODES) if state_refusal("", state, "setpoint") is None}


class Fleet:
    """All drones of a scenario, stepped together gate by gate from t = 0, standing on the ground.

    Attributes:
        names: in scenario order, in which drones are counted.
        rotors: how many each has.
        external: the drones that are not integrated, each with its place among them.
        sensors: of each.
        environment: of the scenario.
        gps_sigma_m: of each drone's fixes.
        impairment: what faults do to it.
        bodies, boards: the arrays that the kernel works on; to be read only.
        sampled: what fell due for publication in the last gate; a sighting is of the sensor behind all of `sensors`.
        sightings: among these, by the row of `sampled`.
        touching: whether a drone's hull touched another's in the last gate, (N,).
    """

    sampled: Sampled

    def __init__(self, scenario: Scenario) -> None:
        """Place the drones and take the samples of t = 0.

        Raises:
            DivergedError: the scenario's numbers cannot be integrated.
        """
        self.names = [drone.name for drone in scenario.drones]
        vehicles = [_vehicle(index, drone) for index, drone in enumerate(scenario.drones)]
        self.rotors = [len(vehicle.rotors) for vehicle in vehicles]
        self.count = len(self.names)
        self.external = {i: e for e, i in enumerate(i for i, d in enumerate(scenario.drones) if d.is_external)}
        self.gps_sigma_m = [_gps_sigma(drone.sensors.gps) for drone in scenario.drones]
        self._tick_ns = round(scenario.time.physics_dt_ms * 1_000_000)
        self._ticks = round(scenario.time.gate_ms / scenario.time.physics_dt_ms)
        self._tick = 0
        self._gates = 0
        self.sensors = fleet_sensors(scenario)
        self.environment = scenario.environment
        self._noise = NoiseTable(scenario, NOISE_GATES)
        self._w = arrays(scenario, vehicles, self.sensors, self._noise)
        self._sampler = Sampler(scenario, self.sensors, self._w.senses)
        self._sightings = _sighting_sampler(scenario, self._w.bodies.vehicle[:, VEHICLE.hull_radius])
        self.sightings: dict[int, PictureSightings] = {}
        self._held = hold(self._w)
        self.bodies, self.boards = self._w.bodies, self._w.boards
        self.impairment = Impairment(self._w, self.names, vehicles, self.sensors)
        self.touching = np.zeros(self.count, dtype=bool)
        self._hull_m = float(self.bodies.vehicle[:, VEHICLE.hull_radius].max())
        self._integrate(0)
        self._watch = FlightWatch(self._w, self.names, [each.name for each in scenario.environment.obstacles])
        self._rehearse()

    def _rehearse(self) -> None:
        """Load or compile what the first command needs: in realtime no gate may wait for it."""
        kernel.enter(self.boards.memory[0].copy(), self.boards.belief[0].copy(), firmware.LANDED)

    @property
    def has_sightings(self) -> bool:
        """Whether any drone has them."""
        return self._sightings is not None

    @property
    def t_ns(self) -> int:
        """Simulated time of the present state."""
        return self._tick * self._tick_ns

    def rotor_info(self, i: int) -> tuple[RotorInfo, ...]:
        """Return the rotors of a drone as `world/info` names them."""
        row, groups = self.bodies.vehicle[i], self.bodies.rotors[i].reshape(ROTOR.size, -1)
        unit, radius = row[VEHICLE.rotor_unit], float(row[VEHICLE.rotor_radius])
        x, y = (unit * groups[ROTOR.x]).tolist(), (unit * groups[ROTOR.y]).tolist()
        turns = groups[ROTOR.turn].tolist()
        named = enumerate(self.impairment.rotors[self.names[i]])
        return tuple(RotorInfo(name, x[r], y[r], 1 if turns[r] > 0.0 else -1, radius) for r, name in named)

    @property
    def wind_m_s(self) -> NDArray[np.float64]:
        """Wind at each drone in W, steady and gusts, without the downwash of others; (N, 3)."""
        return self._w.gust + self._w.wind[WIND.steady : WIND.steady + 3]

    def advance(self) -> None:
        """Integrate one gate with the present setpoints.

        Raises:
            DivergedError: the state of a drone is no longer finite.
        """
        if self._gates % NOISE_GATES == 0:
            self._noise.refill()
        self._gates += 1
        self._integrate(self._ticks)

    def snapshot(self) -> State:
        """Return all from which the flight goes on to the same bits."""
        return {
            "tick": self._tick,
            "gates": self._gates,
            "least_m": self._least,
            "touching": self.touching,
            "arrays": list(state_arrays(self._w)),
            "streams": self._noise.streams,
            "sampler": self._sampler.snapshot(),
            **({"sightings": self._sightings.snapshot()} if self._sightings else {}),
        }

    def restore(self, state: State) -> None:
        """Take over what `snapshot` of a fleet of the same scenario returned.

        Raises:
            ValueError: it is of another scenario.
        """
        self._tick, self._gates, self._least = state["tick"], state["gates"], state["least_m"]
        self.touching[:] = state["touching"]
        for array, saved in zip(state_arrays(self._w), state["arrays"], strict=True):
            array[...] = saved
        self.bodies.near.origin.fill(math.inf)  # the near pairs are found anew
        self._noise.streams[:] = state["streams"]
        self._sampler.restore(state["sampler"])
        if self._sightings:
            self._sightings.restore(state["sightings"])

    def samples(self) -> list[SensorSample]:
        """Return what fell due for publication in the last gate but sightings, by (t_ns, drone, sensor)."""
        numbers = self.sampled.whose[:, WHOSE.sensor] < len(self.sensors.names)
        return Sampled(self.sampled.whose[numbers], self.sampled.values[numbers]).each(self.sensors)

    def truth(self) -> TrueState:
        """Return the true state now."""
        s, accel = self.bodies.state.copy(), self.bodies.accel[:, 0:3].copy()
        return TrueState(s[:, 0:3], s[:, 3:6], s[:, 6:10], s[:, 10:13], accel, s[:, STATE.size :])

    def lead(self, i: int, pose: NDArray[np.float64]) -> None:
        """Let an external drone be where a pose says, (STATE.size + its rotors,), and move on with its velocity."""
        self.bodies.pose[self.external[i], : len(pose)] = pose
        self.bodies.state[i, : len(pose)] = pose

    def status(self, i: int) -> tuple[DroneState, float, bool]:
        """Return the firmware's mode, the charge [%], and whether the hull touched another in the last gate."""
        charge = 100.0 * self.bodies.energy.item(i) / self.bodies.vehicle.item(i, VEHICLE.capacity)
        return firmware.MODES[self._mode(i)], charge, bool(self.touching[i])

    def closest_m(self) -> float:
        """Return the least distance between two drones over the last gate; inf for a single one."""
        return self._least

    def collisions(self) -> list[tuple[int, int]]:
        """Return the pairs whose hulls began to touch in the last gate."""
        return self._began

    def bumps(self) -> list[tuple[int, int]]:
        """Return who began to touch which obstacle in the last gate."""
        if not self.bodies.obstacle.size:
            return []
        return [(int(i), int(m)) for i, m in np.argwhere(self.bodies.bumped)]

    def incidents(self) -> list[Incident]:
        """Return the incidents of drones in the last gate."""
        return self._watch.incidents() if self._has_incidents else []

    def takeoff(self, i: int) -> str | None:
        """Start a take-off; return None, or why not."""
        charge = self.status(i)[1]
        if refusal := self._state_refusal(i, "takeoff"):
            return refusal
        least = TAKEOFF_CHARGE * self.boards.setting.item(i, SETTING.low_battery)
        if charge < least:
            return f"{self.names[i]} has {charge:.1f} % of charge; a take-off needs {least:g} %"
        x, y = self.boards.belief[i, BELIEF.q_WB + 1 : BELIEF.q_WB + 3]
        if 1.0 - 2.0 * (x * x + y * y) < UPRIGHT_COSINE:
            return f"{self.names[i]} does not stand upright; a take-off needs it within 30 deg of level"
        self._enter(i, firmware.TAKING_OFF)
        return None

    def land(self, i: int) -> str | None:
        """Start a landing; return None, or why not."""
        if refusal := self._state_refusal(i, "land"):
            return refusal
        if self._mode(i) != firmware.LANDING:
            self._enter(i, firmware.LANDING)
        return None

    def emergency(self, i: int) -> str | None:
        """Stop the rotors at once; always accepted."""
        self._enter(i, firmware.EMERGENCY)
        return None

    def reset(self, i: int) -> str | None:
        """Leave the emergency; return None, or why not."""
        if refusal := self._state_refusal(i, "reset"):
            return refusal
        self._enter(i, firmware.LANDED)
        return None

    def set_velocity(
        self,
        i: int,
        velocity_m_s: Sequence[float],
        yaw_rate_rad_s: float = 0.0,
        frame: Literal["heading", "world"] = "heading",
    ) -> str | None:
        """Fly a velocity in the heading frame, or in W by the firmware's own heading; return None, or why not."""
        kind = firmware.VELOCITY if frame == "heading" else firmware.VELOCITY_WORLD
        return self._set(i, kind, (*velocity_m_s, yaw_rate_rad_s))

    def set_ardrone(
        self, i: int, forward: float, left: float, up: float, yaw_left: float, hover: bool = False
    ) -> str | None:
        """Fly by tilt, climb and yaw rate, each in [-1, 1] of its limit, or hover; return None, or why not."""
        return self._set(i, firmware.HOVER if hover else firmware.ARDRONE, (forward, left, up, yaw_left))

    def set_attitude(self, i: int, q_WB: Sequence[float], thrust_n: float, yaw_rate_rad_s: float = 0.0) -> str | None:
        """Fly a tilt (of q_WB, w first; its heading is not used), thrust [N] and yaw rate; return None, or why not."""
        if fault := self.orientation_fault(i, q_WB):
            return fault
        return self._set(i, firmware.ATTITUDE, (*q_WB, thrust_n, yaw_rate_rad_s))

    def set_rotors(self, i: int, speed_rad_s: Sequence[float]) -> str | None:
        """Command the speeds of all rotors within their limits; return None, or why not."""
        if fault := self.rotors_fault(i, speed_rad_s):
            return fault
        return self._set(i, firmware.ROTORS, tuple(speed_rad_s))

    def orientation_fault(self, i: int, q_WB: Sequence[float]) -> str | None:
        """Return why an orientation sent to a drone is none, None if it is one."""
        if sum(x * x for x in q_WB) < QUATERNION_SQUARE_MIN:
            return f"{self.names[i]} was sent the orientation {list(q_WB)}; must be a quaternion of length 1"
        return None

    def rotors_fault(self, i: int, speed_rad_s: Sequence[float]) -> str | None:
        """Return why rotor speeds sent to a drone are not for it, None if they are."""
        if len(speed_rad_s) != self.rotors[i]:
            return f"{self.names[i]} was sent {len(speed_rad_s)} rotor speeds; it has {self.rotors[i]} rotors"
        return None

    def release(self, i: int) -> None:
        """Let nobody fly the drone any more: it hovers."""
        self.boards.setpoint[i, SETPOINT.kind] = firmware.NONE

    def _set(self, i: int, kind: int, values: tuple[float, ...]) -> str | None:
        if self._mode(i) not in _TAKES_SETPOINT:
            return self._state_refusal(i, "setpoint")
        if not math.isfinite(sum(values)):
            return f"{self.names[i]} was sent a setpoint with {list(values)}; must be finite"
        self.boards.setpoint[i, SETPOINT.kind : SETPOINT.value + len(values)] = (kind, *values)
        self.boards.set_tick[i] = self._tick
        return None

    def _mode(self, i: int) -> int:
        return int(self.boards.memory.item(i, MEMORY.mode))

    def _state_refusal(self, i: int, asked: str) -> str | None:
        return state_refusal(self.names[i], firmware.MODES[self._mode(i)], asked)

    def _enter(self, i: int, mode: int) -> None:
        kernel.enter(self.boards.memory[i], self.boards.belief[i], mode)
        self._watch.note_command(i, mode)

    def _integrate(self, ticks: int) -> None:
        logged, least, diverged, self._has_incidents = kernel.advance(self._held, ticks)
        if diverged >= 0:
            raise DivergedError(self.names[diverged], (self._tick + ticks) * self._tick_ns / 1e9)
        self._tick += ticks
        self._least = least
        self._meet(least)
        self.sampled = self._sampler.due(logged, self.t_ns)
        if self._sightings:
            self._add_sightings(self._sightings.due(self.bodies.state, self.t_ns))

    def _add_sightings(self, sightings: list[PictureSightings]) -> None:
        """Put sightings among the samples of the gate, behind those of the same drone and time."""
        self.sightings = {}
        if not sightings:
            return
        number = len(self.sensors.names)
        sightings.sort()
        rows = [(number, each.drone, each.t_ns, each.t_sample_ns) for each in sightings]
        more = np.array(rows, dtype=np.int64)
        whose, values, places = with_more(*self.sampled, more)
        self.sampled = Sampled(whose, values)
        self.sightings = dict(zip(places.tolist(), sightings, strict=True))

    def _meet(self, least: float) -> None:
        self._began: list[tuple[int, int]] = []
        self.touching.fill(False)
        if self.bodies.obstacle.size:
            self.touching[:] = self.bodies.bumping.any(axis=1)
        if least < 2.0 * self._hull_m:
            self._began = [(int(i), int(j)) for i, j in np.argwhere(self.bodies.touched)]
            self.touching[np.argwhere(self.bodies.touched | self.bodies.touching).ravel()] = True


def _sighting_sampler(scenario: Scenario, hulls: NDArray[np.float64]) -> SightingSampler | None:
    """Return what makes the sightings of a scenario, None where no drone has any."""
    has_some = any(drone.sensors.sightings is not UNSET and not drone.is_external for drone in scenario.drones)
    return SightingSampler(scenario, hulls.copy()) if has_some else None


def _gps_sigma(gps: GpsConfig) -> float:
    return noise_sigma(gps.position_m, gps.rate_hz)


def _vehicle(index: int, drone: Drone) -> Vehicle:
    """Return what a drone of a scenario is.

    Raises:
        DocumentError: its model is a module that is not installed here.
    """
    return vehicle_of(drone.model, f"drones[{index}].model")
