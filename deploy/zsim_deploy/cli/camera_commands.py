"""`zsim camera` and `zsim detect`: pictures of what drones see, and what is found in pictures."""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from zsim_deploy.arguments import WorldAccess, participant_options, positive, require

if TYPE_CHECKING:
    from zsim_deploy.roles.roles import Drones as Chosen
    from zsim_deploy.roles.roles import Serve

ROLES = "Roles, started by hand, on any machine, in any order"
CAMERA_NEEDS = {"cameras": ("cv2",)}  # modules by extra
SOME_DRONES = "Drones, or patterns: 'drone*'; all that have cameras if not given."

app = typer.Typer()
Drones = Annotated[list[str] | None, typer.Argument(metavar="[DRONE]...", help=SOME_DRONES, show_default=False)]


@app.command(rich_help_panel=ROLES)
@participant_options
def camera(
    reach: WorldAccess,
    drones: Drones = None,
    name: Annotated[
        str, typer.Option(help="Process name (default camera.DRONE, camera.main for several, or the certificate's).")
    ] = "",
) -> None:
    """Draw what the cameras of one drone see, or of several in one process, as JPEG."""
    require("camera", CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    serve = partial(roles.camera, names=drones or ())
    _serve("camera", serve, roles.of_camera, reach, drones, name)


@app.command(rich_help_panel=ROLES)
@participant_options
def detect(
    reach: WorldAccess,
    drones: Drones = None,
    diameter: Annotated[
        float | None, typer.Option(callback=positive, help="Of a hat, m (default the scenario's).", show_default=False)
    ] = None,
    name: Annotated[
        str,
        typer.Option(help="Process name (default detector.DRONE, detector.main for several, or the certificate's)."),
    ] = "",
) -> None:
    """Find magenta hats in the pictures of one drone, or of several in one process."""
    require("detect", CAMERA_NEEDS)
    from zsim_deploy.roles import roles

    serve = partial(roles.detector, names=drones or (), diameter_m=diameter)
    _serve("detector", serve, roles.of_detector, reach, drones, name)


def _serve(
    role: str, serve: "Serve", chosen: "Chosen", reach: WorldAccess, drones: Sequence[str] | None, name: str
) -> None:
    """Serve one run after the other with lower priority, as the process that the command means."""
    from zsim_deploy.roles.roles import process_name, serve_runs, slack_ns, stands_for
    from zsim_deploy.roles.stop_channel import lower_priority

    lower_priority()
    own_name = process_name(role, name, reach.who, _thing(drones))
    serve_runs(own_name, serve, reach, partial(stands_for, role, chosen, drones or ()), partial(slack_ns, role))


def _thing(drones: Sequence[str] | None) -> str:
    """Return what a process for some drones is named after: the only one, if it is named."""
    one = drones[0] if drones and len(drones) == 1 else ""
    return one if one and not set(one) & set("*?[") else "main"
