"""Ground, obstacles, surfaces and hulls: drones stand, slide, tip and rebound on them, and gain no energy from them."""

import math
from typing import Any

import numpy as np
import pytest
from falling import check_slide, energy, fly, tilt_deg
from hypothesis import given, settings
from hypothesis import strategies as st
from vehicle_rows import one_drone

from zsim.contract.snapshot import pack, restore, saved_state, unpack
from zsim.math.frames import quaternion_from_rpy, rpy_from_quaternion
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surroundings import SHAPES, nearest, packed
from zsim.vehicles.ardrone2 import VEHICLE as ARDRONE2
from zsim.vehicles.crazyflie2 import VEHICLE as CRAZYFLIE2
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics import rigid_body as body
from zsim_world.physics.fleet_arrays import STATE, VEHICLE, four, vector
from zsim_world.physics.surfaces import Touch, contact, drag_anchors, touched

OFF, CALM = np.zeros(4), (0.0, 0.0, 0.0)
DT = 0.0025
FRAME = ARDRONE2.airframe
STAND_HEIGHT_M = FRAME.foot_depth_m - FRAME.foot_sag_m
ROTORS = one_drone()[1]
ROOF_M = 1.0
BOX = {"name": "box", "shape": "box", "position_m": [0, 0, 0], "size_m": [6, 6, ROOF_M]}
PILLAR = {"name": "pillar", "shape": "cylinder", "position_m": [0, 0, 0], "radius_m": 3, "height_m": ROOF_M}
HILL_M = 200.0  # radius of a ball that is large compared with a drone
WIDE_M = 4.0  # half width of a sheet: nothing gets any further, and a wider one takes half a second to build
ANGLE, UNIT = st.floats(-3.2, 3.2), st.floats(-1.0, 1.0)


@pytest.fixture
def row():
    return one_drone()[0]


def placed(height=STAND_HEIGHT_M, rpy=(0.0, 0.0, 0.0)):
    state = np.zeros(STATE.size + 4)
    state[2], state[6:10] = height, quaternion_from_rpy(rpy)
    return state


def stand(row, state, seconds, push=CALM):
    anchor = np.zeros((8, 2))
    drag_anchors(row, anchor, vector(state, 0), four(state, 6))
    track = []
    for _ in range(round(seconds / DT)):
        body.step(row, ROTORS, anchor, state, OFF, CALM, push, DT)
        drag_anchors(row, anchor, vector(state, 0), four(state, 6))
        track.append(state.copy())
    return np.array(track)


def test_a_dropped_drone_settles_and_never_gains_energy(row):
    state = placed(0.5, (0.2, -0.3, 1.0))
    track = stand(row, state, 4.0)
    inertia = row[VEHICLE.inertia : VEHICLE.inertia + 3]
    kinetic = 0.5 * row[VEHICLE.mass] * (track[:, 3:6] ** 2).sum(1) + 0.5 * (inertia * track[:, 10:13] ** 2).sum(1)
    energy = kinetic + row[VEHICLE.mass] * row[VEHICLE.gravity] * track[:, 2]
    assert energy.max() <= row[VEHICLE.mass] * row[VEHICLE.gravity] * 0.5 * 1.001
    assert kinetic[-1] < 1e-6
    assert abs(state[2] - STAND_HEIGHT_M) < 1e-3
    np.testing.assert_allclose(rpy_from_quaternion(state[6:10])[:2], 0.0, atol=1e-3)


@pytest.mark.parametrize(("share", "moves"), [(0.9, False), (1.1, True)])
def test_friction_holds_within_the_friction_cone(row, share, moves):
    weight = row[VEHICLE.mass] * row[VEHICLE.gravity]
    state = placed()
    stand(row, state, 2.0, (share * FRAME.friction * weight, 0.0, 0.0))
    if moves:  # accelerated by the push in excess of friction, against the drag of still air
        left = (share - 1.0) * FRAME.friction * weight
        tau = row[VEHICLE.mass] / row[VEHICLE.drag]
        expected = left / row[VEHICLE.drag] * (1 - math.exp(-2.0 / tau))
        assert math.isclose(state[3], expected, rel_tol=0.1)
    else:
        assert abs(state[0]) < 0.01
        assert abs(state[3]) < 1e-6


def test_a_drone_does_not_creep_under_a_constant_push(row):
    state = placed()
    track = stand(row, state, 20.0, (0.15, -0.1, 0.0))
    np.testing.assert_allclose(track[-1, :2], track[2000, :2], atol=1e-9)


def test_there_is_no_contact_force_in_the_air(row):
    anchor = np.zeros((8, 2))
    force, moment = contact(row, anchor, (0.0, 0.0, 0.2), CALM, (1.0, 0.0, 0.0, 0.0), CALM)
    assert force == CALM
    assert moment == CALM


def test_the_ground_never_pulls(row):
    anchor = np.zeros((8, 2))
    force, _ = contact(row, anchor, (0.0, 0.0, 0.0599), (0.0, 0.0, 5.0), (1.0, 0.0, 0.0, 0.0), CALM)
    assert force == CALM


def plane(slope: float = 0.0, cell_m: float = 0.5, half_m: float = WIDE_M, z_m: float = ROOF_M) -> np.ndarray:
    """Return the triangles of a gridded plane that rises to the west, (T, 9)."""
    x = np.arange(-half_m, half_m + 1e-9, cell_m)
    points = np.stack(np.broadcast_arrays(x[None, :], x[:, None], z_m - math.tan(slope) * x[None, :]), axis=2)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.concatenate(three, axis=2).reshape(-1, 9) for three in ((a, b, c), (a, c, d))])


def block(*size_m: float) -> np.ndarray:
    """Return the triangles, unordered and of mixed winding, of a box centred at x = y = 0 on the ground."""
    wide, long, high = size_m
    p = np.array([[x * wide / 2, y * long / 2, z * high] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)])
    faces = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return np.array([p[list(three)] for a, b, c, d in faces for three in ((a, b, c), (c, a, d))]).reshape(-1, 9)


def on(*obstacles: Any, sheet: np.ndarray | None = None, drones: int = 1, **drone: Any) -> Fleet:
    """Return drones with still rotors, far from the obstacles and the sheet, in calm air."""
    start = [{"name": f"d{k}", "position_m": [3.0 * k, 900, 0], **drone} for k in range(drones)]
    around: dict[str, Any] = {"obstacles": list(obstacles)}
    if sheet is not None:
        around["surfaces"] = [{"name": "sheet", "triangles": packed(sheet), "position_m": [0, 0, 0]}]
    return Fleet(resolve({"name": "t", "duration_s": 1, "drones": start, "environment": around}))


def put(fleet: Fleet, p: Any, q: Any = (1, 0, 0, 0), v: Any = (0, 0, 0), w: Any = (0, 0, 0), i: int = 0) -> None:
    """Put a drone into a state and clear its contacts."""
    state = fleet.bodies.state[i]
    state[:] = 0.0
    state[: STATE.size] = *p, *v, *q, *w
    fleet.bodies.held[i] = np.nan  # contacts at the previous place must not matter
    fleet.bodies.solid[i] = -1
    fleet.bodies.plane[i] = 0.0
    fleet.bodies.braced[i], fleet.bodies.twist[i] = 1, 0.0


GROUND: dict[str, Any] = {}
STANDS = {"ground": (GROUND, 0.0), "box": (BOX, ROOF_M), "cylinder": (PILLAR, ROOF_M)}


@pytest.mark.parametrize(("solid", "top_m"), STANDS.values(), ids=STANDS)
@pytest.mark.parametrize("model", ["ardrone2", "crazyflie2"])
def test_feet_carry_the_weight_at_their_sag(solid: Any, top_m: float, model: str) -> None:
    frame = {"ardrone2": ARDRONE2, "crazyflie2": CRAZYFLIE2}[model].airframe
    fleet = on(*([solid] if solid else []), model=model)
    put(fleet, (0.3, 0.2, top_m + frame.foot_depth_m + 0.05), quaternion_from_rpy((0.1, -0.1, 0.5)))
    end = fly(fleet, 4.0)[-1, 0]
    assert end[2] == pytest.approx(top_m + frame.foot_depth_m - frame.foot_sag_m, abs=1e-6)  # four springs carry m g
    np.testing.assert_allclose(end[3:6], 0.0, atol=1e-6)
    assert np.degrees(np.abs(end[10:13])).max() < 1e-3
    assert tilt_deg(end) < 0.01
    assert not fleet.touching[0]  # it stands on its feet: no collision


@pytest.mark.parametrize(
    "cell_m", [None, 0.05, 0.1, 7.0], ids=["box", "sheet of 0.05 m", "sheet of 0.1 m, feet on edges", "sheet of 7 m"]
)
def test_a_roof_or_sheet_carries_a_drone_as_the_ground_does(cell_m: float | None) -> None:
    """The same fall on the feet ends in the same slide and place on the ground and on a roof or a sheet."""
    low = on()
    if cell_m is None:
        high = on({**BOX, "size_m": [90, 90, ROOF_M]})
    else:
        high = on(sheet=plane(cell_m=cell_m, half_m=7.0 if cell_m > 1.0 else 1.0))
    q, v = quaternion_from_rpy((0.05, -0.03, 1.0)), (0.4, -0.2, 0.0)
    put(low, (0.0, 0.0, 0.1), q, v)
    put(high, (0.0, 0.0, 0.1 + ROOF_M), q, v)
    one, other = fly(low, 3.0)[-1, 0], fly(high, 3.0)[-1, 0]
    atol = 1e-9 if cell_m is None else 1e-7
    np.testing.assert_allclose(other[:3] - one[:3], (0.0, 0.0, ROOF_M), atol=atol)
    np.testing.assert_allclose(other[6:10], one[6:10], atol=atol)
    assert np.hypot(*one[:2]) > 0.02  # it has slid there
    assert not high.touching[0]


@pytest.mark.parametrize(("solid", "top_m"), [(GROUND, 0.0), (BOX, ROOF_M)], ids=["ground", "box"])
def test_a_drone_on_its_back_rests_on_its_rim(solid: Any, top_m: float) -> None:
    fleet = on(*([solid] if solid else []))
    put(fleet, (0.0, 0.0, top_m + 0.3), quaternion_from_rpy((math.pi, 0.0, 0.0)))
    end = fly(fleet, 4.0)[-1, 0]
    assert end[2] == pytest.approx(top_m + FRAME.rim_height_m - FRAME.foot_sag_m, abs=1e-5 if solid else 2e-3)
    assert fleet.touching[0] == bool(solid)


@pytest.mark.parametrize(("share", "slides"), [(0.95, False), (1.05, True)])
@pytest.mark.parametrize("cell_m", [None, 0.5, 40.0], ids=["side of a ball", "sheet of 0.5 m", "sheet of 40 m"])
def test_a_drone_slides_where_the_slope_exceeds_the_friction(share: float, slides: bool, cell_m: float | None) -> None:
    """Coulomb: on a plane of slope s a block slides if and only if tan s > mu, and then at g (sin s - mu cos s)."""
    slope, away, base_m = math.atan(share * FRAME.friction), FRAME.foot_depth_m - FRAME.foot_sag_m, ROOF_M
    if cell_m is None:  # on the side of a ball that is large compared with the drone
        fleet = on({"name": "hill", "shape": "sphere", "position_m": [0, 0, 0], "radius_m": HILL_M}, drag_n_s_m=1e-9)
        away, base_m = away + HILL_M, 0.0
    else:
        fleet = on(sheet=plane(slope, cell_m, max(WIDE_M, cell_m / 2)), drag_n_s_m=1e-9)
    put(fleet, (away * math.sin(slope), 0.0, base_m + away * math.cos(slope)), quaternion_from_rpy((0.0, slope, 0.0)))
    check_slide(fleet, slope, FRAME.friction if slides else None, rel=0.1 if cell_m is None else 0.05)


@pytest.mark.parametrize("drop_m", [0.05, 0.5, 2.0])
def test_a_rebound_is_lower_than_the_fall(drop_m: float) -> None:
    """The restitution of a flat fall, as the height of the rebound per height of the fall, stays well below 1."""
    fleet = on(BOX)
    rest = ROOF_M + FRAME.foot_depth_m
    put(fleet, (0.0, 0.0, rest + drop_m))
    track = fly(fleet, 4.0)[:, 0]
    first = np.argmax(track[:, 5] > 0.0)
    rebound = (track[first:, 2].max() - rest) / drop_m
    assert rebound < 0.3
    assert track[:, 2].min() > ROOF_M - 0.06


def test_a_drone_with_its_outer_feet_over_an_edge_leans_on_its_hull() -> None:
    fleet = on(BOX)
    put(fleet, (3.0 - 0.03, 0.0, ROOF_M + FRAME.foot_depth_m))
    end = fly(fleet, 4.0)[-1, 0]
    assert 5.0 < tilt_deg(end) < 30.0
    assert np.abs(end[[3, 4, 5, 10, 11, 12]]).max() < 1e-3


@pytest.mark.parametrize(("over_m", "falls"), [(-0.12, False), (0.03, True)])
def test_a_drone_tips_when_its_centre_is_beyond_the_edge(over_m: float, falls: bool) -> None:
    fleet = on(BOX)
    put(fleet, (3.0 + over_m, 0.0, ROOF_M + FRAME.foot_depth_m))
    track = fly(fleet, 4.0)[:, 0]
    if falls:
        assert max(map(tilt_deg, track)) > 30.0
        assert track[-1, 2] < 0.3
    else:
        assert max(map(tilt_deg, track)) < 1.0
        assert track[-1, 2] == pytest.approx(ROOF_M + FRAME.foot_depth_m - FRAME.foot_sag_m, abs=1e-3)


def test_an_off_centre_force_exerts_a_moment() -> None:
    """One foot on the roof: M = r × F about the centre, F = k × depth along the normal."""
    fleet = on(BOX)
    row, q = fleet.bodies.vehicle[0], quaternion_from_rpy((0.0, 0.0, 0.4))
    r_B = np.array([FRAME.foot_xy_m, FRAME.foot_xy_m, -FRAME.foot_depth_m])
    w = 0.4
    turn = np.array([[math.cos(w), -math.sin(w), 0], [math.sin(w), math.cos(w), 0], [0, 0, 1]])
    corner = turn @ r_B
    p = (-3.01 + 0.02 - corner[0], -3.01 + 0.02 - corner[1], ROOF_M - corner[2] - 0.001)  # the others are over the edge
    held = np.zeros((1, *fleet.bodies.held.shape[2:]))
    held[0, 0] = np.array(p) + corner
    touch = Touch(fleet.bodies.obstacle, np.zeros(1, dtype=np.int32), held, fleet.bodies.plane[0], (0.0, 0.0, 0.0))
    force, moment = touched(row, touch, p, (0.0, 0.0, 0.0), (q[0], q[1], q[2], q[3]), (0.0, 0.0, 0.0))
    normal = row[VEHICLE.foot_stiffness] * 0.001
    np.testing.assert_allclose(force, (0.0, 0.0, normal), atol=1e-9)
    np.testing.assert_allclose(moment, np.cross(r_B, (0.0, 0.0, normal)), atol=1e-9)
    assert abs(moment[0]) > 0.01


@pytest.mark.parametrize("half_m", [0.02, 0.05, 0.3])
@pytest.mark.parametrize("speed_m_s", [1.0, 4.0])
@pytest.mark.parametrize("heading_deg", [0.0, 15.0, 40.0])
def test_a_drone_does_not_pass_through_a_post(half_m: float, speed_m_s: float, heading_deg: float) -> None:
    post = {"name": "post", "shape": "cylinder", "position_m": [0, 0, 0], "radius_m": half_m, "height_m": 60}
    fleet = on(post)
    put(fleet, (-1.0, 0.0, 40.0), quaternion_from_rpy((0.0, 0.0, math.radians(heading_deg))), (speed_m_s, 0.0, 0.0))
    track = fly(fleet, 1.6)[:, 0]
    solid = fleet.bodies.obstacle[0]
    assert min(nearest(solid, *p)[0] for p in track[:, :3]) > -half_m
    beyond = track[:, 0] > 0.0
    assert not (beyond & (np.abs(track[:, 1]) < 0.5 * FRAME.hull_radius_m)).any()


@pytest.mark.parametrize("fall_m", [0.5, 2.0])
def test_a_thin_slab_stops_a_falling_drone(fall_m: float) -> None:
    fleet = on({"name": "table", "shape": "box", "position_m": [0, 0, 10], "size_m": [3, 3, 0.05]})
    put(fleet, (0.0, 0.0, 10.05 + FRAME.foot_depth_m + fall_m))
    assert fly(fleet, 3.0)[-1, 0, 2] == pytest.approx(10.05 + FRAME.foot_depth_m - FRAME.foot_sag_m, abs=1e-3)


def solid_of(shape: str, size: tuple[float, ...], yaw_deg: float) -> dict[str, Any]:
    made: dict[str, Any] = {"name": "o", "shape": shape, "position_m": [0, 0, 20], "yaw_deg": yaw_deg}
    if shape == "box":
        return {**made, "size_m": list(size)}
    if shape == "cylinder":
        return {**made, "radius_m": size[0] / 2, "height_m": size[2]}
    return {**made, "radius_m": size[0] / 2}


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    shape=st.sampled_from(SHAPES),
    size=st.tuples(*[st.floats(0.3, 3.0)] * 3),
    yaw_deg=st.floats(-180, 180),
    towards=st.tuples(UNIT, UNIT, UNIT).filter(lambda a: math.hypot(*a) > 0.1),
    rpy=st.tuples(ANGLE, ANGLE, ANGLE),
    speed=st.floats(0.0, 5.0),
    rates=st.tuples(UNIT, UNIT, UNIT),
    model=st.sampled_from(["ardrone2", "crazyflie2"]),
)
def test_a_collision_with_an_obstacle_adds_no_energy(
    shape: str,
    size: tuple[float, ...],
    yaw_deg: float,
    towards: tuple[float, ...],
    rpy: tuple[float, ...],
    speed: float,
    rates: tuple[float, ...],
    model: str,
) -> None:
    """Thrown at a solid from anywhere, in any attitude and turning, a drone never exceeds its initial total energy."""
    fleet = on(solid_of(shape, size, yaw_deg), model=model)
    solid = fleet.bodies.obstacle[0]
    n = np.array(towards) / math.hypot(*towards)
    p = np.array(solid[1:4]) + n * 4.0
    while nearest(solid, *p)[0] > 0.35:
        p = p - 0.02 * n
    put(fleet, p, quaternion_from_rpy(rpy), -speed * n, 10.0 * np.array(rates))
    first = energy(fleet, fleet.bodies.state[:, : STATE.size])[0]
    most = energy(fleet, fly(fleet, 1.2))[:, 0].max()
    zero = fleet.bodies.vehicle[0, VEHICLE.mass] * fleet.bodies.vehicle[0, VEHICLE.gravity] * p[2]
    assert most <= first + 1e-3 * (first - zero) + 1e-4 * fleet.bodies.vehicle[0, VEHICLE.mass]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    aside=st.tuples(UNIT, UNIT, UNIT).filter(lambda a: math.hypot(*a) > 0.1),
    rpy=st.tuples(ANGLE, ANGLE, ANGLE),
    closing=st.floats(0.1, 5.0),
    across=st.tuples(UNIT, UNIT, UNIT),
    rates=st.tuples(UNIT, UNIT, UNIT),
    models=st.tuples(*[st.sampled_from(["ardrone2", "crazyflie2"])] * 2),
)
def test_colliding_hulls_keep_momentum_and_gain_no_energy(
    aside: tuple[float, ...],
    rpy: tuple[float, ...],
    closing: float,
    across: tuple[float, ...],
    rates: tuple[float, ...],
    models: tuple[str, str],
) -> None:
    """Two drones in free fall without drag; angular momentum is kept except for motion within a tick of held forces."""
    start = [
        {"name": f"d{k}", "position_m": [9.0 * k, 0, 0], "model": model, "drag_n_s_m": 0.0}
        for k, model in enumerate(models)
    ]
    fleet = Fleet(resolve({"name": "t", "duration_s": 1, "drones": start}))
    row = fleet.bodies.vehicle
    n, gap = np.array(aside) / math.hypot(*aside), row[:, VEHICLE.hull_radius].sum() + 0.01
    centre, q = np.array([0.0, 0.0, 500.0]), quaternion_from_rpy(rpy)
    put(fleet, centre, q, 2.0 * np.array(across), 8.0 * np.array(rates))
    put(fleet, centre + gap * n, (1, 0, 0, 0), -closing * n, (0, 0, 0), 1)
    fleet.bodies.near.origin[:] = np.inf
    before = fleet.bodies.state[:, : STATE.size].copy()
    track = fly(fleet, 0.4)
    scale = row[:, VEHICLE.mass].min() * gap * max(closing, 2.0)
    change = energy(fleet, track).sum(1) - energy(fleet, before).sum()
    assert change.max() <= 1e-3 * row[:, VEHICLE.mass].sum() * max(closing, 1.0) ** 2
    np.testing.assert_allclose(spin(row, track[-1]), spin(row, before), atol=0.03 * scale)


def spin(row: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Return the angular momentum of all drones about their common centre of mass in W [kg m^2/s]."""
    mass = row[:, VEHICLE.mass][:, None]
    p, v = state[:, 0:3], state[:, 3:6]
    p, v = p - (mass * p).sum(0) / mass.sum(), v - (mass * v).sum(0) / mass.sum()
    total = np.cross(p, mass * v).sum(0)
    for i, each in enumerate(state):
        own = row[i, VEHICLE.inertia : VEHICLE.inertia + 3] * each[10:13]
        total += turned(each[6:10], own)
    return total


def turned(q: np.ndarray, a: np.ndarray) -> np.ndarray:
    u = q[1:]
    return a + 2.0 * np.cross(u, np.cross(u, a) + q[0] * a)


def test_a_glancing_collision_turns_both_drones() -> None:
    """Friction at the contact between centres half a metre apart turns both drones the same way."""
    fleet = on(drones=2)
    put(fleet, (0.0, 0.0, 500.0))
    put(fleet, (2 * FRAME.hull_radius_m + 0.01, 0.0, 500.0), v=(-1.5, 2.0, 0.0), i=1)
    fleet.bodies.near.origin[:] = np.inf
    end = fly(fleet, 0.3)[-1]
    assert end[0, 12] > 0.5
    assert end[1, 12] == pytest.approx(end[0, 12], rel=1e-6)


def test_with_more_solids_than_slots_those_within_reach_are_used() -> None:
    """On a roof of forty planks, a drone stands on those below it, whichever were found first."""
    planks = [
        {"name": f"p{k}", "shape": "box", "position_m": [0.1 * k - 2.0, 0, 0], "size_m": [0.1, 4, ROOF_M]}
        for k in range(40)
    ]
    fleet = on(*planks)
    put(fleet, (0.02, 0.0, ROOF_M + FRAME.foot_depth_m + 0.02))
    end = fly(fleet, 3.0)[-1, 0]
    assert end[2] == pytest.approx(ROOF_M + FRAME.foot_depth_m - FRAME.foot_sag_m, abs=1e-4)


def test_a_drone_that_starts_on_a_sheet_stays_there() -> None:
    fleet = on(sheet=plane(), position_m=[0, 0, ROOF_M])
    track = fly(fleet, 1.0)[:, 0]
    assert np.abs(track[:, 2] - ROOF_M - FRAME.foot_depth_m + FRAME.foot_sag_m).max() < 1e-6


@pytest.mark.parametrize("speed_m_s", [1.0, 6.0, 15.0])
@pytest.mark.parametrize("rpy_deg", [(0, 0, 0), (180, 0, 0), (70, 20, 0)], ids=["feet", "back", "side"])
def test_a_sheet_stops_a_drone_from_either_side_without_adding_energy(speed_m_s: float, rpy_deg: Any) -> None:
    for below in (False, True):
        fleet = on(sheet=plane(z_m=20.0), drag_n_s_m=1e-9)
        toward = 1.0 if below else -1.0
        put(
            fleet,
            (0.03, 0.02, 20.0 - 0.5 * toward),
            quaternion_from_rpy(np.radians(rpy_deg)),
            (0, 0, toward * speed_m_s),
        )
        before = energy(fleet, fleet.bodies.state[:, : STATE.size])[0]
        track = fly(fleet, 1.0)
        beyond = toward * (track[:, 0, 2] - 20.0)
        assert beyond.max() < FRAME.hull_radius_m  # penetration of its centre: 15 m/s dents the hull
        assert beyond[-1] < 0.0
        assert energy(fleet, track).max() <= before * (1.0 + 1e-3)


def test_a_block_of_triangles_behaves_like_a_box() -> None:
    """Falls on the top, a side and an edge, with triangles of mixed winding: the paths differ by at most 2 cm."""
    mesh = on(sheet=block(4.0, 4.0, ROOF_M), drag_n_s_m=1e-9)
    solid = on({**BOX, "size_m": [4, 4, ROOF_M]}, drag_n_s_m=1e-9)
    falls = [
        ((0.5, 0.3, 1.6), (0.3, 0.0, 0.0), (0, 0, 0)),
        ((2.6, 0.2, 0.7), (-2.0, 0.0, 0.0), (0, 0, 0)),
        ((1.5, -0.4, 1.4), (0.0, 0.0, 0.0), (0.5, 0.3, 0.1)),
    ]
    for p, v, rpy in falls:
        for fleet in (mesh, solid):
            put(fleet, p, quaternion_from_rpy(rpy), v)
        one, other = fly(mesh, 0.8)[:, 0], fly(solid, 0.8)[:, 0]
        np.testing.assert_allclose(one[:, :3], other[:, :3], atol=0.02)
        assert tilt_deg(other[-1]) == pytest.approx(tilt_deg(one[-1]), abs=5.0)


def test_a_drone_slides_off_a_sheet_and_nothing_holds_it() -> None:
    """It slides over the edge of a sheet, which has no sides, and falls to the ground as from a table."""
    fleet = on(sheet=plane(half_m=1.0), drag_n_s_m=1e-9)
    put(fleet, (0.5, 0.0, ROOF_M + FRAME.foot_depth_m), v=(3.0, 0.0, 0.0))
    track = fly(fleet, 3.0)[:, 0]
    assert track[-1, 0] > 1.2
    assert track[-1, 2] < 0.2
    assert np.linalg.norm(track[:, 3:6], axis=1).max() < 6.0  # a fall of 1 m gives 4.4 m/s


def test_a_contact_continues_bit_identically_from_a_saved_state() -> None:
    one, other = on(sheet=plane(0.3)), on(sheet=plane(0.3))
    put(one, (0.0, 0.0, ROOF_M + 0.2), quaternion_from_rpy((0.4, 0.2, 0.1)), (0.5, 0.3, 0.0))
    fly(one, 0.3)
    restore(other, unpack(pack(saved_state(one))))
    assert one.bodies.plane[..., 0].any()
    np.testing.assert_array_equal(fly(one, 0.3), fly(other, 0.3))


def test_a_bump_into_a_surface_is_reported_by_its_name() -> None:
    far = {"name": "far", "shape": "sphere", "position_m": [0, 0, 90], "radius_m": 1}
    fleet, bumps = on(far, sheet=plane()), []
    put(fleet, (0.0, 0.0, ROOF_M + 0.3), quaternion_from_rpy((math.pi, 0.0, 0.0)))
    for _ in range(100):
        fleet.advance()
        bumps += fleet.bumps()
    assert [fleet.object_names[thing] for _, thing in bumps][:1] == ["sheet"]
    assert fleet.touching[0]
