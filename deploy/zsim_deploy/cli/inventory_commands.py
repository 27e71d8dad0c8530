"""`zsim certs` and `zsim render`: from an inventory, certificates and access rights, and files for other launchers."""

import json
import sys
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zsim.errors import printable
from zsim.transport.tls import DAYS
from zsim_deploy.arguments import FlightOptions, Set, flight_options, load_scenario

if TYPE_CHECKING:
    from zsim_deploy.inventory.certificates import CertificateStatus
    from zsim_deploy.inventory.enrolment import Enrolment
    from zsim_deploy.inventory.inventory import InventoryFile

certs = typer.Typer(name="certs", help="Make and show the certificates of a federation.", no_args_is_help=True)

Inventory = Annotated[
    Path, typer.Argument(help="Inventory (YAML): hosts and which role runs where.", show_default=False)
]
FIRST_OPERATOR = "main"
DAYS_MIN = 0.05  # an hour, longer than a flight
DAYS_MAX = 825.0  # what browsers took at most; CA/Browser Forum, ballot 193
WARN = timedelta(days=3)  # before a certificate ends, when `show` warns
rendering = typer.Typer(
    name="render", help="Write systemd units, compose files or manifests for an inventory.", no_args_is_help=True
)

Hosts = Annotated[Path, typer.Option("--hosts", help="Inventory (YAML): which hosts, which role where.")]
Out = Annotated[Path, typer.Option("--out", help="Folder to write into; what was rendered there before is replaced.")]
Force = Annotated[
    bool, typer.Option("--force", help="Overwrite files that no rendering wrote, or that were changed since.")
]


def _days(value: float) -> float:
    if not DAYS_MIN <= value <= DAYS_MAX:
        raise typer.BadParameter(f"is {value:g}; must be {DAYS_MIN:g} to {DAYS_MAX:g}")
    return value


@certs.command()
def init(
    hosts: Inventory,
    scenario: Annotated[Path, typer.Option(help="Scenario whose processes they are for.", show_default=False)],
    set_: Set = None,
    operator: Annotated[
        list[str] | None,
        typer.Option(
            help=f"NAME or NAME@HOST of who looks and commands, beside who is there ({FIRST_OPERATOR} at first)."
        ),
    ] = None,
    days: Annotated[float, typer.Option(callback=_days, help="How long they are good for.")] = DAYS,
    renew: Annotated[bool, typer.Option("--renew", help="Make all of them anew, by the same authority.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Make a new authority; nothing made before is good.")] = False,
) -> None:
    """Make what is missing: authority, certificates, and access control for the world and the routers."""
    from zsim_deploy.inventory import certificates, inventory
    from zsim_deploy.inventory.enrolment import Enrolment, folder_of

    placed = inventory.load(hosts)
    folder = folder_of(placed)
    operators = [*(operator or ()), *certificates.operators(folder, placed.inventory.hosts)] or [FIRST_OPERATOR]
    enrolment = Enrolment(placed, load_scenario(scenario, set_, elsewhere=True), operators)
    made, kept = _issue_all(folder, enrolment, days, renew, force)
    for host, process, rules in enrolment.access():
        content = json.dumps(rules, indent=2) + "\n"
        certificates.write(folder / host / f"{process}.access.json", content.encode())
    _warn(placed)
    print(printable(f"{folder}: {made} certificates made, {kept} kept; zsim certs show {hosts} lists them"))


@certs.command()
def show(hosts: Inventory) -> None:
    """List the certificates that are there: for whom, for which addresses, until when."""
    from zsim.errors import RunError
    from zsim.presentation import Column, FittedTable, print_table
    from zsim_deploy.inventory import certificates, inventory
    from zsim_deploy.inventory.enrolment import folder_of, init_command

    placed, now = inventory.load(hosts), datetime.now(UTC)
    folder = folder_of(placed)
    statuses = certificates.show(folder, now)
    if not statuses:
        raise RunError(f"{folder}: has no certificates; make them with `{init_command(placed)}`")
    rows = [
        (
            status.host,
            status.process,
            f"{status.until:%Y-%m-%d %H:%M}Z",
            ", ".join(status.addresses),
            status.fault or _soon(status, now),
        )
        for status in statuses
    ]
    print_table(FittedTable([Column("", kind) for kind in ("name", "name", "figure", "text", "text")], rows))
    over = any(_soon(status, now) or certificates.EXPIRED in status.fault for status in statuses)
    if over or any(status.fault for status in statuses):
        print(printable(f"make them anew with `{init_command(placed, renew=over)}`"), file=sys.stderr)
    _warn(placed)


def _issue_all(folder: Path, enrolment: "Enrolment", days: float, renew: bool, force: bool) -> tuple[int, int]:
    """Return how many certificates were made and how many kept."""
    from zsim_deploy.inventory import certificates

    now = datetime.now(UTC)
    signer = certificates.authority(folder, now, force)
    wanted = enrolment.certificates()
    lacking = [each for each in wanted if renew or certificates.renewal_reason(folder, signer.certificate, each, now)]
    for each in lacking:
        certificates.issue(folder, signer, each, now, days)
    return len(lacking), len(wanted) - len(lacking)


def _soon(status: "CertificateStatus", now: datetime) -> str:
    return "ends soon" if status.until - now < WARN else ""


def _warn(placed: "InventoryFile") -> None:
    """Print which private keys others can read."""
    from zsim_deploy.inventory.enrolment import exposed_keys

    if warning := exposed_keys(placed):
        print(printable(f"warning: {warning}"), file=sys.stderr)


@rendering.command()
@flight_options
def systemd(flight: FlightOptions, hosts: Hosts, out: Out, force: Force = False) -> None:
    """Write HOST/zsim-PROCESS.service and HOST/zsim.target for every host."""
    from zsim_deploy.render.systemd import render

    _write(out, "systemd", render(*_read(hosts, flight), flight.pace()), force)


@rendering.command()
@flight_options
def compose(flight: FlightOptions, hosts: Hosts, out: Out, force: Force = False) -> None:
    """Write HOST/compose.yaml and HOST/Dockerfile for every host."""
    from zsim_deploy.render.compose import render

    _write(out, "compose", render(*_read(hosts, flight), flight.pace()), force)


@rendering.command()
@flight_options
def kubernetes(
    flight: FlightOptions,
    hosts: Hosts,
    out: Out,
    image: Annotated[str | None, typer.Option(help="Image as the nodes find it (default zsim:VERSION).")] = None,
    force: Force = False,
) -> None:
    """Write the manifests of a run, a Dockerfile, and a script that makes the Secrets from the certificates."""
    from zsim_deploy.render.kubernetes import IMAGE, render

    _write(out, "kubernetes", render(*_read(hosts, flight), flight.pace(), image or IMAGE), force)


def _read(hosts: Path, flight: FlightOptions) -> tuple[Any, Any]:
    """Return the inventory and the scenario; print what has no command in them."""
    from zsim_deploy.inventory import inventory
    from zsim_deploy.inventory.processes import own_programs

    loaded = flight.scenario(elsewhere=True)
    placed = inventory.load(hosts)
    for remark in own_programs(placed, loaded):
        print(printable(remark), file=sys.stderr)
    return placed, loaded


def _write(out: Path, target: str, texts: Mapping[str, str], force: bool) -> None:
    from zsim_deploy.render.rendered_files import write

    removed = write(out, target, texts, force)
    more = f"; removed of an earlier rendering: {', '.join(removed)}" if removed else ""
    print(printable(f"{len(texts)} files in {out}{more}"))
