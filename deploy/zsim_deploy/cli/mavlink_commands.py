"""`zsim mavlink`: drones of a run as MAVLink vehicles."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from zsim.errors import RunError
from zsim_deploy.arguments import WorldAccess, participant_options, positive

KEY_BYTES = 32
GCS_PORT, GCS_LOCAL_PORT = 14550, 18570  # PX4's simulation: to the ground station, and the first port here
API_PORT, API_LOCAL_PORT = 14540, 14580  # likewise for programs
PORT_MAX = 65535

app = typer.Typer(
    name="mavlink", no_args_is_help=True, help="MAVLink: the drones of a run as vehicles of PX4 or ArduPilot."
)


@app.callback()
def mavlink() -> None:
    """Keep the commands below this one, also while there is one alone."""


@app.command()
@participant_options
def serve(
    reach: WorldAccess,
    autopilot: Annotated[Literal["px4", "ardupilot"], typer.Option(help="Whose modes and parameters.")] = "px4",
    gcs: Annotated[str, typer.Option(help="The ground station, HOST:PORT.")] = f"127.0.0.1:{GCS_PORT}",
    api: Annotated[
        str | None, typer.Option(help=f"Programs, HOST:PORT of the first; +1 each (default 127.0.0.1:{API_PORT}).")
    ] = None,
    listen: Annotated[str, typer.Option(help="Address on which the vehicles' ports are opened.")] = "127.0.0.1",
    gcs_local: Annotated[
        int | None,
        typer.Option(
            help=f"First port that talks with the ground station; +1 each (default {GCS_LOCAL_PORT}).",
            min=1,
            max=PORT_MAX,
        ),
    ] = None,
    api_local: Annotated[
        int | None,
        typer.Option(
            help=f"First port that talks with programs; +1 each (default {API_LOCAL_PORT}).", min=1, max=PORT_MAX
        ),
    ] = None,
    first_system_id: Annotated[
        int, typer.Option(help="Of the first drone; +1 each. The default ports move with it.", min=1, max=254)
    ] = 1,
    signing_key: Annotated[
        Path | None, typer.Option(help="File with the key of MAVLink 2 signatures; unsigned messages are refused.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(callback=positive, help="Pace to ask of the world, simulated per wall second.")
    ] = None,
    telemetry: Annotated[Literal["normal", "full"], typer.Option(help="Rates of the messages.")] = "normal",
    protocol: Annotated[int, typer.Option(help="Version of MAVLink that is sent; both are read.", min=1, max=2)] = 2,
    name: Annotated[str, typer.Option(help="Process name (default mavlink.main, or the certificate's).")] = "",
) -> None:
    """Offer each drone as a vehicle: QGroundControl, MAVSDK, DroneKit, MAVProxy fly it."""
    from zsim_bridges.mavlink.mavlink_server import MavlinkOptions, MavlinkServer
    from zsim_deploy.roles.process_identity import process_name
    from zsim_deploy.roles.roles import serve_runs

    ahead = first_system_id - 1  # as of PX4's simulation, whose ports go by the system id too
    options = MavlinkOptions(
        autopilot=autopilot,
        level=telemetry,
        listen=listen,
        gcs=_endpoint("--gcs", gcs, listen),
        gcs_local=gcs_local or GCS_LOCAL_PORT + ahead,
        api=_endpoint("--api", api or f"127.0.0.1:{API_PORT + ahead}", listen),
        api_local=api_local or API_LOCAL_PORT + ahead,
        key=read_key(signing_key) if signing_key else None,
        version=1 if protocol == 1 else 2,
        rate=rate,
        first_system_id=first_system_id,
    )
    if options.key and options.version == 1:
        raise typer.BadParameter("--signing-key needs MAVLink 2; leave out --protocol 1")
    serve_runs(process_name("mavlink", name, reach.who), partial(MavlinkServer.serve, options=options), reach)


def _endpoint(option: str, text: str, listen: str) -> tuple[str, int]:
    """Return the address of HOST:PORT."""
    from socket import gaierror, gethostbyname

    from zsim_bridges.web.loopback import is_loopback

    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= PORT_MAX:
        raise typer.BadParameter(f"{option} is {text!r}; must be HOST:PORT")
    try:
        address = gethostbyname(host)
    except (gaierror, UnicodeError) as error:
        raise typer.BadParameter(f"{option} is {text!r}; {host} is no host that is known here") from error
    if is_loopback(listen) and not is_loopback(address):
        raise typer.BadParameter(f"{option} is {text!r}, which {listen} does not reach; give --listen an address")
    return address, int(port)


def read_key(path: Path) -> bytes:
    """Return the key in a file: 32 bytes, 64 hexadecimal digits, or a passphrase, whose SHA-256 it is.

    Raises:
        RunError: the file cannot be read, or is empty.
    """
    from hashlib import sha256

    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); give --signing-key a file with the key") from error
    if len(content) == KEY_BYTES:
        return content
    text = content.strip()
    if not text:
        allowed = f"{KEY_BYTES} bytes, {2 * KEY_BYTES} hexadecimal digits, or a passphrase"
        raise RunError(f"{path}: is empty; must hold {allowed}")
    try:
        key = bytes.fromhex(text.decode())
    except ValueError:
        return sha256(text).digest()
    return key if len(key) == KEY_BYTES else sha256(text).digest()
