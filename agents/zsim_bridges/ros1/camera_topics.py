"""The cameras of one drone in the ROS graph, as ardrone_autonomy's driver with image_transport has them; no session.

The driver has a topic for each camera, and one for the active camera, which its service togglecam changes. Pictures
are large: a camera's are read only while a node subscribes to them.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.stores import ros1_noetic as ros

from zsim.contract.flight_messages import CameraImage, CameraInfo
from zsim.math.rotation import Quaternion, Vector
from zsim.sensors.camera import CAMERAS
from zsim_bridges.ros1.connections import PublishedTopic
from zsim_bridges.ros1.driver_messages import header
from zsim_bridges.ros1.node import Ros1Node
from zsim_bridges.ros_frames import DISTORTION_MODEL, projection

CAMERA_QUEUE = 10  # pictures, of the driver's image publishers
NOT_ROTATED = np.eye(3).ravel()  # of a camera that is no part of a stereo pair


class CameraPublishers(NamedTuple):
    """The topics of a camera."""

    image: PublishedTopic
    info: PublishedTopic

    @property
    def wanted(self) -> bool:
        """Whether a node subscribes to one of them."""
        return bool(self.image.links or self.info.links)


class CameraTopics:
    """Topics and service of a drone's cameras.

    Args:
        node: in which they are.
        name: of the drone in ROS.
    """

    def __init__(self, node: Ros1Node, name: str) -> None:
        self._name = name
        base = f"/{name}/ardrone"
        self._own = {camera: _publishers(node, f"{base}/{camera}") for camera in CAMERAS}
        self._of_active = _publishers(node, base)
        self._infos: dict[str, CameraInfo] = {}
        self.active = CAMERAS[0]
        node.serve(f"{base}/togglecam", self._toggle)

    def wanted(self) -> Iterator[str]:
        """Yield the cameras that some node subscribes to."""
        for camera, topics in self._own.items():
            if topics.wanted or (camera == self.active and self._of_active.wanted):
                yield camera

    def learn(self, camera: str, info: CameraInfo) -> None:
        """Keep how a camera sees: it is published with each picture."""
        self._infos[camera] = info

    def publish(self, camera: str, image: CameraImage) -> None:
        """Publish a picture."""
        frame = camera_frame(self._name, camera)
        info = self._infos.get(camera)
        active = (self._of_active,) if camera == self.active else ()
        for topics in (self._own[camera], *active):
            topics.image.publish(partial(compressed_image, image=image, frame=frame))
            if info is not None:
                topics.info.publish(partial(camera_info, info=info, t_ns=image.t_sample_ns, frame=frame))

    def poses(self) -> list[tuple[str, Vector, Quaternion]]:
        """Return frame, position and orientation in the body of the cameras that have said how they see."""
        return [
            (camera_frame(self._name, camera), info.position_m, info.orientation_wxyz)
            for camera, info in self._infos.items()
        ]

    def _toggle(self) -> None:
        """Let the next camera be the active one."""
        self.active = CAMERAS[(CAMERAS.index(self.active) + 1) % len(CAMERAS)]


def _publishers(node: Ros1Node, base: str) -> CameraPublishers:
    return CameraPublishers(
        node.publish(f"{base}/image_raw/compressed", "sensor_msgs/CompressedImage", CAMERA_QUEUE),
        node.publish(f"{base}/camera_info", "sensor_msgs/CameraInfo", CAMERA_QUEUE),
    )


def camera_frame(name: str, camera: str) -> str:
    """Return the driver's name of a camera's frame: x to the right of the picture, y down, z ahead."""
    return f"{name}/ardrone_base_{camera}cam"


def compressed_image(seq: int, image: CameraImage, frame: str) -> Any:
    """Return a picture as image_transport's compressed plugin sends it."""
    return ros.sensor_msgs__msg__CompressedImage(
        header=header(seq, image.t_sample_ns, frame), format=image.format, data=np.frombuffer(image.data, np.uint8)
    )


def camera_info(seq: int, info: CameraInfo, t_ns: int, frame: str) -> Any:
    """Return what the pixels of a picture that was exposed at t_ns mean."""
    whole = ros.sensor_msgs__msg__RegionOfInterest(0, 0, 0, 0, False)
    return ros.sensor_msgs__msg__CameraInfo(
        header=header(seq, t_ns, frame),
        height=info.height,
        width=info.width,
        distortion_model=DISTORTION_MODEL,
        D=np.array(info.D),
        K=np.array(info.K),
        R=NOT_ROTATED,
        P=projection(info.K),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )
