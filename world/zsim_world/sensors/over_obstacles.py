"""What sonar and optical flow make of an obstacle below; over the bare ground their values stay. Compiled."""

from zsim.math.compiled import inlined, noinline
from zsim.math.rotation import Vector, add, rotate, scaled, z_axis
from zsim_world.physics.rays import Scene, cast_ground, cast_parts
from zsim_world.sensors.equations import SONAR_COSINE_MIN, BodyTruth, MountedSensor


@inlined
def _beam(x: BodyTruth, s: MountedSensor) -> tuple[Vector, Vector]:
    """Return where a sensor is, and the unit vector along its -z, in W."""
    return add(x.p_WB, rotate(x.q_WB, s.p_BS)), scaled(rotate(x.q_WB, z_axis(s.q_BS)), -1.0)


@noinline
def sonar_over(x: BodyTruth, s: MountedSensor, value: Vector, scene: Scene) -> Vector:
    """Return distance [m] and echo of a sonar, given those over the bare ground: of what is first in its beam.

    From a beam that is too far from the vertical there is no echo, as over the ground.
    """
    o, d = _beam(x, s)
    if -d[2] < SONAR_COSINE_MIN:
        return value
    distance = cast_parts(scene, o, d, value[0])
    return (distance, 1.0, 0.0) if distance < value[0] else value


@noinline
def flow_over(x: BodyTruth, s: MountedSensor, ranging: MountedSensor, value: Vector, scene: Scene) -> Vector:
    """Return the velocity [m/s] that a flow sensor reports, given that over the bare ground.

    A camera sees an angular rate, of which the board makes a velocity by the distance that the sonar measures. Where
    the middle of the picture and the sonar's beam meet one surface, high or low, it is right; where there is an edge
    between them, it is wrong by the ratio of the two distances.
    """
    o, d = _beam(x, s)
    b, down = _beam(x, ranging)
    far = ranging.range_max
    seen, measured = cast_parts(scene, o, d, far), cast_parts(scene, b, down, far)
    if seen >= far and measured >= far:
        return value
    seen, measured = cast_ground(o, d, seen), cast_ground(b, down, measured)
    if seen >= far or measured >= far or seen <= 0.0 or -d[2] < SONAR_COSINE_MIN or -down[2] < SONAR_COSINE_MIN:
        return value  # the board has no distance, and goes on with the last one
    return (value[0] * measured / seen, value[1] * measured / seen, value[2])
