"""The commands of a run on several hosts: push, doctor, up, ps, logs, restart, move, down."""

import codecs
import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from zsim.errors import printable
from zsim_deploy.arguments import HOSTS, REPORT_NEEDS, FlightOptions, Force, Insecure, flight_options, require
from zsim_deploy.hosts.row_choice import RowChoice, RowOrder

app = typer.Typer()

UP_NEEDS = {"hosts": ("asyncssh", "cryptography"), "record": ("mcap", "zstandard")}  # modules by extra
EVERY = ""  # federation
FOLLOW_S = 0.2  # between two looks at a log that is followed

Hosts = Annotated[Path, typer.Option("--hosts", help="Inventory (YAML): which hosts, which role where.")]
Federation = Annotated[str, typer.Option(help="Federation that is up.")]
Only = Annotated[
    list[str] | None,
    typer.Option("--only", help="Only roles that match, or what they work for, or hosts: 'drone1*'. Repeatable."),
]
Sort = Annotated[RowOrder | None, typer.Option("--sort", help="By what rows are sorted, the greatest figure first.")]
Role = Annotated[str, typer.Argument(help="Process name, e.g. estimator.drone2.", show_default=False)]


@flight_options
def up(
    flight: FlightOptions,
    hosts: Hosts,
    out: Annotated[Path | None, typer.Option(help="Folder of the run (default runs/NAME-TIME).")] = None,
    insecure: Insecure = False,
    report: Annotated[bool, typer.Option(help="Make the report at the end.")] = True,
    only: Only = None,
    sort: Sort = None,
    force: Force = False,
) -> None:
    """Fly a scenario on several hosts: check them, start every role over ssh, watch, record, end everything.

    --only and --sort are of the table that is shown; every role is started whatever they are.
    """
    require("up", UP_NEEDS | (REPORT_NEEDS if report else {}))
    from zsim.scenario.rights import ROUTER
    from zsim.transport.zenoh_settings import host_launcher_files, require_files
    from zsim_deploy.cli.record_commands import conclude
    from zsim_deploy.hosts.host_run import HostRun, HostRunOptions
    from zsim_deploy.hosts.status_table import StatusTable
    from zsim_deploy.inventory import inventory

    loaded = flight.scenario(elsewhere=True)
    placed = inventory.load(hosts)
    placed = inventory.insecure(placed) if insecure else placed
    choice = RowChoice(only or (), sort)
    routers = {f"{ROUTER}.{name}": router.host for name, router in placed.inventory.routers.items()}
    hosts_of = {**routers, **inventory.placement(placed, loaded)}
    choice.check([{"role": role, "host": host} for role, host in hosts_of.items()])
    mode, pace = flight.mode_and_rate()
    count, hosts_count = len(inventory.roles(loaded)), len(placed.inventory.hosts)
    require_files(host_launcher_files(count, hosts_count), f"{count} processes on {hosts_count} hosts")
    with _folder(out, loaded, force) as folder:
        with StatusTable(loaded.duration_s, choice=choice) as status:
            options = HostRunOptions(loaded, placed, folder, mode, pace, changed=flight.changed())
            outcome = HostRun(options, status).run()
        conclude(outcome, folder, report)


@contextlib.contextmanager
def _folder(out: Path | None, scenario: Any, force: bool) -> Iterator[Path]:
    """Yield a folder for a run, which is removed again if the run was refused and nothing is in it."""
    from zsim_deploy.launch.run_folder import make_directory

    was_there = out is not None and out.exists()
    folder = make_directory(out, scenario, force)
    try:
        yield folder
    finally:
        if not was_there:
            with contextlib.suppress(OSError):
                folder.rmdir()


def down(federation: Federation = "zsim") -> None:
    """End the run that is up, on all hosts."""
    from zsim_deploy.hosts import control_socket

    control_socket.ask(federation, "down")


def ps(
    roles: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ROLE]...", help="The same as --only.", show_default=False),
    ] = None,
    only: Only = None,
    sort: Sort = None,
    federation: Annotated[str, typer.Option(help="Only runs of this federation.")] = EVERY,
    as_json: Annotated[bool, typer.Option("--json", help="As a JSON line.")] = False,
) -> None:
    """Show the processes of the runs on this machine: role, host, pid, state, lag, age, messages/s, restarts.

    A narrow terminal shows fewer columns, --json all of them, in a line for each run.
    """
    from zsim.errors import RunError
    from zsim.terminal.fitted_table import print_table
    from zsim_deploy.hosts import control_socket
    from zsim_deploy.hosts.status_table import table

    runs = []
    for name in control_socket.launchers():
        if name == federation or name.startswith(f"{federation}@") or federation == EVERY:
            with contextlib.suppress(RunError):  # its launcher was killed, or ends
                runs.append(control_socket.ask(name, "ps"))
    if not runs:
        whose = "" if federation == EVERY else f" of federation {federation!r}"
        raise RunError(f"no run{whose} that `zsim run` or `zsim up` has started goes on on this machine")
    choice = RowChoice([*(roles or ()), *(only or ())], sort)
    choice.check([row for status in runs for row in status["rows"]])
    for status in runs:
        status["rows"] = choice.of(status["rows"])
        if as_json:
            print(json.dumps(status))
        elif status["rows"]:
            print(printable(_run_line(status)))
            print_table(table(status["rows"]))


def _run_line(status: dict[str, Any]) -> str:
    clock = status["clock"]
    return f"{status['out']}: {clock['t_s']:.1f} s, {clock['state']}" if clock else f"{status['out']}"


@contextlib.contextmanager
def seen_by_ps(federation: str, status: Callable[[], dict[str, Any]]) -> Iterator[None]:
    """Let `zsim ps` see a run of this process while it lasts; a machine without a place to listen goes without."""
    from zsim.errors import RunError

    with contextlib.ExitStack() as stack:
        with contextlib.suppress(RunError, ImportError):  # no such sockets on Windows
            from zsim_deploy.hosts import control_socket

            name = control_socket.of_run(federation)
            stack.enter_context(control_socket.ControlSocket(name, {"ps": status}))
        yield


def logs(
    role: Role,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what is written from now on.")] = False,
    federation: Federation = "zsim",
) -> None:
    """Print the log of a process of the run that is up; progress and events are shown by `zsim up` itself."""
    from zsim.errors import RunError
    from zsim_deploy.hosts import control_socket

    where = control_socket.ask(federation, "where")
    if role not in where["roles"]:
        raise RunError(f"role is {role!r}; must be one of {', '.join(where['roles'])}")
    path = Path(where["out"]) / "logs" / f"{role}.log"
    if not path.exists():
        print(printable(_silent(role)), file=sys.stderr)
    for text in _written(path, follow, lambda: _is_up(federation, where["out"])):
        sys.stdout.write(printable(text))
        sys.stdout.flush()


def _written(path: Path, follow: bool, goes_on: Callable[[], bool]) -> Iterator[str]:
    """Yield the content of a file, which may not exist yet, and what is appended while the run goes on."""
    done, last = 0, not follow
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    while True:
        if path.exists():
            with path.open("rb") as log:
                log.seek(done)
                new = log.read()
            done += len(new)
            yield decoder.decode(new)
        if last:
            return
        time.sleep(FOLLOW_S)
        last = not goes_on()


def _silent(role: str) -> str:
    """Return why the log of a role is empty."""
    from zsim.scenario.rights import WORLD

    if role == WORLD:
        return "world has logged nothing; its progress and events are shown by `zsim up`, and are in the record"
    return f"{role} has logged nothing yet"


def _is_up(federation: str, out: str) -> bool:
    """Return whether the launcher of a federation still has the run of this folder."""
    from zsim.errors import RunError
    from zsim_deploy.hosts import control_socket

    try:
        return control_socket.ask(federation, "where")["out"] == out
    except RunError:
        return False


def restart(role: Role, federation: Federation = "zsim") -> None:
    """Start a process of the run anew where it is; it takes over from its former self."""
    from zsim_deploy.hosts import control_socket

    print(printable(f"restarting {control_socket.ask(federation, 'restart', role=role)}"))


def move(
    role: Role,
    host: Annotated[str, typer.Argument(help="Host of the inventory.", show_default=False)],
    federation: Federation = "zsim",
) -> None:
    """Let another host run a process of the run from now on."""
    from zsim_deploy.hosts import control_socket

    print(printable(f"moving {control_socket.ask(federation, 'move', role=role, host=host)}"))


def doctor(
    hosts: Hosts,
    scenario: Annotated[Path | None, typer.Argument(help="Scenario whose roles are to be placed.")] = None,
) -> None:
    """Check every host: ssh, versions, clock, load, and how the hosts reach each other."""
    from zsim.errors import HostsError
    from zsim.runtime.progress import PipedConsole
    from zsim_deploy.hosts.doctor import check_hosts
    from zsim_deploy.inventory import inventory

    placed = inventory.load(hosts)
    result = check_hosts(placed, _placement(placed, scenario))
    console = PipedConsole()
    for shown in result.tables:
        console.print(shown)
    for warning in result.warnings:
        print(printable(f"warning: {warning}"), file=sys.stderr)
    if result.faults:
        raise HostsError("\n".join(result.faults))
    print("all hosts are ready")


def _placement(placed: Any, scenario: Path | None) -> dict[str, str] | None:
    from zsim.scenario import scenario_file
    from zsim_deploy.inventory import inventory

    return inventory.placement(placed, scenario_file.load(scenario)) if scenario else None


def push(
    hosts: Hosts,
    host: Annotated[list[str] | None, typer.Option("--host", help="Only this host. Repeatable.")] = None,
    extra: Annotated[
        list[str] | None, typer.Option("--extra", help="An extra beside those of the host's roles. Repeatable.")
    ] = None,
) -> None:
    """Install zsim on the hosts, each with the extras that its roles need; they need ssh and Python, no internet."""
    import asyncio

    from zsim_deploy.inventory import inventory
    from zsim_deploy.push.push import PushProgress, default_cache
    from zsim_deploy.push.push import push as push_to

    placed = inventory.load(hosts)
    with PushProgress() as stages:
        done = asyncio.run(push_to(placed, host or [], extra or [], stages.update, default_cache()))
    changed = sum(done.values())
    nothing = "nothing to do; all hosts have what they need"
    print(printable(f"installed on {changed} of {len(done)} hosts" if changed else nothing))


for _command in (push, doctor, up, ps, logs, restart, move, down):
    app.command(rich_help_panel=HOSTS)(_command)
