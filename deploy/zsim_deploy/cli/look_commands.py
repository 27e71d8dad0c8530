"""The commands that look at and poke a running federation: keys, echo, hz, pub, ask."""

import json
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zsim_deploy.options.arguments import positive
from zsim_deploy.options.reach import Reach, looks

if TYPE_CHECKING:
    from zsim.contract.messages import Info
    from zsim.transport.session import Session

PANEL = "Look and poke"

app = typer.Typer()


@app.command(rich_help_panel=PANEL)
@looks
def keys(
    reach: Reach,
) -> None:
    """List the keys that speak, with their message and how many came in a second."""
    from zsim_deploy.cli.inspect import look

    with linked(reach) as (link, _):
        for key, kind, count in look.list_keys(link):
            print(f"{key:<36} {kind:<14} {count:>6}")


@app.command(rich_help_panel=PANEL)
@looks
def echo(
    reach: Reach,
    key: Annotated[str, typer.Argument(help="Key or expression, e.g. drone/drone1/sensor/imu or 'drone/*/truth'.")],
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="Stop after so many messages.")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="Payload as hexadecimal digits.")] = False,
) -> None:
    """Print the messages on a key as JSON lines."""
    from zsim_deploy.cli.inspect import look

    def emit(name: str, message: Any) -> None:
        print(json.dumps({"key": name, "message": message}), flush=True)

    with linked(reach) as (link, _):
        look.echo(link, key, count, emit, raw)


@app.command(rich_help_panel=PANEL)
@looks
def hz(
    reach: Reach,
    key: Annotated[str, typer.Argument(help="Key or expression.")],
    window: Annotated[int, typer.Option(help="Messages that the rate is taken over.", min=2, max=1_000_000)] = 1000,
    seconds: Annotated[float | None, typer.Option(callback=positive, help="Stop after so many seconds.")] = None,
) -> None:
    """Print how often messages come on a key, in wall and in simulated time."""
    from zsim_deploy.cli.inspect import look

    with linked(reach) as (link, _):
        look.hz(link, key, window, seconds or math.inf, lambda line: print(line, flush=True))


@app.command(rich_help_panel=PANEL)
@looks
def pub(
    reach: Reach,
    key: Annotated[str, typer.Argument(help="Key, e.g. drone/drone1/cmd/velocity.")],
    message: Annotated[str, typer.Argument(help='JSON, e.g. \'{"velocity_m_s": [1, 0, 0], "yaw_rate_rad_s": 0}\'.')],
    count: Annotated[int, typer.Option("--count", "-n", min=1, help="How many times.")] = 1,
    rate_hz: Annotated[float, typer.Option(callback=positive, max=1000, help="How often per wall second.")] = 10.0,
) -> None:
    """Send a command to a drone; t_ns, seq and source are filled in."""
    from zsim_deploy.cli.inspect import poke

    with linked(reach) as (link, info):
        sent = poke.publish(link, info, key, message, count, rate_hz)
    print(f"published {sent} on {key}")


@app.command(rich_help_panel=PANEL)
@looks
def ask(
    reach: Reach,
    key: Annotated[str, typer.Argument(help="world/control or cluster/NAME/control.")],
    op: Annotated[str, typer.Argument(help="E.g. pause, resume, step, stop; engage, hold, land, target.")],
    args: Annotated[str, typer.Argument(help="JSON map, e.g. '{\"gates\": 50}'.")] = "{}",
) -> None:
    """Send a request to the world or a controller and print the answer."""
    from zsim_deploy.cli.inspect import poke

    with linked(reach) as (link, _):
        result = poke.ask(link, key, op, args)
    print("ok" if result is None else json.dumps(result))


@contextmanager
def linked(reach: Reach) -> Iterator[tuple["Session", "Info"]]:
    """Yield a session to the federation's hub, and what its world says of the run."""
    from zsim.transport.connection import find_world

    say = partial(print, file=sys.stderr)
    with find_world(reach.endpoint, reach.federation, reach.wait_s, say, reader=True, identity=reach.who) as found:
        try:
            yield found
        except KeyboardInterrupt:  # the usual end of `zsim echo` and `zsim hz`
            sys.exit(130)
