"""The cameras of one drone in ROS 2: a topic for each, and one for the active camera, as ardrone_autonomy does. Pure.

Each picture comes with how its camera sees, with the same stamp: that of the exposure.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from rosbags.typesys.stores import ros2_jazzy as ros

from zsim.contract import keys
from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.sensors.camera import CAMERAS
from zsim_bridges.ros2 import rmw_zenoh
from zsim_bridges.ros2.conversions import camera_frame, header
from zsim_bridges.ros2.topics import Topic
from zsim_bridges.ros_frames import DISTORTION_MODEL, projection

IMAGE, INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
DRIVER = "ardrone"  # under which ardrone_autonomy has its topics and services
NOT_ROTATED = np.eye(3).ravel()  # of a camera that is no part of a stereo pair


class DroneCameras:
    """What is known of a drone's cameras.

    Args:
        drone: its name.
        name: its name in ROS, which is its namespace.

    Attributes:
        active: the camera whose pictures are on the topics without a camera's name.
    """

    def __init__(self, drone: str, name: str) -> None:
        self._drone = drone
        self._name = name
        self._infos: dict[str, CameraInfo] = {}
        self.active = CAMERAS[0]

    def topics(self) -> Iterator[Topic]:
        """Yield the topics of each camera, and of the active one."""
        for camera in CAMERAS:
            yield from self._topics(f"/{self._name}/{DRIVER}/{camera}", (camera,))
        yield from self._topics(f"/{self._name}/{DRIVER}", CAMERAS)

    def _topics(self, base: str, cameras: tuple[str, ...]) -> Iterator[Topic]:
        images = tuple(keys.camera(self._drone, camera) for camera in cameras)
        infos = tuple(keys.camera_info(self._drone, camera) for camera in cameras)
        of_active = len(cameras) > 1
        image, info = partial(self._image, of_active), partial(self._info, of_active)
        yield Topic(f"{base}/image_raw/compressed", IMAGE, rmw_zenoh.SENSOR, images, image)
        yield Topic(f"{base}/camera_info", INFO, rmw_zenoh.SENSOR, (*images, *infos), info)

    def toggle(self, response: Any, _: Any) -> Any:
        """Let the next camera be the active one; `response` is the class of std_srvs/Trigger_Response."""
        self.active = CAMERAS[(CAMERAS.index(self.active) + 1) % len(CAMERAS)]
        return response(True, f"the active camera is {self.active}")

    def _image(self, of_active: bool, key: str, image: CameraImage) -> Any | None:
        camera = keys.leaf(key)
        if of_active and camera != self.active:
            return None
        return compressed_image(image, camera_frame(self._name, camera))

    def _info(self, of_active: bool, key: str, message: CameraImage | CameraInfo) -> Any | None:
        """Keep how a camera sees, and return it for a picture."""
        camera = keys.parts(key)[2].split("/")[1]
        if isinstance(message, CameraInfo):
            self._infos[camera] = message
            return None
        info = self._infos.get(camera)
        if info is None or (of_active and camera != self.active):
            return None
        return camera_info(info, message.t_sample_ns, camera_frame(self._name, camera))


def compressed_image(image: CameraImage, frame: str) -> Any:
    """Return a picture as image_transport's compressed plugin sends it."""
    data = np.frombuffer(image.data, np.uint8)
    return ros.sensor_msgs__msg__CompressedImage(header(image.t_sample_ns, frame), image.format, data)


def camera_info(info: CameraInfo, t_ns: int, frame: str) -> Any:
    """Return what the pixels of a picture that was exposed at t_ns mean."""
    return ros.sensor_msgs__msg__CameraInfo(
        header=header(t_ns, frame),
        height=info.height,
        width=info.width,
        distortion_model=DISTORTION_MODEL,
        d=np.array(info.D),
        k=np.array(info.K),
        r=NOT_ROTATED,
        p=projection(info.K),
        binning_x=0,
        binning_y=0,
        roi=ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False),
    )
