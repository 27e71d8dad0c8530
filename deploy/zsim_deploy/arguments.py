"""Options that several commands share: those of a flight, and those by which a command connects to a world."""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from zsim.errors import RunError, install_command

if TYPE_CHECKING:
    from zsim.transport.tls import Identity

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
CONNECT_VARIABLE = "ZSIM_CONNECT"  # of the environment: the endpoint where --connect is not given
RUN_ID = "{run}"  # in the folder of a record: a recorder that is started again finds the one that it had begun
CONSOLE_NEEDS = {"console": ("aiohttp", "viser")}  # modules by extra
FLIGHT_NEEDS = {"record": ("mcap", "zstandard"), "world": ("numba",), "agents": ("scipy", "filterpy")}
REPORT_NEEDS = {"report": ("matplotlib", "jinja2", "mcap", "zstandard")}
CONSOLE_PORT = 8080  # of its page
RUN, HOSTS = "Run", "On several machines"  # panels of the help
REALTIME = "--realtime"  # of the world and the routers, whose lease it shortens
CHANGED = "--changed"  # of the world: what a launcher, whose scenario is resolved, has changed of its file
LOOK_S = 5.0  # wall; for which a command that a person types waits for a world


def positive(value: float | None) -> float | None:
    """Return the value of an option that is None or a number above 0."""
    if value is not None and not 0 < value < math.inf:
        raise typer.BadParameter(f"is {value:g}; must be a finite number > 0")
    return value


def not_negative(value: float | None) -> float | None:
    """Return the value of an option that is None or a number from 0 on."""
    if value is not None and not 0 <= value < math.inf:
        raise typer.BadParameter(f"is {value:g}; must be a finite number >= 0")
    return value


def finite(value: float | None) -> float | None:
    """Return the value of an option that is None or a finite number."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"is {value:g}; must be a finite number")
    return value


def require(command: str, needs: Mapping[str, Sequence[str]]) -> None:
    """Refuse to begin without what a command needs.

    Args:
        command: its name.
        needs: modules, by the extra that brings them.

    Raises:
        RunError: with what to install.
    """
    missing = {module: extra for extra, modules in needs.items() for module in modules if find_spec(module) is None}
    if missing:
        lacking = f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed"
        raise RunError(f"{command}: {lacking}; {install_command(missing.values())}")


def endpoint_origin(text: str, arguments: Sequence[str], environment: Mapping[str, str]) -> str:
    """Return a refusal of an endpoint with where it comes from, if that is the environment."""
    value = environment.get(CONNECT_VARIABLE)
    is_given = any(each.partition("=")[0] == "--connect" for each in arguments)
    return f"{text} ({value} is from {CONNECT_VARIABLE})" if value and value in text and not is_given else text


def check_range(from_: float | None, to: float | None) -> None:
    """Refuse `--to` before `--from`."""
    if from_ is not None and to is not None and to < from_:
        raise typer.BadParameter(f"--to is {to:g}, before --from {from_:g}; must be at or after it")


ScenarioPath = Annotated[Path, typer.Argument(help="Scenario file (YAML).", show_default=False)]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override a field: a.b.c=value. Repeatable.")]
Seed = Annotated[int | None, typer.Option(help="Seed instead of the scenario's.")]
Duration = Annotated[float | None, typer.Option(help="Simulated seconds instead of the scenario's.")]
Realtime = Annotated[bool, typer.Option(REALTIME, help="Pace by the wall clock and wait for nobody.")]
RateOption = Annotated[float | None, typer.Option(help="Simulated per wall second (realtime 1, lockstep unpaced).")]
Connect = Annotated[
    str, typer.Option("--connect", envvar=CONNECT_VARIABLE, help="Where the world (or a router) listens.")
]
Federation = Annotated[str, typer.Option(help="Name of the federation: the prefix of its keys.")]
Wait = Annotated[
    float | None,
    typer.Option(callback=not_negative, help="Seconds to wait for a world; for ever if not given."),
]
Launched = Annotated[str | None, typer.Option("--launched", hidden=True)]  # by `zsim run`, for the run of this id
Tls = Annotated[Path | None, typer.Option("--tls", help="Folder of this process's certificate (zsim certs init).")]
Access = Annotated[Path | None, typer.Option("--access", help="Zenoh's access control (zsim certs init).")]
Host = Annotated[str | None, typer.Option("--host", help="Name of this host, as others see it.")]
Insecure = Annotated[bool, typer.Option("--insecure", help="Without TLS, on a network that is nobody else's.")]


Keys = Annotated[
    list[str] | None, typer.Option(help="Only these keys, e.g. 'drone/*/truth'. Repeatable.", show_default=False)
]
Trust = Annotated[
    bool,
    typer.Option("--trust", help="Import the modules that the scenario names. That runs them: trust who wrote them."),
]
From = Annotated[
    float | None, typer.Option("--from", callback=not_negative, help="Simulated seconds of the first message.")
]
To = Annotated[float | None, typer.Option("--to", callback=not_negative, help="Simulated seconds of the last message.")]


Force = Annotated[
    bool, typer.Option("--force", help="Replace an earlier run in the folder; other files there stay as they are.")
]


def identity(host: str | None, tls: Path | None, insecure: bool, access: Path | None = None) -> "Identity":
    """Return who this process is on the network."""
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
    """Return the scenario of a file with the overrides of the command line; `elsewhere`: it flies on other hosts.

    `modules`: folders in which modules that it names may stand, beside its own.
    """
    from zsim.scenario import scenario_file
    from zsim_agents.hosting import check_classes

    scenario = scenario_file.load(path, overrides or (), modules, seed=seed, duration_s=duration)
    check_classes(scenario, path.name, elsewhere)
    return scenario


def changed_fields(overrides: Sequence[str] | None, seed: int | None, duration: float | None) -> list[str]:
    """Return what a command line changes of a scenario as texts of `--set`."""
    own = {"seed": seed, "duration_s": duration}
    return [*(overrides or ()), *(f"{name}={value}" for name, value in own.items() if value is not None)]


def changed_options(changed: Sequence[str]) -> list[str]:
    """Return changed fields as options of the world."""
    return [word for text in changed for word in (CHANGED, text)]


def pace_options(mode: str, rate: float) -> list[str]:
    """Return mode and pace as options of the world."""
    return [*([REALTIME] if mode == "realtime" else []), *(["--rate", str(rate)] if rate else [])]


class FlightOptions(NamedTuple):
    """What is to be flown, and how fast.

    Attributes:
        path: of the scenario.
        seed, duration: instead of the scenario's.
        realtime: paced by the wall clock.
        rate: simulated per wall second.
        overrides: texts `a.b.c=value`.
    """

    path: Path
    seed: int | None
    duration: float | None
    realtime: bool
    rate: float | None
    overrides: list[str] | None

    def scenario(self, elsewhere: bool = False) -> Any:
        """Return the scenario, the classes that it names loaded here; `elsewhere`: it flies on other hosts."""
        from zsim.scenario.roles import check_pace

        scenario = load_scenario(self.path, self.overrides, self.seed, self.duration, elsewhere)
        check_pace(scenario, self.mode_and_rate()[0])
        return scenario

    def changed(self) -> list[str]:
        """Return the texts `a.b.c=value` by which the scenario is changed against its file."""
        return changed_fields(self.overrides, self.seed, self.duration)

    def mode_and_rate(self) -> tuple[str, float]:
        """Return the mode of a run, and its pace in simulated per wall seconds; 0 is as fast as it goes."""
        if self.rate is not None and not 0 < self.rate <= 1000:
            raise typer.BadParameter(f"--rate is {self.rate:g}; must be > 0 and <= 1000")
        return ("realtime", self.rate or 1.0) if self.realtime else ("lockstep", self.rate or 0.0)

    def pace(self) -> list[str]:
        """Return mode and rate as options of the world."""
        return pace_options(*self.mode_and_rate())


class WorldAccess(NamedTuple):
    """How to reach a world, and the identity of the process that connects.

    Attributes:
        endpoint: on which the world or a router listens.
        federation: prefix of its keys.
        wait_s: for a world; None for ever.
        tls: folder of the process's certificate.
        insecure: without TLS, on a network that is nobody else's.
        host: its name, as others see it.
        launched: run of which it is a part, of processes that a launcher starts.
    """

    endpoint: str
    federation: str
    wait_s: float | None
    tls: Path | None
    insecure: bool
    host: str | None
    launched: str | None = None

    @property
    def who(self) -> "Identity":
        """Return who the process is on the network."""
        return identity(self.host, self.tls, self.insecure)


Options = Mapping[str, tuple[Any, Any]]
"""Annotation and default of each option, in the order of the tuple that they make."""
_FLIGHT: Options = {
    "scenario": (ScenarioPath, inspect.Parameter.empty),
    "seed": (Seed, None),
    "duration": (Duration, None),
    "realtime": (Realtime, False),
    "rate": (RateOption, None),
    "set_": (Set, None),
}
_WORLD: Options = {
    "connect": (Connect, DEFAULT_ENDPOINT),
    "federation": (Federation, "zsim"),
    "wait": (Wait, LOOK_S),
    "tls": (Tls, None),
    "insecure": (Insecure, False),
    "host": (Host, None),
}


def flight_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of its argument `flight`."""
    return _with_options(command, "flight", FlightOptions, _FLIGHT)


def observer_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that a person types the options of its argument `reach`."""
    return _with_options(command, "reach", WorldAccess, _WORLD)


def participant_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that runs a process of a federation the options of its argument `reach`: it waits for a world."""
    options = {**_WORLD, "wait": (Wait, None), "launched": (Launched, None)}
    return _with_options(command, "reach", WorldAccess, options)


def _with_options(
    command: Callable[..., None], name: str, make: Callable[..., Any], options: Options
) -> Callable[..., None]:
    """Return the command as typer is to see it: the options in place of the argument that is made of them."""

    @wraps(command)
    def with_options(**values: Any) -> None:
        made = make(*(values.pop(option, default) for option, (_, default) in options.items()))
        command(**values, **{name: made})

    parameters = [
        inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for option, (annotation, default) in options.items()
    ]
    signature = inspect.signature(command, eval_str=True)
    own = [each.replace(kind=each.KEYWORD_ONLY) for each in signature.parameters.values() if each.name != name]
    together = [*parameters, *own] if make is FlightOptions else [*own, *parameters]
    with_options.__signature__ = signature.replace(parameters=together)  # type: ignore[attr-defined]
    return with_options
