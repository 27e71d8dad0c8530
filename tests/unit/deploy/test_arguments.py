"""The options by which commands reach a world: what typer sees, and what the command is given."""

from typing import Any

import typer
from typer.testing import CliRunner

from zsim_deploy.arguments import DEFAULT_ENDPOINT, LOOK_S, WorldAccess, observer_options, participant_options


def given(decorate: Any, *arguments: str) -> tuple[WorldAccess, str, int]:
    """Return what a command gets of a command line, and the exit code."""
    app, got = typer.Typer(), []

    @app.command()
    @decorate
    def command(reach: WorldAccess, key: str, count: int = 1) -> None:
        """Do something."""
        got.append((reach, key, count))

    result = CliRunner().invoke(app, [*arguments])
    assert result.exit_code == 0, result.output
    return got[0]


def test_a_command_that_looks_waits_a_little_and_one_that_takes_part_for_ever():
    assert given(observer_options, "clock") == (
        WorldAccess(DEFAULT_ENDPOINT, "zsim", LOOK_S, None, False, None),
        "clock",
        1,
    )
    assert given(participant_options, "clock", "--count", "3")[0].wait_s is None


def test_options_reach_the_command_beside_its_own():
    options = ("--connect", "tcp/h:1", "--federation", "f", "--wait", "2", "--insecure", "--host", "lab")
    reach, key, count = given(participant_options, "clock", *options, "--launched", "r1", "--count", "2")
    assert reach == WorldAccess("tcp/h:1", "f", 2.0, None, True, "lab", "r1")
    assert (key, count) == ("clock", 2)
    assert (reach.who.host, reach.who.insecure) == ("lab", True)
