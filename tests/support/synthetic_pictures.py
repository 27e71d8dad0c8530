"""Pictures, calibrations and sightings of a camera of drone d1, generated without a renderer."""

from functools import cache

import cv2
import numpy as np

from zsim.contract.flight_messages import CameraImage, CameraInfo, Seen, Sightings

WIDTH_PX, HEIGHT_PX = 64, 36
FRONT_P_BK = (0.162, 0.0, 0.012)
AHEAD = (0.5, -0.5, 0.5, -0.5)  # q_BK of a camera that looks ahead: K's z is B's x
NO_JPEG = b"GIF89a, which is no JPEG"


@cache
def jpeg(shade: int = 128, width: int = WIDTH_PX, height: int = HEIGHT_PX) -> bytes:
    """Return a JPEG of one shade of grey, 0 to 255."""
    done, data = cv2.imencode(".jpg", np.full((height, width, 3), shade, np.uint8))
    assert done
    return data.tobytes()


def image(t_ns: int, seq: int = 0, data: bytes | None = None, source: str = "camera.d1") -> CameraImage:
    """Return the message of a picture exposed 4 ms before its publication."""
    exposed_ns = max(0, t_ns - 4_000_000)
    picture = jpeg() if data is None else data
    return CameraImage(t_ns, seq, t_sample_ns=exposed_ns, source=source, width=WIDTH_PX, height=HEIGHT_PX, data=picture)


def info(t_ns: int = 0, seq: int = 0, source: str = "camera.d1") -> CameraInfo:
    """Return the calibration of a front camera."""
    return CameraInfo(
        t_ns,
        seq,
        source=source,
        width=WIDTH_PX,
        height=HEIGHT_PX,
        K=(50.0, 0.0, 31.5, 0.0, 51.0, 17.5, 0.0, 0.0, 1.0),
        D=(-0.1, 0.02, 0.001, -0.002, 0.003),
        position_m=FRONT_P_BK,
        orientation_wxyz=AHEAD,
        rate_hz=15.0,
    )


def sightings(t_ns: int, seq: int = 0, hats: int = 2, source: str = "detector.d1") -> Sightings:
    """Return a detector's sightings: hats ahead, each 1 m farther than the one before."""
    seen = tuple(Seen((1.0, 0.0, 0.0), 4.0 + hat, 0.01, 0.2) for hat in range(hats))
    return Sightings(t_ns, seq, t_sample_ns=max(0, t_ns - 4_000_000), source=source, camera="front", seen=seen)
