"""Camera frusta in the scene (their poses, and the pages that show them), and how a page's camera follows a formation."""

import math
import re
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic_camera

from zsim.math import frames
from zsim_bridges.console.page_cameras import (
    DISTANCE_MIN_M,
    OFFSET_M,
    VISIBLE_MAX_M,
    CameraView,
    PageCameras,
    drone_index,
    fit_distance_m,
    frustum_pose,
)
from zsim_bridges.console.picture import DronePoses, drone_on_ray

FRONT, BOTTOM = synthetic_camera.info_of("front"), synthetic_camera.info_of("bottom")
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
UP_W = np.array([0.0, 0.0, 1.0])
AHEAD_K, DOWN_K = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def drones(x_m: float = 0.0) -> DronePoses:
    p_W = np.array([(x_m, 0.0, 2.0), (math.nan,) * 3])
    return DronePoses(0, ("drone1", "drone2"), p_W, np.tile(LEVEL, (2, 1)), np.zeros((2, 4)), np.zeros(3))


def test_a_frustum_follows_the_attitude_of_its_drone():
    north = frames.quaternion_from_heading(np.array(math.pi / 2))
    p_WK, q_WK = frustum_pose(FRONT, np.array([1.0, 2.0, 3.0]), north)
    assert p_WK == pytest.approx((1.0 - 0.0, 2.162, 3.012))
    assert frames.rotate(q_WK, AHEAD_K) == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)
    assert frames.rotate(q_WK, DOWN_K) == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)

    p_WK, q_WK = frustum_pose(BOTTOM, np.array([0.0, 0.0, 3.0]), LEVEL)
    assert p_WK == pytest.approx((0.0, 0.0, 2.97))
    assert frames.rotate(q_WK, AHEAD_K) == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)
    assert frames.rotate(q_WK, DOWN_K) == pytest.approx((-1.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(
    ("camera", "index"), [("drone1/front", 0), ("drone2/front", None), ("drone9/front", None), ("", None)]
)
def test_only_the_camera_of_a_visible_drone_has_an_index(camera: str, index: int | None):
    assert drone_index(drones(), camera) == index
    assert drone_index(None, camera) is None


class Page:
    """A viser page that records its frusta; its camera looks north from 6 m south of and 2 m above the origin."""

    def __init__(self, client_id: int, aspect: float = 1.5) -> None:
        self.client_id = client_id
        self.camera = SimpleNamespace(
            position=np.array([0.0, -6.0, 2.0]), look_at=np.array([0.0, 0.0, 2.0]),
            up_direction=UP_W, fov=math.radians(75), aspect=aspect,
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

    @property
    def distance_m(self) -> float:
        return float(np.linalg.norm(self.camera.position - self.camera.look_at))

    def shows(self, p_W: np.ndarray) -> bool:
        """Return whether all points are within the page's picture."""
        camera = self.camera
        back = (camera.position - camera.look_at) / self.distance_m
        right = np.cross(UP_W, back)
        away = (p_W - camera.position) @ np.column_stack((right / np.linalg.norm(right), np.cross(back, right), -back))
        half = math.tan(camera.fov / 2) * away[:, 2]
        return bool((np.abs(away[:, 0]) <= half * camera.aspect).all() and (np.abs(away[:, 1]) <= half).all())


class Pages:
    """Pages that connect and disconnect, and their cameras."""

    def __init__(self) -> None:
        self.there: dict[int, Any] = {}
        self.calls: dict[str, Any] = {}
        server: Any = SimpleNamespace(
            on_client_connect=lambda call: self.calls.update(come=call),
            on_client_disconnect=lambda call: self.calls.update(go=call),
            get_clients=lambda: self.there,
        )
        self.cameras = PageCameras(server)

    def come(self, page: Page) -> Page:
        self.there[page.client_id] = page
        self.calls["come"](page)
        return page

    def go(self, page: Page) -> None:
        self.calls["go"](page)


@pytest.fixture
def followed() -> Pages:
    return Pages()


@pytest.fixture
def pages(followed: Pages) -> list[Page]:
    made = [followed.come(Page(number)) for number in (1, 2)]
    for page in made:  # back to the pose from before the page's camera was aimed
        page.camera.position, page.camera.look_at = np.array([0.0, -6.0, 2.0]), np.array([0.0, 0.0, 2.0])
    return made


@pytest.fixture
def frustums(followed: Pages) -> PageCameras:
    return followed.cameras


def shown(camera: str, number: int = 1) -> Any:
    """Return the information and picture of a camera; all cameras have the same picture."""
    if not camera.startswith("drone"):
        return None
    name = camera.split("/")[1]
    image = synthetic_camera.image_message(name, number, b"JPEG %d" % number, 0)
    return synthetic_camera.info_of(name), SimpleNamespace(number=number, image=image)


def test_a_clicked_frustum_appears_only_on_its_page(frustums: PageCameras, pages: list[Page]):
    frustums.show_frustum(pages[0].key, "drone1/front")
    frustums.draw_frusta(drones(5.0), shown)
    (node,) = pages[0].nodes
    assert pages[1].nodes == []
    assert node.position == pytest.approx((5.162, 0.0, 2.012))
    assert (node._format, node._image_data) == ("jpeg", b"JPEG 1")
    assert node.aspect == pytest.approx(16 / 9)
    frustums.draw_frusta(drones(6.0), lambda camera: shown(camera, 2))
    assert pages[0].nodes == [node]
    assert node.position[0] == pytest.approx(6.162)
    assert node._image_data == b"JPEG 2"


def test_a_frustum_out_of_view_is_brought_into_view_once(frustums: PageCameras, pages: list[Page]):
    frustums.show_frustum(pages[1].key, "drone1/front")
    frustums.draw_frusta(drones(1.0), shown)
    assert pages[1].camera.position.tolist() == [0.0, -6.0, 2.0]
    frustums.show_frustum(pages[0].key, "drone1/front")
    frustums.draw_frusta(drones(50.0), shown)
    camera = pages[0].camera
    assert camera.look_at == pytest.approx((50.162, 0.0, 2.012))
    assert camera.position[1] == pytest.approx(-np.linalg.norm(OFFSET_M))
    assert pages[1].camera.look_at.tolist() == [0.0, 0.0, 2.0]
    frustums.draw_frusta(drones(90.0), lambda name: shown(name, 2))
    assert camera.look_at[0] == pytest.approx(50.162)


def test_another_camera_replaces_the_frustum_and_deselection_hides_it(frustums: PageCameras, pages: list[Page]):
    for camera in ("drone1/front", "drone1/bottom"):
        frustums.show_frustum(pages[0].key, camera)
        frustums.draw_frusta(drones(), shown)
    (node,) = pages[0].nodes
    assert node.aspect == pytest.approx(4 / 3)

    frustums.show_frustum(pages[0].key, "drone1/front")
    frustums.draw_frusta(drones(), shown)
    frustums.show_frustum(pages[0].key, "")
    frustums.draw_frusta(drones(), shown)
    assert pages[0].nodes == []


@pytest.mark.parametrize("camera", ["drone2/front", "elsewhere", "drone9/front"])
def test_a_camera_without_a_picture_or_a_visible_drone_has_no_frustum(
    frustums: PageCameras, pages: list[Page], camera: str
):
    frustums.show_frustum(pages[0].key, camera)
    frustums.draw_frusta(drones(), shown)
    frustums.draw_frusta(None, shown)
    assert pages[0].nodes == []


def test_a_frustum_is_chosen_only_with_the_key_of_the_page(frustums: PageCameras, pages: list[Page]):
    for key in ("", "guessed", pages[0].key[:-1]):
        frustums.show_frustum(key, "drone1/front")
    frustums.draw_frusta(drones(), shown)
    assert [page.nodes for page in pages] == [[], []]
    assert pages[0].key != pages[1].key


def test_a_closed_page_or_run_leaves_no_frustum(frustums: PageCameras, pages: list[Page], followed: Pages):
    frustums.show_frustum(pages[1].key, "drone1/front")
    frustums.draw_frusta(drones(), shown)
    frustums.clear_frusta()
    assert pages[1].nodes == []

    frustums.show_frustum(pages[0].key, "drone1/front")
    followed.go(pages[0])
    frustums.draw_frusta(drones(), shown)
    assert pages[0].nodes == []
    frustums.show_frustum(pages[0].key, "drone1/front")
    frustums.draw_frusta(drones(), shown)
    assert pages[0].nodes == []


def test_a_click_is_returned_once_and_only_to_its_page(frustums: PageCameras, pages: list[Page], followed: Pages):
    frustums.click(2, "drone1")
    assert frustums.pop_click(pages[0].key) == ""
    assert [frustums.pop_click(pages[1].key) for _ in range(2)] == ["drone1", ""]

    frustums.click(1, "drone1")
    followed.go(pages[0])
    frustums.click(1, "drone1")
    assert frustums.pop_click(pages[0].key) == ""


@pytest.mark.parametrize(
    ("direction", "drone"),
    [
        ((0.0, 0.0, -1.0), "near"),
        ((5.0, 0.2, -10.0), "far"),  # passes it at 0.2 m
        ((5.0, 0.4, -10.0), None),
        ((0.1, 0.0, -5.0), "near"),  # also hits the one behind, farther from its centre
        ((0.0, 50.5, -10.0), "distant"),  # passes it at 0.5 m, 0.01 rad
        ((0.0, 0.0, 1.0), None),  # all drones are behind
        ((0.0, 0.0, 0.0), None),
    ],
)
def test_a_click_selects_the_drone_that_its_ray_hits(direction: tuple[float, ...], drone: str | None):
    p_W = np.array([(0.0, 0.0, 5.0), (0.0, 0.0, 4.0), (5.0, 0.0, 0.0), (0.0, 50.0, 0.0), (math.nan,) * 3])
    names = ("near", "behind", "far", "distant", "gone")
    poses = DronePoses(0, names, p_W, np.tile(LEVEL, (5, 1)), np.zeros((5, 4)), np.zeros(3))
    assert drone_on_ray(poses, np.full(5, 0.3), (0.0, 0.0, 10.0), direction) == drone
    nobody = poses._replace(p_W=np.full((5, 3), math.nan))
    assert drone_on_ray(nobody, np.ones(5), (0.0, 0.0, 10.0), direction) is None


TRIANGLE = np.array([(0.0, 3.5, 15.0), (-3.5, -3.5, 15.0), (3.5, -3.5, 15.0)])


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.2])
@pytest.mark.parametrize("direction", ["reset", "top", "side"])
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_a_formation_fits_the_view_whatever_its_size_and_the_aspect(
    aspect: float, direction: str, scale: float, followed: Pages
):
    page = followed.come(Page(1, aspect))
    followed.cameras.look(1, follows=True, fits=True, direction=direction)
    followed.cameras.follow(scale * TRIANGLE)
    assert page.shows(scale * TRIANGLE)
    assert page.distance_m >= DISTANCE_MIN_M


def test_the_distance_is_finite_even_on_a_page_without_width():
    distance_m = fit_distance_m(TRIANGLE, TRIANGLE.mean(axis=0), np.array([0.0, -1.0, 0.3]), UP_W, 1.31, 0.0)
    assert math.isfinite(distance_m)


def test_a_camera_follows_a_growing_and_shrinking_formation(followed: Pages):
    page = followed.come(Page(1))
    for t in range(60):
        flown = (1.0 + t / 10) * TRIANGLE + np.array((t, -t, 0.0))
        followed.cameras.follow(flown)
        assert page.shows(flown)
    before_m = page.distance_m
    followed.cameras.follow(TRIANGLE)
    assert page.distance_m < before_m


def test_a_following_camera_keeps_the_direction_set_on_its_page(followed: Pages):
    page = followed.come(Page(1))
    followed.cameras.follow(TRIANGLE)
    page.camera.position = page.camera.look_at + np.array((0.0, page.distance_m, 0.0))
    followed.cameras.follow(TRIANGLE + np.array((40.0, 0.0, 0.0)))
    back = (page.camera.position - page.camera.look_at) / page.distance_m
    assert back == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)
    assert page.camera.look_at[0] == pytest.approx(40.0)


def test_a_hovering_formation_moves_no_camera(followed: Pages):
    page = followed.come(Page(1))
    followed.cameras.follow(TRIANGLE)
    before = page.camera.position.copy()
    followed.cameras.follow(TRIANGLE + np.array((0.1, 0.0, 0.05)))
    assert page.camera.position.tolist() == before.tolist()


def test_a_zoomed_page_keeps_its_distance_and_a_fixed_one_its_place(followed: Pages):
    zoomed, still = followed.come(Page(1)), followed.come(Page(2))
    followed.cameras.follow(TRIANGLE)
    zoomed.camera.position = zoomed.camera.look_at + np.array((0.0, -2.0, 0.0))
    followed.cameras.look(1, follows=True, fits=False)
    followed.cameras.look(2, follows=False, fits=True)
    place = still.camera.look_at.tolist()
    followed.cameras.follow(TRIANGLE + np.array((40.0, 0.0, 0.0)))
    assert zoomed.distance_m == pytest.approx(2.0)
    assert zoomed.camera.look_at[0] == pytest.approx(40.0)
    assert still.camera.look_at.tolist() == place
    followed.cameras.restart()  # for another run, every page aims anew
    followed.cameras.follow(TRIANGLE + np.array((80.0, 0.0, 0.0)))
    assert still.camera.look_at[0] == pytest.approx(80.0)


def test_fitting_again_after_a_zoom_restores_the_fitting_distance(followed: Pages):
    page = followed.come(Page(1))
    followed.cameras.follow(TRIANGLE)
    fitting_m = page.distance_m
    page.camera.position = page.camera.look_at + 1.3 * (page.camera.position - page.camera.look_at)
    followed.cameras.look(1, follows=True, fits=False)
    followed.cameras.follow(TRIANGLE)
    assert page.distance_m == pytest.approx(1.3 * fitting_m)
    followed.cameras.look(1, follows=True, fits=True)
    followed.cameras.follow(TRIANGLE)
    assert page.distance_m == pytest.approx(fitting_m)


def test_no_camera_moves_without_drones_or_on_a_closed_page(followed: Pages):
    there, gone = followed.come(Page(2)), Page(1)
    before = there.camera.position.tolist()
    followed.cameras.follow(np.zeros((0, 3)))
    followed.go(gone)
    followed.calls["come"](gone)
    before_gone = gone.camera.position.tolist()
    followed.cameras.look(1, follows=True, fits=True, direction="top")
    assert there.camera.position.tolist() == before
    followed.cameras.follow(TRIANGLE)
    assert gone.camera.position.tolist() == before_gone


NORTHWARDS = CameraView(np.zeros(3), np.array([0.0, 2.0, 0.0]), np.array([0.0, 0.0, 1.0]), math.radians(90), 1.5)


@pytest.mark.parametrize(
    ("p_W", "seen"),
    [
        ((0.0, 5.0, 0.0), True),
        ((6.0, 5.0, 0.0), True),  # far to the right: the page is wider than high
        ((0.0, 5.0, 6.0), False),
        ((0.0, 5.0, -6.0), False),
        ((-9.0, 5.0, 0.0), False),
        ((0.0, -5.0, 0.0), False),  # behind
        ((0.0, VISIBLE_MAX_M + 1.0, 0.0), False),
    ],
)
def test_a_point_is_in_view_if_the_page_shows_it(p_W: tuple[float, float, float], seen: bool):
    assert NORTHWARDS.contains(np.array(p_W)) == seen
