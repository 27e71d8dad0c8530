"""Checks across fields of a scenario: consistent names and references, distances, divisible times, plausible units.

They use only the sound parts of a document (`checker.sound`); checks that need missing or faulty fields are skipped.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
from msgspec import UNSET

from zsim.contract import messages
from zsim.math import elementary as el
from zsim.math.held import hold
from zsim.math.linear import singular_values
from zsim.scenario.faults import Known, flaws, kinds_of
from zsim.scenario.own_classes import agent_faults, law_faults
from zsim.scenario.roles import AGENTS, MAIN, OPERATOR, PILOT, ROLES
from zsim.scenario.scenario import (
    EXTERNAL,
    PATHS,
    SEA_HEIGHT_MAX_M,
    DroneReference,
    Exchange,
    Scenario,
    space_name,
)
from zsim.scenario.surroundings import CENTRE, HALF, nearest, nearest_points, row_of, sheet_of
from zsim.schema.checker import Fault, listed, show, suggestion
from zsim.schema.quantities import COULOMB_PER_MAH, G_M_S2, SEA_LEVEL_KG_M3
from zsim.sensors.camera_model import folds, lens_of
from zsim.sensors.scanner import RAYS_MAX, SCANNERS
from zsim.sensors.sensor_catalogue import DECLARED, MODULE, STOCK, declarations, own_sections, sensor_names
from zsim.sensors.stock_sensors import BOARD_RATE_HZ
from zsim.vehicles.vehicle import Vehicle, lift_shares

FIRMWARE_STEP_US = round(1e6 / BOARD_RATE_HZ)  # us, the firmware's time step
TEMPLATE_ROBOTS_MIN = 3  # robots; fewer are always collinear
TEMPLATE_WIDTH_MIN_M = 0.1  # m, design choice: any real formation is wider; the controller requires more in flight
WORLD_DEATHS = ("restart", "end")  # `on_death` of the world; no other process can continue the run
LIFT_SHARE_MAX = 0.9  # maximum ratio of weight to the rotors' maximum lift; the rest is left for control
TOP_COSINE, TOP_DEPTH_M = 0.999, 0.001  # minimum cosine of a flat top's slope; maximum depth of a drone in it
ON_TOP_COSINE = 0.5  # minimum cosine of a slope on which a drone may stand; design choice: beyond 60 deg it is a wall
THRUST_SHARE_MIN = 0.005  # minimum weight / lift; design choice: racers that lift 15 times their weight have 0.07
TILT_FREE_DEG = 30.0  # deg, tilt allowed to any drone that is light enough to fly
# Design choice: a decade or more beyond real drones, which need 60 (large rotors) to 400 W/kg (racers) for 3 min to 2 h
HOVER_W_KG = (3.0, 10_000.0)  # W/kg, the rotors' electric power in a hover per mass
HOVER_S = (10.0, 86_400.0)  # s, endurance in a hover on a full battery
TIP_MAX_M_S = 340.3  # m/s, speed of sound at 15 deg C, ISO 2533; propellers lose thrust near it
# m/s, design choice: no multirotor falls so slowly. In tests, those of 20 g to 1 kg fall at 7 to 24 m/s (Svaty et al.,
# PLoS ONE 20 (2025) e0320073); with the drag modelled here, an AR.Drone falls at 17 m/s and a Crazyflie at 43 m/s.
AIR_M_S = 2.0
# maximum ratio of inertia to mass_kg arm_m^2; design choice: it is 0.35 for the AR.Drone about z, 1 for bare rotors
INERTIA_MAX_MR2 = 10.0
K1_MIN = -4 / 27  # minimum of k1 tan^2(diagonal / 2); below it r + k1 r^3 peaks within the picture
RESERVED_ROLES = (OPERATOR, "agent", "python", "test")  # roles of zsim's own processes in addition to ROLES
SIGHTING_DRONES_MAX = 12  # in a cluster with sightings: each estimator holds all states, at quadratic cost


def cross_faults(
    scenario: Any,
    vehicles: Mapping[str, Vehicle],  # by model; checks that need a missing vehicle are skipped
    unread: Collection[str] = (),  # names of sensors missing from `scenario` because their modules could not be read
) -> Iterator[Fault]:
    """Yield every conflict between fields of a scenario, or of its parts returned by `checker.sound`."""
    drones, clusters = _entries(scenario.drones), _entries(scenario.clusters)
    yield from _name_faults("drones", drones)
    yield from _name_faults("clusters", clusters)
    yield from _time_faults(scenario.time)
    yield from _start_faults(drones, vehicles)
    obstacles = _entries(scenario.environment and scenario.environment.obstacles)
    yield from _obstacle_faults(obstacles, drones, vehicles)
    surfaces = _entries((scenario.environment and scenario.environment.surfaces) or [])
    yield from _surface_faults(surfaces, {each.name for _, each in obstacles}, drones, vehicles)
    for index, drone in drones:
        yield from _under(f"drones[{index}]", _drone_faults(drone, scenario, vehicles))
    yield from _own_sensor_faults(drones)
    yield from _sighting_faults(scenario, drones, clusters)
    yield from _membership_faults(drones, clusters)
    for index, cluster in clusters:
        yield from _under(f"clusters[{index}]", _plan_faults(cluster))
        yield from _under(f"clusters[{index}]", law_faults(cluster, {drone.name: drone for _, drone in drones}, unread))
    for index, cluster in clusters:
        yield from _under(f"clusters[{index}]", _shape_faults(cluster, drones))
    yield from _reference_faults(scenario, drones, clusters)
    yield from _process_faults(scenario, drones, clusters)
    if isinstance(scenario.agents, dict):
        sound_agents = {role: each for role, each in scenario.agents.items() if each and each.per}
        yield from agent_faults(sound_agents, (*ROLES, *RESERVED_ROLES), bool(clusters))
    if isinstance(scenario.programs, dict):
        yield from _program_faults(scenario.programs, (*ROLES, *RESERVED_ROLES, *(scenario.agents or ())))
    yield from _graph_faults(scenario.topology, _names(drones))
    yield from _injected_faults(scenario, drones, clusters, vehicles, unread)
    window = scenario.report and scenario.report.window_s
    if window is not None and not 0 <= window[0] < window[1]:
        yield "report.window_s", f"is {show(list(window))}; must be [start, end] with 0 <= start < end"


def unflown_plans(scenario: Scenario) -> list[str]:
    """Return a line for each cluster or drone of a resolved scenario with planned flight after the end of the run.

    This is not a fault: a run may be shortened, and another program may fly the drones.
    """
    lines = []
    for index, cluster in enumerate(scenario.clusters):
        plan, flies = cluster.plan, cluster.plan.takeoff_s is not None
        trajectory_s = plan.trajectory.start_s if flies and plan.trajectory else None
        times = {"take-off": plan.takeoff_s, "trajectory": trajectory_s, "landing": plan.land_s}
        planned = {step: at_s for step, at_s in times.items() if at_s is not None}
        missed = [f"its {step} at {at_s:g} s" for step, at_s in planned.items() if at_s >= scenario.duration_s]
        if missed:
            effect = "none of it is flown" if "take-off" in missed[0] or len(missed) == len(planned) else "not flown"
            line = f"the run ends at {scenario.duration_s:g} s, before {' and '.join(missed)}: {effect}"
            lines.append(f"clusters[{index}].plan: {line} (cluster {cluster.name!r})")
    for name, ref in scenario.piloted().items():
        begins = [ref.takeoff_s, *([stage.start_s for stage in ref.stages] if isinstance(ref, Exchange) else [])]
        begins += [ref.start_s] if isinstance(ref, DroneReference) and ref.start_s is not None else []
        if max(begins) >= scenario.duration_s:
            missed = f"before its reference begins at {max(begins):g} s"
            lines.append(f"drones.{name}: the run ends at {scenario.duration_s:g} s, {missed}: not flown")
    return lines


_Entries = list[tuple[int, Any]]  # sound entries of a list, with their indices


def _entries(items: list[Any] | None) -> _Entries:
    return [(index, item) for index, item in enumerate(items or ()) if item is not None]


def _names(entries: _Entries) -> list[str]:
    return [item.name for _, item in entries if item.name is not None]


def _placed(drones: _Entries) -> _Entries:
    return [(index, drone) for index, drone in drones if drone.position_m is not None]


def _under(section: str, faults: Iterable[Fault]) -> Iterator[Fault]:
    yield from ((f"{section}.{path}", text) for path, text in faults)


def _known(*values: Any) -> bool:
    return all(value is not None for value in values)


def _name_faults(path: str, entries: _Entries) -> Iterator[Fault]:
    first: dict[str, int] = {}
    for index, item in entries:
        if item.name is not None and first.setdefault(item.name, index) != index:
            yield f"{path}[{index}].name", f"is {item.name!r}, as {path}[{first[item.name]}]; must be unique"


def _time_faults(time: Any) -> Iterator[Fault]:
    if time is None:
        return
    gate_us = time.gate_ms * 1000 if _known(time.gate_ms) else 0.0
    dt_us = time.physics_dt_ms * 1000 if _known(time.physics_dt_ms) else FIRMWARE_STEP_US
    step_ms = FIRMWARE_STEP_US / 1000
    if gate_us % FIRMWARE_STEP_US:
        yield "time.gate_ms", f"is {time.gate_ms:g}; must be a multiple of {step_ms:g} (the firmware's step)"
    if dt_us % 1 or FIRMWARE_STEP_US % dt_us:
        yield "time.physics_dt_ms", f"is {time.physics_dt_ms:g}; must divide {step_ms:g} (the firmware's step)"


def _clearance_m(drone: Any, vehicles: Mapping[str, Vehicle]) -> float:
    """Return the free space that a drone needs around its centre at the start [m]; 0 for an unknown vehicle."""
    vehicle = vehicles.get(drone.model) if drone.model else None
    return vehicle.airframe.clearance_m if vehicle else 0.0


def _start_faults(drones: _Entries, vehicles: Mapping[str, Vehicle]) -> Iterator[Fault]:
    placed = _placed(drones)
    positions = np.array([drone.position_m for _, drone in placed], dtype=float).reshape(-1, 3)
    clearance = np.array([_clearance_m(drone, vehicles) for _, drone in placed])
    for k, (index, _) in enumerate(placed):
        if positions[k, 2] < 0:
            yield f"drones[{index}].position_m[2]", f"is {positions[k, 2]:g}; must be >= 0 (the ground)"
        distances = np.linalg.norm(positions[:k] - positions[k], axis=1)
        limits = clearance[:k] + clearance[k]
        if k and (distances < limits).any():
            worst = int((distances - limits).argmin())
            nearest, other = placed[worst]
            yield (
                f"drones[{index}].position_m",
                f"is {distances[worst]:.2f} m from {other.name or f'drones[{nearest}]'!r}; "
                f"must be >= {limits[worst]:g} m",
            )


_SIZES = {"box": ("size_m",), "cylinder": ("radius_m", "height_m"), "sphere": ("radius_m",)}


def _obstacle_faults(obstacles: _Entries, drones: _Entries, vehicles: Mapping[str, Vehicle]) -> Iterator[Fault]:
    """Yield the faults of obstacles: names, sizes, and drones that start inside or too close, unless on top."""
    yield from _name_faults("environment.obstacles", obstacles)
    names = _names(drones)
    starts = [(index, drone.position_m, _clearance_m(drone, vehicles)) for index, drone in _placed(drones)]
    for index, obstacle in obstacles:
        path = f"environment.obstacles[{index}]"
        if obstacle.name in names:
            yield f"{path}.name", f"is {obstacle.name!r}, as a drone; must be unique"
        sizes = _SIZES.get(obstacle.shape)
        if sizes is None:
            continue
        fields = [name for name in ("size_m", "radius_m", "height_m") if getattr(obstacle, name) is not None]
        for name in sizes:
            if name not in fields:
                yield f"{path}.{name}", f"is missing; must be given for a {obstacle.shape}"
        for name in fields:
            if name not in sizes:
                yield f"{path}.{name}", f"is given; must be left out of a {obstacle.shape}"
        if sorted(fields) != sorted(sizes) or not _known(obstacle.position_m, obstacle.yaw_deg):
            continue
        row = row_of(obstacle)
        x, extent = row[CENTRE], sum(row[HALF:])  # no point of the obstacle is farther from its centre, at any yaw
        for drone, p_W, clearance in starts:
            if abs(p_W[0] - x) >= extent + clearance:
                continue
            distance, _, _, up = nearest(row, *p_W)
            is_on_top = up > TOP_COSINE and distance > -TOP_DEPTH_M
            if distance < clearance and not is_on_top:
                actual = f"is {distance:.2f} m from {obstacle.name or 'an obstacle'!r}"
                yield f"drones[{drone}].position_m", f"{actual}; must be >= {clearance:g} m"


def _surface_faults(
    surfaces: _Entries, obstacles: Collection[str], drones: _Entries, vehicles: Mapping[str, Vehicle]
) -> Iterator[Fault]:
    """Yield the faults of surfaces: names, and drones that start too close, unless on top."""
    yield from _name_faults("environment.surfaces", surfaces)
    names = _names(drones)
    for index, surface in surfaces:
        if surface.name in names or surface.name in obstacles:
            other = "a drone" if surface.name in names else "an obstacle"
            yield f"environment.surfaces[{index}].name", f"is {surface.name!r}, as {other}; must be unique"
    placed = _placed(drones)
    for _, surface in surfaces:
        is_read = isinstance(surface.triangles, str) and _known(surface.position_m, surface.yaw_deg, surface.scale)
        if not placed or not is_read:
            continue
        try:
            sheet = hold(sheet_of(SimpleNamespace(surfaces=[surface])))
        except ValueError:  # invalid triangles are reported elsewhere
            continue
        clearances = np.array([_clearance_m(drone, vehicles) for _, drone in placed])
        positions = np.array([drone.position_m for _, drone in placed])
        distance, nearest_W = nearest_points(sheet, positions, clearances)
        up = positions[:, 2] - nearest_W[:, 2]
        is_on_top = (distance <= TOP_DEPTH_M) | (up > ON_TOP_COSINE * distance)
        for k in np.flatnonzero((distance < clearances) & ~is_on_top).tolist():
            actual = f"is {distance[k]:.2f} m from {surface.name or 'a surface'!r}"
            yield f"drones[{placed[k][0]}].position_m", f"{actual}; must be >= {clearances[k]:g} m"


def _drone_faults(drone: Any, scenario: Any, vehicles: Mapping[str, Vehicle]) -> Iterator[Fault]:
    low, high = drone.rotor_min_rad_s, drone.rotor_max_rad_s
    if _known(low, high) and low >= high:
        yield "rotor_min_rad_s", f"is {low:g}; must be < rotor_max_rad_s ({high:g})"
    gravity = scenario.environment and scenario.environment.gravity_m_s2
    vehicle = vehicles.get(drone.model) if drone.model else None
    if vehicle and _known(drone.thrust_n_s2, high):
        scale = math.sqrt(math.sqrt(drone.thrust_n_s2 / vehicle.thrust_n_s2))  # a larger one may come from a wrong unit
        radius_m = vehicle.rotor_radius_m * min(1.0, scale)
        if radius_m * high > TIP_MAX_M_S:
            tip = f"so that the tip of a rotor of {radius_m:.3g} m moves at {radius_m * high:.0f} m/s"
            allowed = f"sane: at most {TIP_MAX_M_S / radius_m:.0f}, the speed of sound"
            yield "rotor_max_rad_s", f"is {high:g}, {tip}; {allowed}; check its unit, rad/s: rpm over 9.55"
        elif _known(drone.mass_kg, gravity):
            yield from _hover_faults(drone, vehicle, scenario.environment)
    if vehicle and _known(drone.mass_kg, drone.thrust_n_s2):
        yield from _drag_faults(drone, len(vehicle.rotors))
    if _known(drone.mass_kg, drone.arm_m, drone.inertia_kg_m2) and None not in drone.inertia_kg_m2:
        max_inertia = INERTIA_MAX_MR2 * drone.mass_kg * el.square(drone.arm_m)
        if max(drone.inertia_kg_m2) > max_inertia:
            actual = f"is {list(drone.inertia_kg_m2)}; sane: at most {max_inertia:.3g}, ten times mass_kg arm_m^2"
            yield "inertia_kg_m2", f"{actual}; check its unit, kg m^2"
    origin_m = scenario.environment and scenario.environment.height_m
    heights = {
        "position_m[2]": drone.position_m and drone.position_m[2],
        "limits.altitude_m": drone.limits and drone.limits.altitude_m,
    }
    for path, height_m in heights.items():
        if _known(origin_m, height_m) and origin_m + height_m > SEA_HEIGHT_MAX_M:
            limit = f"with environment.height_m ({origin_m:g}) it must be <= {SEA_HEIGHT_MAX_M} m above the sea"
            yield path, f"is {height_m:g}; {limit}"
    if drone.sensors is not None:
        yield from _under("sensors", _sensor_faults(drone.sensors))


def _drag_faults(drone: Any, rotors: int) -> Iterator[Fault]:
    """Yield faults of drag coefficients with which slow air would push as hard as the weight: a wrong unit is likely.

    A coefficient that is too small cannot be distinguished from an omitted one.
    """
    weight, v = drone.mass_kg * G_M_S2, AIR_M_S
    speed_sum = rotors * math.sqrt(weight / (rotors * drone.thrust_n_s2))  # rad/s, sum of the rotors' speeds in a hover
    speeds = {
        "drag_n_s_m": (v, "N s/m"),
        "aerodynamics.linear_drag_n_s_m": (v, "N s/m"),
        "aerodynamics.quadratic_drag_n_s2_m2": (el.square(v), "N s^2/m^2"),
        "aerodynamics.rotor_drag_n_s2_m": (speed_sum * v, "N s^2/m"),
        "aerodynamics.rotor_inflow_n_s2_m": (speed_sum * v, "N s^2/m"),
        "aerodynamics.rotor_lift_n_s2_m2": (rotors * el.square(v), "N s^2/m^2"),
    }
    for path, (factor, unit) in speeds.items():
        section, _, name = path.rpartition(".")
        value = getattr(getattr(drone, section, None) if section else drone, name, None)
        coefficients = value if isinstance(value, Sequence) else [value]
        largest = max((each for each in coefficients if each is not None), default=0.0)
        if largest * factor >= weight:
            actual = f"is {show(value)}, so that air at {v:g} m/s pushes with {largest * factor:.3g} N"
            yield (
                path,
                f"{actual}; sane: less than {weight:.3g} N, its weight: {weight / factor:.3g}; check its unit, {unit}",
            )


def _hover_faults(drone: Any, vehicle: Vehicle, environment: Any) -> Iterator[Fault]:
    """Yield faults of mass, rotors and battery that make a hover implausible, which indicates a wrong unit."""
    count, shares = len(vehicle.rotors), lift_shares(vehicle)
    thrust, torque = drone.thrust_n_s2, drone.torque_nm_s2
    low, high = drone.rotor_min_rad_s, drone.rotor_max_rad_s
    weight = drone.mass_kg * environment.gravity_m_s2
    lift = count * thrust * el.square(high) / shares.max()
    max_kg = LIFT_SHARE_MAX * lift / environment.gravity_m_s2
    if drone.mass_kg >= max_kg:
        yield "mass_kg", f"is {drone.mass_kg:g}; must be < {max_kg:.3f}, nine tenths of what its rotors lift"
        return
    if weight < THRUST_SHARE_MIN * lift:
        hover = f"so that it hovers at {100 * weight / lift:.2g} % of what its rotors lift ({lift:.3g} N)"
        units = "check their units, N s^2, rad/s and kg (thrust = thrust_n_s2 times speed^2)"
        yield "thrust_n_s2", f"is {thrust:g}, {hover}; sane: {100 * THRUST_SHARE_MIN:g} to 90 %; {units}"
        return
    tilt, lean = drone.limits and drone.limits.tilt_deg, math.degrees(el.acos(weight / (LIFT_SHARE_MAX * lift)))
    cut_deg = math.degrees(el.acos(vehicle.firmware.tilt_cut_cosine))
    if tilt is not None and tilt > (most_deg := max(lean, TILT_FREE_DEG)):
        yield "limits.tilt_deg", f"is {tilt:g}; must be <= {most_deg:.1f}; its rotors carry its weight up to {lean:.1f}"
    if tilt is not None and tilt >= cut_deg:
        yield "limits.tilt_deg", f"is {tilt:g}; must be < {cut_deg:.1f}, at which its firmware cuts the rotors"
    density = environment.air_density_kg_m3
    if not _known(torque, density):
        return
    thin = density / SEA_LEVEL_KG_M3  # factor by which thin air reduces the coefficients
    speeds = np.sqrt(weight * shares / (count * thrust * thin))
    if low is not None and speeds.min() <= low < high:
        yield "rotor_min_rad_s", f"is {low:g}; must be < {speeds.min():.1f}, the speed of a rotor in a hover"
    battery = vehicle.battery
    power = float(torque * thin * (speeds**3).sum()) / battery.efficiency
    min_w, max_w = (each * drone.mass_kg for each in HOVER_W_KG)
    if not min_w <= power <= max_w:
        takes = f"so that a hover takes {power:.3g} W"
        units = "check its unit, N m s^2: multiply a torque per thrust in m by thrust_n_s2"
        yield "torque_nm_s2", f"is {torque:g}, {takes}; sane: {min_w:.3g} to {max_w:.3g} W for its mass; {units}"
    elif drone.battery_mah is not None:
        power += battery.electronics_w
        endurance = drone.battery_mah * COULOMB_PER_MAH * battery.voltage_v / power
        if not HOVER_S[0] <= endurance <= HOVER_S[1]:
            lasts = f"which lasts {endurance:.3g} s in a hover at {power:.3g} W"
            sane = f"sane: {HOVER_S[0]:g} to {HOVER_S[1]:g} s"
            yield "battery_mah", f"is {drone.battery_mah:g}, {lasts}; {sane}; check its unit, mAh"


def _sensor_faults(sensors: Any) -> Iterator[Fault]:
    if sensors.as_printed and sensors.preset not in (None, "paper"):
        yield "as_printed", "is true; must be false unless preset is paper"
    if sensors.imu and _known(sensors.imu.rate_hz) and sensors.imu.rate_hz > BOARD_RATE_HZ:
        limit = f"{BOARD_RATE_HZ:g}, the rate of the navigation board"
        yield "imu.rate_hz", f"is {sensors.imu.rate_hz:g}; must be <= {limit}"
    for name, kind in STOCK.items():
        for channel in kind.channels:
            model = getattr(getattr(sensors, name), channel.settings, None)
            if model and _known(model.bias_instability) and model.bias_instability and not model.correlation_s:
                needed = "must be 0 unless correlation_s says how fast it changes"
                yield f"{name}.{channel.settings}.bias_instability", f"is {model.bias_instability:g}; {needed}"
    sonar = sensors.sonar
    if sonar and _known(sonar.min_m, sonar.max_m) and sonar.min_m >= sonar.max_m:
        yield "sonar.min_m", f"is {sonar.min_m:g}; must be < max_m ({sonar.max_m:g})"


def _own_sensor_faults(drones: _Entries) -> Iterator[Fault]:
    first: dict[str, tuple[int, str]] = {}
    fields_of: dict[str, dict[str, str]] = {}
    used = {kind.__name__ for kind in messages.types_by_shape().values()}
    for index, drone in drones:
        for name, section in own_sections(drone).items():
            message = section[DECLARED]["message"]
            path = f"drones[{index}].sensors.{name}.{DECLARED}.message"
            if message in used:
                yield path, f"is {show(message)}, a message of the contract; must be a different name"
            elif fields_of.setdefault(message, section[DECLARED]["fields"]) != section[DECLARED]["fields"]:
                yield path, f"is {show(message)}, which another sensor declares with other fields; must be unique"
            other, module = first.setdefault(name, (index, section[MODULE]))
            if module != section[MODULE]:
                difference = f"is {show(section[MODULE])}, and {show(module)} in drones[{other}]"
                yield f"drones[{index}].sensors.{name}.{MODULE}", f"{difference}; must be the same for all drones"


def _membership_faults(drones: _Entries, clusters: _Entries) -> Iterator[Fault]:
    names = _names(drones)
    is_checked = len(names) == len(drones) and bool(drones)
    owner: dict[str, str] = {}
    for index, cluster in clusters:
        called = cluster.name or f"clusters[{index}]"
        for k, name in _entries(cluster.drones):
            path = f"clusters[{index}].drones[{k}]"
            if name in owner:
                yield path, f"is {name!r}, which {owner[name]!r} flies already; a drone is in one cluster"
            elif is_checked and name not in names:
                yield path, f"is {name!r}; must be one of the drones {listed(list(dict.fromkeys(names)))}"
            owner.setdefault(name, called)


def _shape_faults(cluster: Any, drones: _Entries) -> Iterator[Fault]:
    if not _known(cluster.drones, cluster.groups) or None in cluster.groups:
        return
    placed = {drone.name: drone.position_m for _, drone in drones if _known(drone.name)}
    starts = [placed.get(name) for name in cluster.drones]
    groups = _entries(cluster.groups)
    yield from _name_faults("groups", groups)
    if len(groups) == 1:
        yield "groups", "has 1 entry; must have none, or 2 or more"
    sizes = [group.size for _, group in groups]
    if groups and _known(*sizes) and sum(sizes) != len(cluster.drones):
        yield "groups", f"has sizes that add up to {sum(sizes)}; must be {len(cluster.drones)}, one for each drone"
    centres: list[Any] = []
    for index, group in groups:
        if group.size is None:
            return
        own, starts = starts[: group.size], starts[group.size :]
        yield from _under(f"groups[{index}]", _template_faults(group, own, group.size))
        centres.append(np.array(own, dtype=float).mean(axis=0) if own and _known(*own) else None)
    robots = len(groups) or len(cluster.drones)
    yield from _template_faults(cluster, centres if groups else starts, robots)


def _template_faults(spec: Any, starts: list[Any], robots: int) -> Iterator[Fault]:
    """Yield the faults of a formation's template for a number of robots at given start positions."""
    template = spec.template_m
    if template is None or robots < 2:
        return
    space = space_name(spec.space, robots, bool(template))
    if space == "triad":
        if template:
            yield "template_m", "is given; must be left out where space is triad"
    elif space == "template" and robots < TEMPLATE_ROBOTS_MIN:
        path = "space" if spec.space else "template_m"
        yield path, f"asks for a template of {robots} robots; must be {TEMPLATE_ROBOTS_MIN} or more"
    elif template and len(template) != robots:
        yield "template_m", f"has {len(template)} positions; must have {robots}, one for each robot"
    elif space != "template":
        return  # a user's class checks its own template
    elif template and _known(*template) and _in_line(template):
        yield "template_m", f"is on one line, within {TEMPLATE_WIDTH_MIN_M:g} m; must span a plane or space"
    elif not template and len(starts) == robots and _known(*starts) and _in_line(starts):
        yield "template_m", "is missing, and the robots start on one line; must be given, or space must be triad"


def _in_line(points: list[Any]) -> bool:
    """Return whether points (n, 3) are collinear: within TEMPLATE_WIDTH_MIN_M of a line, root mean square."""
    p = np.array(points, dtype=float)
    widths = singular_values(p - p.mean(axis=0)) / np.sqrt(len(p))
    return el.length(widths[1:].tolist()) < TEMPLATE_WIDTH_MIN_M


def _plan_faults(cluster: Any) -> Iterator[Fault]:
    yield from _order_faults("plan.assemblies", (cluster.plan and cluster.plan.assemblies) or [])
    trajectory = cluster.plan and cluster.plan.trajectory
    if not trajectory:
        return
    expressions, waypoints = trajectory.expressions, trajectory.waypoints
    if _known(expressions, waypoints) and bool(expressions) == bool(waypoints):
        yield "plan.trajectory", "has both or neither of expressions and waypoints; must have one of them"
    yield from _order_faults("plan.trajectory.waypoints", waypoints)


def _order_faults(path: str, points: list[Any] | None) -> Iterator[Fault]:
    for (_, previous), (index, current) in pairwise(_entries(points)):
        if _known(previous.at_s, current.at_s) and current.at_s <= previous.at_s:
            yield f"{path}[{index}].at_s", f"is {current.at_s:g}; must be > {previous.at_s:g}, the time before it"


def _reference_faults(scenario: Any, drones: _Entries, clusters: _Entries) -> Iterator[Fault]:
    """Yield conflicts between drones' references, exchanges and clusters."""
    flown_by = {name: f"cluster {c.name!r}" for _, c in clusters for _, name in _entries(c.drones)}
    for index, drone in drones:
        if not drone.reference:
            continue
        path = f"drones[{index}].reference"
        if drone.name in flown_by:
            other = flown_by[drone.name]
            yield path, f"is given, and {other} flies the drone; must be left out, or the drone out of the cluster"
        elif drone.name is not None:
            flown_by[drone.name] = path
        yield from _under(path, _path_faults(drone.reference))
    names = _names(drones)
    exchanges = scenario.exchanges if isinstance(scenario.exchanges, list) else []
    for index, exchange in _entries(exchanges):
        path = f"exchanges[{index}]"
        for k, name in _entries(exchange.drones):
            at = f"{path}.drones[{k}]"
            if len(names) == len(drones) and name not in names:
                yield at, f"is {name!r}; must be one of the drones {listed(list(dict.fromkeys(names)))}"
            elif name in flown_by:
                yield at, f"is {name!r}, which {flown_by[name]} flies; a drone has one of cluster, reference, exchange"
            flown_by.setdefault(name, path)
        before_s = exchange.takeoff_s
        for number, stage in _entries(exchange.stages):
            at = f"{path}.stages[{number}]"
            if _known(stage.places_m, exchange.drones) and len(stage.places_m) != len(exchange.drones):
                count = len(exchange.drones)
                yield f"{at}.places_m", f"has {len(stage.places_m)} positions; must have {count}, one for each drone"
            if _known(stage.start_s, before_s) and stage.start_s < before_s:
                yield f"{at}.start_s", f"is {stage.start_s:g}; must be >= {before_s:g}, the end of the stage before"
            if _known(stage.start_s, stage.over_s):
                before_s = stage.start_s + stage.over_s
        yield from _under(path, _landing_faults(exchange, before_s))


def _path_faults(reference: Any) -> Iterator[Fault]:
    """Yield conflicts between the fields of one drone's reference."""
    paths = [name for name in PATHS if getattr(reference, name)]
    if len(paths) > 1:
        yield paths[1], f"is given together with {paths[0]}; give only one of {', '.join(PATHS)}"
    if paths and reference.start_s is None:
        yield "start_s", f"is missing; must say when {paths[0]} begins"
    if not paths and reference.start_s is not None:
        yield "start_s", f"is {reference.start_s:g} without a path; leave it out, or add one of {', '.join(PATHS)}"
    if _known(reference.start_s, reference.takeoff_s) and reference.start_s < reference.takeoff_s:
        yield "start_s", f"is {reference.start_s:g}; must be >= takeoff_s ({reference.takeoff_s:g})"
    for name in ("constants", "duration_s"):
        if getattr(reference, name) and "expressions" not in paths:
            yield name, "is given; must be left out without expressions"
    for name in ("waypoints", "minimum_snap"):
        points = getattr(reference, name)
        if name == "minimum_snap" and len(_entries(points)) == 1:
            yield name, "has 1 entry; must have 2 or more"
        yield from _order_faults(name, points)
    yield from _landing_faults(reference, reference.start_s or reference.takeoff_s)


def _landing_faults(piloted: Any, from_s: float | None) -> Iterator[Fault]:
    if _known(piloted.land_s, from_s) and piloted.land_s <= from_s:
        yield "land_s", f"is {piloted.land_s:g}; must be > {from_s:g}: after its take-off, path start or stages"


def _piloted(scenario: Any, drones: _Entries) -> _Entries:
    """Return the drones that have a reference or take part in an exchange."""
    exchanges = _entries(scenario.exchanges if isinstance(scenario.exchanges, list) else [])
    exchanged = {name for _, exchange in exchanges for _, name in _entries(exchange.drones)}
    return [(index, drone) for index, drone in drones if drone.reference or drone.name in exchanged]


def _process_faults(scenario: Any, drones: _Entries, clusters: _Entries) -> Iterator[Fault]:
    processes = scenario.processes
    action = ((processes and processes.on_death) or {}).get("world")
    if action is not None and action not in WORLD_DEATHS:
        yield "processes.on_death.world", f"is {action!r}; must be {' or '.join(WORLD_DEATHS)}"
    first: dict[str, int] = {}
    entries_of = {role: (each.about, drones if each.about == "drone" else clusters) for role, each in AGENTS.items()}
    entries_of[PILOT] = "drone with a reference", _piloted(scenario, drones)
    for index, name in _entries(processes and processes.expect):
        if first.setdefault(name, index) != index:
            yield f"processes.expect[{index}]", f"is {name!r}, as expect[{first[name]}]; must be unique"
        role, _, thing = name.partition(".")
        kind, entries = entries_of.get(role, ("", []))
        names = _names(entries)
        if kind and thing not in names and len(names) == len(entries):
            choices = listed(names) or f"a {kind} (the scenario has none)"
            allowed = f"must be {role}.NAME of {choices}, or a name of your own"
            yield f"processes.expect[{index}]", f"is {name!r}, and no {kind} is named {thing!r}; {allowed}"


def _program_faults(programs: Mapping[str, Any], roles: Sequence[str]) -> Iterator[Fault]:
    for name, program in programs.items():
        if (role := str(name).partition(".")[0]) in roles:
            allowed = f"must not begin with {', '.join(roles)}"
            yield f"programs.{name}", f"is named like a process of the role {role}; {allowed}"
        if program and program.command and not program.command[0]:
            yield f"programs.{name}.command[0]", "is empty; must be a program"


def _graph_faults(topology: Any, drones: list[str]) -> Iterator[Fault]:
    """Yield the faults of a topology's graph: names that are not those of other drones."""
    graph = getattr(topology, "graph", None)
    for hearer, senders in graph.items() if isinstance(graph, dict) else ():
        where = f"topology.graph.{hearer}"
        if hearer not in drones:
            yield where, f"is not a drone; {suggestion(hearer, drones)}must be one of {listed(drones)}"
        for k, name in enumerate(senders):
            others = [each for each in drones if each != hearer]
            if name not in others:
                itself = ", the drone itself" if name == hearer else ""
                close = suggestion(name, others)
                yield f"{where}[{k}]", f"is {show(name)}{itself}; {close}must be one of {listed(others)}"


def _injected_faults(
    scenario: Any, drones: _Entries, clusters: _Entries, vehicles: Mapping[str, Vehicle], unread: Collection[str]
) -> Iterator[Fault]:
    if any(item.name is None for _, item in [*drones, *clusters]) or not drones:
        return
    expected = scenario.processes and scenario.processes.expect
    processes = tuple(name for name in expected or () if name is not None)
    if isinstance(scenario.agents, dict):
        things = {"drone": [d.name for _, d in drones], "cluster": [c.name for _, c in clusters], "run": [MAIN]}
        own = scenario.agents.items()
        processes += tuple(f"{role}.{thing}" for role, each in own if each for thing in things.get(each.per, ()))
    processes += tuple(f"{PILOT}.{drone.name}" for _, drone in _piloted(scenario, drones))
    kinds = kinds_of(declarations([drone for _, drone in drones]))
    rotors = {drone.name: vehicles[drone.model].rotor_names if drone.model in vehicles else () for _, drone in drones}
    external = tuple(drone.name for _, drone in drones if drone.body == EXTERNAL)
    names = tuple(_names(drones)), tuple(_names(clusters))
    sensors = {drone.name: sensor_names(drone.sensors) for _, drone in drones if drone.sensors is not None}
    known = Known(*names, processes, kinds, rotors, external, sensors, unread)
    for index, fault in _entries(scenario.faults):
        for path, text in flaws(fault, known):
            yield f"faults[{index}]{f'.{path}' if path else ''}", text


def _sighting_faults(scenario: Any, drones: _Entries, clusters: _Entries) -> Iterator[Fault]:
    """Yield conflicts between cameras, sightings, hats and the estimators that use them."""
    for index, drone in drones:
        if drone.sensors is not None:
            yield from _under(f"drones[{index}].sensors", _camera_faults(drone.sensors))
            yield from _under(f"drones[{index}].sensors", _scanner_faults(drone.sensors))
    hats = scenario.environment and scenario.environment.hats
    names = [drone.name for _, drone in drones]
    for k, name in enumerate(hats.covered or () if hats else ()):
        if name not in names:
            yield f"environment.hats.covered[{k}]", f"is {show(name)}; must be one of {', '.join(map(str, names))}"
    if scenario.estimation is None or scenario.estimation.use_sightings is not True:
        return
    path, algorithm = "estimation.use_sightings", scenario.estimation.algorithm
    if algorithm not in (UNSET, None, "ekf"):
        yield path, f"is true; must be false with algorithm {show(algorithm)}: only ekf uses them"
    sensors = [drone.sensors for _, drone in drones if drone.sensors is not None]
    if sensors and not any(each.front_camera or each.bottom_camera for each in sensors):
        yield path, "is true and no drone has a camera; give one sensors.front_camera, and sightings or a detector"
    for index, cluster in clusters:
        count = len(cluster.drones or ())
        if count > SIGHTING_DRONES_MAX:
            where = f"clusters[{index}].drones"
            yield where, f"has {count}; must have at most {SIGHTING_DRONES_MAX} where {path} is true"


def _camera_faults(sensors: Any) -> Iterator[Fault]:
    cameras = {"front": sensors.front_camera, "bottom": sensors.bottom_camera}
    for name, camera in cameras.items():
        if not camera:
            continue
        path = f"{name}_camera"
        lens = camera.width_px, camera.height_px, camera.diagonal_deg, camera.distortion
        if None not in lens and None not in camera.distortion and folds(lens_of(camera)):
            min_k1 = K1_MIN / el.tan(math.radians(camera.diagonal_deg) / 2) ** 2
            actual = f"is {list(camera.distortion)}, which folds a picture of {camera.diagonal_deg:g} deg"
            needed = f"must give every pixel its own ray: if only k1 is set, k1 > {min_k1:.3f}"
            yield f"{path}.distortion", f"{actual}; {needed}"
        if None not in (camera.exposure_ms, camera.rate_hz) and camera.exposure_ms * camera.rate_hz > 1e3:
            limit = f"{1e3 / camera.rate_hz:.4g} ms at rate_hz {camera.rate_hz:g}"
            text = f"is {camera.exposure_ms:g}; must be <= {limit}, the time from one picture to the next"
            yield f"{path}.exposure_ms", text
    for section in ("sightings", "depth"):
        used = getattr(sensors, section)
        looks_at = (used and used.cameras) or ()
        for k, name in enumerate(looks_at):
            path = f"{section}.cameras[{k}]"
            if name in looks_at[:k]:
                yield path, f"is {name!r}, as cameras[{looks_at.index(name)}]; must be unique"
            elif name in cameras and not cameras[name]:
                yield path, f"is {name!r}, which the drone does not have; give it {name}_camera: {{}}"


def _scanner_faults(sensors: Any) -> Iterator[Fault]:
    """Yield conflicts between the settings of a drone's beams, lidar and depth images."""
    for name in SCANNERS:
        own = getattr(sensors, name)
        if not own:
            continue
        if _known(own.min_m, own.max_m) and own.min_m >= own.max_m:
            yield f"{name}.min_m", f"is {own.min_m:g}; must be < max_m ({own.max_m:g})"
        rows = {"lidar": "channels", "depth": "rows"}.get(name)
        if rows and _known(getattr(own, rows), own.columns) and getattr(own, rows) * own.columns > RAYS_MAX:
            limit = f"must be <= {RAYS_MAX // getattr(own, rows)} with {rows} {getattr(own, rows)}"
            yield f"{name}.columns", f"is {own.columns}; {limit}: {RAYS_MAX} rays per message"
    azimuth = sensors.lidar and sensors.lidar.azimuth_deg
    if azimuth and None not in azimuth and not 0 < azimuth[1] - azimuth[0] <= 360:
        yield "lidar.azimuth_deg", f"is {show(list(azimuth))}; must be [first, last], rising by at most 360"
