"""The commands that each run one role of a federation."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from zsim.scenario.roles import AGENTS, Role
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import require

if TYPE_CHECKING:
    from zsim.transport.tls import Identity
    from zsim_deploy.roles.roles import Remain, Serve


app = typer.Typer()
SOME_DRONES = "Drones, or patterns: 'drone*'; all that have cameras if not given."
Drones = Annotated[list[str] | None, Argument(metavar="[DRONE]...", help=SOME_DRONES, show_default=False)]


@app.command(rich_help_panel=opt.ROLES)
@opt.flight_options
@opt.listener_options
def world(
    flight: opt.FlightOptions,
    who: "Identity",
    listen: opt.Listen = None,
    expect: Annotated[list[str] | None, Option(help="Wait for this process too, e.g. recorder.")] = None,
    journal: Annotated[
        Path | None, Option(help="Folder of the run's journal, with which a restarted world continues.")
    ] = None,
    all_died: Annotated[bool, Option("--all-died", hidden=True)] = False,
    changed: Annotated[list[str] | None, Option(opt.CHANGED, hidden=True)] = None,
    launched: opt.Launched = None,
) -> None:
    """Run the world: integrates all drones and owns simulated time."""
    require("world", {"agents": ("numba", "scipy")})
    from zsim.scenario import scenario_file
    from zsim.schema import plugin
    from zsim_deploy.roles import world_role

    path, overrides = flight.path, flight.overrides or ()
    # a launcher has written the resolved scenario into the run's folder, and passes the folders of its modules
    modules = plugin.folders() if launched else ()
    loaded = scenario_file.load(
        path, overrides, modules, imports=not launched, seed=flight.seed, duration_s=flight.duration
    )
    mode, pace = flight.mode_and_rate()
    changes = [*(changed or ()), *flight.changed()]
    endpoints = listen or [opt.DEFAULT_ENDPOINT]
    world_role.world(loaded, mode, pace, endpoints, launched, expect, who, journal, all_died, changes)


def _agent_command(name: str, role: Role) -> Callable[..., None]:
    about = str(role.about)
    several_help = f"{about.capitalize()}s, or patterns: '{about}*'."

    def start(things: list[str], reach: opt.WorldAccess) -> None:
        require(name, {"agents": ("scipy",)})
        from zsim_deploy.roles import roles

        roles.agent(roles.agent_of(name, things), reach, roles.process_of(name, things))

    def several(
        reach: opt.WorldAccess,
        things: Annotated[list[str], Argument(metavar=f"{about.upper()}...", help=several_help, show_default=False)],
    ) -> None:
        start(things, reach)

    def one(
        reach: opt.WorldAccess,
        thing: Annotated[str, Argument(metavar=about.upper(), help=f"Name of the {about}.")] = "main",
    ) -> None:
        start([thing], reach)

    return opt.participant_options(several if role.joint else one)


for _name, _role in AGENTS.items():
    _also = ", or of several in one process" if _role.joint else ""
    _help = f"Run the {_name} of one {_role.about}{_also}."
    app.command(_name, rich_help_panel=opt.ROLES, help=_help)(_agent_command(_name, _role))


@app.command("host", rich_help_panel=opt.ROLES)
@opt.several_options
def host_agents(
    reach: opt.WorldAccess,
    names: Annotated[
        list[str], Argument(metavar="NAME...", help="Processes, or patterns: 'estimator.*' controller.main.")
    ],
) -> None:
    """Run several estimators and controllers in one process, which is faster."""
    from zsim_deploy.roles import roles

    roles.agent(roles.host(names), reach)


@app.command("agent", rich_help_panel=opt.ROLES)
@opt.participant_options
def own_agent(
    reach: opt.WorldAccess,
    named: Annotated[
        str,
        Argument(
            metavar="MODULE:CLASS",
            help="A subclass of zsim.Agent; or the process name of one of the scenario's agents, as pilot.drone1.",
            show_default=False,
        ),
    ],
    settings: Annotated[
        list[str] | None, Argument(metavar="[NAME=VALUE]...", help="Arguments of the class.", show_default=False)
    ] = None,
    name: Annotated[str, Option(help="Process name (default: the class's own).", show_default=False)] = "",
) -> None:
    """Run your own agent: a class in a module on PYTHONPATH or in this folder."""
    from zsim.schema import plugin
    from zsim_agents.hosting import AgentSpec
    from zsim_deploy.roles import roles

    if not reach.launched:
        plugin.search(Path.cwd())
    if ":" not in named and not settings:
        roles.agent(roles.host([named]), reach, named)
        return
    spec = AgentSpec.parse([named, *(settings or ())], name)
    roles.agent(spec.make, reach, spec.name)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def record(
    reach: opt.WorldAccess,
    out: Annotated[Path, Option(help=f"Folder for run.mcap; {opt.RUN_ID} in its name is the id of the run.")] = Path(
        "."
    ),
) -> None:
    """Record every message of a federation into run.mcap."""
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()
    roles.recorder(out, reach)


@app.command(rich_help_panel=opt.ROLES)
@opt.listener_options
def router(
    who: "Identity",
    name: Annotated[str, Argument(help="Name of the router.")] = "main",
    listen: Annotated[str, Option(help="Endpoint for its clients.")] = "tcp/127.0.0.1:7448",
    connect: opt.Connect = opt.DEFAULT_ENDPOINT,
    federation: opt.Federation = "zsim",
    realtime: opt.Realtime = False,
    launched: opt.Launched = None,
) -> None:
    """Run a router: connects the clients of one network to a world, or a router, in another."""
    from zsim_deploy.roles import roles

    roles.router(name, listen, connect, federation, "realtime" if realtime else "lockstep", launched, who)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def camera(
    reach: opt.WorldAccess,
    drones: Drones = None,
    name: Annotated[str, opt.process_option("camera.DRONE, camera.main for several")] = "",
) -> None:
    """Render the cameras of one drone, or of several in one process, as JPEG."""
    require("camera", opt.CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    roles.serve_pictures("camera", drones or (), name, reach)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def detect(
    reach: opt.WorldAccess,
    drones: Drones = None,
    diameter: Annotated[
        float | None, Option(callback=opt.positive, help="Of a hat, m (default the scenario's).", show_default=False)
    ] = None,
    name: Annotated[str, opt.process_option("detector.DRONE, detector.main for several")] = "",
) -> None:
    """Detect magenta hats in the pictures of one drone, or of several in one process."""
    require("detect", opt.CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    roles.serve_pictures("detector", drones or (), name, reach, diameter)


def serve_as(
    role: str,
    name: str,
    serve: "Serve",
    reach: opt.WorldAccess,
    thing: str = "main",
    lowered: bool = False,
    remain: "Remain | None" = None,
) -> None:
    """Serve one run after the other, as the process named by role, name and thing.

    `lowered`: with lower priority than the processes that the world waits for; `remain`: called after a launched run.
    """
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.roles import process_name
    from zsim_deploy.roles.stop_channel import lower_priority

    if lowered:
        lower_priority()
    roles.serve_runs(process_name(role, name, reach.who, thing), serve, reach, remain=remain)
