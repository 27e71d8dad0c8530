"""The options by which a command reaches a world, the same for all that do."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from zsim_deploy.options.arguments import (
    DEFAULT_ENDPOINT,
    Connect,
    Federation,
    Host,
    Insecure,
    Launched,
    Tls,
    Wait,
    identity,
)

if TYPE_CHECKING:
    from zsim.transport.tls import Identity

LOOK_S = 5.0  # wall; for which a command that a person types waits for a world
NAME = "reach"  # of the argument


class Reach(NamedTuple):
    """Where a world is, and who comes.

    Attributes:
        endpoint: on which the world or a router listens.
        federation: prefix of its keys.
        wait_s: for a world; None for ever.
        tls: folder of the process's certificate.
        insecure: without TLS, on a network that is nobody else's.
        host: its name, as others are told.
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


_OPTIONS: dict[str, tuple[Any, Any]] = {  # annotation and default, in the order of Reach
    "connect": (Connect, DEFAULT_ENDPOINT),
    "federation": (Federation, "zsim"),
    "wait": (Wait, LOOK_S),
    "tls": (Tls, None),
    "insecure": (Insecure, False),
    "host": (Host, None),
}


def looks(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that a person types the options of its argument `reach`."""
    return _with_options(command, _OPTIONS)


def takes_part(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that runs a process of a federation the options of its argument `reach`: it waits for a world."""
    return _with_options(command, {**_OPTIONS, "wait": (Wait, None), "launched": (Launched, None)})


def _with_options(command: Callable[..., None], options: dict[str, tuple[Any, Any]]) -> Callable[..., None]:
    """Return the command as typer is to see it: the options in place of `reach`."""

    @wraps(command)
    def given(**values: Any) -> None:
        reach = Reach(*(values.pop(name, default) for name, (_, default) in options.items()))
        command(**values, **{NAME: reach})

    signature = inspect.signature(command, eval_str=True)
    own = [each.replace(kind=each.KEYWORD_ONLY) for name, each in signature.parameters.items() if name != NAME]
    more = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, (annotation, default) in options.items()
    ]
    given.__signature__ = signature.replace(parameters=[*own, *more])  # type: ignore[attr-defined]
    return given
