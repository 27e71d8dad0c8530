"""The fleet: all drones of a scenario, advanced gate by gate, initially on the ground with stopped rotors.

An external drone also has a row in the arrays, for collisions and downwash; its pose is set, not integrated. Its driver
publishes a pose from time to time. Between poses, the drone moves on at the published velocity until the pose is too
old; then it stops there.

Heights: the altitude_m of `baro` is the height above the origin of W (zeroed on site, as the aircraft does at
power-up), and its pressure_pa is that of the standard atmosphere at `environment.height_m` + altitude_m.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from zsim.contract.flight_messages import (
    POSE_AGE_MAX_NS,
    DroneState,
    Status,
    Truth,
    moved_on,
    state_refusal,
    truth_fault,
)
from zsim.contract.keys import SIGHTINGS
from zsim.contract.messages import RotorInfo
from zsim.contract.snapshot import IN_PLACE, PART, Saved
from zsim.errors import RunError
from zsim.math import elementary as el
from zsim.math import linear
from zsim.math.frames import quaternion_from_heading, quaternion_from_rpy
from zsim.math.held import hold
from zsim.scenario.scenario import Drone, Scenario
from zsim.scenario.surroundings import sheet_of
from zsim.sensors.scanner import SCANNERS
from zsim.sensors.sensor import noise_sigma
from zsim.vehicles.vehicle import Vehicle, vehicle_of
from zsim_world.fleet import kernel
from zsim_world.fleet.fault_effects import Impairment
from zsim_world.fleet.flight_watch import SEEN, FlightWatch, Incident
from zsim_world.physics import rigid_body
from zsim_world.physics.contacts import WIND
from zsim_world.physics.fleet_arrays import (
    CLOCK,
    EXPOSED,
    ROTOR,
    STATE,
    VEHICLE,
    Arrays,
    Boards,
    Bodies,
    KernelTime,
    NearPairs,
    NoiseRows,
    Senses,
    Watched,
    aero_row,
    rotor_row,
    rotor_slots,
    state_arrays,
    vehicle_row,
)
from zsim_world.physics.rays import Scene, scene
from zsim_world.physics.simd import body_blocks
from zsim_world.physics.surfaces import BALLS, PLANE, POINTS, SLOTS_MAX, contact_points, obstacle_rows
from zsim_world.sensors import sensor_set
from zsim_world.sensors.noise import NoiseTable
from zsim_world.sensors.sampler import Sampled, Sampler, insert_rows
from zsim_world.sensors.scans import Scan, ScanSampler
from zsim_world.sensors.sensor_set import SONAR_COSINE_MIN, FleetSensors, fleet_sensors
from zsim_world.sensors.sightings import PictureSightings, SightingSampler
from zsim_world.vehicles import firmware, observer
from zsim_world.vehicles.firmware import MEMORY, SETPOINT, SETTING, board_blocks, sound_actuators
from zsim_world.vehicles.observer import BELIEF, CALIBRATION, DEVICE

GPS_FIX = 3  # NMEA: a three-dimensional fix
GPS_SATELLITES = 9  # as in a real navdata packet of the AR.Drone
TAKEOFF_CHARGE = 2.0  # multiple of the low-battery charge; with less, a drone refuses a take-off
UPRIGHT_COSINE = 0.87  # cosine of 30 deg, the largest tilt for a take-off
QUATERNION_SQUARE_MIN = 1e-6  # squared length; a shorter quaternion gives no orientation
NOISE_GATES = 8  # gates between refills of the noise table; the noise of 100 drones then fits into a cache of 1 MB
_TAKES_SETPOINT = {mode for mode, state in enumerate(firmware.MODES) if state_refusal("", state, "setpoint") is None}


class DivergedError(RunError):
    """The state of a drone is no longer finite, or is out of bounds; the text names the drone and the time."""

    def __init__(self, drone: str, t_s: float) -> None:
        super().__init__(
            f"{drone} at {t_s:.3f} s: the state is no longer finite, or is out of bounds;"
            " check its mass, inertia, rotors and dt"
        )
        self.drone = drone


class TrueState(NamedTuple):
    """The true state of N drones, copied."""

    position_m: NDArray[np.float64]  # (N, 3), W
    velocity_m_s: NDArray[np.float64]  # (N, 3), W
    orientation_wxyz: NDArray[np.float64]  # (N, 4), B to W
    angular_velocity_rad_s: NDArray[np.float64]  # (N, 3), B
    accel_m_s2: NDArray[np.float64]  # (N, 3), W
    rotor_rad_s: NDArray[np.float64]  # (N, R), 0 where a drone has fewer rotors


class Fleet:
    """All drones of a scenario, advanced together gate by gate from t = 0.

    Attributes:
        names: names of the drones in scenario order, the order of their indices.
        rotors: number of rotors of each drone.
        external: index of each external drone among the external ones, by its index in the fleet.
        gps_sigma_m: standard deviation of each drone's GPS fixes [m].
        impairment: effects of faults.
        bodies, boards: arrays of the kernel, read-only for callers.
        object_names: names of the obstacles, then of the surfaces.
        extra_sensors: names of sightings and scanners, whose sensor numbers follow those of `sensors`.
        sampled: samples due for publication in the last gate.
        observations: messages of sightings and scanners, by row of `sampled`.
        closest_m: smallest distance between two drones during the last gate [m]; inf for a single drone.
        collisions: pairs of drones whose hulls began to touch in the last gate.
        touching: whether a drone's hull touched another's, an obstacle or a surface in the last gate, (N,).
    """

    SAVED: ClassVar[Saved] = {
        "_tick": int,
        "_gates": int,
        "closest_m": float,
        "touching": IN_PLACE,
        "arrays": IN_PLACE,
        "_streams": IN_PLACE,
        "_sampler": PART,
        "_seeing": PART,
    }
    sampled: Sampled
    closest_m: float
    collisions: list[tuple[int, int]]

    def __init__(self, scenario: Scenario) -> None:
        """Place the drones and take the samples at t = 0.

        Raises:
            DivergedError: the initial state is not finite, or out of bounds.
            DocumentError: the module of a drone's model is not installed here.
        """
        self.names = [drone.name for drone in scenario.drones]
        vehicles = [vehicle_of(drone.model, f"drones[{i}].model") for i, drone in enumerate(scenario.drones)]
        self.rotors = [len(vehicle.rotors) for vehicle in vehicles]
        self.count = len(self.names)
        self.external = {i: e for e, i in enumerate(i for i, d in enumerate(scenario.drones) if d.is_external)}
        fixes = [drone.sensors.gps for drone in scenario.drones]
        self.gps_sigma_m = [noise_sigma(gps.position_m, gps.rate_hz) for gps in fixes]
        self._tick_ns = round(scenario.time.physics_dt_ms * 1_000_000)
        self._ticks = round(scenario.time.gate_ms / scenario.time.physics_dt_ms)
        self._tick = 0
        self._gates = 0
        self.sensors = fleet_sensors(scenario)
        self.environment = scenario.environment
        self._noise = NoiseTable(scenario, NOISE_GATES)
        self._streams = self._noise.streams
        self._w = _initial_arrays(scenario, vehicles, self.sensors, self._noise)
        self._sampler = Sampler(scenario, self.sensors, self._w.senses)
        hulls = self._w.bodies.vehicle[:, VEHICLE.hull_radius]
        simulated = [drone.sensors for drone in scenario.drones if not drone.is_external]
        scanned = [name for name in SCANNERS if any(getattr(each, name) is not UNSET for each in simulated)]
        has_sightings = any(each.sightings is not UNSET for each in simulated)
        self.extra_sensors = (*([SIGHTINGS] if has_sightings else []), *scanned)
        self._seeing: list[SightingSampler | ScanSampler] = []
        scans: ScanSampler | None = None
        if has_sightings:
            self._seeing.append(SightingSampler(scenario, hulls.copy(), self._w.scene))
        if scanned:
            scans = ScanSampler(scenario, hulls.copy(), self._w.scene)
            self._seeing.append(scans)
        self.observations: dict[int, PictureSightings | Scan] = {}
        self._held = hold(self._w)
        self.bodies, self.boards = self._w.bodies, self._w.boards
        self.impairment = Impairment(self._w, self.names, vehicles, self.sensors, scans)
        self.touching = np.zeros(self.count, dtype=bool)
        self._hull_m = float(hulls.max())
        self._integrate(0)
        environment = scenario.environment
        self.object_names = [each.name for each in (*environment.obstacles, *(environment.surfaces or ()))]
        self._watch = FlightWatch(self._w, self.names, self.object_names)
        # Load or compile now what the first command needs, because in realtime no gate may wait for it.
        kernel.enter(self.boards.memory[0].copy(), self.boards.belief[0].copy(), firmware.LANDED)

    @property
    def arrays(self) -> list[NDArray]:
        """All arrays of the kernel except the near pairs of drones, the scene and the sheet."""
        return list(state_arrays(self._w))

    def restored(self) -> None:
        self.bodies.near.origin.fill(math.inf)  # so that the near pairs are found anew

    # Time

    def advance(self) -> None:
        """Integrate one gate with the current setpoints.

        Raises:
            DivergedError: the state of a drone is no longer finite, or is out of bounds.
        """
        if self._gates % NOISE_GATES == 0:
            self._noise.refill()
        self._gates += 1
        self._integrate(self._ticks)

    def _integrate(self, ticks: int) -> None:
        logged, self.closest_m, diverged, self._has_incidents = kernel.advance(self._held, ticks)
        if diverged >= 0:
            raise DivergedError(self.names[diverged], (self._tick + ticks) * self._tick_ns / 1e9)
        self._tick += ticks
        self.collisions = []
        self.touching.fill(False)
        if self.bodies.bumping.size:
            self.touching[:] = self.bodies.bumping.any(axis=1)
        if self.closest_m < 2.0 * self._hull_m:
            self.collisions = [(int(i), int(j)) for i, j in np.argwhere(self.bodies.touched)]
            self.touching[np.argwhere(self.bodies.touched | self.bodies.touching).ravel()] = True
        self.sampled = self._sampler.due(logged, self.t_ns)
        if self._seeing:
            self.observations = {}
            observations = [each for sampler in self._seeing for each in sampler.due(self.bodies.state, self.t_ns)]
            if observations:
                self._insert_observations(observations)

    def _insert_observations(self, observations: list[PictureSightings | Scan]) -> None:
        """Insert sightings and scans into the samples of the gate, after those of the same drone and time."""
        number = {name: len(self.sensors.names) + k for k, name in enumerate(self.extra_sensors)}
        observations.sort(key=lambda each: (each.t_ns, each.drone, number[each.sensor], each.t_sample_ns, each.camera))
        rows = [(number[each.sensor], each.drone, each.t_ns, each.t_sample_ns) for each in observations]
        whose, values, indices = insert_rows(*self.sampled, np.array(rows, dtype=np.int64))
        self.sampled = Sampled(whose, values)
        self.observations = dict(zip(indices.tolist(), observations, strict=True))

    # State

    @property
    def t_ns(self) -> int:
        return self._tick * self._tick_ns

    @property
    def scene(self) -> Scene:
        """Return the static scene: obstacles and surfaces."""
        return self._w.scene

    def rotor_info(self, i: int) -> tuple[RotorInfo, ...]:
        """Return the rotors of a drone for `world/info`."""
        row, groups = self.bodies.vehicle[i], self.bodies.rotors[i].reshape(ROTOR.size, -1)
        unit, radius = row[VEHICLE.rotor_unit], float(row[VEHICLE.rotor_radius])
        x, y = (unit * groups[ROTOR.x]).tolist(), (unit * groups[ROTOR.y]).tolist()
        turns = groups[ROTOR.turn].tolist()
        numbered_names = enumerate(self.impairment.rotors[self.names[i]])
        return tuple(RotorInfo(name, x[r], y[r], 1 if turns[r] > 0.0 else -1, radius) for r, name in numbered_names)

    @property
    def wind_m_s(self) -> NDArray[np.float64]:
        """Wind at each drone, (N, 3) [m/s; W]: steady wind and gusts, without downwash."""
        return self._w.gust + self._w.wind[WIND.steady : WIND.steady + 3]

    def truth(self) -> TrueState:
        s, accel = self.bodies.state.copy(), self.bodies.accel[:, 0:3].copy()
        return TrueState(s[:, 0:3], s[:, 3:6], s[:, 6:10], s[:, 10:13], accel, s[:, STATE.size :])

    def status(self, i: int) -> tuple[DroneState, float, bool]:
        """Return the firmware's mode, the charge [%], and whether the hull touched anything but the ground."""
        charge = 100.0 * self.bodies.energy.item(i) / self.bodies.vehicle.item(i, VEHICLE.capacity)
        return firmware.MODES[self._mode(i)], charge, bool(self.touching[i])

    def bumps(self) -> list[tuple[int, int]]:
        """Return the contacts that began in the last gate: pairs of a drone's index and an index in `object_names`."""
        if not self.bodies.bumped.size:
            return []
        return [(int(i), int(m)) for i, m in np.argwhere(self.bodies.bumped)]

    def incidents(self) -> list[Incident]:
        return self._watch.incidents() if self._has_incidents else []

    # Commands

    def lead(self, i: int, pose: NDArray[np.float64]) -> None:
        """Set the pose of an external drone, (STATE.size + its rotors,), from which it is extrapolated."""
        self.bodies.pose[self.external[i], : len(pose)] = pose
        self.bodies.state[i, : len(pose)] = pose

    def takeoff(self, i: int) -> str | None:
        """Start a take-off; return None, or why it is refused."""
        charge = self.status(i)[1]
        if refusal := self._state_refusal(i, "takeoff"):
            return refusal
        min_charge = TAKEOFF_CHARGE * self.boards.setting.item(i, SETTING.low_battery)
        if charge < min_charge:
            return f"{self.names[i]} has {charge:.1f} % of charge; a take-off needs {min_charge:g} %"
        x, y = self.boards.belief[i, BELIEF.q_WB + 1 : BELIEF.q_WB + 3]
        if 1.0 - 2.0 * (x * x + y * y) < UPRIGHT_COSINE:
            return f"{self.names[i]} does not stand upright; to take off, it must be within 30 deg of level"
        self._enter(i, firmware.TAKING_OFF)
        return None

    def land(self, i: int) -> str | None:
        """Start a landing; return None, or why it is refused."""
        if refusal := self._state_refusal(i, "land"):
            return refusal
        if self._mode(i) != firmware.LANDING:
            self._enter(i, firmware.LANDING)
        return None

    def emergency(self, i: int) -> str | None:
        """Stop the rotors immediately; always accepted."""
        self._enter(i, firmware.EMERGENCY)
        return None

    def reset(self, i: int) -> str | None:
        """Leave the emergency state; return None, or why that is refused."""
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
        """Fly at a velocity in the heading frame, or in W, using the firmware's heading; return why it is refused."""
        kind = firmware.VELOCITY if frame == "heading" else firmware.VELOCITY_WORLD
        return self._set(i, kind, (*velocity_m_s, yaw_rate_rad_s))

    def set_ardrone(
        self, i: int, forward: float, left: float, up: float, yaw_left: float, hover: bool = False
    ) -> str | None:
        """Fly by tilt, climb and yaw rate as shares of their limits (-1 to 1), or hover; return why it is refused."""
        return self._set(i, firmware.HOVER if hover else firmware.ARDRONE, (forward, left, up, yaw_left))

    def set_attitude(self, i: int, q_WB: Sequence[float], thrust_n: float, yaw_rate_rad_s: float = 0.0) -> str | None:
        """Fly at a tilt (q_WB, w first; its heading is ignored), thrust [N] and yaw rate; return why it is refused."""
        if fault := self.orientation_fault(i, q_WB):
            return fault
        return self._set(i, firmware.ATTITUDE, (*q_WB, thrust_n, yaw_rate_rad_s))

    def set_rotors(self, i: int, speed_rad_s: Sequence[float]) -> str | None:
        """Command the speeds of all rotors within their limits; return why it is refused."""
        if fault := self.rotors_fault(i, speed_rad_s):
            return fault
        return self._set(i, firmware.ROTORS, tuple(speed_rad_s))

    def orientation_fault(self, i: int, q_WB: Sequence[float]) -> str | None:
        """Return why an orientation is invalid; None if it is valid."""
        if sum(x * x for x in q_WB) < QUATERNION_SQUARE_MIN:
            return f"{self.names[i]} was sent the orientation {list(q_WB)}; must be a quaternion of length 1"
        return None

    def rotors_fault(self, i: int, speed_rad_s: Sequence[float]) -> str | None:
        """Return why rotor speeds do not fit a drone; None if they do."""
        if len(speed_rad_s) != self.rotors[i]:
            return f"{self.names[i]} was sent {len(speed_rad_s)} rotor speeds; it has {self.rotors[i]} rotors"
        return None

    def release(self, i: int) -> None:
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

    def _state_refusal(self, i: int, requested: str) -> str | None:
        return state_refusal(self.names[i], firmware.MODES[self._mode(i)], requested)

    def _enter(self, i: int, mode: int) -> None:
        kernel.enter(self.boards.memory[i], self.boards.belief[i], mode)
        self._watch.note_command(i, mode)


class Pose(NamedTuple):
    """A published row of a fleet's states, and its time [ns]."""

    t_ns: int
    row: NDArray[np.float64]  # (STATE.size + rotors of the drone,)


class ExternalDrones:
    """The external drones of a fleet, which follow published poses; `i` is a drone's index in the fleet."""

    SAVED: ClassVar[Saved] = {"_poses": dict[int, Pose], "_statuses": dict[int, Status]}

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._index = {fleet.names[i]: i for i in fleet.external}
        self.names = frozenset(self._index)
        self._poses: dict[int, Pose] = {}
        self._statuses: dict[int, Status] = {}

    def __contains__(self, i: int) -> bool:
        return i in self._fleet.external

    def take(self, drone: str, message: Any, now_ns: int) -> str | None:
        """Handle a driver's Truth or Status; return why it is refused, or None.

        `now_ns`: time of the newest gate. Of other messages, only the time stamp is checked.
        """
        i, t_ns = self._index[drone], message.t_ns
        former = self._poses.get(i) if isinstance(message, Truth) else self._statuses.get(i)
        if t_ns > now_ns:
            return f"t_ns is {t_ns}; must be <= {now_ns}, the newest gate"
        if isinstance(message, Truth | Status) and former is not None and t_ns < former.t_ns:
            return f"t_ns is {t_ns}; must be >= {former.t_ns}, that of the last one"
        if isinstance(message, Status):
            self._statuses[i] = message
        if not isinstance(message, Truth):
            return None
        if now_ns - t_ns > POSE_AGE_MAX_NS:
            return f"t_ns is {t_ns}; must be >= {now_ns - POSE_AGE_MAX_NS}, {POSE_AGE_MAX_NS / 1e9:g} s ago"
        if fault := truth_fault(message, self._fleet.rotors[i]):
            return fault
        row = np.empty(STATE.size + len(message.rotor_rad_s))
        row[STATE.p_WB : STATE.p_WB + 3], row[STATE.v_WB : STATE.v_WB + 3] = message.position_m, message.velocity_m_s
        length = el.length(message.orientation_wxyz)
        row[STATE.q_WB : STATE.q_WB + 4] = np.divide(message.orientation_wxyz, length)
        row[STATE.w_WB_B : STATE.w_WB_B + 3] = message.angular_velocity_rad_s
        max_rad_s = self._fleet.bodies.vehicle.item(i, VEHICLE.rotor_max)
        row[STATE.size :] = np.clip(message.rotor_rad_s, 0.0, max_rad_s)
        self._poses[i] = Pose(t_ns, row)
        return None

    def lead(self) -> None:
        """Before the fleet advances, extrapolate to the present every drone whose driver has published a pose.

        The velocity is constant, and zero once the pose is too old.
        """
        p, v = slice(STATE.p_WB, STATE.p_WB + 3), slice(STATE.v_WB, STATE.v_WB + 3)
        for i, pose in self._poses.items():
            row, age_ns = pose.row.copy(), self._fleet.t_ns - pose.t_ns
            row[p] = moved_on(row[p].tolist(), row[v].tolist(), age_ns)
            if age_ns >= POSE_AGE_MAX_NS:
                row[v] = row[STATE.w_WB_B : STATE.w_WB_B + 3] = 0.0
            self._fleet.lead(i, row)

    def status(self, i: int) -> Status | None:
        """Return the newest status; None before the first."""
        return self._statuses.get(i)

    def command_refusal(self, i: int, kind: str, message: Any) -> str | None:
        """Return why a command is not passed on to the driver; None if it is.

        A stop of the rotors is always passed on, other commands only if the newest state from the driver allows them
        and their values fit the drone.
        """
        name, requested = self._fleet.names[i], message.mode if kind == "mode" else "setpoint"
        if requested == "emergency":
            return None
        if i not in self._statuses:
            return f"{name} has no state: its driver has published none; start driver.{name}"
        state: DroneState = self._statuses[i].state
        refusal = state_refusal(name, state, requested)
        if refusal is None and kind == "rotors":
            refusal = self._fleet.rotors_fault(i, message.speed_rad_s)
        if refusal is None and kind == "attitude":
            refusal = self._fleet.orientation_fault(i, message.orientation_wxyz)
        return refusal


def _initial_arrays(
    scenario: Scenario, vehicles: Sequence[Vehicle], sensors: FleetSensors, noise: NoiseTable
) -> Arrays:
    dt, drones, environment = scenario.time.physics_dt_ms / 1000.0, scenario.drones, scenario.environment
    each = rotor_slots(vehicles)
    row = np.array([vehicle_row(vehicle, drone, environment) for vehicle, drone in zip(vehicles, drones, strict=True)])
    rotors = np.array([rotor_row(vehicle, drone, each) for vehicle, drone in zip(vehicles, drones, strict=True)])
    clock = np.zeros(CLOCK.size, dtype=np.int64)
    clock[CLOCK.ticks_per_step] = round(observer.STEP_S / dt)
    time = KernelTime(clock=clock, spans=np.array([dt, scenario.silence.hover_s, scenario.silence.land_s]))
    numbers = NoiseRows(table=noise.table, at=noise.at, width=noise.width, cursor=noise.cursor)
    bodies, boards = _bodies(scenario, row, rotors, dt), _boards(scenario, vehicles, row, rotors)
    senses = _senses(scenario, sensors, noise)
    watched = Watched(seen=np.zeros((len(drones), SEEN.size)), found=np.zeros(len(drones), dtype=np.int64))
    watched.seen[bodies.external, SEEN.external] = 1.0
    wind, air = environment.wind, np.empty(WIND.size)
    air[WIND.steady : WIND.steady + 3] = wind.steady_m_s
    air[WIND.gust], air[WIND.correlation] = wind.gust_m_s, wind.gust_correlation
    air[WIND.length], air[WIND.speed_min] = wind.gust_length_m, wind.gust_speed_min_m_s
    sheet = sheet_of(environment)
    static_scene = scene(bodies.obstacle, sheet.triangle)
    return Arrays(time, bodies, boards, numbers, senses, air, noise.gust, watched, static_scene, sheet)


def _bodies(scenario: Scenario, row: np.ndarray, rotors: np.ndarray, dt: float) -> Bodies:
    drones, n, obstacles = scenario.drones, len(scenario.drones), obstacle_rows(scenario.environment)
    surfaces = len(scenario.environment.surfaces or ())
    each, slots = rotors.shape[1] // ROTOR.size, min(len(obstacles), SLOTS_MAX)
    state, anchor = np.zeros((n, STATE.size + each)), np.zeros((n, POINTS, 2))
    for i, drone in enumerate(drones):  # on the ground the feet carry the weight; a drone placed higher falls
        yaw = math.radians(drone.yaw_deg)
        state[i, STATE.p_WB : STATE.p_WB + 3] = drone.position_m
        state[i, STATE.p_WB + 2] += row[i, VEHICLE.stand_height]
        state[i, STATE.q_WB : STATE.q_WB + 4] = quaternion_from_heading(yaw)
        turn = np.array([[el.cos(yaw), -el.sin(yaw)], [el.sin(yaw), el.cos(yaw)]])
        anchor[i] = np.array(drone.position_m[:2]) + linear.product(contact_points(row[i])[:, :2], turn.T)
    aero = np.array([aero_row(drone, scenario.environment) for drone in drones])
    external = np.array([i for i, drone in enumerate(drones) if drone.is_external], dtype=np.int64)
    pairs = np.zeros((n * (n - 1) // 2, 2), dtype=np.int32)  # found in the first tick, as `origin` is infinite
    eye = np.array([_look_down(drone) for drone in drones])
    number, above = np.zeros(1, dtype=np.int64), np.zeros(n, dtype=np.int8)
    near = NearPairs(pair=pairs, number=number, origin=np.full((n, 3), np.inf), above=above, eye=eye)
    kernel_function = rigid_body.half_decay
    # not compiled: for so few numbers, compiling would take longer
    half_decay = getattr(kernel_function, "py_func", kernel_function)
    return Bodies(
        each=tuple(range(each)),
        vehicle=row,
        rotors=rotors,
        state=state,
        accel=np.zeros((n, 6)),
        anchor=anchor,
        command=np.zeros((n, each)),
        energy=row[:, VEHICLE.capacity] * [drone.battery_percent / 100.0 for drone in drones],
        air=np.zeros((n, 3)),
        push=np.zeros((n, 3)),
        touching=np.zeros((n, n), dtype=np.int8),
        touched=np.zeros((n, n), dtype=np.int8),
        near=near,
        obstacle=obstacles,
        bumping=np.zeros((n, len(obstacles) + surfaces), dtype=np.int8),
        bumped=np.zeros((n, len(obstacles) + surfaces), dtype=np.int8),
        solid=np.full((n, slots), -1, dtype=np.int32),
        held=np.zeros((n, slots, BALLS, 3)),
        plane=np.zeros((n, BALLS if surfaces else 0, PLANE.size)),
        braced=np.zeros(n, dtype=np.int8),
        twist=np.zeros((n, 3)),
        aero_parts=(0, 1) if aero.any() else (0,),
        aero=aero,
        lanes=body_blocks(row, rotors, np.array([[half_decay(lag, dt)] for lag in row[:, VEHICLE.rotor_lag]]), aero),
        external=external,
        pose=state[external],
    )


def _look_down(drone: Drone) -> tuple[float, float, float]:
    """Return the row of `NearPairs.eye` for a drone's downward sonar and flow sensor."""
    sonar, flow = drone.sensors.sonar, drone.sensors.flow
    away_m = max(el.length(sensor.mount.position_m) for sensor in (sonar, flow))
    return away_m, sonar.max_m, SONAR_COSINE_MIN


def _boards(scenario: Scenario, vehicles: Sequence[Vehicle], row: np.ndarray, rotors: np.ndarray) -> Boards:
    drones, n, each = scenario.drones, len(scenario.drones), rotors.shape[1] // ROTOR.size
    pairs = list(zip(vehicles, drones, strict=True))
    setting = np.array([firmware.settings(vehicle, drone) for vehicle, drone in pairs])
    calibration = np.array([_calibration(drone, scenario) for drone in drones])
    rows = zip(drones, row, calibration, strict=True)
    mounts = calibration[:, CALIBRATION.imu_turn : CALIBRATION.imu_turn + 4]
    return Boards(
        setting=setting,
        gain=np.array([observer.gain_row(vehicle, drone, scenario.environment) for vehicle, drone in pairs]),
        calibration=calibration,
        setpoint=np.zeros((n, firmware.SETPOINT.size)),
        set_tick=np.zeros(n, dtype=np.int64),
        memory=np.zeros((n, firmware.MEMORY.size)),
        belief=np.array([_first_belief(drone, own, board, each) for drone, own, board in rows]),
        actuator=sound_actuators(n, each),
        device=np.zeros((n, DEVICE.size)),
        lanes=board_blocks(row, rotors, setting, mounts),
    )


def _senses(scenario: Scenario, sensors: FleetSensors, noise: NoiseTable) -> Senses:
    field, log = scenario.environment, sensor_set.samples_per_gate(sensors, scenario.time.gate_ms) + 1
    kinds = len(sensors.names)
    exposures = log if kinds > len(sensor_set.SENSORS) else 1
    return Senses(
        place=np.array([*field.magnetic_field_ut, field.height_m]),
        config=sensor_set.config(sensors),
        fault=np.zeros((len(scenario.drones), kinds, sensor_set.FAULT.size)),
        schedule=sensor_set.schedule(sensors, scenario.time.physics_dt_ms),
        soonest=np.zeros(len(scenario.drones), dtype=np.int64),
        bias=noise.bias,
        whose=np.zeros((log, 3), dtype=np.int64),
        value=np.zeros((log, 6)),
        exposed_count=np.zeros(1, dtype=np.int64),
        exposed_whose=np.zeros((exposures, 3), dtype=np.int64),
        exposed=np.zeros((exposures, EXPOSED.size)),
    )


def _first_belief(drone: Drone, row: np.ndarray, calibration: np.ndarray, rotors: int) -> np.ndarray:
    """Return the belief at power-up: level, heading unknown until the first magnetometer sample.

    If the magnetic field gives no heading, the true heading is used.
    """
    belief = np.zeros(BELIEF.size + rotors)
    belief[BELIEF.q_WB] = 1.0
    if math.isnan(calibration[CALIBRATION.mag_bearing]):
        belief[BELIEF.heading] = math.radians(drone.yaw_deg)
        belief[BELIEF.q_WB : BELIEF.q_WB + 4] = quaternion_from_heading(belief[BELIEF.heading])
    belief[BELIEF.height] = row[VEHICLE.stand_height]
    belief[BELIEF.still_steps] = observer.STILL_STEPS_MIN
    return belief


def _calibration(drone: Drone, scenario: Scenario) -> np.ndarray:
    """Return the board's calibration: its mounts, and the bearing of the magnetic field if that gives a heading."""
    board, field = np.zeros(CALIBRATION.size), scenario.environment.magnetic_field_ut
    imu, mag = drone.sensors.imu.mount, drone.sensors.mag.mount
    board[CALIBRATION.imu_turn : CALIBRATION.imu_turn + 4] = quaternion_from_rpy(np.radians(imu.rpy_deg))
    board[CALIBRATION.mag_turn : CALIBRATION.mag_turn + 4] = quaternion_from_rpy(np.radians(mag.rpy_deg))
    compass = sensor_set.has_compass(drone.sensors.mag, field)
    board[CALIBRATION.mag_bearing] = el.atan2(field[1], field[0]) if compass else math.nan
    board[CALIBRATION.sonar_min] = drone.sensors.sonar.min_m
    return board
