"""`zsim certs`: a small authority, a certificate for each process and host, and who may do what."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from zsim_deploy.certificates import Shown
    from zsim_deploy.enrolment import Enrolment
    from zsim_deploy.inventory import Placed

app = typer.Typer(name="certs", help="Make and show the certificates of a federation.", no_args_is_help=True)

Hosts = Annotated[Path, typer.Argument(help="Inventory (YAML): hosts and which role runs where.", show_default=False)]
OPERATOR = "main"
WARN = timedelta(days=3)  # before a certificate ends, when `show` says so


@app.command()
def init(
    hosts: Hosts,
    scenario: Annotated[Path, typer.Option(help="Scenario whose processes they are for.", show_default=False)],
    set_: Annotated[list[str] | None, typer.Option("--set", help="Override a field of the scenario.")] = None,
    operator: Annotated[
        list[str] | None, typer.Option(help=f"NAME or NAME@HOST of who looks and commands (default {OPERATOR}).")
    ] = None,
    days: Annotated[float, typer.Option(min=0.0, max=825.0, help="How long they are good for.")] = 30.0,
    renew: Annotated[bool, typer.Option("--renew", help="Make all of them anew, by the same authority.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Make a new authority; nothing made before is good.")] = False,
) -> None:
    """Make what is missing: authority, certificates, and access control for the world and the routers."""
    from zsim import scenario_file
    from zsim_deploy import inventory
    from zsim_deploy.enrolment import Enrolment

    placed = inventory.load(hosts)
    enrolment = Enrolment(placed, scenario_file.load(scenario, set_ or ()), operator or [OPERATOR])
    folder = folder_of(placed)
    made, kept = _issue_all(folder, enrolment, days, renew, force)
    for host, process, rules in enrolment.access():
        place = folder / host / f"{process}.access.json"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(json.dumps(rules, indent=2) + "\n")
    print(f"{folder}: {made} certificates made, {kept} kept; zsim certs show {hosts} lists them")


@app.command()
def show(hosts: Hosts) -> None:
    """List the certificates that are there: for whom, for which addresses, until when."""
    from zsim_deploy import certificates, inventory

    now = datetime.now(UTC)
    for shown in certificates.show(folder_of(inventory.load(hosts)), now):
        until = f"{shown.until:%Y-%m-%d %H:%M}Z"
        where = ", ".join(shown.addresses)
        print(f"{shown.host:<16} {shown.process:<32} {until:<18} {where:<40} {_state(shown, now)}".rstrip())


def folder_of(placed: "Placed") -> Path:
    """Return the folder of an inventory's certificates."""
    return placed.folder / Path(placed.inventory.security.certificates).expanduser()


def _issue_all(folder: Path, enrolment: "Enrolment", days: float, renew: bool, force: bool) -> tuple[int, int]:
    """Return how many certificates were made and how many kept."""
    from zsim_deploy import certificates

    now = datetime.now(UTC)
    signer = certificates.authority(folder, now, force)
    wanted = enrolment.certificates()
    lacking = [each for each in wanted if renew or certificates.due(folder, signer, each, now)]
    for each in lacking:
        certificates.issue(folder, signer, each, now, days)
    return len(lacking), len(wanted) - len(lacking)


def _state(shown: "Shown", now: datetime) -> str:
    if shown.fault:
        return f"{shown.fault}; run zsim certs init"
    return "ends soon; run zsim certs init --renew" if shown.until - now < WARN else ""
