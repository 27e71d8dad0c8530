"""Options that several commands share."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from zsim.transport.tls import Identity

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
RUN, HOSTS = "Run", "On several machines"  # panels of the help
REALTIME = "--realtime"  # of the world and the routers, whose lease it shortens


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


ScenarioPath = Annotated[Path, typer.Argument(help="Scenario file (YAML).", show_default=False)]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override a field: a.b.c=value. Repeatable.")]
Seed = Annotated[int | None, typer.Option(help="Seed instead of the scenario's.")]
Duration = Annotated[float | None, typer.Option(help="Simulated seconds instead of the scenario's.")]
Realtime = Annotated[bool, typer.Option(REALTIME, help="Pace by the wall clock and wait for nobody.")]
RateOption = Annotated[float | None, typer.Option(help="Simulated per wall second (realtime 1, lockstep unpaced).")]
Connect = Annotated[str, typer.Option(help="Where the world (or a router) listens.")]
Federation = Annotated[str, typer.Option(help="Name of the federation: the prefix of its keys.")]
Wait = Annotated[
    float | None,
    typer.Option(callback=not_negative, help="Seconds to wait for a world; for ever if not given."),
]
Launched = Annotated[str | None, typer.Option("--launched", hidden=True)]  # by `zsim run`, for the run of this id
Tls = Annotated[Path | None, typer.Option("--tls", help="Folder of this process's certificate (zsim certs init).")]
Access = Annotated[Path | None, typer.Option("--access", help="Zenoh's access control (zsim certs init).")]
Host = Annotated[str | None, typer.Option("--host", help="Name of this host, as others are told.")]
Insecure = Annotated[bool, typer.Option("--insecure", help="Without TLS, on a network that is nobody else's.")]


def identity(host: str | None, tls: Path | None, insecure: bool, access: Path | None = None) -> "Identity":
    """Return who this process is on the network."""
    from zsim.transport.tls import Identity

    found = Identity(tls=tls, access=access, insecure=insecure)
    return found._replace(host=host) if host else found


def load_scenario(
    path: Path, overrides: list[str] | None, seed: int | None = None, duration: float | None = None
) -> Any:
    """Return the scenario of a file with what the command line says of it."""
    from zsim.scenario import scenario_file

    return scenario_file.load(path, overrides or (), seed=seed, duration_s=duration)


def mode_and_rate(realtime: bool, rate: float | None) -> tuple[str, float]:
    """Return the mode of a run, and its pace in simulated per wall seconds; 0 is as fast as it goes."""
    if rate is not None and not 0 < rate <= 1000:
        raise typer.BadParameter(f"--rate is {rate:g}; must be > 0 and <= 1000")
    return ("realtime", rate or 1.0) if realtime else ("lockstep", rate or 0.0)


def pace_options(mode: str, rate: float) -> list[str]:
    """Return mode and pace as options of the world."""
    return [*([REALTIME] if mode == "realtime" else []), *(["--rate", str(rate)] if rate else [])]
