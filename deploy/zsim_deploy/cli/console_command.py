"""The command that shows a run in the browser, and steers it."""

from typing import Annotated

import typer

from zsim_deploy.options.arguments import positive
from zsim_deploy.options.reach import Reach, takes_part

PANEL = "Watch and steer"
PORT = 8080
OF_A_RUN = "console.run"  # the one that a run starts: not to be taken over by the first that is started by hand
MODULES = ("aiohttp", "viser")  # of the extra
TOKEN = "ZSIM_TOKEN"  # in the environment: a command line can be read by everybody on the machine

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
@takes_part
def console(
    reach: Reach,
    listen: Annotated[str, typer.Option(help="Address on which the page is served.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port of the page.", min=1, max=65535)] = PORT,
    token: Annotated[
        str | None, typer.Option(envvar=TOKEN, help="What operators must show; needed off loopback.")
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            callback=positive, help="Pictures a second (20; 10 from 20 drones or 4 × real time on).", show_default=False
        ),
    ] = None,
    name: Annotated[
        str,
        typer.Option(help="Process name (default the certificate's, or console.1, .2, …)."),
    ] = "",
) -> None:
    """Show a run in the browser, and steer it: scene, plots, events, faults."""
    check()
    from zsim.runtime.progress import JsonProgress
    from zsim_bridges.console.console_server import Console
    from zsim_bridges.console.http.http_proxy import Place
    from zsim_deploy.roles.priority import give_way
    from zsim_deploy.roles.roles import speaker
    from zsim_deploy.roles.service_loop import named, visit

    give_way(for_eyes=True)
    mine = named("console", name, reach.tls, "*")
    say = JsonProgress().say if reach.launched else speaker(False)
    shown = Console(Place(listen, port), mine.removesuffix(".*"), token, rate_hz, say)
    with shown.open():
        visit(mine, shown.serve, reach)


def check() -> None:
    """Refuse where what the page is made of is not installed.

    Raises:
        RunError: says what to install.
    """
    from importlib.util import find_spec

    from zsim.errors import RunError

    missing = [module for module in MODULES if find_spec(module) is None]
    if missing:
        raise RunError(f"console: {' and '.join(missing)} is not installed; pip install 'zsim[console]'")
