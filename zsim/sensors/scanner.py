"""Messages and settings of sensors that measure distances along rays: range beams, lidars and depth cameras.

The world casts the rays at the ground, obstacles, surfaces and the hulls of other drones (zsim_world.sensors.scans). A
drone has such a sensor only if the scenario has its section.

A distance of 0 means no echo: nothing is within range, or the echo was lost. Messages of the contract contain no
infinities, and measured distances are above 0.
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

RAYS_MAX = 100_000  # rays per message, which is then 400 kB long
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
    """The distance along each beam [m] in the order of `beams`, the sorted names of the beams; 0: no echo."""

    beams: Annotated[tuple[str, ...], Meta(max_length=BEAMS_MAX)]
    ranges_m: Annotated[tuple[Number, ...], Meta(max_length=BEAMS_MAX)]
    max_m: Number

    def fault(self) -> str | None:
        if len(self.beams) == len(self.ranges_m):
            return None
        return f"ranges_m has {len(self.ranges_m)} entries; must have {len(self.beams)}, one for each beam"


class Lidar(Sample, frozen=True):
    """A scan: `channels` rows of `columns` distances [m], little-endian float32; 0: no echo.

    Ray (j, k) has elevation elevation_rad[0] + j elevation_rad[1], positive upwards, and azimuth azimuth_rad[0] +
    k azimuth_rad[1], positive to the left of the sensor's x axis.
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
        """Return the unit vectors along the rays in sensor components, (channels, columns, 3)."""
        up = self.elevation_rad[0] + self.elevation_rad[1] * np.arange(self.channels)[:, None]
        left = self.azimuth_rad[0] + self.azimuth_rad[1] * np.arange(self.columns)[None, :]
        return along(up, left)


class Depth(Sample, frozen=True, kw_only=True):
    """A depth image: `rows` rows of `columns` depths along the camera's axis [m], little-endian float32; 0: no echo.

    `focal_px` and `centre_px` are the focal lengths and the centre of this image [px], each as (x, y) with x to the
    right and y down.
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
        """Return the depths, (rows, columns) [m]; inf without an echo."""
        return _without_zeros(self.depth_m, self.rows)


def along(up: NDArray[Any], left: NDArray[Any]) -> NDArray[np.float64]:
    """Return the unit vectors at elevations `up` (m, 1) and azimuths `left` (1, n) [rad], (m, n, 3)."""
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
    """Settings common to scanners: range and errors; the noise terms of a ray add in quadrature."""

    min_m: Positive
    max_m: Positive
    noise_m: NonNegative = 0.0  # standard deviation of white noise, independent per ray
    noise_share: NonNegative = 0.0  # standard deviation divided by the distance
    noise_1_m: NonNegative = 0.0  # standard deviation divided by the distance squared, as for stereo cameras
    bias_m: NonNegative = 0.0  # standard deviation between runs of a bias constant in a run and common to all rays
    quantum_m: NonNegative = 0.0  # step of the converter; 0: none
    miss: Fraction = 0.0  # probability that a ray returns no echo, independent per ray


def deck() -> dict[str, Mount]:
    """Return the beams of the Crazyflie's Multi-ranger deck: front, left, back, right and up."""
    turned = {"front": (0.0, 0.0), "left": (0.0, 90.0), "back": (0.0, 180.0), "right": (0.0, -90.0), "up": (-90.0, 0.0)}
    return {name: Mount(rpy_deg=(0.0, pitch, yaw)) for name, (pitch, yaw) in turned.items()}


class RangeConfig(Scanner, frozen=True, kw_only=True):
    """Beams, each along the x axis of its own mount, which is relative to the mount of the sensor."""

    rate_hz: RateHz = 20.0  # Hz; a measurement takes 33 to 140 ms (data sheet of the VL53L1X)
    beams: Annotated[dict[BeamName, Mount], Meta(min_length=1, max_length=BEAMS_MAX)] = field(default_factory=deck)
    cone_deg: Annotated[float, Meta(ge=0, le=60)] = 0.0  # apex angle; the nearest point inside the cone is measured
    min_m: Positive = 0.04  # m, data sheet of the VL53L1X
    max_m: Positive = 4.0  # m, data sheet of the VL53L1X, in the dark
    noise_m: NonNegative = 0.01  # m, design choice: half of the maximum error of 20 mm (data sheet of the VL53L1X)
    bias_m: NonNegative = 0.01  # m, the other half of the maximum error


class LidarConfig(Scanner, frozen=True, kw_only=True):
    """Rows (channels) of rays equally spaced in angle about the sensor's z axis; by default the 2D lidar RPLIDAR A1."""

    rate_hz: RateHz = 5.5
    channels: ChannelCount = 1
    columns: ColumnCount = 360
    elevation_deg: tuple[Elevation, Elevation] = (0.0, 0.0)
    """Elevations of the first and the last channel, positive upwards."""
    azimuth_deg: tuple[Azimuth, Azimuth] = (-180.0, 180.0)
    """Azimuths of the first column and of the one that would follow the last, positive to the left."""
    min_m: Positive = 0.15
    max_m: Positive = 12.0
    noise_share: NonNegative = 0.01  # the data sheet states a "resolution" below 1 % of the distance


class DepthConfig(Scanner, frozen=True, kw_only=True):
    """Depth images from the positions of the drone's cameras, with their lenses and mounts."""

    rate_hz: RateHz = 15.0
    cameras: Annotated[list[CameraName], Meta(min_length=1, max_length=2)] = field(default_factory=lambda: ["front"])
    columns: ColumnCount = 80  # about a tenth of the 848 columns of a RealSense D435
    rows: Annotated[int, Meta(ge=1, le=2160)] = 45
    min_m: Positive = 0.3  # m, about the minimum of a D435 at 848 columns
    max_m: Positive = 10.0
    noise_1_m: NonNegative = 0.0038  # 1/m, s / (f B): disparity error s 0.08 px, B 0.05 m and 848 px over 90 deg


SCANNERS: dict[str, type[Sample]] = {"range": Range, "lidar": Lidar, "depth": Depth}
"""Message classes by sensor name, in the order of the contract's keys."""


def scanners(sensors: object) -> dict[str, Scanner]:
    """Return the scanner settings of a drone's sensors by name, in the order of SCANNERS."""
    by_name = {name: getattr(sensors, name) for name in SCANNERS}
    return {name: settings for name, settings in by_name.items() if settings is not UNSET}
