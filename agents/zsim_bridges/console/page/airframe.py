"""The AR.Drone as meshes, made of simple solids; B is x ahead, y left, z up, its origin at the centre of mass.

Lengths are in metres; those that have no name are chosen for the looks, and used in no computation.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.creation import annulus, box, capsule, cone, cylinder, icosphere
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

HULL_M = 0.515  # over all with the indoor hull, as weighed and measured by OpenMAS
ARM_M = 0.1785  # from the centre to a rotor's axis
ROTOR_RADIUS_M = 0.10  # 8 inch propellers of the AR.Drone
HUB_M = ARM_M / math.sqrt(2)
HUBS_B = np.array([(HUB_M, HUB_M), (HUB_M, -HUB_M), (-HUB_M, -HUB_M), (-HUB_M, HUB_M)])  # fl, fr, rr, rl
ROTOR_Z_M = 0.030  # of the rotors over the centre of mass; drawn
RING_M = HULL_M / 2 - HUB_M  # outer radius of a hull ring
COLOURS = {  # sRGB, 0 to 255
    "cross": (42, 44, 48),
    "hull": (74, 78, 86),
    "nose": (240, 108, 24),  # the orange of the outdoor hull's nose
    "hat": (226, 0, 134),  # the paper's magenta marker
    "rotor": (28, 28, 30),
}


class Mesh(NamedTuple):
    """A surface: vertices (V, 3) [m; B], faces (F, 3)."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


@cache
def coloured() -> bytes:
    """Return a drone without its rotors as GLB: what has a colour of its own is a surface of its own."""
    scene = trimesh.Scene()
    for name, solids in _solids().items():
        solid = _joined(solids)
        solid.unmerge_vertices()  # else light would run round the edges
        look = PBRMaterial(baseColorFactor=(*COLOURS[name], 255), metallicFactor=0.0, roughnessFactor=0.75)
        solid.visual = TextureVisuals(material=look)
        scene.add_geometry(solid, geom_name=name)
    return bytes(scene.export(file_type="glb"))  # type: ignore[arg-type]


@cache
def whole() -> Mesh:
    """Return a drone as one surface."""
    return _mesh([solid for solids in _solids().values() for solid in solids])


def _solids() -> dict[str, list[trimesh.Trimesh]]:
    return {
        "cross": [*_arms(), *_motors(), *_feet(), _lens()],
        "hull": [*_rings(), _body()],
        "nose": [_nose()],
        "hat": _hat(),
    }


@cache
def rotor() -> Mesh:
    """Return a propeller about its own axis: two blades, one for the other after half a turn."""
    blades = [_moved(box((ROTOR_RADIUS_M, 0.016, 0.002)), (side * ROTOR_RADIUS_M / 2, 0, 0)) for side in (-1, 1)]
    for side, blade in zip((-1, 1), blades, strict=True):
        blade.apply_transform(trimesh.transformations.rotation_matrix(side * 0.2, (1, 0, 0)))
    return _mesh([*blades, cylinder(0.012, 0.012, sections=10)])


@cache
def ball() -> Mesh:
    """Return a sphere of 1 m radius."""
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


def _arms() -> list[trimesh.Trimesh]:
    """The carbon cross under 45 degrees."""
    return [_moved(box((2 * ARM_M, 0.014, 0.012)), (0, 0, 0.004), turn) for turn in (math.pi / 4, -math.pi / 4)]


def _motors() -> list[trimesh.Trimesh]:
    return [_moved(cylinder(0.017, 0.034, sections=12), (x, y, ROTOR_Z_M / 2)) for x, y in HUBS_B]


def _feet() -> list[trimesh.Trimesh]:
    return [_moved(cylinder(0.006, 0.058, sections=8), (0.92 * x, 0.92 * y, -0.029)) for x, y in HUBS_B]


def _rings() -> list[trimesh.Trimesh]:
    """The foam rings of the indoor hull about the rotors."""
    return [_moved(annulus(RING_M - 0.016, RING_M, 0.042, sections=28), (x, y, 0.022)) for x, y in HUBS_B]


def _body() -> trimesh.Trimesh:
    """The long body with the battery, from nose to tail."""
    body = capsule(height=0.19, radius=0.045, count=[14, 14])
    body.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (0, 1, 0)))
    body.apply_scale((1.0, 1.0, 0.72))
    return _moved(body, (-body.centroid[0], 0, 0.012))


def _nose() -> trimesh.Trimesh:
    nose = icosphere(subdivisions=2, radius=0.042)
    nose.apply_scale((1.25, 1.0, 0.78))
    return _moved(nose, (0.115, 0, 0.012))


def _lens() -> trimesh.Trimesh:
    """The front camera."""
    lens = cylinder(0.013, 0.03, sections=14)
    lens.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (0, 1, 0)))
    return _moved(lens, (0.162, 0, 0.012))


def _hat() -> list[trimesh.Trimesh]:
    """The coloured marker by which the paper's drones see each other."""
    return [_moved(cone(0.062, 0.11, sections=24), (-0.03, 0, 0.062)), _moved(cylinder(0.02, 0.03), (-0.03, 0, 0.05))]
