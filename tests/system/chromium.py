"""Debian's chromium without a window, driven by playwright."""

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")
FLAGS = (  # as root, without a screen and without a graphics card, in a container
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-gpu-rasterization",  # which Debian turns on: a page itself is drawn faster without a card that is none
    "--disable-accelerated-2d-canvas",  # to read pixels of a plot took up to a minute
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; on Debian: apt-get install chromium")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One browser for the tests of a file."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; pip install playwright")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield started
        started.close()
