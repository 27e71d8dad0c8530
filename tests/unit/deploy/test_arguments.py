"""The options by which commands reach a world: what typer parses, and what the commands receive."""

from typing import Any

import typer
from refused import has_terms
from typer.testing import CliRunner

from zsim_deploy.arguments import (
    DEFAULT_ENDPOINT,
    LOOK_S,
    WorldAccess,
    endpoint_origin,
    observer_options,
    participant_options,
)


def given(decorate: Any, *arguments: str, **environment: str) -> tuple[WorldAccess, str, int]:
    """Return what a command receives from a command line."""
    app, got = typer.Typer(), []

    @app.command()
    @decorate
    def command(reach: WorldAccess, key: str, count: int = 1) -> None:
        """Do something."""
        got.append((reach, key, count))

    result = CliRunner().invoke(app, [*arguments], env=environment)
    assert result.exit_code == 0, result.output
    return got[0]


def test_observers_wait_briefly_for_a_world_and_participants_indefinitely():
    assert given(observer_options, "clock") == (
        WorldAccess(DEFAULT_ENDPOINT, "zsim", LOOK_S, None, False, None),
        "clock",
        1,
    )
    assert given(participant_options, "clock", "--count", "3")[0].wait_s is None


def test_shared_options_reach_a_command_besides_its_own():
    options = ("--connect", "tcp/h:1", "--federation", "f", "--wait", "2", "--insecure", "--host", "lab")
    reach, key, count = given(participant_options, "clock", *options, "--launched", "r1", "--count", "2")
    assert reach == WorldAccess("tcp/h:1", "f", 2.0, None, True, "lab", "r1")
    assert (key, count) == ("clock", 2)
    assert (reach.who.host, reach.who.insecure) == ("lab", True)


def test_the_environment_gives_the_endpoint_unless_the_option_does():
    for decorate in (observer_options, participant_options):
        assert given(decorate, "clock", ZSIM_CONNECT="tcp/h:1")[0].endpoint == "tcp/h:1"
        assert given(decorate, "clock", ZSIM_CONNECT="")[0].endpoint == DEFAULT_ENDPOINT
        assert given(decorate, "clock", "--connect", "tcp/o:2", ZSIM_CONNECT="tcp/h:1")[0].endpoint == "tcp/o:2"


def test_a_refused_endpoint_from_the_environment_names_the_variable():
    refusal, environment = "no world on tcp/h:1", {"ZSIM_CONNECT": "tcp/h:1"}
    assert has_terms(endpoint_origin(refusal, ["zsim", "keys"], environment), refusal, "ZSIM_CONNECT")
    for option in (["--connect", "tcp/h:1"], ["--connect=tcp/h:1"]):
        assert endpoint_origin(refusal, option, environment) == refusal
    assert endpoint_origin("no such file", ["zsim"], environment) == "no such file"
