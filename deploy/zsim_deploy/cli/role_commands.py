"""The commands that are one role of a federation each."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from zsim.scenario.role_table import AGENTS, Role
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import require

if TYPE_CHECKING:
    from zsim.transport.tls import Identity
    from zsim_deploy.roles.roles import Drones as Chosen
    from zsim_deploy.roles.roles import Serve

SOME_DRONES = "Drones, or patterns: 'drone*'; all that have cameras if not given."

app = typer.Typer()
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
        Path | None, Option(help="Folder of the run's journal: started again with it, it goes on.")
    ] = None,
    all_died: Annotated[bool, Option("--all-died", hidden=True)] = False,
    changed: Annotated[list[str] | None, Option(opt.CHANGED, hidden=True)] = None,
    launched: opt.Launched = None,
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
    changes = [*(changed or ()), *flight.changed()]
    endpoints = listen or [opt.DEFAULT_ENDPOINT]
    world_role.world(loaded, mode, pace, endpoints, launched, expect, who, journal, all_died, changes)


def _agent_command(name: str, role: Role) -> Callable[..., None]:
    """Return the command of a role that has agents, named after drones or clusters."""
    about = str(role.about)
    several_help = f"{about.capitalize()}s, or patterns: '{about}*'."

    def start(things: list[str], reach: opt.WorldAccess) -> None:
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
    """Run a router: carries the clients of one network to a world, or a router, in another."""
    from zsim_deploy.roles import roles

    roles.router(name, listen, connect, federation, "realtime" if realtime else "lockstep", launched, who)


@app.command(rich_help_panel=opt.ROLES)
@opt.participant_options
def camera(
    reach: opt.WorldAccess,
    drones: Drones = None,
    name: Annotated[str, opt.process_option("camera.DRONE, camera.main for several")] = "",
) -> None:
    """Draw what the cameras of one drone see, or of several in one process, as JPEG."""
    require("camera", opt.CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    serve = partial(roles.camera, names=drones or ())
    _serve_pictures("camera", serve, roles.of_camera, reach, drones, name)


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
    """Find magenta hats in the pictures of one drone, or of several in one process."""
    require("detect", opt.CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    serve = partial(roles.detector, names=drones or (), diameter_m=diameter)
    _serve_pictures("detector", serve, roles.of_detector, reach, drones, name)


def _serve_pictures(
    role: str, serve: "Serve", chosen: "Chosen", reach: opt.WorldAccess, drones: Sequence[str] | None, name: str
) -> None:
    """Serve as a camera or a detector, named after its drone if one alone is named."""
    from zsim_deploy.roles.roles import PATTERN, slack_ns, stands_for

    one = drones[0] if drones and len(drones) == 1 else ""
    thing = one if one and not set(one) & set(PATTERN) else "main"
    does = {"stands_for": partial(stands_for, role, chosen, drones or ()), "slack_ns": partial(slack_ns, role)}
    serve_as(role, name, serve, reach, thing, lowered=True, **does)


def serve_as(
    role: str,
    name: str,
    serve: "Serve",
    reach: opt.WorldAccess,
    thing: str = "main",
    lowered: bool = False,
    **does: Any,
) -> None:
    """Serve one run after the other as the process that a command means.

    Args:
        role, name, thing: of which its name is made.
        serve: what it does in a run.
        lowered: with lower priority than what the world waits for.
        does: what more `serve_runs` is given.
    """
    from zsim_deploy.roles import roles
    from zsim_deploy.roles.roles import process_name
    from zsim_deploy.roles.stop_channel import lower_priority

    if lowered:
        lower_priority()
    roles.serve_runs(process_name(role, name, reach.who, thing), serve, reach, **does)
