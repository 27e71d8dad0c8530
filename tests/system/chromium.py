"""Debian's Chromium, headless and driven by Playwright."""

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")
FLAGS = (  # to run as root in a container, without a screen or a graphics card
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-gpu-rasterization",  # Debian enables it; without a graphics card, pages are drawn faster on the CPU
    "--disable-accelerated-2d-canvas",  # with it, reading a plot's pixels took up to a minute
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; on Debian: apt-get install chromium")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Yield one browser for all tests of a file."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed; pip install playwright")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield started
        started.close()
