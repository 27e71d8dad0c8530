"""Expressions of t, given as text, with their exact derivatives.

The text is parsed with Python's grammar, whitelisted nodes are converted into a tree of closures, and the tree is
evaluated on dual numbers (value, rate): the text is never executed.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping

from zsim.math import elementary as el
from zsim.scenario.scenario import CONSTANTS_MAX

Dual = tuple[float, float]
Node = tuple[Callable[[float], Dual], bool]  # function of t, and whether it is constant

TEXT_MAX = 1000  # maximum number of characters
DEPTH_MAX = 100  # maximum depth of nested operations
NAME_MAX = 40  # maximum number of characters in a constant's name
CONSTANTS = {"pi": math.pi, "e": math.e}


class ExpressionError(ValueError):
    """An expression is not allowed or has no finite value; the message names the variable, finding and remedy."""

    def __init__(self, finding: str, name: str = "") -> None:
        super().__init__(f"{name}: {finding}" if name else finding)
        self.name = name
        self.finding = finding


class Expression:
    """A function of t with its exact first derivative, for a named variable.

    The text is for example "5*cos(2*pi*f*t)", with user constants such as {"f": 0.01}.

    Raises:
        ExpressionError: the text is not an expression of t in numbers, + - * / **, constants and functions.
    """

    def __init__(self, name: str, text: str, constants: Mapping[str, float] | None = None) -> None:
        self.name = name
        self.text = text
        self._constants = {**CONSTANTS, **checked_constants(constants or {})}
        self._evaluate, self.constant = self._build(self._parse(), 0)

    def __call__(self, t_s: float) -> Dual:
        """Return the value and its rate per second at `t_s`; ExpressionError: one of them is not finite there."""
        try:
            value, rate = self._evaluate(t_s)
        except (ArithmeticError, ValueError) as error:
            raise self._error(f"has no value at t = {t_s:g} s ({error})") from None
        if not (math.isfinite(value) and math.isfinite(rate)):
            raise self._error(f"has value {value} and rate {rate} at t = {t_s:g} s; both must be finite")
        return value, rate

    def _parse(self) -> ast.expr:
        if not isinstance(self.text, str):
            raise self._error(f"is of type {type(self.text).__name__}; allowed: text or a number")
        if len(self.text) > TEXT_MAX:
            raise self._error(f"has {len(self.text)} characters; allowed: {TEXT_MAX}")
        try:
            return ast.parse(self.text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            reason = error.msg if isinstance(error, SyntaxError) else error
            raise self._error(f"cannot be read ({reason})") from None

    def _build(self, tree: ast.expr, depth: int) -> Node:
        if depth > DEPTH_MAX:
            raise self._error(f"is nested deeper than {DEPTH_MAX}; allowed: {DEPTH_MAX}")
        if isinstance(tree, ast.Constant):
            number = finite_number(tree.value)
            if number is None:
                raise self._error(f"contains {str(tree.value)[:40]!r}; allowed: {self._allowed()}")
            return _constant(number)
        if isinstance(tree, ast.Name):
            if tree.id == "t":
                return lambda t: (t, 1.0), False
            if tree.id not in self._constants:
                raise self._error(f"uses {tree.id[:40]!r}; allowed: {self._allowed()}")
            return _constant(self._constants[tree.id])
        if isinstance(tree, ast.BinOp) and type(tree.op) in _BINARY:
            return self._apply(_BINARY[type(tree.op)], [tree.left, tree.right], depth)
        if isinstance(tree, ast.UnaryOp) and type(tree.op) in _UNARY:
            return self._apply(_UNARY[type(tree.op)], [tree.operand], depth)
        if isinstance(tree, ast.Call):
            name = self._source(tree.func)
            if name not in _FUNCTIONS or tree.keywords:
                raise self._error(f"calls {name!r}; allowed: {self._allowed()}")
            function, args_min, args_max = _FUNCTIONS[name]
            if not args_min <= len(tree.args) <= args_max:
                count = f"{args_min}" if args_min == args_max else f"{args_min} to {args_max}"
                raise self._error(f"calls {name} with {len(tree.args)} arguments; allowed: {count}")
            return self._apply(function, tree.args, depth)
        raise self._error(f"contains {self._source(tree)!r}; allowed: {self._allowed()}")

    def _apply(self, function: Callable[..., Dual], trees: list[ast.expr], depth: int) -> Node:
        nodes = [self._build(tree, depth + 1) for tree in trees]
        parts = [evaluate for evaluate, _ in nodes]
        if all(constant for _, constant in nodes):
            try:
                value, _ = function(*(part(0.0) for part in parts))
            except (ArithmeticError, ValueError) as error:
                raise self._error(f"has a constant part without a value ({error})") from None
            if not math.isfinite(value):
                raise self._error(f"has a constant part of value {value}; allowed: finite values")
            return _constant(value)
        if len(parts) == 1:
            (only,) = parts
            return lambda t: function(only(t)), False
        if len(parts) == 2:
            left, right = parts
            return lambda t: function(left(t), right(t)), False
        return lambda t: function(*[part(t) for part in parts]), False

    def _source(self, tree: ast.expr) -> str:
        return (ast.get_source_segment(self.text.strip(), tree) or "")[:40]

    def _error(self, finding: str) -> ExpressionError:
        return ExpressionError(f"expression {str(self.text)[:60]!r} {finding}", self.name)

    def _allowed(self) -> str:
        return f"t, numbers, + - * / **, {', '.join(self._constants)}, {', '.join(_FUNCTIONS)}"


def checked_constants(constants: Mapping[str, float]) -> dict[str, float]:
    """Return the constants as floats; ExpressionError: there are too many, or a name or value is not allowed."""
    if len(constants) > CONSTANTS_MAX:
        raise ExpressionError(f"constants: found {len(constants)}; allowed: at most {CONSTANTS_MAX}")
    reserved = ["t", *CONSTANTS, *_FUNCTIONS]
    for name, value in constants.items():
        is_name = isinstance(name, str) and len(name) <= NAME_MAX and name.isidentifier()
        if not is_name or name in reserved:
            allowed = f"an identifier of at most {NAME_MAX} characters except {', '.join(reserved)}"
            raise ExpressionError(f"constant {str(name)[:40]!r}: not a free name; allowed: {allowed}")
        if finite_number(value) is None:
            raise ExpressionError(f"constant {name}: found {str(value)[:40]!r}; allowed: a finite number")
    return {name: float(value) for name, value in constants.items()}


def finite_number(value: object) -> float | None:
    """Return the value as a float; None if it is not a finite number (a bool is not a number)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def _constant(value: float) -> Node:
    return lambda t: (value, 0.0), True


def _divide(a: Dual, b: Dual) -> Dual:
    value = a[0] / b[0]
    return value, (a[1] - value * b[1]) / b[0]


def _in_domain(value: float) -> float:
    if not math.isfinite(value):  # checked at once, because min or max might discard the value
        raise ValueError("outside the domain of a function")
    return value


def _power(a: Dual, b: Dual) -> Dual:
    base, exponent = a[0], b[0]
    value = _in_domain(el.power(base, exponent))
    rate = exponent * el.power(base, exponent - 1) * a[1] if exponent and a[1] else 0.0
    return value, rate + value * el.log(base) * b[1] if b[1] else rate


def _unary(
    function: Callable[[float], float], rate_of: Callable[[float, float, float], float]
) -> Callable[[Dual], Dual]:
    """Extend a function to dual numbers; `rate_of` takes the argument, the value and the argument's nonzero rate."""

    def apply(a: Dual) -> Dual:
        value = _in_domain(function(a[0]))
        return value, rate_of(a[0], value, a[1]) if a[1] else 0.0

    return apply


_BINARY: dict[type[ast.operator], Callable[[Dual, Dual], Dual]] = {
    ast.Add: lambda a, b: (a[0] + b[0], a[1] + b[1]),
    ast.Sub: lambda a, b: (a[0] - b[0], a[1] - b[1]),
    ast.Mult: lambda a, b: (a[0] * b[0], a[1] * b[0] + a[0] * b[1]),
    ast.Div: _divide,
    ast.Pow: _power,
}
_UNARY: dict[type[ast.unaryop], Callable[[Dual], Dual]] = {
    ast.USub: _unary(operator.neg, lambda x, y, rate: -rate),
    ast.UAdd: _unary(operator.pos, lambda x, y, rate: rate),
}
_FUNCTIONS: dict[str, tuple[Callable[..., Dual], int, int]] = {  # with minimum and maximum numbers of arguments
    "sin": (_unary(el.sin, lambda x, y, rate: el.cos(x) * rate), 1, 1),
    "cos": (_unary(el.cos, lambda x, y, rate: -el.sin(x) * rate), 1, 1),
    "tan": (_unary(el.tan, lambda x, y, rate: (1 + y * y) * rate), 1, 1),
    "asin": (_unary(el.asin, lambda x, y, rate: rate / math.sqrt(1 - x * x)), 1, 1),
    "acos": (_unary(el.acos, lambda x, y, rate: -rate / math.sqrt(1 - x * x)), 1, 1),
    "atan": (_unary(el.atan, lambda x, y, rate: rate / (1 + x * x)), 1, 1),
    "sqrt": (_unary(math.sqrt, lambda x, y, rate: rate / (2 * y)), 1, 1),
    "exp": (_unary(el.exp, lambda x, y, rate: y * rate), 1, 1),
    "log": (_unary(el.log, lambda x, y, rate: rate / x), 1, 1),
    "abs": (_unary(abs, lambda x, y, rate: math.copysign(1.0, x) * rate if x else 0.0), 1, 1),
    "min": (lambda *parts: min(parts, key=lambda part: part[0]), 2, 16),
    "max": (lambda *parts: max(parts, key=lambda part: part[0]), 2, 16),
}
