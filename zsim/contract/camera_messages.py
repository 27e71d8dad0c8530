"""Messages of cameras: pictures, what a picture's pixels mean, and what was seen in it."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from zsim.contract.flight_messages import Quaternion
from zsim.schema.message import Count, Message, Number, Vector3, Whole

PICTURE_MAX = 4_000_000  # bytes; a JPEG of 1920 x 1080 at full quality is below it
SEEN_MAX = 1000  # of one picture
JPEG_BEGINS = b"\xff\xd8\xff"  # SOI, then the next marker: ISO/IEC 10918-1, B.1

SidePx = Annotated[int, Meta(ge=1, le=16_384)]


class CameraImage(Message, frozen=True, kw_only=True):
    """A picture, exposed around `t_sample_ns`."""

    t_sample_ns: Whole
    source: str
    width: SidePx
    height: SidePx
    format: Literal["jpeg"] = "jpeg"
    data: Annotated[bytes, Meta(max_length=PICTURE_MAX)]

    def fault(self) -> str | None:
        """Return what the types do not say."""
        if self.data.startswith(JPEG_BEGINS):
            return None
        return f"data begins with {self.data[:8].hex(' ') or 'nothing'}; must be a JPEG, which begins with ff d8 ff"


class CameraInfo(Message, frozen=True, kw_only=True):
    """What a camera's pixels mean; its last value is kept.

    `K` is row-major; `D` k1, k2, p1, p2, k3. `position_m` is the camera's in B; `orientation_wxyz` turns K (x right, y
    down, z ahead) to B. `exposure_s` is the time of exposure, `gate_ns` the run's.
    """

    source: str = ""
    width: SidePx
    height: SidePx
    K: tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
    D: tuple[Number, Number, Number, Number, Number]
    position_m: Vector3
    orientation_wxyz: Quaternion
    rate_hz: Number
    exposure_s: Number = 0.0
    gate_ns: Count = 0


class Seen(Struct, frozen=True, gc=False):
    """A hat that was seen, nobody knows whose.

    `direction_B` is the unit vector from the camera to the hat's centre in B. The sigmas are standard deviations,
    that of the direction in each of the two axes across it.
    """

    direction_B: Vector3
    range_m: Number
    sigma_direction_rad: Number
    sigma_range_m: Number


class Sightings(Message, frozen=True, kw_only=True):
    """All that was seen in one picture; `camera` tells in which camera's."""

    t_sample_ns: Whole
    source: str = ""
    camera: str
    seen: Annotated[tuple[Seen, ...], Meta(max_length=SEEN_MAX)] = ()
