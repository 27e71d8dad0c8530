"""Frusta in the scene: where they stand, and on whose page."""

import math
import re
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic_camera

from zsim.math import frames
from zsim_bridges.console.page_cameras import OFFSET_M, CameraFrustums, drone_index, frustum_pose
from zsim_bridges.console.picture import DronePoses, drone_on_ray

FRONT, BOTTOM = synthetic_camera.info_of("front"), synthetic_camera.info_of("bottom")
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
AHEAD_K, DOWN_K = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def drones(x_m: float = 0.0) -> DronePoses:
    p_W = np.array([(x_m, 0.0, 2.0), (math.nan,) * 3])
    return DronePoses(0, ("drone1", "drone2"), p_W, np.tile(LEVEL, (2, 1)), np.zeros((2, 4)), np.zeros(3))


def test_a_front_camera_looks_where_its_drone_looks():
    north = frames.quaternion_from_heading(np.array(math.pi / 2))
    p_WK, q_WK = frustum_pose(FRONT, np.array([1.0, 2.0, 3.0]), north)
    assert p_WK == pytest.approx((1.0 - 0.0, 2.162, 3.012))
    assert frames.rotate(q_WK, AHEAD_K) == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)
    assert frames.rotate(q_WK, DOWN_K) == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)


def test_a_bottom_camera_looks_down_with_ahead_at_the_top_of_its_picture():
    p_WK, q_WK = frustum_pose(BOTTOM, np.array([0.0, 0.0, 3.0]), LEVEL)
    assert p_WK == pytest.approx((0.0, 0.0, 2.97))
    assert frames.rotate(q_WK, AHEAD_K) == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)
    assert frames.rotate(q_WK, DOWN_K) == pytest.approx((-1.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("camera", "index"), [("drone1/front", 0), ("drone2/front", None), ("drone9/front", None), ("", None)]
)
def test_only_a_drone_in_the_view_has_a_place(camera: str, index: int | None):
    assert drone_index(drones(), camera) == index
    assert drone_index(None, camera) is None


class Page:
    """A page of viser's that notes its frusta; its camera looks north from 6 m south of the origin, 2 m above it."""

    def __init__(self, client_id: int) -> None:
        self.client_id = client_id
        self.camera = SimpleNamespace(
            position=np.array([0.0, -6.0, 2.0]), look_at=np.array([0.0, 0.0, 2.0]),
            up_direction=np.array([0.0, 0.0, 1.0]), fov=math.radians(75), aspect=1.5,
        )  # fmt: skip
        self.atomic = nullcontext
        self.html = ""
        self.nodes: list[Any] = []
        self.gui = SimpleNamespace(add_html=self._add_html)
        self.scene = SimpleNamespace(add_camera_frustum=self._add)

    def _add_html(self, content: str, **_: Any) -> None:
        self.html = content

    def _add(self, name: str, fov: float, aspect: float, **_: Any) -> Any:
        node: Any = SimpleNamespace(fov=fov, aspect=aspect)
        node.remove = lambda: self.nodes.remove(node)
        self.nodes.append(node)
        return node

    @property
    def key(self) -> str:
        found = re.search('data-zsim-page="([^"]+)"', self.html)
        assert found is not None
        return found[1]


class Server:
    """A viser server with pages that come and go."""

    def __init__(self) -> None:
        self.comes: Callable[[Any], None] = lambda _: None
        self.goes: Callable[[Any], None] = lambda _: None

    def on_client_connect(self, act: Callable[[Any], None]) -> None:
        self.comes = act

    def on_client_disconnect(self, act: Callable[[Any], None]) -> None:
        self.goes = act


@pytest.fixture
def server() -> Server:
    return Server()


@pytest.fixture
def frustums(server: Any) -> CameraFrustums:
    return CameraFrustums(server)


@pytest.fixture
def pages(server: Server, frustums: CameraFrustums) -> list[Page]:
    made = [Page(1), Page(2)]
    for page in made:
        server.comes(page)
    return made


def shown(camera: str, number: int = 1) -> Any:
    """Return what a camera shows: every one has the same picture."""
    if not camera.startswith("drone"):
        return None
    name = camera.split("/")[1]
    image = synthetic_camera.image_message(name, number, b"JPEG %d" % number, 0)
    return synthetic_camera.info_of(name), SimpleNamespace(number=number, image=image)


def test_a_page_shows_the_frustum_that_was_clicked_on_it_and_the_others_do_not(
    frustums: CameraFrustums, pages: list[Page]
):
    frustums.choose(pages[0].key, "drone1/front")
    frustums.draw(drones(5.0), shown)
    (node,) = pages[0].nodes
    assert pages[1].nodes == []
    assert node.position == pytest.approx((5.162, 0.0, 2.012))
    assert (node._format, node._image_data) == ("jpeg", b"JPEG 1")
    assert node.aspect == pytest.approx(16 / 9)
    frustums.draw(drones(6.0), lambda camera: shown(camera, 2))
    assert pages[0].nodes == [node]
    assert node.position[0] == pytest.approx(6.162)
    assert node._image_data == b"JPEG 2"


def test_a_frustum_that_is_in_view_leaves_its_page_s_camera_alone(frustums: CameraFrustums, pages: list[Page]):
    frustums.choose(pages[0].key, "drone1/front")
    frustums.draw(drones(1.0), shown)
    assert pages[0].camera.position.tolist() == [0.0, -6.0, 2.0]


def test_a_frustum_that_appears_out_of_view_is_brought_into_it_once(frustums: CameraFrustums, pages: list[Page]):
    frustums.choose(pages[0].key, "drone1/front")
    frustums.draw(drones(50.0), shown)
    camera = pages[0].camera
    assert camera.look_at == pytest.approx((50.162, 0.0, 2.012))
    assert camera.position[1] == pytest.approx(-np.linalg.norm(OFFSET_M))
    assert pages[1].camera.look_at.tolist() == [0.0, 0.0, 2.0]
    frustums.draw(drones(90.0), lambda name: shown(name, 2))
    assert camera.look_at[0] == pytest.approx(50.162)


def test_another_click_hides_it(frustums: CameraFrustums, pages: list[Page]):
    frustums.choose(pages[0].key, "drone1/front")
    frustums.draw(drones(), shown)
    frustums.choose(pages[0].key, "")
    frustums.draw(drones(), shown)
    assert pages[0].nodes == []


def test_another_camera_takes_its_place(frustums: CameraFrustums, pages: list[Page]):
    for camera in ("drone1/front", "drone1/bottom"):
        frustums.choose(pages[0].key, camera)
        frustums.draw(drones(), shown)
    (node,) = pages[0].nodes
    assert node.aspect == pytest.approx(4 / 3)


@pytest.mark.parametrize("camera", ["drone2/front", "elsewhere", "drone9/front"])
def test_a_camera_without_a_picture_or_a_place_has_none(frustums: CameraFrustums, pages: list[Page], camera: str):
    frustums.choose(pages[0].key, camera)
    frustums.draw(drones(), shown)
    frustums.draw(None, shown)
    assert pages[0].nodes == []


def test_nobody_chooses_for_a_page_without_its_key(frustums: CameraFrustums, pages: list[Page]):
    for key in ("", "guessed", pages[0].key[:-1]):
        frustums.choose(key, "drone1/front")
    frustums.draw(drones(), shown)
    assert [page.nodes for page in pages] == [[], []]
    assert pages[0].key != pages[1].key


def test_a_page_that_has_gone_is_forgotten(frustums: CameraFrustums, pages: list[Page], server: Server):
    frustums.choose(pages[0].key, "drone1/front")
    server.goes(pages[0])
    frustums.draw(drones(), shown)
    assert pages[0].nodes == []
    frustums.choose(pages[0].key, "drone1/front")
    frustums.draw(drones(), shown)
    assert pages[0].nodes == []


def test_a_run_that_is_over_leaves_none(frustums: CameraFrustums, pages: list[Page]):
    frustums.choose(pages[1].key, "drone1/front")
    frustums.draw(drones(), shown)
    frustums.clear()
    assert pages[1].nodes == []


def test_a_click_in_a_scene_is_for_its_page_and_told_once(frustums: CameraFrustums, pages: list[Page]):
    frustums.click(2, "drone1")
    assert frustums.take_click(pages[0].key) == ""
    assert [frustums.take_click(pages[1].key) for _ in range(2)] == ["drone1", ""]


def test_a_click_on_a_page_that_has_gone_is_forgotten(frustums: CameraFrustums, pages: list[Page], server: Server):
    frustums.click(1, "drone1")
    server.goes(pages[0])
    frustums.click(1, "drone1")
    assert frustums.take_click(pages[0].key) == ""


@pytest.mark.parametrize(
    ("direction", "drone"),
    [
        ((0.0, 0.0, -1.0), "near"),
        ((5.0, 0.2, -10.0), "far"),  # passes by it at 0.2 m
        ((5.0, 0.4, -10.0), None),
        ((0.1, 0.0, -5.0), "near"),  # hits the one behind it, too, further from its centre
        ((0.0, 50.5, -10.0), "distant"),  # passes by it at 0.5 m, 0.01 rad
        ((0.0, 0.0, 1.0), None),  # all are behind
        ((0.0, 0.0, 0.0), None),
    ],
)
def test_a_click_is_on_the_drone_that_its_ray_hits(direction: tuple[float, ...], drone: str | None):
    p_W = np.array([(0.0, 0.0, 5.0), (0.0, 0.0, 4.0), (5.0, 0.0, 0.0), (0.0, 50.0, 0.0), (math.nan,) * 3])
    names = ("near", "behind", "far", "distant", "gone")
    poses = DronePoses(0, names, p_W, np.tile(LEVEL, (5, 1)), np.zeros((5, 4)), np.zeros(3))
    assert drone_on_ray(poses, np.full(5, 0.3), (0.0, 0.0, 10.0), direction) == drone


def test_without_drones_a_click_is_on_none():
    poses = DronePoses(0, ("gone",), np.full((1, 3), math.nan), LEVEL[None], np.zeros((1, 4)), np.zeros(3))
    assert drone_on_ray(poses, np.ones(1), (0.0, 0.0, 10.0), (0.0, 0.0, -1.0)) is None
