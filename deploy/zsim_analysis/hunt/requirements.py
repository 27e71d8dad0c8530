"""Requirements on a flight: comparisons of its quantities, as in `min_separation_m > 1.5 and not crashed`.

A requirement may use numbers, texts, names, comparisons, `and`, `or`, `not`, + - * / and abs, min, max. Names are paths
in `summary.json` and columns of a sweep: `errors.p.true_rms`, `clusters.main.engaged_share`, `collisions`,
`metrics.NAME`. Nothing else is accepted, and nothing is executed.

The margin of a requirement is its distance from violation: the difference between the sides of a comparison, the
minimum for `and`, the maximum for `or`; this is the robustness of Fainekos and Pappas (Theoretical Computer Science
410, 2009) without time. So that margins with different units can be compared, each is also given as a share of the
larger side of its comparison.
"""

import ast
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from zsim.errors import ScenarioError
from zsim.schema.checker import show, suggestion

OPTION = "--require"
SYNTAX = "comparisons of quantities and numbers, as in 'min_separation_m > 1.5 and not crashed'"
LENGTH_MAX = 1000  # longest requirement [characters]
NAMES_SHOWN = 12  # maximum number of names listed in an error
TINY = 1e-12  # smallest denominator of a share
_COMPARES = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_ARITHMETIC: dict[type, Callable[[float, float], float]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b if b else math.nan,
}
_EXTREMES: dict[str, Callable[[list[float]], float]] = {"min": min, "max": max}


class Margin(NamedTuple):
    """The margin of a requirement in a flight."""

    holds: bool
    # relative to the larger side of the comparison, from -2 to 2; in a hunt, relative to the margin without faults
    share: float
    value: float | None  # in the unit of the quantities; None if one of them is unknown
    unknown: str = ""  # the first unknown quantity, or why the flight failed; empty if neither

    def __invert__(self) -> "Margin":
        if self.unknown:
            return self  # with an unknown quantity, the negation does not hold either
        return Margin(not self.holds, -self.share, None if self.value is None else -self.value)


BROKEN = -2.0  # share for a flight that failed or has an unknown quantity


class Requirement:
    """A parsed requirement.

    Raises:
        ScenarioError: the text cannot be parsed.
    """

    def __init__(self, text: str) -> None:
        self.text = " ".join(text.split())
        if len(self.text) > LENGTH_MAX:
            raise self._fault(f"has {len(self.text)} characters; must have at most {LENGTH_MAX}")
        try:
            self._tree = ast.parse(self.text, mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            location = f" at character {error.offset}" if isinstance(error, SyntaxError) and error.offset else ""
            raise self._fault(f"cannot be read{location}; must be {SYNTAX}") from None
        self._check(self._tree, as_truth=True)
        self.names = tuple(dict.fromkeys(self._names(self._tree)))

    def margin(self, quantities: Mapping[str, Any]) -> Margin:
        """Return the margin in a flight, given its quantities by path.

        Raises:
            ScenarioError: the requirement names a quantity that no flight has, or one of the wrong type.
        """
        return self._margin(self._tree, quantities)

    def faults(self, quantities: Mapping[str, Any]) -> list[str]:
        """Return a line for each name that is not a quantity of a flight, with the most similar quantity."""
        unknown = [self._unknown(name, quantities) for name in self.names if name not in quantities]
        return [fault for text in unknown for fault in self._fault(text).faults]

    # Parsing

    def _fault(self, text: str) -> ScenarioError:
        return ScenarioError([f"{OPTION} {show(self.text)}: {text}"])

    def _check(self, node: ast.AST, as_truth: bool) -> None:
        """Raise ScenarioError for unsupported syntax; `as_truth`: a truth value is expected, otherwise a quantity."""
        parts: list[tuple[ast.AST, bool]] = []
        if as_truth and isinstance(node, ast.BoolOp):
            parts = [(each, True) for each in node.values]
        elif as_truth and isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            parts = [(node.operand, True)]
        elif as_truth and isinstance(node, ast.Compare) and all(type(op) in _COMPARES for op in node.ops):
            parts = [(each, False) for each in (node.left, *node.comparators)]
        elif path_of(node):
            pass
        elif as_truth:
            raise self._fault(f"has {show(ast.unparse(node))}, which is not a truth value; must be {SYNTAX}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float | str):
            pass
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            parts = [(node.operand, False)]
        elif isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            parts = [(node.left, False), (node.right, False)]
        elif isinstance(node, ast.Call) and self._is_function(node):
            parts = [(each, False) for each in node.args]
        else:
            raise self._fault(f"has {show(ast.unparse(node))}; must be {SYNTAX}")
        for part, truth in parts:
            self._check(part, truth)

    @staticmethod
    def _is_function(node: ast.Call) -> bool:
        name, plain = path_of(node.func), not node.keywords and not any(isinstance(a, ast.Starred) for a in node.args)
        return plain and ((name in _EXTREMES and len(node.args) > 0) or (name == "abs" and len(node.args) == 1))

    def _names(self, node: ast.AST) -> Iterator[str]:
        path = path_of(node)
        if path:
            yield path
            return
        for child in ast.iter_child_nodes(node):
            if not (isinstance(node, ast.Call) and child is node.func):
                yield from self._names(child)

    # Margin

    def _margin(self, node: ast.AST, quantities: Mapping[str, Any]) -> Margin:
        if isinstance(node, ast.BoolOp):
            parts = [self._margin(each, quantities) for each in node.values]
            pick = min if isinstance(node.op, ast.And) else max
            return pick(parts, key=lambda part: (part.holds, part.share))
        if isinstance(node, ast.UnaryOp):
            return ~self._margin(node.operand, quantities)
        if isinstance(node, ast.Compare):
            sides = [self._quantity(each, quantities) for each in (node.left, *node.comparators)]
            pairs = zip(node.ops, sides, sides[1:], strict=False)
            parts = [self._compared(_COMPARES[type(op)], *two) for op, *two in pairs]
            return min(parts, key=lambda part: (part.holds, part.share))
        value = self._quantity(node, quantities)
        if isinstance(value, Unknown):
            return Margin(False, BROKEN, None, value.name)
        if not isinstance(value, bool):
            raise self._fault(f"has {path_of(node)}, which is {show(value)}; must be compared, or be true or false")
        return Margin(value, 1.0 if value else -1.0, 1.0 if value else -1.0)

    def _compared(self, op: str, left: Any, right: Any) -> Margin:
        if lacking := next((each for each in (left, right) if isinstance(each, Unknown)), None):
            return Margin(False, BROKEN, None, lacking.name)
        if isinstance(left, str) != isinstance(right, str) or (isinstance(left, str) and op not in ("==", "!=")):
            raise self._fault(f"compares {show(left)} {op} {show(right)}; must compare numbers, or texts by == and !=")
        if isinstance(left, str):
            holds = (left == right) == (op == "==")
            return Margin(holds, 1.0 if holds else -1.0, 1.0 if holds else -1.0)
        value = left - right if op in (">", ">=") else right - left if op in ("<", "<=") else -abs(left - right)
        value = -value if op == "!=" else value
        if math.isnan(value):
            return Margin(False, BROKEN, None, "a quantity that is not a number")
        holds = value > 0 or (value == 0 and op in (">=", "<=", "=="))
        return Margin(holds, value / max(abs(left), abs(right), TINY), value)

    def _quantity(self, node: ast.AST, quantities: Mapping[str, Any]) -> Any:
        """Return the value of a node: a number, a text or a truth value, or `Unknown`."""
        if isinstance(node, ast.Constant):
            return node.value
        if path := path_of(node):
            if path not in quantities:
                raise self._fault(self._unknown(path, quantities))
            value = quantities[path]
            return Unknown(path) if value is None else value
        values = [self._quantity(each, quantities) for each in _operands(node)]
        if lacking := next((each for each in values if isinstance(each, Unknown)), None):
            return lacking
        if text := next((each for each in values if isinstance(each, str)), None):
            raise self._fault(f"computes with the text {show(text)}; must be a number")
        if isinstance(node, ast.UnaryOp):
            return -values[0] if isinstance(node.op, ast.USub) else values[0]
        if isinstance(node, ast.Call):
            return abs(values[0]) if path_of(node.func) == "abs" else _EXTREMES[path_of(node.func)](values)
        assert isinstance(node, ast.BinOp)
        return _ARITHMETIC[type(node.op)](*values)

    def _unknown(self, name: str, quantities: Mapping[str, Any]) -> str:
        below = sorted(each for each in quantities if each.startswith(f"{name}."))
        among = below or sorted(quantities, key=lambda each: (each.count("."), each))
        names = f"{', '.join(among[:NAMES_SHOWN])}{', …' if len(among) > NAMES_SHOWN else ''}"
        return f"has {name}, which no flight has; {suggestion(name, quantities)}allowed: {names}"


class Unknown(NamedTuple):
    """Stands for a quantity that a flight does not have."""

    name: str


def _operands(node: ast.AST) -> list[ast.expr]:
    if isinstance(node, ast.UnaryOp):
        return [node.operand]
    if isinstance(node, ast.BinOp):
        return [node.left, node.right]
    assert isinstance(node, ast.Call)
    return node.args


def path_of(node: ast.AST) -> str:
    """Return the dotted path of a name or attribute node; empty for any other node."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{path}.{node.attr}" if (path := path_of(node.value)) else ""
    return ""


def quantities_of(document: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path and value of every number, text, truth value and None of a summary, except in lists."""
    if isinstance(document, Mapping):
        for name, value in document.items():
            yield from quantities_of(value, f"{prefix}.{name}" if prefix else str(name))
    elif prefix and (document is None or isinstance(document, bool | int | float | str)):
        yield prefix, document


def worst(margins: list[Margin]) -> Margin:
    """Return the worst margin: the smallest, with violated requirements first."""
    return min(margins, key=lambda margin: (margin.holds, margin.share))
