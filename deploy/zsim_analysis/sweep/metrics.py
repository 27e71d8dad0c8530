"""Figures of a user's own for each run: `report.metrics` names the function that computes them from its flight.

    def metrics(flight: RecordedFlight) -> float | Mapping[str, float]

A number becomes the column `metrics.` and the function's name, a mapping a column `metrics.NAME` for each of its names.
A name that ends in a unit as those of the scenario do (`overshoot_m`) has it in tables and figures. NaN, infinity and
None are empty. What goes wrong in the function is the run's `metrics_failure`, and nothing else is lost.
"""

import math
import re
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any

from msgspec import UNSET, Struct

from zsim.errors import DocumentError, ReportError, ScenarioError, reason_of
from zsim.scenario.scenario import Scenario
from zsim.schema import plugin
from zsim.schema.checker import show
from zsim_analysis.reading.recorded_flight import RecordedFlight

PREFIX = "metrics."  # of the columns
FIELD = "report.metrics"
COLUMNS_MAX = 100  # of one function
_NAME = re.compile(r"[A-Za-z]\w{0,63}", re.ASCII)


class FlightMetrics(Struct, frozen=True):
    """What a user's function returned of a flight: numbers by column, or in one line why there are none."""

    columns: dict[str, float | None]
    failure: str | None = None


NO_METRICS = FlightMetrics({})


def metrics_of(scenario: Scenario, flight: RecordedFlight) -> FlightMetrics:
    """Return the figures of a flight by the function that its scenario names; none where it names none."""
    name = scenario.report.metrics
    if name is UNSET:
        return NO_METRICS
    try:
        return FlightMetrics(_columns(plugin.load_function(name, FIELD)(flight), name))
    except DocumentError as error:
        return FlightMetrics({}, error.faults[0])
    except (Exception, SystemExit) as error:  # of any type: the user's function raised it
        return FlightMetrics({}, f"{FIELD} {name}: {reason_of(error)}")


def check_metrics(scenario: Scenario, source: str) -> None:
    """Refuse a scenario whose function cannot be loaded here.

    Raises:
        ScenarioError: it is not there; one line.
    """
    if scenario.report.metrics is not UNSET:
        try:
            plugin.load_function(scenario.report.metrics, f"{source}: {FIELD}")
        except DocumentError as error:
            raise ScenarioError(error.faults) from error


def _columns(returned: Any, name: str) -> dict[str, float | None]:
    """Return numbers by column of what a function returned."""
    named = returned if isinstance(returned, Mapping) else {name.partition(":")[2]: returned}
    if len(named) > COLUMNS_MAX:
        raise ReportError(f"returned {len(named)} numbers; must be at most {COLUMNS_MAX}")
    return {f"{PREFIX}{_checked_name(key)}": _number(key, value) for key, value in named.items()}


def _checked_name(key: Any) -> str:
    if not (isinstance(key, str) and _NAME.fullmatch(key)):
        raise ReportError(f"returned the name {show(key)}; must be a letter and up to 63 letters, digits and _")
    return key


def _number(key: str, value: Any) -> float | None:
    if value is None:
        return None
    if not isinstance(value, Real):
        raise ReportError(f"returned {show(str(type(value).__name__))} for {key}; must be a number or None")
    number = float(value)
    return number if math.isfinite(number) else None


def metric_columns(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the columns of figures of the user's own in all rows, in the order of their first occurrence."""
    return list(dict.fromkeys(name for row in rows for name in row if name.startswith(PREFIX)))


def metrics_function(document: Mapping[str, Any]) -> str:
    """Return the function that a scenario's document names, "" where it names none."""
    report = document.get("report")
    return str(report.get("metrics") or "") if isinstance(report, Mapping) else ""
