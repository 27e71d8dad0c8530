"""Settings of cameras, sightings and hats in a scenario, and the frame header of a JPEG.

The defaults are those of the AR.Drone 2.0. A drone has a camera or sightings only if the scenario has the section.
"""

from typing import Annotated, Literal, NamedTuple

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
    """A camera; in the axes of its mount, x is the viewing direction, y points left in the picture and z up."""

    width_px: WidthPx
    height_px: HeightPx
    diagonal_deg: Annotated[float, Meta(ge=10, le=150)]
    """Field of view along the picture's diagonal, without distortion."""
    rate_hz: CameraRateHz
    latency_ms: LatencyMs = 0.0  # from the middle of the exposure to the picture's publication
    mount: Mount
    distortion: tuple[Real, Real, Real, Real, Real] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Brown-Conrady coefficients k1, k2, p1, p2, k3 in OpenCV's convention."""
    exposure_ms: Annotated[float, Meta(ge=0, le=100)] = 8.0  # typical of a small aperture in daylight
    noise: Annotated[float, Meta(ge=0, le=64)] = 3.0  # sigma per pixel, of 255 grey levels; typical of small sensors
    blur_px: Annotated[float, Meta(ge=0, le=10)] = 0.6  # standard deviation of the lens blur; assumed
    jpeg_quality: Annotated[int, Meta(ge=10, le=100)] = 75  # gives about 18 kB per picture


class FrontCamera(Camera, frozen=True, kw_only=True):
    """A forward-looking camera; by default the 720p camera of the AR.Drone 2.0, at the size of its video stream."""

    width_px: WidthPx = 640
    height_px: HeightPx = 360
    diagonal_deg: Annotated[float, Meta(ge=10, le=150)] = 92.0  # deg, data sheet of the AR.Drone 2.0
    rate_hz: CameraRateHz = 15.0  # Hz, minimum of the SDK's codec settings; the maximum is 30
    mount: Mount = Mount(position_m=(0.162, 0.0, 0.012))  # m, lens in the nose of the drawn model


class BottomCamera(Camera, frozen=True, kw_only=True):
    """A downward-looking camera; by default the AR.Drone 2.0's QVGA camera. The picture's top is towards the nose."""

    width_px: WidthPx = 320
    height_px: HeightPx = 240
    diagonal_deg: Annotated[float, Meta(ge=10, le=150)] = 64.0  # deg, data sheet of the AR.Drone 2.0
    rate_hz: CameraRateHz = 60.0  # Hz, data sheet of the AR.Drone 2.0
    mount: Mount = Mount(position_m=(0.0, 0.0, -0.03), rpy_deg=(0.0, 90.0, 0.0))  # m, assumed below the main board


class SightingModel(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A hat detector modelled without pictures; a test compares it with the detector on rendered pictures."""

    cameras: Annotated[list[CameraName], Meta(min_length=1, max_length=2)] = field(default_factory=lambda: ["front"])
    latency_ms: LatencyMs = 0.0  # latency of the detector, in addition to the camera's
    # the next four are fitted to the detector's results on rendered pictures
    centre_px: ErrorPx = 0.035
    """Error of a large hat's centre, standard deviation per axis."""
    diameter_px: ErrorPx = 0.11  # error of a large hat's apparent diameter, standard deviation
    noise_px2: NonNegative = 0.65
    """Error times apparent diameter, added in quadrature to both above; for a clear day, larger in low light."""
    blur_share: NonNegative = 0.018
    """Error as a share of the hat's motion in the picture during the exposure, likewise added in quadrature."""
    diameter_min_px: Positive = 4.0  # hats with a smaller measured diameter are not reported
    misalignment_deg: Annotated[float, Meta(ge=0, le=30)] = 0.0
    """Misalignment of the camera's mount, constant over a run, standard deviation per axis."""
    miss: Fraction = 0.02  # probability that a hat in view is not detected in a picture
    false_hz: Annotated[float, Meta(ge=0, le=60)] = 0.0  # rate of false sightings, uniform over the picture


class Hats(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Magenta markers by which drones detect each other: a ball on every drone, and decoys."""

    diameter_m: Annotated[float, Meta(gt=0, le=2)] = 0.14  # about the crown of a tennis cap put on the AR.Drone's hull
    position_m: tuple[NearM, NearM, NearM] = (-0.03, 0.0, 0.11)  # m, in B: on top of the hull, behind the middle
    covered: Annotated[list[DroneName], Meta(max_length=1000)] = []  # drones whose hat cannot be seen
    false_m: Annotated[list[Vector3], Meta(max_length=100)] = []
    """Centres in W [m] of decoys: balls with the size and colour of a hat."""


BEGINS = b"\xff\xd8"  # SOI, start of image; markers are those of ITU-T T.81, table B.1
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15, without DHT, JPG and DAC between them
SCAN, END = 0xDA, 0xD9  # SOS and EOI, which end the header
STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length: TEM, RST0 to RST7
FILL = 0xFF  # fill byte; any number of them may precede a marker
FRAME_BYTES = 9  # bytes of marker, length, precision, height and width


class PictureError(ValueError):
    """Bytes that are not a picture of an allowed kind and size; the text has one line."""


class Frame(NamedTuple):
    """The frame header of a JPEG: its marker, which identifies the coding, and the size [px]."""

    marker: int
    width: int
    height: int


def frame_of(data: bytes) -> Frame:
    """Return the frame header of a JPEG.

    Raises:
        PictureError: there is no valid frame header.
    """
    at = len(BEGINS) if data.startswith(BEGINS) else len(data)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in FRAMES:
            frame = Frame(marker, *(int.from_bytes(data[at + k : at + k + 2], "big") for k in (7, 5)))
            if at + FRAME_BYTES <= len(data) and frame.width and frame.height:
                return frame
            break
        if marker in (SCAN, END):
            break
        if marker == FILL:
            at += 1
        else:
            at += 2 if marker in STANDALONE else 2 + max(2, length)  # always advances, so that reading ends
    raise PictureError(f"data ({len(data)} bytes, {data[:4].hex(' ') or 'none'} …) has no frame header; must be a JPEG")
