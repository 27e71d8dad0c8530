"""The commands that inspect and control a running federation: keys, echo, hz, pub, ask, and `zsim fault`."""

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, BadParameter, Option

from zsim_deploy import INTERRUPTED
from zsim_deploy.arguments import POKE, Trust, WorldAccess, failed, note, observer_options, positive, say
from zsim_deploy.cli.run_commands import note_skipped

if TYPE_CHECKING:
    from zsim.contract.messages import Info
    from zsim.contract.run_messages import Fault
    from zsim.transport.session import Session

SOURCE = "zsim.fault"  # source named in fault requests
ALL = "all"

app = typer.Typer()
faults = typer.Typer(
    name="fault", help="Inject faults into a running federation, and clear them.", no_args_is_help=True
)


@app.command(rich_help_panel=POKE)
@observer_options
def keys(
    reach: WorldAccess,
    expression: Annotated[
        str, Argument(metavar="[KEY]", help="Only keys that match, e.g. 'drone/drone1/**'.", show_default=False)
    ] = "**",
) -> None:
    """List the keys in use, with message type and number of messages within one second."""
    from zsim_deploy.cli import inspection

    with connected(reach) as (link, _):
        rows = inspection.list_keys(link, expression)
        for key, kind, count in rows:
            say(f"{key:<36} {kind:<14} {count:>6}")
        if not rows:
            raise failed(f"no key in use matches {expression}{inspection.keys_like(link, expression)}")


@app.command(rich_help_panel=POKE)
@observer_options
def echo(
    reach: WorldAccess,
    key: Annotated[str, Argument(help="Key or expression, e.g. drone/drone1/sensor/imu or 'drone/*/truth'.")],
    count: Annotated[int | None, Option("--count", "-n", min=1, help="Stop after this many messages.")] = None,
    raw: Annotated[bool, Option("--raw", help="Print payloads as hexadecimal digits.")] = False,
    timeout: Annotated[float | None, Option(callback=positive, help="Stop after this many seconds.")] = None,
) -> None:
    """Print the messages on a key as JSON lines; exit code 1 if too few have arrived when --timeout expires."""
    from zsim_deploy.cli import inspection

    def emit(name: str, message: Any) -> None:
        print(json.dumps({"key": name, "message": message}), flush=True)

    with connected(reach) as (link, _):
        received = inspection.echo(link, key, count, emit, raw, timeout or math.inf, note)
    if received < (count or 1):
        raise failed(f"{received or 'no'} messages on {key} within {timeout:g} s")


@app.command(rich_help_panel=POKE)
@observer_options
def hz(
    reach: WorldAccess,
    key: Annotated[str, Argument(help="Key or expression.")],
    window: Annotated[
        int, Option(help="Number of messages over which the rate is measured.", min=2, max=1_000_000)
    ] = 1000,
    seconds: Annotated[float | None, Option(callback=positive, help="Stop after this many seconds.")] = None,
) -> None:
    """Print the message rate on a key, in wall time and in simulated time."""
    from zsim_deploy.cli import inspection

    with connected(reach) as (link, _):
        received = inspection.hz(link, key, window, seconds or math.inf, say)
    if not received:
        raise failed(f"no message on {key} within {seconds:g} s")


@app.command(rich_help_panel=POKE)
@observer_options
def pub(
    reach: WorldAccess,
    key: Annotated[str, Argument(help="Key, e.g. drone/drone1/cmd/velocity.")],
    message: Annotated[str, Argument(help='JSON, e.g. \'{"velocity_m_s": [1, 0, 0], "yaw_rate_rad_s": 0}\'.')],
    count: Annotated[int, Option("--count", "-n", min=1, help="Number of times to send it.")] = 1,
    rate_hz: Annotated[float, Option(callback=positive, max=1000, help="Messages per wall second.")] = 10.0,
) -> None:
    """Send a command to a drone; t_ns, seq and source are filled in. Exit code 1 if the world refuses it."""
    from zsim_deploy.cli import inspection

    with connected(reach) as (link, info):
        sent = inspection.publish(link, info, key, message, count, rate_hz)
    say(f"published {sent.sent} on {key}")
    if sent.note:
        note(sent.note)
    if sent.refused:
        raise failed(f"refused {sent.refused} of {sent.sent}: {sent.reason}")


@app.command(rich_help_panel=POKE)
@observer_options
def ask(
    reach: WorldAccess,
    key: Annotated[str, Argument(help="world/control, cluster/NAME/control or drone/NAME/control.")],
    op: Annotated[str, Argument(help="Operation, e.g. pause, resume, step, stop; engage, hold, land, target.")],
    args: Annotated[str, Argument(help="Arguments as a JSON object, e.g. '{\"gates\": 50}'.")] = "{}",
) -> None:
    """Send a request to the world, a controller or a pilot, and print the answer. Exit code 1 if it is refused."""
    from zsim_deploy.cli import inspection

    with connected(reach) as (link, _):
        result = inspection.ask(link, key, op, args)
    print("ok" if result is None else json.dumps(result))


@contextmanager
def connected(reach: WorldAccess) -> Iterator[tuple["Session", "Info"]]:
    """Yield a session with the hub of the federation, and the `world/info` of its run."""
    from zsim.transport.connection import find_world

    world = find_world(reach.endpoint, reach.federation, reach.wait_s, note, reader=True, identity=reach.who)
    with world as (link, info):
        try:
            yield link, info
        except KeyboardInterrupt:  # the usual end of `zsim echo` and `zsim hz`
            sys.exit(INTERRUPTED)


def duration(text: str | None) -> str | None:
    """Return an option's text; raise BadParameter if it is not a duration such as 10s, 500ms or 2min."""
    _seconds(text)
    return text


def _seconds(text: str | None) -> float | None:
    from zsim.scenario.faults import typed_duration_s

    try:
        return None if text is None else typed_duration_s(text)
    except ValueError as error:
        raise BadParameter(str(error)) from None


For = Annotated[
    str | None, Option("--for", callback=duration, help="Duration, e.g. 10s, 500ms, 2min (default: until cleared).")
]
At = Annotated[
    str | None, Option("--at", callback=duration, help="Simulated time at which it begins, e.g. 40s (default: now).")
]


@faults.command()
@observer_options
def add(
    reach: WorldAccess,
    target: Annotated[
        str, Argument(help="Drone, link (a/b), process, cluster or world, depending on the kind.", show_default=False)
    ],
    kind: Annotated[str, Argument(help="Kind, one of those that `zsim fault kinds` lists.", show_default=False)],
    parameters: Annotated[
        list[str] | None, Argument(help="NAME=VALUE, e.g. factor=3 or 'value_m=[2, 0, 0]'.", show_default=False)
    ] = None,
    for_: For = None,
    at: At = None,
) -> None:
    """Inject a fault, e.g. `zsim fault add drone2 gps_dropout --for 10s`. Exit code 1 if the world refuses it."""
    from zsim.scenario.faults import typed_parameters

    try:
        values = typed_parameters(parameters or ())
    except ValueError as error:
        raise BadParameter(str(error)) from None
    args = {"kind": kind, "target": target, "for_s": _seconds(for_), "at_s": _seconds(at), **values}
    with connected(reach) as (link, _):
        done = _ask(link, "fault_add", args)
    until = "until it is cleared" if done["until_ns"] is None else f"to {done['until_ns'] / 1e9:.2f} s"
    say(f"fault {done['id']}: {kind} of {target} from {done['from_ns'] / 1e9:.2f} s {until}")


@faults.command()
@observer_options
def clear(
    reach: WorldAccess,
    which: Annotated[str, Argument(help="Number, target or kind of the faults, or all.")] = ALL,
) -> None:
    """End all faults, or those with a given number, target or kind."""
    with connected(reach) as (link, info):
        done = _ask(link, "fault_clear", selector(which, info.scenario))
    cleared = ", ".join(map(str, done["cleared"])) or "nothing: no fault was planned or active"
    say(f"cleared {cleared}")


@faults.command("list")
@observer_options
def list_(reach: WorldAccess) -> None:
    """List the faults that are planned or active."""
    from zsim.contract import keys, messages
    from zsim.presentation import Column, FittedTable, print_table

    with connected(reach) as (link, _):
        now_ns = max((messages.decode(keys.CLOCK, s.payload).t_ns for s in link.get(keys.CLOCK)), default=0)
        answers = [messages.decode(keys.FAULTS, sample.payload) for sample in link.get(keys.FAULTS)]
    faults = [fault for message in answers for fault in message.faults]
    rows = [row(fault, now_ns) for fault in faults if fault.until_ns is None or fault.until_ns > now_ns]
    if rows:
        kinds = ("figure", "figure", "name", "name", "figure", "text")
        print_table(FittedTable([Column("", kind) for kind in kinds], rows))
    else:
        note("no fault is planned or active")


@faults.command()
def kinds(
    scenario: Annotated[
        Path | None, Argument(help="Scenario; the kinds of its custom sensors are listed too.", show_default=False)
    ] = None,
    trust: Trust = False,
) -> None:
    """List the kinds of faults, with their targets and parameters."""
    from zsim.presentation import Column, FittedTable, print_table
    from zsim.scenario import faults as fault_kinds
    from zsim.scenario import scenario_file
    from zsim.schema import plugin
    from zsim.sensors.sensor_catalogue import declarations

    with plugin.names_only(not trust) as skipped:
        own = declarations(scenario_file.load(scenario).drones) if scenario else {}
    rows = []
    for name, kind in fault_kinds.kinds_of(own).items():
        parameters = [
            f"{parameter.name}: {fault_kinds.expected(parameter)}{'' if parameter.required else ' (optional)'}"
            for parameter in kind.parameters
        ]
        needed = ["--for is required"] if kind.lasts == "ends" else []
        rows.append((name, kind.strikes, "  ".join([*parameters, *needed]) or "-"))
    print_table(FittedTable([Column("", "name"), Column(""), Column("", "text")], rows))
    note_skipped(skipped)


def selector(which: str, scenario: str) -> dict[str, Any]:
    """Return the arguments of `fault_clear` for a word from the command line.

    `which`: a number, kind or target, or ALL; `scenario`: text of the run's scenario, which may add kinds.
    """
    from zsim.scenario import faults as fault_kinds
    from zsim.scenario import scenario_file
    from zsim.sensors.sensor_catalogue import declarations

    if which == ALL:
        return {}
    if which.isdecimal():
        return {"id": int(which)}
    kinds_by_name = fault_kinds.kinds_of(declarations(scenario_file.from_text(scenario).drones))
    return {"kind" if which in kinds_by_name else "target": which}


def row(fault: "Fault", now_ns: int) -> tuple[str, ...]:
    until = "..." if fault.until_ns is None else f"{fault.until_ns / 1e9:.2f}"
    state = "active" if fault.from_ns <= now_ns else "planned"
    parameters = " ".join(f"{name}={value}" for name, value in fault.parameters.items() if value is not None)
    times = f"{fault.from_ns / 1e9:.2f} to {until} s"
    return (str(fault.id), state, fault.target, fault.kind, times, parameters)


def _ask(link: "Session", op: str, args: dict[str, Any]) -> dict[str, Any]:
    from zsim.contract import keys
    from zsim.transport.session import result_of

    arguments = {name: value for name, value in args.items() if value is not None}
    return result_of(link.request(keys.CONTROL, op, SOURCE, arguments))
