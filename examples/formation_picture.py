"""Draw a recorded formation, as seen by a camera that follows it; docs/pictures/formation.jpg is an example.

    python examples/formation_picture.py runs/first formation.jpg 60

The camera is carried by an invisible drone, behind and above the formation, and looks at its centre.
"""

import math
import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from zsim.contract import keys
from zsim.contract.flight_messages import Truth
from zsim.contract.messages import Info
from zsim.math.frames import quaternion_from_rpy, rotation_matrix
from zsim.output_folder import record_at
from zsim.record.record_reader import RecordReader
from zsim.scenario import scenario_file
from zsim.sensors.camera import Camera
from zsim.sensors.camera_model import camera_pose, lens_of
from zsim.sensors.sensor import Mount
from zsim_agents.cameras.renderer import Picture, Renderer
from zsim_agents.cameras.scene import DroneStates, Scene, View, camera_motion, default_look, scene_of

Array = NDArray[np.float64]
SIDE = Mount(position_m=(1.0, 0.0, 0.0))  # m; ahead of its carrier, which therefore stays out of the picture
CAMERA = Camera(width_px=1440, height_px=720, diagonal_deg=60, rate_hz=1, mount=SIDE, noise=0, exposure_ms=2)
AWAY, YAW_RAD, DOWN_RAD = 2.2, 0.35, 0.42  # camera's distance in formation widths, heading, and downward tilt
MAGENTA, INK, PAPER = (152, 17, 233), (40, 40, 40), (255, 255, 255)  # B, G, R


class Instant(NamedTuple):
    """Names, scene and states of the recorded drones at one instant."""

    names: list[str]
    scene: Scene
    states: DroneStates


def recorded(record: Path, t_ns: int | None) -> Instant:
    """Return the drones at the first gate at or after t_ns, or at the last gate if t_ns is None.

    Raises:
        SystemExit: the record ends before t_ns.
    """
    with RecordReader(record) as reader:
        info = msgspec.msgpack.decode(next(m.payload for m in reader.messages([keys.INFO])), type=Info)
        names = [drone.name for drone in info.drones]
        wanted = [keys.truth(name) for name in names]
        if t_ns is None:
            last = (reader.last(key) for key in wanted)
            payloads = {message.key: message.payload for message in last if message}
        else:
            come = (message for message in reader.messages(wanted, from_ns=t_ns) if message.t_ns >= t_ns)
            payloads = {message.key: message.payload for message in islice(come, len(names))}  # one per drone and gate
    if payloads.keys() != set(wanted):
        raise SystemExit(
            f"{record}: ends before that instant; give an earlier one, or leave out SECONDS for the last instant"
        )
    truths = [msgspec.msgpack.decode(payloads[key], type=Truth) for key in wanted]
    return Instant(names, scene_of(info, scenario_file.from_text(info.scenario)), states(truths))


def states(truths: Sequence[Truth]) -> DroneStates:
    """Convert truths to the arrays that the renderer expects."""
    return DroneStates(
        np.array([truth.position_m for truth in truths]),
        np.array([truth.velocity_m_s for truth in truths]),
        np.array([truth.orientation_wxyz for truth in truths]),
        np.array([truth.angular_velocity_rad_s for truth in truths]),
        [truth.rotor_rad_s for truth in truths],
    )


def follower(of: DroneStates) -> DroneStates:
    """Return the states of the drones, followed by that of the drone that carries the camera."""
    middle, width = of.p_WB.mean(axis=0), float(np.ptp(of.p_WB, axis=0).max())
    q = quaternion_from_rpy([0.0, DOWN_RAD, YAW_RAD])
    place = middle - rotation_matrix(q)[:, 0] * (AWAY * max(width, 1.0))
    return DroneStates(
        np.vstack([of.p_WB, place]),
        np.vstack([of.v_WB, of.v_WB.mean(axis=0)]),
        np.vstack([of.q_WB, q]),
        np.vstack([of.w_WB_B, np.zeros(3)]),
        [*of.rotors, [0.0] * 4],
    )


def picture(instant: Instant, t_s: float) -> Picture:
    """Return the picture (height, width, 3) in B, G, R, labelled with names and distances."""
    bodies, carrier = follower(instant.states), len(instant.names)
    scene = instant.scene._replace(drones=(*instant.scene.drones, default_look(has_hat=False)))
    drawn = Renderer(CAMERA, scene, carrier, 0, "follower").picture(0, t_s, bodies)
    motion = camera_motion(camera_pose(CAMERA), bodies, rotation_matrix(bodies.q_WB[carrier]), carrier)
    corners = View(lens_of(CAMERA)).pixels(motion.points_K(instant.states.p_WB))
    lines, places = drawn.copy(), [(int(u), int(v)) for u, v in corners]
    for i, j in sides(len(corners)):
        cv2.line(lines, places[i], places[j], MAGENTA, 2, cv2.LINE_AA)
    drawn[:] = cv2.addWeighted(lines, 0.6, drawn, 0.4, 0)
    for i, j in sides(len(corners)):
        length_m = math.dist(instant.states.p_WB[i], instant.states.p_WB[j])
        label(drawn, f"{length_m:.2f} m", (corners[i] + corners[j]) / 2)
    for name, corner in zip(instant.names, corners, strict=True):
        label(drawn, name, corner - (0, 60))
    return drawn


def sides(count: int) -> list[tuple[int, int]]:
    """Return the pairs of consecutive drones, as a ring if there are more than two."""
    return [(i, (i + 1) % count) for i in range(count)] if count > 2 else [(0, count - 1)]


def label(drawn: Picture, text: str, at: Array) -> None:
    """Draw a text centred at a point of the picture [px]."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 1)
    x, y = int(at[0] - width / 2), int(at[1] + height / 2)
    cv2.rectangle(drawn, (x - 6, y - height - 6), (x + width + 6, y + 6), PAPER, -1)
    cv2.putText(drawn, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.7, INK, 1, cv2.LINE_AA)


def main() -> None:
    if len(sys.argv) not in (3, 4):
        raise SystemExit(
            "usage: python examples/formation_picture.py DIR PICTURE [SECONDS]    e.g. runs/first a.jpg 60"
        )
    place, out = Path(sys.argv[1]), sys.argv[2]
    seconds = float(sys.argv[3]) if len(sys.argv) > 3 else None
    instant = recorded(record_at(place), None if seconds is None else round(seconds * 1e9))
    cv2.imwrite(out, picture(instant, seconds or 0.0), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
