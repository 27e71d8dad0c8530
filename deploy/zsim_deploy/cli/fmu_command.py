"""`zsim fmu`: an FMU from Simulink, Modelica or Dymola as an agent in the lockstep."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, BadParameter, Option

from zsim_deploy import arguments as opt
from zsim_deploy.arguments import require

FMU_NEEDS = {"fmu": ("fmpy",)}

app = typer.Typer()


@app.command(rich_help_panel=opt.TRANSLATE)
@opt.participant_options
def fmu(
    reach: opt.WorldAccess,
    path: Annotated[
        Path, Argument(metavar="FILE", help="The FMU: FMI 2 or 3, for co-simulation. Trust it: it is run.")
    ],
    drone: Annotated[str | None, Option(help="The drone that places mean that name none.", show_default=False)] = None,
    map_: Annotated[
        list[str] | None,
        Option("--map", metavar="NAME=PLACE", help="vx=velocity_m_s.0, or z=drone2/estimate.position_m.2. Repeatable."),
    ] = None,
    param: Annotated[
        list[str] | None, Option(metavar="NAME=VALUE", help="Start value of a parameter or an input. Repeatable.")
    ] = None,
    period: Annotated[
        float | None,
        opt.positive_option("Communication step, s (default what the FMU suggests, or the gate).", show_default=False),
    ] = None,
    takeoff: Annotated[
        float | None,
        Option(
            callback=opt.not_negative, help="When the drones that it commands take off, s; others' task if not given."
        ),
    ] = None,
    frame: Annotated[Literal["heading", "world"], Option(help="Of velocity commands.")] = "heading",
    log: Annotated[bool, Option("--log", help="Print all that the FMU logs, not only warnings and errors.")] = False,
    name: Annotated[
        str, Option(help="Process name (default fmu.DRONE, or the certificate's); controller.main replaces that one.")
    ] = "",
) -> None:
    """Let an FMU of Simulink, Modelica, Dymola or pythonfmu control drones, or estimate."""
    require("fmu", FMU_NEEDS)
    from zsim_bridges.fmu.agent import Fmu
    from zsim_deploy.roles import roles

    params = {}
    for text in param or ():
        variable, equals, value = text.partition("=")
        if not equals or not variable:
            raise BadParameter(f"--param is {text!r}; must be NAME=VALUE")
        params[variable] = value
    own_name = roles.process_name("fmu", name, reach.who, drone or "main")
    made = Fmu(
        path,
        drone,
        map_ or (),
        name=own_name,
        period_s=period,
        param=params,
        takeoff_s=takeoff,
        frame=frame,
        log=log,
        say=roles.log_printer(reach.launched),
    )
    roles.agent(made, reach, own_name)
