"""Parameters of users' classes: a struct of named quantities with defaults and limits, filled in from the scenario.

class Pilot(zsim.Agent):
    class Parameters(zsim.Parameters):
        push_1_s: Annotated[float, Meta(ge=0, le=2)] = 0.4

    def step(self, t_ns):
        ... self.parameters.push_1_s
"""

from collections.abc import Callable, Iterator
from inspect import Parameter, signature
from typing import Annotated, Any, get_type_hints

import msgspec
from msgspec import Meta, Struct

from zsim.errors import DocumentError
from zsim.schema.checker import Fault, faults, show
from zsim.schema.quantities import Real

COUNT_MAX = 100  # maximum number of parameters of a class
Given = Annotated[dict[str, Any], Meta(max_length=COUNT_MAX)]
"""Parameters of a class in a scenario, by name; in a resolved scenario, all of them."""


class Parameters(Struct, kw_only=True, forbid_unknown_fields=True):
    """Base of the parameters of a user's class, whose instances have them in the attribute `parameters`."""


def parameters_type(kind: Callable[..., Any], filled: tuple[str, ...] = ()) -> type[Struct]:
    """Return the struct of a class's parameters: its `Parameters`, or the arguments of its constructor.

    Args:
        filled: arguments of the constructor that zsim supplies, which are not parameters.

    Raises:
        TypeError: its `Parameters` is not a subclass of `zsim.Parameters`.
    """
    declared = getattr(kind, "Parameters", None)
    if declared is not None:
        if not (isinstance(declared, type) and issubclass(declared, Parameters)):
            raise TypeError(f"{kind.__name__}.Parameters is not a subclass of zsim.Parameters")
        return declared
    return msgspec.defstruct("Arguments", list(_arguments(kind, filled)), bases=(Parameters,), kw_only=True)


def _arguments(kind: Callable[..., Any], filled: tuple[str, ...]) -> Iterator[Any]:
    arguments = signature(kind).parameters.values()
    hints = get_type_hints(kind.__init__ if isinstance(kind, type) else kind, include_extras=True)
    for each in arguments:
        if each.name in filled or each.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD):
            continue
        hint = hints.get(each.name, Any)
        hint = Real if hint is float else hint  # limited like all numbers of a scenario
        yield (each.name, hint) if each.default is Parameter.empty else (each.name, hint, each.default)


def resolved(kind: Callable[..., Any], given: Any, where: str, filled: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return all parameters of a class by name, given or default, as plain values for a file.

    Raises:
        DocumentError: a line for each unknown, missing or invalid parameter.
    """
    try:
        declared = parameters_type(kind, filled)
        wrong: list[Fault] = [*faults(given, declared, where)]
    except (TypeError, NameError, NotImplementedError) as error:  # an undefined or unsupported annotation
        raise DocumentError([f"{where}: {error}"]) from error
    if wrong:
        raise DocumentError([f"{path} {text}" for path, text in wrong])
    return msgspec.to_builtins(msgspec.convert(given, declared))


def bound(kind: Any, given: Any, where: str) -> Any:
    """Return a subclass whose instances have these parameters, set before the constructor is called.

    A class without `Parameters` is returned as it is.

    Raises:
        DocumentError: as for `resolved`, or parameters are given although the class has no `Parameters`.
    """
    if not has_parameters(kind):
        if given:
            raise DocumentError([f"{where} is {show(given)}; must be left out: {kind.__name__} has no Parameters"])
        return kind
    own = msgspec.convert(resolved(kind, given or {}, where), kind.Parameters)
    return type(kind.__name__, (kind,), {"parameters": own, "__module__": kind.__module__, "__doc__": kind.__doc__})


def has_parameters(kind: Callable[..., Any]) -> bool:
    """Return whether a class declares `Parameters`."""
    return getattr(kind, "Parameters", None) is not None
