"""Printing of lines in the terminal during a test, bypassing pytest's capture."""

from collections.abc import Iterable
from typing import Any

import pytest


def say(request: pytest.FixtureRequest, lines: Iterable[str]) -> None:
    plugins = request.config.pluginmanager
    terminal: Any = plugins.getplugin("terminalreporter")
    capture: Any = plugins.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        terminal.ensure_newline()
        for line in lines:
            terminal.write_line(line)
