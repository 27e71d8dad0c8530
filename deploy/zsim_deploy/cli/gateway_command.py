"""The command that lets in programs that have sockets or HTTP and no Zenoh."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim_deploy.options.reach import LOOK_S, Reach, takes_part

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from zsim.contract.messages import Info
    from zsim.transport.session import Session
    from zsim.transport.tls import Identity

PANEL = "Others come in"
TOKEN = "ZSIM_TOKEN"  # in the environment: a command line can be read by everybody on the machine

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
@takes_part
def gateway(
    reach: Reach,
    listen: Annotated[str, typer.Option(help="Address on which clients come in.")] = "127.0.0.1",
    http: Annotated[int, typer.Option(help="Port of HTTP and WebSocket.", min=1, max=65535)] = 8000,
    lines: Annotated[int, typer.Option(help="Port of JSON lines on TCP.", min=1, max=65535)] = 7470,
    token: Annotated[
        str | None, typer.Option(envvar=TOKEN, help="What clients must show; needed off loopback.")
    ] = None,
    name: Annotated[str, typer.Option(help="Process name (default gateway.main, or the certificate's).")] = "",
) -> None:
    """Let in MATLAB, Octave, C, JavaScript, scripts: JSON lines, WebSocket, REST."""
    from zsim.transport.connection import find_world
    from zsim_bridges.gateway.gateway_server import Doors, Gateway
    from zsim_deploy.roles.priority import give_way
    from zsim_deploy.roles.roles import speaker
    from zsim_deploy.roles.service_loop import named, visit

    give_way()
    who = reach.who
    mine = named("gateway", name, reach.tls)

    def dial(process: str) -> "AbstractContextManager[tuple[Session, Info]]":
        return find_world(reach.endpoint, reach.federation, LOOK_S, identity=_of_seat(who, process))

    doors = Doors(listen, http, lines)
    gate = Gateway(doors, mine, token, dial, speaker(reach.launched is not None), secured=reach.tls is not None)
    with gate.open():
        visit(mine, gate.serve, reach)


def _of_seat(who: "Identity", process: str) -> "Identity":
    """Return who a client's seat is on the network: its certificate lies beside the gateway's."""
    from zsim.errors import SessionError

    if who.tls is None:
        return who
    folder: Path = who.tls.parent / process
    if not folder.is_dir():
        raise SessionError(
            f"{process}: has no certificate here ({folder}); name it in the scenario and in the inventory"
        )
    return who._replace(tls=folder)
