"""Surfaces as bodies: drones stand, slide and rebound on sheets of triangles, from both sides, and are not let through."""

import math
from typing import Any

import numpy as np
import pytest
from falling import check_slide, energy, fly, tilt_deg

from zsim.contract.snapshot import pack, restore, saved_state, unpack
from zsim.math.frames import quaternion_from_rpy
from zsim.scenario.scenario_file import resolve
from zsim.scenario.surface_file import packed
from zsim.vehicles.ardrone2 import VEHICLE
from zsim_world.fleet.fleet import Fleet
from zsim_world.physics.fleet_arrays import STATE

FRAME = VEHICLE.airframe
FLOOR_M = 1.0
WIDE_M = 4.0  # as far as anything gets here; a wider sheet takes half a second to be made


def plane(slope: float = 0.0, cell_m: float = 0.5, half_m: float = WIDE_M, z_m: float = FLOOR_M) -> np.ndarray:
    """Return the triangles of a plane that rises to the west, in cells, (T, 9)."""
    x = np.arange(-half_m, half_m + 1e-9, cell_m)
    points = np.stack(np.broadcast_arrays(x[None, :], x[:, None], z_m - math.tan(slope) * x[None, :]), axis=2)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.concatenate(three, axis=2).reshape(-1, 9) for three in ((a, b, c), (a, c, d))])


def block(*size_m: float) -> np.ndarray:
    """Return the triangles of a box about x = y = 0 that stands on the ground, in no order and of no direction."""
    wide, long, high = size_m
    p = np.array([[x * wide / 2, y * long / 2, z * high] for x in (-1, 1) for y in (-1, 1) for z in (0, 1)])
    faces = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
    return np.array([p[list(three)] for a, b, c, d in faces for three in ((a, b, c), (c, a, d))]).reshape(-1, 9)


def over(
    triangles: np.ndarray | None = None, position_m: Any = (0, 0, 0), start_m: float = 0.0, **environment: Any
) -> Fleet:
    """Return one drone with still rotors, far away, in calm air."""
    if triangles is not None:
        environment["surfaces"] = [{"name": "sheet", "triangles": packed(triangles), "position_m": [*position_m]}]
    drone = {"name": "d0", "position_m": [0, 900, start_m], "drag_n_s_m": 1e-9}
    return Fleet(resolve({"name": "t", "duration_s": 1, "drones": [drone], "environment": environment}))


def put(fleet: Fleet, p: Any, q: Any = (1, 0, 0, 0), v: Any = (0, 0, 0), w: Any = (0, 0, 0)) -> None:
    state = fleet.bodies.state[0]
    state[:] = 0.0
    state[: STATE.size] = *p, *v, *q, *w
    fleet.bodies.plane[0] = 0.0


@pytest.mark.parametrize("cell_m", [0.05, 0.1, 7.0])
def test_it_rests_on_a_flat_sheet_as_on_the_ground(cell_m: float) -> None:
    """The same fall, to the ground and to a sheet: the same slide, the same place; at 0.1 m feet fall on its edges."""
    low, high = over(), over(plane(cell_m=cell_m, half_m=7.0 if cell_m > 1.0 else 1.0))
    for q, v in (((1, 0, 0, 0), (0, 0, 0)), (quaternion_from_rpy((0.05, -0.03, 1.0)), (0.4, -0.2, 0.0))):
        put(low, (0.0, 0.0, 0.1), q, v)
        put(high, (0.0, 0.0, 0.1 + FLOOR_M), q, v)
        one, other = fly(low, 2.0)[-1, 0], fly(high, 2.0)[-1, 0]
        np.testing.assert_allclose(other[:3] - one[:3], (0.0, 0.0, FLOOR_M), atol=1e-7)
        np.testing.assert_allclose(other[6:10], one[6:10], atol=1e-7)
        assert one[2] == pytest.approx(FRAME.foot_depth_m - FRAME.foot_sag_m, abs=1e-6)
        assert not high.touching[0]  # it stands on its feet: no collision


def test_a_drone_that_starts_upon_a_sheet_stays() -> None:
    fleet = over(plane(), position_m=(0, 900, 0), start_m=FLOOR_M)
    track = fly(fleet, 1.0)[:, 0]
    assert np.abs(track[:, 2] - FLOOR_M - FRAME.foot_depth_m + FRAME.foot_sag_m).max() < 1e-6


@pytest.mark.parametrize(("share", "slides"), [(0.95, False), (1.05, True)])
@pytest.mark.parametrize("cell_m", [0.5, 40.0])
def test_on_a_slope_it_slides_where_the_tangent_exceeds_the_friction(share: float, slides: bool, cell_m: float) -> None:
    """Coulomb: on a plane of slope s a block slides if and only if tan s > mu, and then at g (sin s - mu cos s)."""
    slope = math.atan(share * FRAME.friction)
    fleet, away = over(plane(slope, cell_m, max(WIDE_M, cell_m / 2))), FRAME.foot_depth_m - FRAME.foot_sag_m
    put(fleet, (away * math.sin(slope), 0.0, FLOOR_M + away * math.cos(slope)), quaternion_from_rpy((0.0, slope, 0.0)))
    check_slide(fleet, slope, FRAME.friction if slides else None, rel=0.05)


@pytest.mark.parametrize("speed_m_s", [1.0, 6.0, 15.0])
@pytest.mark.parametrize("rpy_deg", [(0, 0, 0), (180, 0, 0), (70, 20, 0)], ids=["feet", "back", "side"])
def test_a_sheet_is_not_passed_from_either_side_and_gives_no_energy(speed_m_s: float, rpy_deg: Any) -> None:
    for below in (False, True):
        fleet = over(plane(z_m=20.0))
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
        assert beyond.max() < FRAME.hull_radius_m  # its centre, dented by 15 m/s
        assert beyond[-1] < 0.0
        assert energy(fleet, track).max() <= before * (1.0 + 1e-3)


def test_a_block_of_triangles_is_as_the_box() -> None:
    """Falls upon its top, its side and its edge, of triangles whose directions are mixed: the paths differ by 2 cm."""
    mesh = over(block(4.0, 4.0, FLOOR_M))
    solid = over(obstacles=[{"name": "b", "shape": "box", "position_m": [0, 0, 0], "size_m": [4, 4, FLOOR_M]}])
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


def test_beside_the_rim_it_falls_off_and_nothing_holds_it() -> None:
    """It slides over the edge of a table without sides, and falls to the ground as from one."""
    fleet = over(plane(half_m=1.0))
    put(fleet, (0.5, 0.0, FLOOR_M + FRAME.foot_depth_m), v=(3.0, 0.0, 0.0))
    track = fly(fleet, 3.0)[:, 0]
    assert track[-1, 0] > 1.2
    assert track[-1, 2] < 0.2
    assert np.linalg.norm(track[:, 3:6], axis=1).max() < 6.0  # of a fall of 1 m, 4.4 m/s


def test_a_contact_goes_on_to_the_same_bits_from_a_saved_state() -> None:
    one, other = over(plane(0.3)), over(plane(0.3))
    put(one, (0.0, 0.0, FLOOR_M + 0.2), quaternion_from_rpy((0.4, 0.2, 0.1)), (0.5, 0.3, 0.0))
    fly(one, 0.3)
    restore(other, unpack(pack(saved_state(one))))
    assert one.bodies.plane[..., 0].any()
    np.testing.assert_array_equal(fly(one, 0.3), fly(other, 0.3))


def test_a_hull_that_hits_a_surface_bumps_once_into_what_has_its_name() -> None:
    fleet, bumps = (
        over(plane(), obstacles=[{"name": "far", "shape": "sphere", "position_m": [0, 0, 90], "radius_m": 1}]),
        [],
    )
    put(fleet, (0.0, 0.0, FLOOR_M + 0.3), quaternion_from_rpy((math.pi, 0.0, 0.0)))
    for _ in range(100):
        fleet.advance()
        bumps += fleet.bumps()
    assert [fleet.things[thing] for _, thing in bumps][:1] == ["sheet"]
    assert fleet.touching[0]
