"""Values of a formation's variables by name, as users give them: in metres and radians, or in degrees as NAME_deg."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from zsim_agents.formation.expression import Expression, finite_number
from zsim_agents.formation.spaces.cluster_space import TAU, Array, ClusterSpace

DEGREES = "_deg"
ANGLE_MAX_RAD = TAU + 1e-3  # a full turn as it is typed with four digits; a target beyond it is meant in degrees


class TrajectoryError(ValueError):
    """A trajectory is not possible as written; the message names the place, finding and remedy.

    Attributes:
        finding: what is wrong, without the place.
        at: path of the value below the target or the trajectory, empty for the whole.
    """

    def __init__(self, finding: str, where: str = "", at: str = "") -> None:
        super().__init__(f"{where} {finding}" if where else finding)
        self.finding = finding
        self.at = at


class Variable(NamedTuple):
    """Place of a variable in c (4n,), and what one unit of its values is there."""

    entry: int
    scale: float


def variable_of(space: ClusterSpace, name: object, where: str, at: str = "") -> Variable:
    """Return the variable of a name: one of the space's, or an angle's with `_deg`.

    Raises:
        TrajectoryError: there is none of that name.
    """
    text = str(name)
    angle = text.removesuffix(DEGREES)
    if text not in space.names and angle in space.names and space.in_radians[space.index(angle)]:
        return Variable(space.index(angle), math.radians(1.0))
    try:
        return Variable(space.index(text), 1.0)
    except ValueError as error:
        raise TrajectoryError(str(error), f"{where}:", at) from None


def named_values(space: ClusterSpace, values: object, where: str, base: Array, at: str = "") -> Array:
    """Return base (4n,) with the values put in by name, numbers or expressions without t.

    Raises:
        TrajectoryError: no mapping, an unknown name or one given twice, no finite number, an angle beyond one turn.
        ExpressionError: a text that is no expression.
    """
    if not isinstance(values, Mapping):
        raise TrajectoryError(f"found {str(values)[:40]!r}; allowed: numbers by name of variable", f"{where}:", at)
    c, given = base.copy(), set[int]()
    for name, value in values.items():
        variable = variable_of(space, name, where, at)
        place = f"{where}: {name}", f"{at}.{name}"
        refuse_twice(space, variable, given, place)
        number = _number(str(name), value, place)
        refuse_turns(space, variable, number, place)
        c[variable.entry] = number * variable.scale
    return c


def refuse_twice(space: ClusterSpace, variable: Variable, given: set[int], place: tuple[str, str]) -> None:
    """Refuse a variable that has been given, in other units, and note that it is given now.

    Raises:
        TrajectoryError: it is given twice.
    """
    if variable.entry in given:
        name = space.names[variable.entry]
        raise TrajectoryError(f"is given beside the same variable; allowed: {name} or {name}{DEGREES}", *place)
    given.add(variable.entry)


def refuse_turns(space: ClusterSpace, variable: Variable, value: float, place: tuple[str, str]) -> None:
    """Refuse an angle to be led to that is beyond one turn: in radians it is meant in degrees.

    Raises:
        TrajectoryError: with how it is written in degrees.
    """
    if not space.in_radians[variable.entry] or abs(value * variable.scale) <= ANGLE_MAX_RAD:
        return
    if variable.scale != 1.0:
        raise TrajectoryError(f"is {value:g} deg; allowed: -360 to 360 deg", *place)
    remedy = f"allowed: -6.283 to 6.283 rad, or degrees as {space.names[variable.entry]}{DEGREES}"
    raise TrajectoryError(f"is {value:g} rad; {remedy}", *place)


def _number(name: str, value: object, place: tuple[str, str]) -> float:
    number = finite_number(value)
    if isinstance(value, str):
        expression = Expression(name, value)
        number = expression(0.0)[0] if expression.constant else None
    if number is None:
        raise TrajectoryError(f"is {str(value)[:40]}; allowed: a finite number, or an expression without t", *place)
    return number
