"""The commands that are one role of a federation each, and `zsim replay`, which stands in for the world."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from zsim.contract.run_messages import RATE_MAX
from zsim.scenario.role_table import AGENTS, Role
from zsim_deploy.arguments import (
    CHANGED,
    CONSOLE_NEEDS,
    DEFAULT_ENDPOINT,
    RUN,
    RUN_ID,
    Access,
    Connect,
    Federation,
    FlightOptions,
    From,
    Host,
    Insecure,
    Keys,
    Launched,
    Realtime,
    Tls,
    To,
    Trust,
    Wait,
    WorldAccess,
    check_range,
    flight_options,
    identity,
    participant_options,
    require,
)

REPLAY_NEEDS = {"record": ("mcap", "zstandard")}  # modules by extra
ROLES = "Roles, started by hand, on any machine, in any order"

app = typer.Typer()


@app.command(rich_help_panel=ROLES)
@flight_options
def world(
    flight: FlightOptions,
    listen: Annotated[
        list[str] | None, typer.Option(help=f"Endpoint, repeatable (default {DEFAULT_ENDPOINT}).")
    ] = None,
    expect: Annotated[list[str] | None, typer.Option(help="Wait for this process too, e.g. recorder.")] = None,
    journal: Annotated[
        Path | None, typer.Option(help="Folder of the run's journal: started again with it, it goes on.")
    ] = None,
    all_died: Annotated[bool, typer.Option("--all-died", hidden=True)] = False,
    changed: Annotated[list[str] | None, typer.Option(CHANGED, hidden=True)] = None,
    launched: Launched = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run the world: integrates all drones and owns simulated time."""
    from zsim.scenario import scenario_file
    from zsim.schema import plugin
    from zsim_deploy.roles import world_role

    path, overrides = flight.path, flight.overrides or ()
    # its launcher has written what is flown into the run's folder, and has read it where the modules are
    modules = plugin.folders() if launched else ()
    loaded = scenario_file.load(path, overrides, modules, seed=flight.seed, duration_s=flight.duration)
    mode, pace = flight.mode_and_rate()
    who = identity(host, tls, insecure, access)
    changes = [*(changed or ()), *flight.changed()]
    endpoints = listen or [DEFAULT_ENDPOINT]
    world_role.world(loaded, mode, pace, endpoints, launched, expect, who, journal, all_died, changes)


def _agent_command(name: str, role: Role) -> Callable[..., None]:
    """Return the command of a role that has agents, named after drones or clusters."""
    about = str(role.about)
    several_help = f"{about.capitalize()}s, or patterns: '{about}*'."

    def start(things: list[str], reach: WorldAccess) -> None:
        from zsim_deploy.roles import roles

        roles.agent(roles.agent_of(name, things), reach, roles.process_of(name, things))

    def several(
        reach: WorldAccess,
        things: Annotated[
            list[str], typer.Argument(metavar=f"{about.upper()}...", help=several_help, show_default=False)
        ],
    ) -> None:
        start(things, reach)

    def one(
        reach: WorldAccess,
        thing: Annotated[str, typer.Argument(metavar=about.upper(), help=f"Name of the {about}.")] = "main",
    ) -> None:
        start([thing], reach)

    return participant_options(several if role.joint else one)


for _name, _role in AGENTS.items():
    _also = ", or of several in one process" if _role.joint else ""
    _help = f"Run the {_name} of one {_role.about}{_also}."
    app.command(_name, rich_help_panel=ROLES, help=_help)(_agent_command(_name, _role))


@app.command("host", rich_help_panel=ROLES)
def host_agents(
    names: Annotated[
        list[str],
        typer.Argument(metavar="NAME...", help="Processes, or patterns: 'estimator.*' controller.main."),
    ],
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    wait: Wait = None,
    launched: Launched = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run several estimators and controllers in one process, which is faster."""
    from zsim_deploy.roles import roles

    roles.agent(roles.host(names), WorldAccess(connect, federation, wait, None, insecure, host, launched))


@app.command(rich_help_panel=ROLES)
@participant_options
def record(
    reach: WorldAccess,
    out: Annotated[Path, typer.Option(help=f"Folder for run.mcap; {RUN_ID} in its name is the id of the run.")] = Path(
        "."
    ),
) -> None:
    """Record every message of a federation into run.mcap."""
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()
    roles.recorder(out, reach)


@app.command(rich_help_panel=ROLES)
def router(
    name: Annotated[str, typer.Argument(help="Name of the router.")] = "main",
    listen: Annotated[str, typer.Option(help="Endpoint for its clients.")] = "tcp/127.0.0.1:7448",
    connect: Connect = DEFAULT_ENDPOINT,
    federation: Federation = "zsim",
    realtime: Realtime = False,
    launched: Launched = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run a router: carries the clients of one network to a world, or a router, in another."""
    from zsim_deploy.roles import roles

    mode = "realtime" if realtime else "lockstep"
    roles.router(name, listen, connect, federation, mode, launched, identity(host, tls, insecure, access))


def _rate(value: float) -> float:
    """Return a pace that a replay can have."""
    if not 0 <= value <= RATE_MAX:
        raise typer.BadParameter(f"is {value:g}; must be >= 0 and <= {RATE_MAX:g}")
    return value


@app.command(rich_help_panel=RUN)
def replay(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of a run, or its run.mcap.", show_default=False)
    ],
    rate: Annotated[
        float, typer.Option(callback=_rate, help="Simulated per wall second; 0 = as fast as it goes.")
    ] = 1.0,
    from_: From = 0.0,
    to: To = None,
    keys: Keys = None,
    expect: Annotated[
        list[str] | None,
        typer.Option(help="Begin when this process has joined, e.g. estimator.drone1, console.1. Repeatable."),
    ] = None,
    paused: Annotated[bool, typer.Option("--paused", help="Stand at the first instant until asked to resume.")] = False,
    console: Annotated[
        bool, typer.Option("--console", help="Show it in the browser, with a timeline; stand still at its end.")
    ] = False,
    listen: Annotated[
        list[str] | None, typer.Option(help=f"Endpoint, repeatable (default {DEFAULT_ENDPOINT}).")
    ] = None,
    federation: Annotated[str | None, typer.Option(help="Name of the federation (default the record's).")] = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
    trust: Trust = False,
) -> None:
    """Play a record back onto the keys: for a console, an estimator under test, any client; nobody can be flown."""
    require("replay", REPLAY_NEEDS)
    if console:
        require("console", CONSOLE_NEEDS)
    from zsim.schema import plugin
    from zsim_deploy.launch.console_process import console_beside
    from zsim_deploy.roles.world_role import ReplayOptions, play
    from zsim_world.playback.playback import PlaybackRange

    check_range(from_, to)
    to_ns = None if to is None else round(to * 1e9)
    choice = PlaybackRange(round((from_ or 0.0) * 1e9), to_ns, tuple(keys or ["**"]), paused, holds=console)
    endpoints = tuple(listen or [DEFAULT_ENDPOINT])
    options = ReplayOptions(choice, rate, tuple(expect or ()), endpoints, federation)
    beside = console_beside(endpoints[0], directory, federation, tls) if console else nullcontext()
    with plugin.names_only(not trust), beside:
        play(directory, options, identity(host, tls, insecure, access))
