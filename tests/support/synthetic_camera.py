"""Cameras without a renderer: JPEGs of known content and their messages, published by a client."""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from meanwhile import meanwhile

from zsim.contract import keys, messages
from zsim.contract.flight_messages import CameraImage, CameraInfo, Seen, Sightings
from zsim.sensors.camera import BottomCamera, Camera, FrontCamera
from zsim.sensors.camera_model import CameraPose, Lens, camera_matrix, camera_pose, lens_of, pixel

SETTINGS: dict[str, Camera] = {"front": FrontCamera(), "bottom": BottomCamera()}
SKY, GROUND, HAT = (235, 190, 130), (96, 138, 104), (200, 0, 220)  # blue, green, red
HAT_B = (6.0, 0.8, 0.5)  # m, position of a ball relative to the front camera, in B
NUMBER_BITS = 8  # bits of a picture's number, shown as black and white squares in its lower left corner


def info_of(name: str) -> CameraInfo:
    """Return the calibration message of a camera."""
    camera = SETTINGS[name]
    lens, pose = lens_of(camera), camera_pose(camera)
    K: Any = tuple(camera_matrix(lens).ravel().tolist())
    D: Any = camera.distortion
    p: Any = tuple(pose.p_BK.tolist())
    q: Any = pose.q_BK
    return CameraInfo(
        t_ns=0, seq=0, source="camera.test", width=camera.width_px, height=camera.height_px, K=K, D=D, position_m=p,
        orientation_wxyz=q, rate_hz=camera.rate_hz,
    )  # fmt: skip


def projected(name: str, direction_B: Sequence[float]) -> tuple[float, float]:
    """Return the pixel of a direction in B."""
    lens: Lens = lens_of(SETTINGS[name])
    pose: CameraPose = camera_pose(SETTINGS[name])
    x, y, z = np.array(pose.R_BK).T @ np.array(direction_B)
    return pixel(lens, x, y, z)


def picture(name: str, number: int) -> bytes:
    """Return a JPEG: sky and ground ahead, a checkerboard below, a ball where HAT_B is, and its number as squares."""
    import cv2

    camera = SETTINGS[name]
    width, height = camera.width_px, camera.height_px
    pixels = np.zeros((height, width, 3), np.uint8)
    if name == "front":
        pixels[: height // 2], pixels[height // 2 :] = SKY, GROUND
        u, v = projected(name, HAT_B)
        cv2.circle(pixels, (round(u), round(v)), 9, HAT, -1, cv2.LINE_AA)
    else:
        rows, columns = np.indices((height, width))
        pixels[:] = np.where((((rows + number) // 40 + columns // 40) % 2)[..., None] == 0, GROUND, (140, 170, 150))
    side = height // 16
    for bit in range(NUMBER_BITS):
        pixels[-side:, bit * side : (bit + 1) * side] = 255 * (number >> bit & 1)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()


def image_message(name: str, number: int, data: bytes, t_ns: int) -> CameraImage:
    """Return the message of a picture."""
    camera = SETTINGS[name]
    return CameraImage(
        t_ns=t_ns, seq=number, t_sample_ns=t_ns, source="camera.test", width=camera.width_px, height=camera.height_px,
        data=data,
    )  # fmt: skip


def sightings_message(number: int, t_ns: int) -> Sightings:
    """Return the message that the ball was found."""
    distance_m = float(np.linalg.norm(HAT_B))
    direction: Any = tuple((np.array(HAT_B) / distance_m).tolist())
    seen = Seen(direction_B=direction, range_m=distance_m, sigma_direction_rad=0.005, sigma_range_m=0.2)
    return Sightings(t_ns=t_ns, seq=number, t_sample_ns=t_ns, source="detect.test", camera="front", seen=(seen,))


@contextmanager
def published(client: Any, drones: Sequence[str], rate_hz: float = 10.0, seen_by: Sequence[str] = ()) -> Iterator[None]:
    """Publish both cameras' pictures of drones, and the sightings of the drones `seen_by`, until the block ends."""
    made = {name: [picture(name, number) for number in range(2**NUMBER_BITS)] for name in SETTINGS}
    numbers = itertools.count(1)

    def publish() -> None:
        number = next(numbers)
        _publish(client, drones, seen_by, made, number, round(number * 1e9 / rate_hz))

    with meanwhile(publish, 1.0 / rate_hz):
        yield


def _publish(
    client: Any, drones: Sequence[str], seen_by: Sequence[str], made: dict[str, list[bytes]], number: int, t_ns: int
) -> None:
    for drone in drones:
        for name in SETTINGS:
            client.put_raw(keys.camera_info(drone, name), messages.encode(info_of(name)))
            message = image_message(name, number, made[name][number % 2**NUMBER_BITS], t_ns)
            client.put_raw(keys.camera(drone, name), messages.encode(message))
    for drone in seen_by:
        client.put_raw(keys.detections(drone), messages.encode(sightings_message(number, t_ns)))
