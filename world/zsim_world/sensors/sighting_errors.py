"""What a detector of hats makes of a picture that nobody has drawn: from what the camera has in view, and chance.

Compiled. The errors are those of the detector on rendered pictures (tests hold them against each other): of a hat's
centre and apparent diameter in pixels, more where it is small, where it moves during the exposure and where the light
is low; misses, false alarms. For every picture of a camera the same count of numbers is drawn.
"""

import math

import numpy as np
from numpy.typing import NDArray

from zsim.math.compiled import Field, columns, compiled, inlined
from zsim.math.rotation import Vector
from zsim.sensors.camera_model import Lens, undistorted
from zsim_world.physics.normal_variates import fill
from zsim_world.sensors.hats_in_view import VIEW

DETECTOR = columns(  # of one camera, and what it looks at
    "DetectorColumns",
    (
        Field("R_BK", "1", 9),  # with the misalignment that nobody knows
        Field("misaligned", "rad"),  # standard deviation
        Field("radius", "m"),  # of a hat
        Field("exposure", "s"),
        Field("centre", "px"),  # standard deviations, as in SightingModel
        Field("diameter", "px"),
        Field("noise", "px^2"),  # in this light
        Field("blur_share", "1"),
        Field("diameter_min", "px"),
        Field("miss", "1"),
        Field("false", "1"),  # false alarms per picture
    ),
)
SEEN = columns(  # a sighting
    "SeenColumns",
    (
        Field("picture", "1"),  # its number among those of a call
        Field("direction_B", "1", 3),
        Field("range", "m"),
        Field("sigma_direction", "rad"),
        Field("sigma_range", "m"),
    ),
)
DRAWS = 4  # normal numbers for each hat of a picture: two for its centre, one for its diameter, one for a miss
FALSE_DRAWS = 4  # likewise for a false alarm: whether, where (2), how large
DIAMETER_NOISE, DIAMETER_BLUR = 1.4, 2.8  # what noise and blur make of a diameter over that of a centre; measured
ANGLE_MAX = 3.0  # rad, of an apparent diameter; pi is that of a ball that touches the lens
SMALLEST = 0.1  # of a hat's apparent diameter, the least that is measured


@inlined
def _unit(normal: float) -> float:
    """Return a number between 0 and 1, all alike, of a standard normal one."""
    return 0.5 * math.erfc(normal / math.sqrt(2.0))


@inlined
def _sigmas_px(model: NDArray, row: NDArray) -> tuple[float, float]:
    """Return the standard deviations of a hat's centre and apparent diameter."""
    scale = row[VIEW.scale]
    noise = model[DETECTOR.noise] / (row[VIEW.angle] * scale)
    blur = model[DETECTOR.blur_share] * row[VIEW.rate] * model[DETECTOR.exposure] * scale
    centre = row[VIEW.centre] * math.hypot(noise, blur)
    hidden = 0.5 * (row[VIEW.radius] - 1.0)
    diameter = math.hypot(row[VIEW.radius] * DIAMETER_NOISE * noise, (1.0 + hidden) * DIAMETER_BLUR * blur)
    return math.hypot(model[DETECTOR.centre], centre), math.hypot(model[DETECTOR.diameter], diameter)


@inlined
def _put(model: NDArray, to_K: Vector, range_m: float, sigma: float, sigma_m: float, out: NDArray) -> None:
    """Write a sighting along a direction of K, of any length."""
    length = math.sqrt(to_K[0] * to_K[0] + to_K[1] * to_K[1] + to_K[2] * to_K[2])
    for k in range(3):
        at = DETECTOR.R_BK + 3 * k
        along = model[at] * to_K[0] + model[at + 1] * to_K[1] + model[at + 2] * to_K[2]
        out[SEEN.direction_B + k] = along / length
    out[SEEN.range], out[SEEN.sigma_direction], out[SEEN.sigma_range] = range_m, sigma, sigma_m


@inlined
def _range_m(model: NDArray, angle: float) -> float:
    """Return how far a hat of an apparent diameter [rad] is."""
    return model[DETECTOR.radius] / math.sin(0.5 * min(angle, ANGLE_MAX))


@inlined
def _see(model: NDArray, row: NDArray, noise: NDArray, out: NDArray) -> bool:
    """Write what is seen of a hat in view; False if it is missed by chance, or measured as too small."""
    centre_px, diameter_px = _sigmas_px(model, row)
    scale, angle = row[VIEW.scale], row[VIEW.angle]
    measured = angle + diameter_px / scale * noise[2]
    if measured * scale < model[DETECTOR.diameter_min] or _unit(noise[3]) < model[DETECTOR.miss]:
        return False
    measured = max(measured, SMALLEST * angle)
    x, y, z = row[VIEW.direction_K], row[VIEW.direction_K + 1], row[VIEW.direction_K + 2]
    across = math.hypot(x, z)
    a, b = centre_px / scale * noise[0], centre_px / scale * noise[1]
    to_K = (x + a * z / across - b * x * y / across, y + b * across, z - a * x / across - b * y * z / across)
    range_m = _range_m(model, measured)
    sigma = math.hypot(centre_px / scale, model[DETECTOR.misaligned])
    sigma_m = range_m * diameter_px / (scale * measured)
    _put(model, to_K, range_m, sigma, sigma_m, out)
    return True


@inlined
def _see_nothing(model: NDArray, lens: Lens, noise: NDArray, out: NDArray) -> bool:
    """Write a false alarm, a small blob anywhere in the picture; False if there is none in this one."""
    if _unit(noise[0]) >= model[DETECTOR.false]:
        return False
    x, y = undistorted(lens, _unit(noise[1]) * lens.width - 0.5, _unit(noise[2]) * lens.height - 0.5)
    size_px = model[DETECTOR.diameter_min] * (1.0 + 2.0 * _unit(noise[3]))
    range_m = _range_m(model, size_px / lens.fx)
    sigma = math.hypot(model[DETECTOR.centre] / lens.fx, model[DETECTOR.misaligned])
    _put(model, (x, y, 1.0), range_m, sigma, range_m * model[DETECTOR.diameter] / size_px, out)
    return True


@inlined
def _sort(out: NDArray, first: int, end: int) -> None:
    """Sort sightings from left to right, so that their order does not tell whose hats they are."""
    for m in range(first + 1, end):
        for k in range(m, first, -1):
            a, b = out[k - 1], out[k]
            if math.atan2(a[SEEN.direction_B + 1], a[SEEN.direction_B]) >= math.atan2(
                b[SEEN.direction_B + 1], b[SEEN.direction_B]
            ):
                break
            for c in range(SEEN.size):
                a[c], b[c] = b[c], a[c]


@compiled
def detect(model: NDArray, lens: Lens, view: NDArray, stream: NDArray, out: NDArray, first: int) -> int:
    """Write what a detector sees in a picture into rows of `out` from `first` on; return where they end.

    Args:
        model: (DETECTOR.size,).
        lens: of the camera.
        view: of all that may be a hat, (M, VIEW.size).
        stream: words of the camera's random stream (WORDS.size,), moved on.
        out: (first + M + 1 or more, SEEN.size).
    """
    drawn = np.empty(DRAWS * len(view) + FALSE_DRAWS)
    fill(drawn, stream)
    end = first
    for m in range(len(view)):
        noise = drawn[DRAWS * m : DRAWS * m + DRAWS]
        if view[m, VIEW.seen] != 0.0 and _see(model, view[m], noise, out[end]):
            end += 1
    if model[DETECTOR.false] > 0.0 and _see_nothing(model, lens, drawn[DRAWS * len(view) :], out[end]):
        end += 1
    _sort(out, first, end)
    return end
