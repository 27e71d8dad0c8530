"""What the exposure makes of a picture: blur of the lens and of the motion, noise of the sensor, JPEG. Pure."""

import math
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from zsim.math.random_streams import stream

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
MARGIN = 64  # px, by which the noise is larger than the picture
NOISE_MAX = 48.0  # grey levels, standard deviation: the most that the gain makes of the noise
SWEEP_MAX_PX = 24.0  # px; a longer way is blurred as this
SAMPLES_PER_PX = 8
FULL_COLOUR = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444  # hats are a few pixels wide
MIX = 0x9E3779B97F4A7C15  # 2^64 over the golden ratio, whose multiples spread (Knuth, TAOCP 3, 6.4)


def gain(light: float) -> float:
    """Return the sensor's gain, which makes up for half of the stops that the light lacks of a clear day; chosen."""
    return 1.0 / math.sqrt(light)


def sweep_kernels(ways_px: Array) -> list[NDArray[np.float32]]:
    """Return the kernels of motions by ways (N, 2) [px] over the picture: how long each pixel has had the light."""
    lengths = np.hypot(*ways_px.T)
    ways = ways_px * np.minimum(1.0, SWEEP_MAX_PX / np.maximum(lengths, 1e-9))[:, None]
    count = max(2, math.ceil(min(lengths.max(), SWEEP_MAX_PX) * SAMPLES_PER_PX))
    at = ways[:, :, None] * ((np.arange(count) + 0.5) / count - 0.5)  # (N, 2, count)
    halves = [math.ceil(way / 2) + 1 for way in np.abs(ways).max(axis=1).tolist()]
    most = max(halves)
    shares = np.maximum(1 - np.abs(np.arange(-most, most + 1) - at[..., None]), 0)  # of a point, in a column or row
    kernels = (shares[:, 1].transpose(0, 2, 1) @ shares[:, 0] / count).astype(np.float32)
    inner = [slice(most - half, most + half + 1) for half in halves]
    return [kernel[part, part] for kernel, part in zip(kernels, inner, strict=True)]


class Noise:
    """The noise of a sensor, made once, laid over each picture at another place.

    Args:
        seed, name: of the random stream; the same give the same noise.
        shape: of the picture, (height, width).
        sigma: grey levels, standard deviation.
    """

    def __init__(self, seed: int, name: str, shape: tuple[int, int], sigma: float) -> None:
        height, width = shape
        drawn = stream(seed, name).standard_normal((height + MARGIN, width + MARGIN, 3), np.float32)
        levels = np.rint(min(sigma, NOISE_MAX) * drawn)
        self._shape = shape
        self._key = zlib.crc32(name.encode()) ^ (seed & 0xFFFFFFFF)
        self._over = np.clip(levels, 0, 255).astype(np.uint8)
        self._under = np.clip(-levels, 0, 255).astype(np.uint8)

    def add(self, picture: Picture, number: int) -> None:
        """Add it to the picture of a number."""
        bits = ((number * 4 + 1) * MIX ^ self._key * MIX >> 7) & (2**64 - 1)
        v, u = bits >> 40 & (MARGIN - 1), bits >> 52 & (MARGIN - 1)
        height, width = self._shape
        over, under = self._over[v : v + height, u : u + width], self._under[v : v + height, u : u + width]
        if bits >> 60 & 1:
            over, under = under, over
        cv2.add(picture, over, dst=picture)
        cv2.subtract(picture, under, dst=picture)


def lens_blur(picture: Picture, sigma_px: float) -> None:
    """Blur a picture as the lens does."""
    if sigma_px < 0.2:
        return  # less than a pixel's own width
    side = 3 if sigma_px <= 0.7 else 2 * math.ceil(2.5 * sigma_px) + 1
    kernel = cv2.getGaussianKernel(side, sigma_px)
    cv2.sepFilter2D(picture, -1, kernel, kernel, dst=picture, borderType=cv2.BORDER_REPLICATE)


def jpeg(picture: Picture, quality: int) -> bytes:
    """Return a picture as JPEG."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality, *FULL_COLOUR])
    return data.tobytes()
