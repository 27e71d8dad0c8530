"""The commands for runs on several hosts, from `zsim push` to `zsim down`, plus `zsim certs` and `zsim render`."""

import codecs
import contextlib
import importlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, BadParameter, Option

from zsim.errors import HostsError, RunError, printable
from zsim.scenario.roles import ROUTER, WORLD
from zsim.transport.tls import DAYS
from zsim_deploy import SAFE_PATH
from zsim_deploy import arguments as opt
from zsim_deploy.arguments import failed, note, require, say
from zsim_deploy.hosts import control_socket

UP_NEEDS = {"hosts": ("asyncssh", "cryptography"), "record": ("mcap", "zstandard")}
ALL_FEDERATIONS = ""  # value of --federation that selects all federations
FOLLOW_S = 0.2  # polling interval of a log with --follow, wall time
FIRST_OPERATOR = "main"  # operator who gets a certificate if none is named
DAYS_MIN = 0.05  # about an hour, longer than a flight
DAYS_MAX = 825.0  # the longest lifetime of TLS certificates allowed by CA/Browser Forum ballot 193
WARN = timedelta(days=3)  # remaining lifetime below which `show` warns

app = typer.Typer()
certs = typer.Typer(name="certs", help="Make and show the certificates of a federation.", no_args_is_help=True)
rendering = typer.Typer(
    name="render", help="Write systemd units, compose files or manifests for an inventory.", no_args_is_help=True
)

Hosts = Annotated[Path, Option("--hosts", help="Inventory (YAML): the hosts, and which role runs where.")]
Inventory = Annotated[
    Path, Argument(help="Inventory (YAML): the hosts, and which role runs where.", show_default=False)
]
Federation = Annotated[str, Option(help="Federation of the run.")]
Only = Annotated[
    list[str] | None,
    Option("--only", help="Show only matching roles, drones, formations or hosts, e.g. 'drone1*'. Repeatable."),
]
Sort = Annotated[
    opt.RowOrder | None, Option("--sort", help="Sort key of the rows; numbers are sorted in descending order.")
]
Role = Annotated[str, Argument(help="Process name, e.g. estimator.drone2.", show_default=False)]


@app.command(rich_help_panel=opt.HOSTS)
def push(
    hosts: Hosts,
    host: Annotated[list[str] | None, Option("--host", help="Only this host. Repeatable.")] = None,
    extra: Annotated[
        list[str] | None, Option("--extra", help="Extra to install besides those of the host's roles. Repeatable.")
    ] = None,
) -> None:
    """Install zsim on the hosts, with the extras that their roles need; hosts need ssh and Python, but no internet."""
    import asyncio

    from zsim_deploy import inventory
    from zsim_deploy.hosts.push import PushProgress
    from zsim_deploy.hosts.push import push as push_to
    from zsim_deploy.hosts.wheelhouse import default_cache

    inventory_file = inventory.load(hosts)
    with PushProgress() as stages:
        done = asyncio.run(push_to(inventory_file, host or [], extra or [], stages.update, default_cache()))
    changed = sum(done.values())
    nothing = "nothing to do; all hosts are up to date"
    say(f"installed on {changed} of {len(done)} hosts" if changed else nothing)


@app.command(rich_help_panel=opt.HOSTS)
def doctor(
    scenario: Annotated[
        Path | None, Argument(help="Scenario whose roles are placed on the hosts; without --hosts, the one to fly.")
    ] = None,
    hosts: Annotated[
        Path | None, Option("--hosts", help="Inventory (YAML): the hosts, and which role runs where.")
    ] = None,
    duration: Annotated[float, Option(callback=opt.between(0.1, 1e6), help="Simulated seconds to fly.")] = 20.0,
) -> None:
    """Check every host: ssh, versions, clock, load, and the network between the hosts.

    Without --hosts, fly the scenario as on two different processors, and report whether the flights are identical.
    """
    if hosts is None:
        if scenario is None:
            raise BadParameter("zsim doctor needs a scenario to fly, or --hosts with an inventory")
        require("doctor", opt.FLIGHT_NEEDS)
        if differs := _check_processor(scenario, duration):
            raise failed(differs)
        return
    from zsim.runtime.progress import PipedConsole
    from zsim.scenario import scenario_file
    from zsim_deploy import inventory
    from zsim_deploy.hosts.doctor import check_hosts

    inventory_file = inventory.load(hosts)
    hosts_by_process = inventory.placement(inventory_file, scenario_file.load(scenario)) if scenario else None
    result = check_hosts(inventory_file, hosts_by_process)
    console = PipedConsole()
    for each in result.tables:
        console.print(each)
    for warning in result.warnings:
        note(f"warning: {warning}")
    if result.faults:
        raise HostsError("\n".join(result.faults))
    say("all hosts are ready")


def older_processor() -> dict[str, str]:
    """Return the environment variables that make libraries compute as on an older processor of this architecture."""
    numpy_core = importlib.import_module("numpy._core._multiarray_umath")  # lists the CPU features it dispatches on
    settings = {"NPY_DISABLE_CPU_FEATURES": " ".join(getattr(numpy_core, "__cpu_dispatch__", ()))}
    if platform.machine() in ("x86_64", "AMD64"):
        settings["OPENBLAS_CORETYPE"] = "Nehalem"  # SSE4.2 at most
        settings["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F,-AVX2_Usable,-FMA_Usable"  # old names too
    else:
        settings["OPENBLAS_CORETYPE"] = "ARMV8"
    return {name: value for name, value in settings.items() if value}


def _check_processor(scenario: Path, duration_s: float) -> str:
    """Fly the start of a scenario as on two processors; return where the flights first differ, empty if nowhere.

    The scenario is flown normally; its record is then rerun with the code of the C library, BLAS and numpy for an older
    processor: on x86, one of 2008 without fused multiply-add. zsim's own code gives the same results with both. A
    difference comes from a user's class that calls functions whose results depend on the processor: np.linalg or `@`,
    np.exp on arrays, math.sin. Raise RunError if the scenario cannot be flown in one process.
    """
    with tempfile.TemporaryDirectory(prefix="zsim-doctor-") as folder:
        out = str(Path(folder, "run"))
        flight = ("run", str(scenario), "--in-process", "--no-report", "--out", out, "--duration", f"{duration_s:g}")
        _finished(flight, {}, (0,))
        say(f"{scenario.name}: {duration_s:g} s flown on this processor")
        # --trust adds no risk: the flight has just run the same code.
        code, text = _finished(("rerun", out, "--trust"), older_processor(), (0, 1))
    if code:
        differing_lines = [line for line in text.splitlines() if "differs" in line]
        differences = (
            "; ".join(dict.fromkeys(differing_lines)) or (text.strip() or "it printed nothing").splitlines()[-1]
        )
        return (
            f"{scenario}: on another processor, {differences}; see docs/extending.md, The same bits on every processor"
        )
    say("flown again as on an older processor: identical to the bit")
    return ""


def _finished(arguments: tuple[str, ...], settings: dict[str, str], allowed: tuple[int, ...]) -> tuple[int, str]:
    command = [sys.executable, SAFE_PATH, "-m", "zsim_deploy", *arguments]
    done = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, errors="replace")
    if done.returncode not in allowed:
        last = (done.stderr or done.stdout).strip().splitlines() or ["it printed nothing"]
        raise RunError(f"zsim {arguments[0]} ended with exit code {done.returncode}: {last[-1]}")
    return done.returncode, done.stdout or done.stderr


@app.command(rich_help_panel=opt.HOSTS)
@opt.flight_options
def up(
    flight: opt.FlightOptions,
    hosts: Hosts,
    out: Annotated[Path | None, Option(help="Folder of the run (default runs/NAME-TIME).")] = None,
    insecure: opt.Insecure = False,
    report: opt.Report = True,
    only: Only = None,
    sort: Sort = None,
    force: opt.Force = False,
) -> None:
    """Fly a scenario on several hosts: check them, start all roles over ssh, watch, record, and end everything.

    --only and --sort affect the table alone; every role is started.
    """
    require("up", UP_NEEDS | (opt.REPORT_NEEDS if report else {}))
    from zsim.transport.zenoh_settings import host_launcher_files, require_files
    from zsim_api.run_folder import new_launch, run_directory
    from zsim_deploy import inventory
    from zsim_deploy.cli.run_commands import conclude
    from zsim_deploy.hosts.host_run import HostRun
    from zsim_deploy.hosts.status_table import RowChoice, StatusTable

    loaded = flight.scenario(elsewhere=True)
    inventory_file = inventory.load(hosts)
    inventory_file = inventory.insecure(inventory_file) if insecure else inventory_file
    choice = RowChoice(only or (), sort)
    routers = {f"{ROUTER}.{name}": router.host for name, router in inventory_file.inventory.routers.items()}
    hosts_of = {**routers, **inventory.placement(inventory_file, loaded)}
    choice.check([{"role": role, "host": host} for role, host in hosts_of.items()])
    mode, pace = flight.mode_and_rate()
    count, hosts_count = len(inventory.roles(loaded)), len(inventory_file.inventory.hosts)
    require_files(host_launcher_files(count, hosts_count), f"{count} processes on {hosts_count} hosts")
    was_there = out is not None and out.exists()
    with run_directory(out, loaded, force) as folder:
        try:
            with StatusTable(loaded.duration_s, choice=choice) as status:
                launch = new_launch(mode=mode, rate=pace, changed=tuple(flight.changed()))
                outcome = HostRun(loaded, inventory_file, folder, launch, status).run()
            conclude(outcome, folder, report)
        finally:
            if not was_there:  # rmdir removes only an empty folder: that of a refused run
                with contextlib.suppress(OSError):
                    folder.rmdir()


@app.command(rich_help_panel=opt.HOSTS)
def ps(
    roles: Annotated[
        list[str] | None, Argument(metavar="[ROLE]...", help="Same as --only.", show_default=False)
    ] = None,
    only: Only = None,
    sort: Sort = None,
    federation: Annotated[str, Option(help="Only runs of this federation.")] = ALL_FEDERATIONS,
    as_json: Annotated[bool, Option("--json", help="Print JSON, one line per run.")] = False,
) -> None:
    """Show the processes of runs on this machine: role, host, pid, state, lag, age, messages/s, round trip, restarts.

    A narrow terminal shows fewer columns; --json prints all of them.
    """
    from zsim.presentation import print_table
    from zsim_deploy.hosts.status_table import RowChoice, table

    runs = []
    for name in control_socket.launchers():
        if name == federation or name.startswith(f"{federation}@") or federation == ALL_FEDERATIONS:
            with contextlib.suppress(RunError):  # its launcher was killed or is ending
                runs.append(control_socket.ask(name, "ps"))
    if not runs:
        federation_text = "" if federation == ALL_FEDERATIONS else f" of federation {federation!r}"
        raise RunError(f"no run{federation_text} of `zsim run` or `zsim up` is active on this machine")
    choice = RowChoice([*(roles or ()), *(only or ())], sort)
    choice.check([row for status in runs for row in status["rows"]])
    for status in runs:
        status["rows"] = choice.select(status["rows"])
        if as_json:
            print(json.dumps(status))
        elif status["rows"]:
            clock = status["clock"]
            say(f"{status['out']}: {clock['t_s']:.1f} s, {clock['state']}" if clock else f"{status['out']}")
            print_table(table(status["rows"]))


@app.command(rich_help_panel=opt.HOSTS)
def logs(
    role: Role,
    follow: Annotated[bool, Option("--follow", "-f", help="Keep printing new lines as they are written.")] = False,
    federation: Federation = "zsim",
) -> None:
    """Print the log of a process of the active run; `zsim up` itself shows progress and events."""
    location = control_socket.ask(federation, "where")
    if role not in location["roles"]:
        raise RunError(f"role is {role!r}; must be one of {', '.join(location['roles'])}")
    path = Path(location["out"]) / "logs" / f"{role}.log"
    if not path.exists():
        hint = "its progress and events are shown by `zsim up`, and are in the record"
        note(f"{role} has logged nothing; {hint}" if role == WORLD else f"{role} has logged nothing yet")

    position, is_last = 0, not follow
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    while True:
        if path.exists():
            with path.open("rb") as log:
                log.seek(position)
                new = log.read()
            position += len(new)
            sys.stdout.write(printable(decoder.decode(new)))
            sys.stdout.flush()
        if is_last:
            return
        time.sleep(FOLLOW_S)
        try:
            is_last = control_socket.ask(federation, "where")["out"] != location["out"]
        except RunError:
            is_last = True


@app.command(rich_help_panel=opt.HOSTS)
def restart(role: Role, federation: Federation = "zsim") -> None:
    """Restart a process of the run on its host; the new process takes over from the old one."""
    say(f"restarting {control_socket.ask(federation, 'restart', role=role)}")


@app.command(rich_help_panel=opt.HOSTS)
def move(
    role: Role,
    host: Annotated[str, Argument(help="Host of the inventory.", show_default=False)],
    federation: Federation = "zsim",
) -> None:
    """Move a process of the run to another host."""
    say(f"moving {control_socket.ask(federation, 'move', role=role, host=host)}")


@app.command(rich_help_panel=opt.HOSTS)
def down(federation: Federation = "zsim") -> None:
    """End the active run on all hosts."""
    control_socket.ask(federation, "down")


@certs.command()
def init(
    hosts: Inventory,
    scenario: Annotated[Path, Option(help="Scenario for whose processes certificates are made.", show_default=False)],
    set_: opt.Set = None,
    operator: Annotated[
        list[str] | None,
        Option(
            help=f"NAME or NAME@HOST of an operator to add (default: existing ones, else {FIRST_OPERATOR}). Repeatable."
        ),
    ] = None,
    days: Annotated[
        float, Option(callback=opt.between(DAYS_MIN, DAYS_MAX), help="Lifetime of the certificates, days.")
    ] = DAYS,
    renew: Annotated[bool, Option("--renew", help="Renew all certificates, with the same authority.")] = False,
    force: Annotated[
        bool, Option("--force", help="Make a new authority; earlier certificates become invalid.")
    ] = False,
) -> None:
    """Make certificates that are missing or invalid, their authority, and access control for world and routers."""
    from zsim_deploy import certificates, inventory

    inventory_file, now = inventory.load(hosts), datetime.now(UTC)
    folder = certificates.folder_of(inventory_file)
    operators = [*(operator or ()), *certificates.operators(folder, inventory_file.inventory.hosts)] or [FIRST_OPERATOR]
    requests, access = certificates.enrolment(
        inventory_file, opt.load_scenario(scenario, set_, elsewhere=True), operators
    )
    signer = certificates.authority(folder, now, force)
    lacking = [each for each in requests if renew or certificates.renewal_reason(folder, signer.certificate, each, now)]
    for each in lacking:
        certificates.issue(folder, signer, each, now, days)
    for host, process, rules in access:
        content = json.dumps(rules, indent=2) + "\n"
        certificates.write(folder / host / f"{process}.access.json", content.encode())
    if warning := certificates.exposed_keys(inventory_file):
        note(f"warning: {warning}")
    kept_count = len(requests) - len(lacking)
    say(f"{folder}: {len(lacking)} certificates made, {kept_count} kept; zsim certs show {hosts} lists them")


@certs.command()
def show(hosts: Inventory) -> None:
    """List the certificates with host, process, expiry, addresses and faults."""
    from zsim.presentation import Column, FittedTable, print_table
    from zsim_deploy import certificates, inventory

    inventory_file, now = inventory.load(hosts), datetime.now(UTC)
    folder = certificates.folder_of(inventory_file)
    statuses = certificates.show(folder, now)
    if not statuses:
        raise RunError(f"{folder}: has no certificates; make them with `{certificates.init_command(inventory_file)}`")
    rows, needs_renewal = [], False
    for status in statuses:
        expiry_note = "expires soon" if status.until - now < WARN else ""
        needs_renewal = needs_renewal or bool(expiry_note) or certificates.EXPIRED in status.fault
        until, addresses = f"{status.until:%Y-%m-%d %H:%M}Z", ", ".join(status.addresses)
        rows.append((status.host, status.process, until, addresses, status.fault or expiry_note))
    print_table(FittedTable([Column("", kind) for kind in ("name", "name", "figure", "text", "text")], rows))
    if needs_renewal or any(status.fault for status in statuses):
        note(f"renew them with `{certificates.init_command(inventory_file, renew=needs_renewal)}`")
    if warning := certificates.exposed_keys(inventory_file):
        note(f"warning: {warning}")


Out = Annotated[Path, Option("--out", help="Folder to write to; an earlier rendering there is replaced.")]
ForceRendering = Annotated[
    bool, Option("--force", help="Overwrite files that were not rendered, or were changed since.")
]


@rendering.command()
@opt.flight_options
def systemd(flight: opt.FlightOptions, hosts: Hosts, out: Out, force: ForceRendering = False) -> None:
    """Write HOST/zsim-PROCESS.service and HOST/zsim.target for each host."""
    _render("systemd", flight, hosts, out, force)


@rendering.command()
@opt.flight_options
def compose(flight: opt.FlightOptions, hosts: Hosts, out: Out, force: ForceRendering = False) -> None:
    """Write HOST/compose.yaml and HOST/Dockerfile for each host."""
    _render("compose", flight, hosts, out, force)


@rendering.command()
@opt.flight_options
def kubernetes(
    flight: opt.FlightOptions,
    hosts: Hosts,
    out: Out,
    image: Annotated[str | None, Option(help="Image reference for the nodes (default zsim:VERSION).")] = None,
    force: ForceRendering = False,
) -> None:
    """Write manifests, a Dockerfile, and a script that makes the Secrets from the certificates."""
    _render("kubernetes", flight, hosts, out, force, *([image] if image else []))


def _render(target: str, flight: opt.FlightOptions, hosts: Path, out: Path, force: bool, *more: str) -> None:
    from zsim_deploy import inventory, render

    loaded = flight.scenario(elsewhere=True)
    inventory_file = inventory.load(hosts)
    for remark in inventory.own_programs(inventory_file, loaded):
        note(remark)
    texts = {"systemd": render.systemd, "compose": render.compose, "kubernetes": render.kubernetes}[target](
        inventory_file, loaded, flight.pace(), *more
    )
    removed = render.write(out, target, texts, force)
    removed_text = f"; removed from an earlier rendering: {', '.join(removed)}" if removed else ""
    say(f"{len(texts)} files in {out}{removed_text}")
