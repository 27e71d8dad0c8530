"""The commands that are one role of a federation each."""

from pathlib import Path
from typing import Annotated

import typer

from zsim_deploy.arguments import (
    DEFAULT_ENDPOINT,
    Access,
    Connect,
    Duration,
    Federation,
    Host,
    Insecure,
    Launched,
    RateOption,
    Realtime,
    ScenarioPath,
    Seed,
    Set,
    Tls,
    Wait,
    WorldAccess,
    identity,
    mode_and_rate,
    participant_options,
)

ROLES = "Roles, started by hand, on any machine, in any order"

app = typer.Typer()


@app.command(rich_help_panel=ROLES)
def world(
    scenario: ScenarioPath,
    listen: Annotated[
        list[str] | None, typer.Option(help=f"Endpoint, repeatable (default {DEFAULT_ENDPOINT}).")
    ] = None,
    seed: Seed = None,
    duration: Duration = None,
    realtime: Realtime = False,
    rate: RateOption = None,
    set_: Set = None,
    expect: Annotated[list[str] | None, typer.Option(help="Wait for this process too, e.g. recorder.")] = None,
    launched: Launched = None,
    tls: Tls = None,
    access: Access = None,
    insecure: Insecure = False,
    host: Host = None,
) -> None:
    """Run the world: integrates all drones and owns simulated time."""
    from zsim.scenario import scenario_file
    from zsim_deploy.roles import world_role

    loaded = scenario_file.load(scenario, set_ or (), seed=seed, duration_s=duration)  # it needs no class of the agents
    mode, pace = mode_and_rate(realtime, rate)
    who = identity(host, tls, insecure, access)
    world_role.world(loaded, mode, pace, listen or [DEFAULT_ENDPOINT], launched, expect, who)


@app.command(rich_help_panel=ROLES)
@participant_options
def estimator(
    reach: WorldAccess,
    drones: Annotated[
        list[str],
        typer.Argument(metavar="DRONE...", help="Drones, or patterns: 'drone*'.", show_default=False),
    ],
) -> None:
    """Run the estimator of one drone, or of several in one process."""
    from zsim_deploy.roles import roles

    roles.agent(roles.agent_of("estimator", drones), reach)


@app.command(rich_help_panel=ROLES)
@participant_options
def controller(
    reach: WorldAccess,
    cluster: Annotated[str, typer.Argument(help="Name of the cluster.")] = "main",
) -> None:
    """Run the cluster-space controller of one cluster."""
    from zsim_deploy.roles import roles

    roles.agent(roles.agent_of("controller", [cluster]), reach)


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
    out: Annotated[Path, typer.Option(help="Folder for run.mcap.")] = Path("."),
) -> None:
    """Record every message of a federation into run.mcap."""
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.roles import give_way

    give_way()
    roles.recorder(out / "run.mcap", reach)


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
