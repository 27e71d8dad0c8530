"""Cameras of a drone, what it sees with them, and the hats by which drones see each other, as a scenario has them.

The defaults are the AR.Drone 2.0's own figures. None of them is there unless the scenario has its section.
"""

from typing import Annotated, Literal

from msgspec import Meta, Struct, field

from zsim.schema.quantities import Fraction, NonNegative, Positive, Real, Vector3
from zsim.sensors.sensor import LatencyMs, Mount

CAMERAS = ("front", "bottom")
CameraName = Literal["front", "bottom"]
NearM = Annotated[float, Meta(ge=-2, le=2)]
DroneName = Annotated[str, Meta(pattern=r"^[a-z0-9_.-]{1,32}\Z")]
WidthPx = Annotated[int, Meta(ge=32, le=1920)]
HeightPx = Annotated[int, Meta(ge=24, le=1080)]
ErrorPx = Annotated[float, Meta(ge=0, le=100)]
CameraRateHz = Annotated[float, Meta(ge=0.1, le=60)]


class Camera(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A camera; its mount's x looks ahead, y to the left of the picture, z up in it."""

    width_px: WidthPx
    height_px: HeightPx
    diagonal_deg: Annotated[float, Meta(ge=10, le=150)]
    """Field of view across the picture's diagonal, without distortion."""
    rate_hz: CameraRateHz
    latency_ms: LatencyMs = 0.0
    """From the middle of the exposure to the picture's publication."""
    mount: Mount
    distortion: tuple[Real, Real, Real, Real, Real] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 of Brown and Conrady, as OpenCV has them."""
    exposure_ms: Annotated[float, Meta(ge=0, le=100)] = 8.0  # chosen: daylight with a small aperture
    noise: Annotated[float, Meta(ge=0, le=64)] = 3.0  # grey levels of 255 per pixel, chosen: a small sensor outdoors
    blur_px: Annotated[float, Meta(ge=0, le=10)] = 0.6  # of the lens, standard deviation, chosen
    jpeg_quality: Annotated[int, Meta(ge=10, le=100)] = 75  # chosen: 18 kB a picture


class FrontCamera(Camera, frozen=True, kw_only=True):
    """Ahead: the 720p camera of the AR.Drone 2.0, as its video stream has it."""

    width_px: WidthPx = 640
    height_px: HeightPx = 360
    diagonal_deg: Annotated[float, Meta(ge=10, le=150)] = 92.0  # deg, data sheet of the AR.Drone 2.0
    rate_hz: CameraRateHz = 15.0  # Hz, least of the SDK's codec settings; up to 30
    mount: Mount = Mount(position_m=(0.162, 0.0, 0.012))  # m, the lens in the nose as drawn


class BottomCamera(Camera, frozen=True, kw_only=True):
    """Down: the QVGA camera of the AR.Drone 2.0; the top of its picture is ahead."""

    width_px: WidthPx = 320
    height_px: HeightPx = 240
    diagonal_deg: Annotated[float, Meta(ge=10, le=150)] = 64.0  # deg, data sheet of the AR.Drone 2.0
    rate_hz: CameraRateHz = 60.0  # Hz, data sheet
    mount: Mount = Mount(position_m=(0.0, 0.0, -0.03), rpy_deg=(0.0, 90.0, 0.0))  # m, under the main board; chosen


class SightingModel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a detector of hats makes of pictures, without pictures: held against rendered ones by a test."""

    cameras: Annotated[list[CameraName], Meta(min_length=1, max_length=2)] = field(default_factory=lambda: ["front"])
    latency_ms: LatencyMs = 0.0
    """Of the detector, after the camera's."""
    centre_px: ErrorPx = 0.035  # px, fitted to the detector on rendered pictures, as the next three
    """Error of a large hat's centre, standard deviation per axis."""
    diameter_px: ErrorPx = 0.11
    """Error of its apparent diameter, standard deviation."""
    noise_px2: NonNegative = 0.65
    """Over the apparent diameter, added to both in quadrature; that of a clear day, more in low light."""
    blur_share: NonNegative = 0.018
    """Of the way that a hat moves over the picture during the exposure, added to both in quadrature."""
    diameter_min_px: Positive = 4.0
    """What is measured as smaller is not seen."""
    misalignment_deg: Annotated[float, Meta(ge=0, le=30)] = 0.0
    """Constant over a run, of the camera's mount, standard deviation per axis."""
    miss: Fraction = 0.02
    """Probability that a hat in view is not seen in a picture."""
    false_hz: Annotated[float, Meta(ge=0, le=60)] = 0.0
    """Rate of sightings of nothing, anywhere in the picture."""


class Hats(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The magenta markers by which drones see each other: a ball on every drone, and what only looks like one."""

    diameter_m: Annotated[float, Meta(gt=0, le=2)] = 0.14  # chosen: a tennis cap's crown, on the AR.Drone's hull
    position_m: tuple[NearM, NearM, NearM] = (-0.03, 0.0, 0.11)  # in B, chosen: on top of the hull, behind the middle
    covered: Annotated[list[DroneName], Meta(max_length=1000)] = []
    """Drones whose hat cannot be seen."""
    false_m: Annotated[list[Vector3], Meta(max_length=100)] = []
    """Centres of balls as large and as magenta as a hat, in W."""
