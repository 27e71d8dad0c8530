"""Shared parts of the commands: common options, the types that combine their values, and terminal output."""

import inspect
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Argument, BadParameter, Exit, Option

from zsim.contract.run_messages import RATE_MAX
from zsim.errors import RunError, install_command, printable
from zsim_analysis.report import FORMATS

if TYPE_CHECKING:
    from zsim.transport.tls import Identity

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
CONNECT_VARIABLE = "ZSIM_CONNECT"  # environment variable: default of --connect
RUN_ID = "{run}"  # stands for the run's id in the name of a record's folder, so that a restarted recorder finds it
CONSOLE_PORT = 8080  # TCP port of the console's page
PORT_MAX = 65535
REALTIME = "--realtime"  # option of the world, and of routers, whose lease it shortens
CHANGED = "--changed"  # option of the world: overrides that the launcher's resolved scenario already contains
LOOK_S = 5.0  # wall time for which an interactive command waits for a world

# Panels in the help of `zsim`
RUN, HOSTS = "Run", "On several machines"
ROLES = "Roles, started by hand, on any machine, in any order"
WATCH, TRANSLATE, POKE = "Watch and control", "Bridges and gateways", "Inspect and send"

# Modules that a command needs, by the extra that installs them
CAMERA_NEEDS = {"cameras": ("cv2",)}
CONSOLE_NEEDS = {"console": ("aiohttp", "viser")}
FLIGHT_NEEDS = {"record": ("mcap", "zstandard"), "world": ("numba",), "agents": ("scipy",)}
REPORT_NEEDS = {"report": ("matplotlib", "jinja2", "mcap", "zstandard")}


def say(text: str) -> None:
    print(printable(text), flush=True)


def note(text: str) -> None:
    print(printable(text), file=sys.stderr, flush=True)


def failed(cause: str) -> Exit:
    """Print the cause of exit code 1 as the last line of a command; return the exception to raise."""
    note(cause)
    return Exit(1)


@contextmanager
def working(text: str) -> Iterator[Callable[[str], None]]:
    """Show a status text on a terminal for the duration of the block; yield a function that changes it."""
    from rich.console import Console

    from zsim.runtime.progress import cell

    with Console(stderr=True).status(text) as status:
        yield lambda text: status.update(cell(text))


def require(command: str, needs: Mapping[str, Sequence[str]]) -> None:
    """Raise RunError if modules that a command needs are missing; `needs`: modules by the extra that installs them."""
    missing = {module: extra for extra, modules in needs.items() for module in modules if find_spec(module) is None}
    if missing:
        lacking = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed"
        raise RunError(f"{command}: {lacking}; {install_command(missing.values())}")


def _check(is_allowed: Callable[[float], bool], allowed: str) -> Callable[[float | None], float | None]:
    def check(value: float | None) -> float | None:
        if value is not None and not is_allowed(value):
            raise BadParameter(f"is {value:g}; must be {allowed}")
        return value

    return check


finite = _check(math.isfinite, "a finite number")
positive = _check(lambda value: 0 < value < math.inf, "a finite number > 0")
not_negative = _check(lambda value: 0 <= value < math.inf, "a finite number >= 0")


def between(minimum: float, maximum: float) -> Callable[[float | None], float | None]:
    return _check(lambda value: minimum <= value <= maximum, f">= {minimum:g} and <= {maximum:g}")


def check_range(from_: float | None, to: float | None) -> None:
    if from_ is not None and to is not None and to < from_:
        raise BadParameter(f"--to is {to:g}, before --from {from_:g}; must be at or after it")


def endpoint_origin(text: str, arguments: Sequence[str], environment: Mapping[str, str]) -> str:
    """Return an error text, with a note if the endpoint that it names is from CONNECT_VARIABLE."""
    value = environment.get(CONNECT_VARIABLE)
    is_given = any(each.partition("=")[0] == "--connect" for each in arguments)
    return f"{text} ({value} is from {CONNECT_VARIABLE})" if value and value in text and not is_given else text


class RowOrder(StrEnum):
    """Sort keys of `zsim ps` and `zsim up`; numbers are sorted in descending order."""

    ROLE = "role"
    HOST = "host"
    STATE = "state"
    AGE = "age"
    LAG = "lag"
    MESSAGES = "messages"
    RESTARTS = "restarts"
    ATTENTION = "attention"


ScenarioPath = Annotated[Path, Argument(help="Scenario file (YAML).", show_default=False)]
Set = Annotated[list[str] | None, Option("--set", help="Override a field: a.b.c=value. Repeatable.")]
Seed = Annotated[int | None, Option(help="Seed, instead of the scenario's.")]
Duration = Annotated[float | None, Option(help="Duration in simulated seconds, instead of the scenario's.")]
Realtime = Annotated[bool, Option(REALTIME, help="Pace by the wall clock, without waiting for any process.")]
Rate = Annotated[
    float | None, Option(help="Simulated seconds per wall second (default: realtime 1, lockstep unpaced).")
]
Connect = Annotated[str, Option("--connect", envvar=CONNECT_VARIABLE, help="Endpoint of the world or a router.")]
Federation = Annotated[str, Option(envvar="ZSIM_FEDERATION", help="Name of the federation, the prefix of its keys.")]
Wait = Annotated[float | None, Option(callback=not_negative, help="Seconds to wait for a world (default: no limit).")]
Launched = Annotated[str | None, Option("--launched", hidden=True)]  # id of the run whose launcher started the process
Tls = Annotated[Path | None, Option("--tls", help="Folder of this process's certificate (zsim certs init).")]
Access = Annotated[Path | None, Option("--access", help="File with Zenoh's access-control rules (zsim certs init).")]
Host = Annotated[str | None, Option("--host", help="Name of this host, as shown to others.")]
Insecure = Annotated[bool, Option("--insecure", help="Run without TLS, on a private network.")]
Keys = Annotated[
    list[str] | None, Option(help="Only these keys, e.g. 'drone/*/truth'. Repeatable.", show_default=False)
]
Trust = Annotated[bool, Option("--trust", help="Import the modules that the scenario names, which runs their code.")]
From = Annotated[float | None, Option("--from", callback=not_negative, help="Start of the range, simulated seconds.")]
To = Annotated[float | None, Option("--to", callback=not_negative, help="End of the range, simulated seconds.")]
Force = Annotated[bool, Option("--force", help="Replace an earlier run in the folder; other files there are kept.")]
Report = Annotated[bool, Option(help="Make the report at the end of the run.")]
Workers = Annotated[int | None, Option(min=1, max=1024, help="Number of processes (default: one per core).")]
Formats = Annotated[
    str | None, Option("--format", help="Additional formats of the figures: pdf, svg or pdf,svg.", show_default=False)
]
Listen = Annotated[list[str] | None, Option(help=f"Endpoint to listen on (default {DEFAULT_ENDPOINT}). Repeatable.")]
Recorded = Annotated[Path, Argument(metavar="DIR", help="Folder of a run, or its run.mcap.", show_default=False)]


def figure_formats(text: str | None) -> tuple[str, ...]:
    """Return the formats in a value of --format; raise BadParameter for an unknown one."""
    formats = tuple(text.split(",")) if text else ()
    if not set(formats) <= set(FORMATS):
        raise BadParameter(f"--format is {text!r}; must be {' or '.join(FORMATS)}, or both separated by a comma")
    return formats


def process_option(default: str) -> Any:
    """Return the option for the name of a process; `default`: the process's name without a certificate."""
    return Option(help=f"Process name (default {default}, or the certificate's).")


def port_option(text: str, minimum: int = 1, **more: Any) -> Any:
    return Option(min=minimum, max=PORT_MAX, help=text, **more)


def positive_option(text: str, **more: Any) -> Any:
    return Option(callback=positive, help=text, **more)


def identity(host: str | None, tls: Path | None, insecure: bool, access: Path | None = None) -> "Identity":
    from zsim.transport.tls import Identity

    plain = Identity(tls=tls, access=access, insecure=insecure)
    return plain._replace(host=host) if host else plain


def load_scenario(
    path: Path,
    overrides: list[str] | None,
    seed: int | None = None,
    duration: float | None = None,
    elsewhere: bool = False,
    modules: Iterable[Path] = (),
) -> Any:
    """Load a scenario with the overrides of the command line.

    `elsewhere`: the scenario is flown on other hosts; `modules`: further folders with modules that it names.
    """
    from zsim.scenario import scenario_file
    from zsim_agents.hosting import check_classes

    scenario = scenario_file.load(path, overrides or (), modules, seed=seed, duration_s=duration)
    check_classes(scenario, path.name, elsewhere)
    return scenario


def changed_fields(overrides: Sequence[str] | None, seed: int | None, duration: float | None) -> list[str]:
    """Return the changes that a command line makes to a scenario, as values of `--set`."""
    own = {"seed": seed, "duration_s": duration}
    return [*(overrides or ()), *(f"{name}={value}" for name, value in own.items() if value is not None)]


def changed_options(changed: Sequence[str]) -> list[str]:
    return [word for text in changed for word in (CHANGED, text)]


def pace_options(mode: str, rate: float) -> list[str]:
    return [*([REALTIME] if mode == "realtime" else []), *(["--rate", str(rate)] if rate else [])]


class FlightOptions(NamedTuple):
    """A scenario to fly, its pace, and changes to it: seed, duration [s], and overrides (`a.b.c=value`)."""

    path: Path
    seed: int | None
    duration: float | None
    realtime: bool
    rate: float | None
    overrides: list[str] | None

    def scenario(self, elsewhere: bool = False) -> Any:
        """Load the scenario and, unless it is flown on other hosts (`elsewhere`), the classes that it names."""
        from zsim.scenario.roles import check_pace

        scenario = load_scenario(self.path, self.overrides, self.seed, self.duration, elsewhere)
        check_pace(scenario, self.mode_and_rate()[0])
        return scenario

    def changed(self) -> list[str]:
        return changed_fields(self.overrides, self.seed, self.duration)

    def mode_and_rate(self) -> tuple[str, float]:
        """Return the mode of a run and its pace in simulated seconds per wall second; 0: as fast as possible."""
        if self.rate is not None and not 0 < self.rate <= RATE_MAX:
            raise BadParameter(f"--rate is {self.rate:g}; must be > 0 and <= {RATE_MAX:g}")
        return ("realtime", self.rate or 1.0) if self.realtime else ("lockstep", self.rate or 0.0)

    def pace(self) -> list[str]:
        return pace_options(*self.mode_and_rate())


class WorldAccess(NamedTuple):
    """How to reach a world, and the identity of the process that connects."""

    endpoint: str  # endpoint on which the world or a router listens
    federation: str
    wait_s: float | None  # how long to wait for a world; None: indefinitely
    tls: Path | None  # folder of the process's certificate
    insecure: bool
    host: str | None  # name of this host, as shown to others
    launched: str | None = None  # id of the run, if a launcher started the process

    @property
    def who(self) -> "Identity":
        return identity(self.host, self.tls, self.insecure)


def option_group(argument: str, make: Callable[..., Any], options: Mapping[str, tuple[Any, Any]]) -> Callable[..., Any]:
    """Return a decorator that replaces one argument of a command with options.

    `make` builds that argument from the values of the options, in their order; `options`: annotation and default of
    each, by name.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def with_options(**values: Any) -> None:
            combined = make(*(values.pop(option, default) for option, (_, default) in options.items()))
            command(**values, **{argument: combined})

        parameters = [
            inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
            for option, (annotation, default) in options.items()
        ]
        signature = inspect.signature(command)
        own = [each for each in signature.parameters.values() if each.name != argument]
        together = [each.replace(kind=each.KEYWORD_ONLY) for each in (*own, *parameters)]
        with_options.__signature__ = signature.replace(parameters=together)  # type: ignore[attr-defined]
        with_options.__annotations__ = {each.name: each.annotation for each in together}
        return with_options

    return decorate


_OBSERVER: dict[str, tuple[Any, Any]] = {
    "connect": (Connect, DEFAULT_ENDPOINT),
    "federation": (Federation, "zsim"),
    "wait": (Wait, LOOK_S),
    "tls": (Tls, None),
    "insecure": (Insecure, False),
    "host": (Host, None),
}
_PARTICIPANT = {**_OBSERVER, "wait": (Wait, None), "launched": (Launched, None)}
flight_options = option_group(
    "flight",
    FlightOptions,
    {
        "scenario": (ScenarioPath, inspect.Parameter.empty),
        "seed": (Seed, None),
        "duration": (Duration, None),
        "realtime": (Realtime, False),
        "rate": (Rate, None),
        "set_": (Set, None),
    },
)
observer_options = option_group("reach", WorldAccess, _OBSERVER)
"""Decorator for interactive commands, with an argument `reach`."""
participant_options = option_group("reach", WorldAccess, _PARTICIPANT)
"""Decorator for commands that run a process that waits for a world and joins it, with an argument `reach`."""
several_options = option_group(
    "reach",
    lambda connect, federation, wait, *more: WorldAccess(connect, federation, wait, None, *more),
    {name: each for name, each in _PARTICIPANT.items() if name != "tls"},
)
"""Like `participant_options`, for a process that hosts several agents: no `--tls`, as a certificate is for one name."""
listener_options = option_group(
    "who",
    identity,
    {"host": (Host, None), "tls": (Tls, None), "insecure": (Insecure, False), "access": (Access, None)},
)
"""Decorator for commands that run a process to which others connect, with an argument `who`."""
