"""`zsim ardrone`: the drones of a run on the AR.Drone's wire."""

from functools import partial
from typing import Annotated

import typer

from zsim_deploy.arguments import WorldAccess, participant_options, positive

FIRST_ADDRESS = "127.0.0.2"  # of the first drone; 127.0.0.1 is where programs on this host send from

ardrone = typer.Typer(name="ardrone", help="Programs for the AR.Drone fly drones of a run.", no_args_is_help=True)


@ardrone.command()
@participant_options
def serve(
    reach: WorldAccess,
    addresses: Annotated[
        str,
        typer.Option(help="Address of the first drone, the others follow it; or DRONE=ADDRESS,DRONE=ADDRESS."),
    ] = FIRST_ADDRESS,
    peer: Annotated[
        list[str] | None,
        typer.Option(help="Host that is obeyed on addresses that are not loopback. Repeatable.", show_default=False),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(callback=positive, help="Simulated per wall second, asked of the world.", show_default=False),
    ] = None,
    name: Annotated[str, typer.Option(help="Process name (default ardrone.main, or the certificate's).")] = "",
) -> None:
    """Offer each drone as an AR.Drone 2.0 on an address of its own."""
    from zsim_bridges.ardrone.ardrone_server import ArdroneOptions, ArdroneServer
    from zsim_bridges.ardrone.ports import peer_addresses
    from zsim_deploy.roles.process_identity import process_name
    from zsim_deploy.roles.roles import serve_runs

    options = ArdroneOptions(addresses, peer_addresses(peer or ()), rate)
    serve_runs(process_name("ardrone", name, reach.who), partial(ArdroneServer.serve, options=options), reach)
