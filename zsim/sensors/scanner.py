"""Messages and settings of sensors that measure distances along rays: range beams, lidars, depth cameras.

The world casts the rays at ground, obstacles and the hulls of other drones (zsim_world.sensors.scans). A scanner exists
only if the scenario has its section; `status` counts its messages like those of all sensors.

A distance of 0 means no echo: nothing is within the sensor's range, or the ray was missed. Messages of the contract
contain no infinities, and measured ranges are above 0.
"""

import math
from typing import Annotated, Any

import numpy as np
from msgspec import UNSET, Meta, field
from numpy.typing import NDArray

from zsim.math import elementary as el
from zsim.schema.message import Count, Number
from zsim.schema.quantities import Fraction, NonNegative, Positive
from zsim.sensors.camera import CameraName
from zsim.sensors.sensor import Mount, RateHz, Sample, Sensor

RAYS_MAX = 100_000  # maximum number of rays in a message, which then has 400 kB
BEAMS_MAX = 64
CHANNELS_MAX, COLUMNS_MAX = 128, 4096
SINGLE = np.dtype("<f4")
BeamName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,31}\Z")]
ChannelCount = Annotated[int, Meta(ge=1, le=CHANNELS_MAX)]
ColumnCount = Annotated[int, Meta(ge=1, le=COLUMNS_MAX)]
RayBytes = Annotated[bytes, Meta(max_length=4 * RAYS_MAX)]
Elevation = Annotated[float, Meta(ge=-90, le=90)]
Azimuth = Annotated[float, Meta(ge=-360, le=360)]


class Range(Sample, frozen=True):
    """The distance along each beam [m], in the order of `beams`, the sorted names of the beams; 0: no echo."""

    beams: Annotated[tuple[str, ...], Meta(max_length=BEAMS_MAX)]
    ranges_m: Annotated[tuple[Number, ...], Meta(max_length=BEAMS_MAX)]
    max_m: Number

    def fault(self) -> str | None:
        if len(self.beams) == len(self.ranges_m):
            return None
        return f"ranges_m has {len(self.ranges_m)} entries; must have {len(self.beams)}, as beams"


class Lidar(Sample, frozen=True):
    """A scan: `channels` rows of `columns` distances [m], little-endian float32; 0: no echo.

    Ray (j, k) points up by elevation_rad[0] + j elevation_rad[1] and to the left of the sensor's x axis by
    azimuth_rad[0] + k azimuth_rad[1].
    """

    channels: Count
    columns: Count
    elevation_rad: tuple[Number, Number]
    azimuth_rad: tuple[Number, Number]
    max_m: Number
    ranges_m: RayBytes

    def fault(self) -> str | None:
        return _size_fault("ranges_m", self.ranges_m, self.channels, self.columns)

    def ranges(self) -> NDArray[np.float32]:
        """Return the distances, (channels, columns) [m]; inf without an echo."""
        return _without_zeros(self.ranges_m, self.channels)

    def directions(self) -> NDArray[np.float64]:
        """Return the unit vectors along the rays in the sensor's axes, (channels, columns, 3)."""
        up = self.elevation_rad[0] + self.elevation_rad[1] * np.arange(self.channels)[:, None]
        left = self.azimuth_rad[0] + self.azimuth_rad[1] * np.arange(self.columns)[None, :]
        return along(up, left)


class Depth(Sample, frozen=True, kw_only=True):
    """A depth image: `rows` rows of `columns` depths along the camera's axis [m], little-endian float32; 0: no depth.

    `focal_px` and `centre_px` are those of this image, as (x to the right, y down).
    """

    camera: CameraName
    columns: Count
    rows: Count
    focal_px: tuple[Number, Number]
    centre_px: tuple[Number, Number]
    max_m: Number
    depth_m: RayBytes

    def fault(self) -> str | None:
        return _size_fault("depth_m", self.depth_m, self.rows, self.columns)

    def depths(self) -> NDArray[np.float32]:
        """Return the depths, (rows, columns) [m]; inf where none was measured."""
        return _without_zeros(self.depth_m, self.rows)


def along(up: NDArray[Any], left: NDArray[Any]) -> NDArray[np.float64]:
    """Return the unit vectors of elevations and azimuths [rad], (rows of up, columns of left, 3)."""
    sine, cosine = el.elementwise(el.sin), el.elementwise(el.cos)
    level = cosine(up)
    return np.stack(np.broadcast_arrays(level * cosine(left), level * sine(left), sine(up)), axis=-1)


def _size_fault(name: str, data: bytes, rows: int, columns: int) -> str | None:
    if len(data) == SINGLE.itemsize * rows * columns:
        return None
    return f"{name} has {len(data)} bytes; must have {SINGLE.itemsize} for each of {rows} x {columns} rays"


def _without_zeros(data: bytes, rows: int) -> NDArray[np.float32]:
    ranges = np.frombuffer(data, SINGLE).reshape(rows, -1)
    return np.where(ranges > 0.0, ranges, np.float32(math.inf))


class Scanner(Sensor, frozen=True, kw_only=True):
    """Common settings: the range limits and the errors of every ray, which add in quadrature."""

    min_m: Positive
    max_m: Positive
    noise_m: NonNegative = 0.0  # standard deviation of white noise, independent per ray
    noise_share: NonNegative = 0.0  # the same, as a share of the distance
    noise_1_m: NonNegative = 0.0  # the same, over the square of the distance, as for stereo cameras
    bias_m: NonNegative = 0.0  # constant over a run and the same for all rays, standard deviation over runs
    quantum_m: NonNegative = 0.0  # step of the converter; 0: no rounding
    miss: Fraction = 0.0  # probability that a ray returns no echo, independent per ray


def deck() -> dict[str, Mount]:
    """Return the beams of the Crazyflie's Multi-ranger deck: front, left, back, right, up."""
    turned = {"front": (0.0, 0.0), "left": (0.0, 90.0), "back": (0.0, 180.0), "right": (0.0, -90.0), "up": (-90.0, 0.0)}
    return {name: Mount(rpy_deg=(0.0, pitch, yaw)) for name, (pitch, yaw) in turned.items()}


class RangeConfig(Scanner, frozen=True, kw_only=True):
    """Beams, each along the x axis of its mount in the body; the sensor's own mount turns and moves them all."""

    rate_hz: RateHz = 20.0  # Hz; a measurement takes 33 to 140 ms (data sheet of the VL53L1X)
    beams: Annotated[dict[BeamName, Mount], Meta(min_length=1, max_length=BEAMS_MAX)] = field(default_factory=deck)
    cone_deg: Annotated[float, Meta(ge=0, le=60)] = 0.0  # apex angle; a beam measures the nearest thing in its cone
    min_m: Positive = 0.04  # m, data sheet of the VL53L1X
    max_m: Positive = 4.0  # m, data sheet, in the dark
    noise_m: NonNegative = 0.01  # m, chosen: half of the data sheet's ranging error of 20 mm
    bias_m: NonNegative = 0.01  # m, chosen: the other half


class LidarConfig(Scanner, frozen=True, kw_only=True):
    """Rows (channels) of rays at even angles about the sensor's z axis; by default one plane."""

    rate_hz: RateHz = 5.5  # Hz; this and all following defaults: RPLIDAR A1
    channels: ChannelCount = 1
    columns: ColumnCount = 360
    elevation_deg: tuple[Elevation, Elevation] = (0.0, 0.0)
    """Elevations of the first and last channel, positive upwards."""
    azimuth_deg: tuple[Azimuth, Azimuth] = (-180.0, 180.0)
    """Azimuths of the first column and of the one that would follow the last, positive to the left."""
    min_m: Positive = 0.15
    max_m: Positive = 12.0
    noise_share: NonNegative = 0.01  # the data sheet's "resolution": below 1 % of the distance


class DepthConfig(Scanner, frozen=True, kw_only=True):
    """Depth images of some of the drone's cameras, through their lenses and from their mounts."""

    rate_hz: RateHz = 15.0
    cameras: Annotated[list[CameraName], Meta(min_length=1, max_length=2)] = field(default_factory=lambda: ["front"])
    columns: ColumnCount = 80  # chosen: about a tenth of a RealSense D435's
    rows: Annotated[int, Meta(ge=1, le=2160)] = 45
    min_m: Positive = 0.3  # m, chosen: about the minimum of a D435 at 848 pixels
    max_m: Positive = 10.0
    noise_1_m: NonNegative = 0.0038  # 1/m, sigma = s z^2 / (f B) with s = 0.08 px, B = 0.05 m and 848 px over 90 deg


SCANNERS: dict[str, type[Sample]] = {"range": Range, "lidar": Lidar, "depth": Depth}
"""Message class of each scanner by its name, in the order of the keys."""


def scanners(sensors: object) -> dict[str, Scanner]:
    """Return the scanners of a drone's `sensors:` by name, in the order of SCANNERS."""
    found = {name: getattr(sensors, name) for name in SCANNERS}
    return {name: settings for name, settings in found.items() if settings is not UNSET}
