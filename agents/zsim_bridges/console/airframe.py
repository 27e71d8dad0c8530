"""Multirotors as meshes of simple solids; B is x ahead, y left, z up, its origin at the centre of mass.

They look like the AR.Drone, scaled by the length of their arms, with their own rotors. Lengths are in metres; those
without a name are the AR.Drone's; they are for display only and enter no computation.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.creation import annulus, box, capsule, cylinder, icosphere
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from zsim.contract.messages import DroneInfo
from zsim.sensors.camera import Hats
from zsim.vehicles.vehicle import cross_layout

ARM_M = 0.1785  # from the centre to a rotor's axis
ROTOR_RADIUS_M = 0.10  # 8 inch propellers of the AR.Drone
RING = 1.31  # rotor radii, outer radius of a hull ring: half of the 0.515 m of the hull, less 0.126 m to its centre
ROTOR_Z_M = 0.030  # height of the rotors above the centre of mass, as drawn
COLOURS = {  # sRGB, 0 to 255; the greys are lighter than the AR.Drone's, to stand out in the dark theme too
    "cross": (104, 108, 116),
    "hull": (124, 129, 138),
    "nose": (240, 108, 24),  # the orange of the outdoor hull's nose
    "hat": (226, 0, 134),  # the paper's magenta marker
    "rotor": (96, 99, 105),
}


class Mesh(NamedTuple):
    """A surface: vertices (V, 3) [m; B], faces (F, 3)."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


class DroneShape(NamedTuple):
    """The appearance of a drone: the axes (x, y) of its rotors and their radius [m]."""

    hubs_B: tuple[tuple[float, float], ...]
    radius_m: float

    @property
    def size(self) -> float:
        """Size relative to the AR.Drone, by the longest arm."""
        return max(math.hypot(x, y) for x, y in self.hubs_B) / ARM_M

    @property
    def reach_m(self) -> float:
        """Distance of its hull's outer edge from the centre [m]."""
        return self.size * ARM_M + RING * self.radius_m


def shape_of(drone: DroneInfo, arm_m: float) -> DroneShape:
    """Return the appearance of a drone; one without named rotors has four, on arms of this length [m]."""
    if not drone.rotors:
        hubs = tuple((rotor.x_m, rotor.y_m) for rotor in cross_layout(arm_m))
        return DroneShape(hubs, ROTOR_RADIUS_M * arm_m / ARM_M)
    return DroneShape(tuple((rotor.x_m, rotor.y_m) for rotor in drone.rotors), drone.rotors[0].radius_m)


@cache
def coloured(shape: DroneShape) -> bytes:
    """Return a drone without rotors as GLB, with one surface for each colour."""
    scene = trimesh.Scene()
    for name, solids in _solids(shape).items():
        solid = _joined(solids)
        solid.unmerge_vertices()  # otherwise shading would blur the edges
        look = PBRMaterial(baseColorFactor=(*COLOURS[name], 255), metallicFactor=0.0, roughnessFactor=0.75)
        solid.visual = TextureVisuals(material=look)
        scene.add_geometry(solid, geom_name=name)
    return bytes(scene.export(file_type="glb"))  # type: ignore[arg-type]


@cache
def whole(shape: DroneShape) -> Mesh:
    return _mesh([solid for solids in _solids(shape).values() for solid in solids])


def _solids(shape: DroneShape) -> dict[str, list[trimesh.Trimesh]]:
    """Return the solids of a drone by colour: drawn as large as the AR.Drone, then scaled."""
    hubs = [(x / shape.size, y / shape.size) for x, y in shape.hubs_B]
    radius = RING * shape.radius_m / shape.size
    cross = []
    for x, y in hubs:
        beam = box((math.hypot(x, y), 0.014, 0.012))
        motor, foot = cylinder(0.017, 0.034, sections=12), cylinder(0.006, 0.058, sections=8)
        cross.append(_moved(beam, (x / 2, y / 2, 0.004), math.atan2(y, x)))
        cross += [_moved(motor, (x, y, ROTOR_Z_M / 2)), _moved(foot, (0.92 * x, 0.92 * y, -0.029))]
    ahead = trimesh.transformations.rotation_matrix(math.pi / 2, (0, 1, 0))
    lens = cylinder(0.013, 0.03, sections=14)  # of the front camera
    lens.apply_transform(ahead)
    rings = [annulus(radius - 0.016, radius, 0.042, sections=28) for _ in hubs]  # foam, of the indoor hull
    body = capsule(height=0.19, radius=0.045, count=[14, 14])  # with the battery, from nose to tail
    body.apply_transform(ahead)
    body.apply_scale((1.0, 1.0, 0.72))
    nose = icosphere(subdivisions=2, radius=0.042)
    nose.apply_scale((1.25, 1.0, 0.78))
    solids = {
        "cross": [*cross, _moved(lens, (0.162, 0, 0.012))],
        "hull": [
            *(_moved(ring, (*hub, 0.022)) for ring, hub in zip(rings, hubs, strict=True)),
            _moved(body, (-body.centroid[0], 0, 0.012)),
        ],
        "nose": [_moved(nose, (0.115, 0, 0.012))],
    }
    for solid in (solid for of_one in solids.values() for solid in of_one):
        solid.apply_scale(shape.size)
    hats = Hats()  # by which drones detect each other, in the size that the cameras assume
    return {**solids, "hat": [_moved(icosphere(subdivisions=3, radius=hats.diameter_m / 2), hats.position_m)]}


@cache
def rotor() -> Mesh:
    blades = [_moved(box((ROTOR_RADIUS_M, 0.016, 0.002)), (side * ROTOR_RADIUS_M / 2, 0, 0)) for side in (-1, 1)]
    for side, blade in zip((-1, 1), blades, strict=True):
        blade.apply_transform(trimesh.transformations.rotation_matrix(side * 0.2, (1, 0, 0)))
    return _mesh([*blades, cylinder(0.012, 0.012, sections=10)])


@cache
def ring() -> Mesh:
    return _mesh([annulus(0.93, 1.0, 0.03, sections=40)])


@cache
def ball() -> Mesh:
    return _mesh([icosphere(subdivisions=2)])


def _mesh(solids: list[trimesh.Trimesh]) -> Mesh:
    joined = _joined(solids)
    return Mesh(np.asarray(joined.vertices, np.float32), np.asarray(joined.faces, np.uint32))


def _joined(solids: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(solids)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def _moved(solid: trimesh.Trimesh, by_m: tuple[float, float, float], yaw: float = 0.0) -> trimesh.Trimesh:
    solid.apply_transform(trimesh.transformations.rotation_matrix(yaw, (0, 0, 1)))
    solid.apply_translation(by_m)
    return solid
