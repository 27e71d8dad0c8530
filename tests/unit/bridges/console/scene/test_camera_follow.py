"""Which way the page's camera goes with the formation, and what it has in view."""

import math
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from zsim_bridges.console.page_cameras import DISTANCE_MIN_M, CameraFollow, fit_distance_m

UP_W = np.array([0.0, 0.0, 1.0])
TRIANGLE = np.array([(0.0, 3.5, 15.0), (-3.5, -3.5, 15.0), (3.5, -3.5, 15.0)])


class Page:
    """A page of viser's, with its camera."""

    def __init__(self, number: int, aspect: float = 1.6) -> None:
        self.client_id = number
        self.atomic = nullcontext
        self.camera = SimpleNamespace(
            position=np.array([9.0, 0.0, 0.0]), look_at=np.zeros(3), up_direction=UP_W, fov=1.31, aspect=aspect
        )

    @property
    def distance_m(self) -> float:
        return float(np.linalg.norm(self.camera.position - self.camera.look_at))

    def shows(self, p_W: np.ndarray) -> bool:
        """Return whether it has all points within its picture."""
        camera = self.camera
        back = (camera.position - camera.look_at) / self.distance_m
        right = np.cross(UP_W, back)
        away = (p_W - camera.position) @ np.column_stack((right / np.linalg.norm(right), np.cross(back, right), -back))
        half = math.tan(camera.fov / 2) * away[:, 2]
        return bool((np.abs(away[:, 0]) <= half * camera.aspect).all() and (np.abs(away[:, 1]) <= half).all())


class Pages:
    """Pages that come and go."""

    def __init__(self) -> None:
        self.there: dict[int, Any] = {}
        self.calls: dict[str, Any] = {}
        server: Any = SimpleNamespace(
            on_client_connect=lambda call: self.calls.update(come=call),
            on_client_disconnect=lambda call: self.calls.update(go=call),
            get_clients=lambda: self.there,
        )
        self.follow = CameraFollow(server)

    def come(self, page: Page) -> Page:
        self.there[page.client_id] = page
        self.calls["come"](page)
        return page

    def go(self, page: Page) -> None:
        self.calls["go"](page)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.2])
@pytest.mark.parametrize("direction", ["reset", "top", "side"])
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_a_formation_is_in_view_whatever_its_size_and_the_page_s(aspect: float, direction: str, scale: float):
    pages = Pages()
    page = pages.come(Page(1, aspect))
    pages.follow.choose(1, follows=True, fits=True, direction=direction)
    pages.follow.follow(scale * TRIANGLE)
    assert page.shows(scale * TRIANGLE)
    assert page.distance_m >= DISTANCE_MIN_M


def test_a_hidden_page_has_a_camera_all_the_same():
    distance_m = fit_distance_m(TRIANGLE, TRIANGLE.mean(axis=0), np.array([0.0, -1.0, 0.3]), UP_W, 1.31, 0.0)
    assert math.isfinite(distance_m)


def test_cameras_follow_from_the_start_and_go_back_where_a_formation_grows():
    pages = Pages()
    page = pages.come(Page(1))
    for t in range(60):
        flown = (1.0 + t / 10) * TRIANGLE + np.array((t, -t, 0.0))
        pages.follow.follow(flown)
        assert page.shows(flown)
    before_m = page.distance_m
    pages.follow.follow(TRIANGLE)
    assert page.distance_m < before_m


def test_a_camera_keeps_the_direction_that_its_page_gave_it():
    pages = Pages()
    page = pages.come(Page(1))
    pages.follow.follow(TRIANGLE)
    page.camera.position = page.camera.look_at + np.array((0.0, page.distance_m, 0.0))
    pages.follow.follow(TRIANGLE + np.array((40.0, 0.0, 0.0)))
    back = (page.camera.position - page.camera.look_at) / page.distance_m
    assert back == pytest.approx((0.0, 1.0, 0.0), abs=1e-9)
    assert page.camera.look_at[0] == pytest.approx(40.0)


def test_a_formation_that_hovers_moves_no_camera():
    pages = Pages()
    page = pages.come(Page(1))
    pages.follow.follow(TRIANGLE)
    before = page.camera.position.copy()
    pages.follow.follow(TRIANGLE + np.array((0.1, 0.0, 0.05)))
    assert page.camera.position.tolist() == before.tolist()


def test_who_zooms_keeps_the_distance_and_who_does_not_follow_the_place():
    pages = Pages()
    zoomed, still = pages.come(Page(1)), pages.come(Page(2))
    pages.follow.follow(TRIANGLE)
    zoomed.camera.position = zoomed.camera.look_at + np.array((0.0, -2.0, 0.0))
    pages.follow.choose(1, follows=True, fits=False)
    pages.follow.choose(2, follows=False, fits=True)
    place = still.camera.look_at.tolist()
    pages.follow.follow(TRIANGLE + np.array((40.0, 0.0, 0.0)))
    assert zoomed.distance_m == pytest.approx(2.0)
    assert zoomed.camera.look_at[0] == pytest.approx(40.0)
    assert still.camera.look_at.tolist() == place
    pages.follow.restart()  # another run: everybody looks there
    pages.follow.follow(TRIANGLE + np.array((80.0, 0.0, 0.0)))
    assert still.camera.look_at[0] == pytest.approx(80.0)


def test_who_follows_again_after_a_zoom_has_all_in_view_from_the_fitting_distance():
    pages = Pages()
    page = pages.come(Page(1))
    pages.follow.follow(TRIANGLE)
    fitting_m = page.distance_m
    page.camera.position = page.camera.look_at + 1.3 * (page.camera.position - page.camera.look_at)
    pages.follow.choose(1, follows=True, fits=False)
    pages.follow.follow(TRIANGLE)
    assert page.distance_m == pytest.approx(1.3 * fitting_m)
    pages.follow.choose(1, follows=True, fits=True)
    pages.follow.follow(TRIANGLE)
    assert page.distance_m == pytest.approx(fitting_m)


def test_a_page_that_went_before_it_was_known_is_forgotten():
    pages = Pages()
    gone = Page(1)
    pages.go(gone)
    pages.calls["come"](gone)
    before = gone.camera.position.tolist()
    pages.follow.choose(1, follows=True, fits=True, direction="top")
    pages.follow.follow(TRIANGLE)
    assert gone.camera.position.tolist() == before


def test_without_drones_no_camera_moves():
    pages = Pages()
    page = pages.come(Page(1))
    before = page.camera.position.tolist()
    pages.follow.follow(np.zeros((0, 3)))
    assert page.camera.position.tolist() == before
