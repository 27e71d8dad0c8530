"""`zsim certs`: a small authority, a certificate for each process and host, and who may do what."""

import json
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsim.transport.tls import DAYS
from zsim_deploy.options.arguments import Set, load_scenario

if TYPE_CHECKING:
    from zsim_deploy.inventory.inventory import Placed
    from zsim_deploy.security.certificates import Shown
    from zsim_deploy.security.enrolment import Enrolment

app = typer.Typer(name="certs", help="Make and show the certificates of a federation.", no_args_is_help=True)

Hosts = Annotated[Path, typer.Argument(help="Inventory (YAML): hosts and which role runs where.", show_default=False)]
FIRST_OPERATOR = "main"
DAYS_MIN, DAYS_MAX = (
    0.05,
    825.0,
)  # an hour, longer than a flight; what browsers took at most (CA/Browser Forum, ballot 193)
WARN = timedelta(days=3)  # before a certificate ends, when `show` says so


def _days(value: float) -> float:
    if not DAYS_MIN <= value <= DAYS_MAX:
        raise typer.BadParameter(f"is {value:g}; must be {DAYS_MIN:g} to {DAYS_MAX:g}")
    return value


@app.command()
def init(
    hosts: Hosts,
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
    from zsim_deploy.inventory import inventory
    from zsim_deploy.security import certificates
    from zsim_deploy.security.enrolment import Enrolment, folder_of

    placed = inventory.load(hosts)
    folder = folder_of(placed)
    operators = [*(operator or ()), *certificates.operators(folder, placed.inventory.hosts)] or [FIRST_OPERATOR]
    enrolment = Enrolment(placed, load_scenario(scenario, set_), operators)
    made, kept = _issue_all(folder, enrolment, days, renew, force)
    for host, process, rules in enrolment.access():
        content = json.dumps(rules, indent=2) + "\n"
        certificates.write(folder / host / f"{process}.access.json", content.encode())
    _warn(placed)
    print(f"{folder}: {made} certificates made, {kept} kept; zsim certs show {hosts} lists them")


@app.command()
def show(hosts: Hosts) -> None:
    """List the certificates that are there: for whom, for which addresses, until when."""
    from zsim.errors import RunError
    from zsim_deploy.inventory import inventory
    from zsim_deploy.security import certificates
    from zsim_deploy.security.enrolment import folder_of, init_command

    placed, now = inventory.load(hosts), datetime.now(UTC)
    folder = folder_of(placed)
    found = certificates.show(folder, now)
    if not found:
        raise RunError(f"{folder}: has no certificates; make them with `{init_command(placed)}`")
    for shown in found:
        until = f"{shown.until:%Y-%m-%d %H:%M}Z"
        where = ", ".join(shown.addresses)
        state = shown.fault or _soon(shown, now)
        print(f"{shown.host:<16} {shown.process:<32} {until:<18} {where:<40} {state}".rstrip())
    over = any(_soon(shown, now) or certificates.EXPIRED in shown.fault for shown in found)
    if over or any(shown.fault for shown in found):
        print(f"make them anew with `{init_command(placed, renew=over)}`", file=sys.stderr)
    _warn(placed)


def _issue_all(folder: Path, enrolment: "Enrolment", days: float, renew: bool, force: bool) -> tuple[int, int]:
    """Return how many certificates were made and how many kept."""
    from zsim_deploy.security import certificates

    now = datetime.now(UTC)
    signer = certificates.authority(folder, now, force)
    wanted = enrolment.certificates()
    lacking = [each for each in wanted if renew or certificates.due(folder, signer.certificate, each, now)]
    for each in lacking:
        certificates.issue(folder, signer, each, now, days)
    return len(lacking), len(wanted) - len(lacking)


def _soon(shown: "Shown", now: datetime) -> str:
    return "ends soon" if shown.until - now < WARN else ""


def _warn(placed: "Placed") -> None:
    """Say which private keys others can read."""
    from zsim_deploy.security.credentials import exposed

    if warning := exposed(placed):
        print(f"warning: {warning}", file=sys.stderr)
