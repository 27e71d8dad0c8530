"""What estimators and those who fly say of each drone, collected message by message: estimates, velocity commands."""

from array import array
from collections import defaultdict

import numpy as np
from msgspec import Struct

from zsim.contract.flight_messages import Covariance
from zsim.schema.message import Vector3
from zsim_analysis.reading.recorded_flight import DroneEstimates, VelocityCommands

ESTIMATE_WIDTH = 44  # position, velocity, heading, its sigma, covariance
COMMAND_WIDTH = 5  # velocity, yaw rate, whether in W


class EstimateFields(Struct):
    """The part of an estimate that is needed here."""

    t_ns: int
    position_m: Vector3
    velocity_m_s: Vector3
    yaw_rad: float
    covariance: Covariance
    yaw_sigma_rad: float


class VelocityFields(Struct):
    """The part of a velocity command that is needed here."""

    t_ns: int
    source: str
    velocity_m_s: Vector3
    yaw_rate_rad_s: float
    frame: str = "heading"


class _Rows:
    """Rows of numbers with their times."""

    def __init__(self, width: int) -> None:
        self._t_ns, self._values, self._width = array("q"), array("f"), width

    def add(self, t_ns: int, *parts: tuple[float, ...]) -> None:
        self._t_ns.append(t_ns)
        for part in parts:
            self._values.extend(part)

    def by_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times (R,) [ns], ascending and without doubles, and rows (R, width)."""
        t_ns, first = np.unique(np.array(self._t_ns, np.int64), return_index=True)
        return t_ns, np.array(self._values, np.float32).reshape(-1, self._width)[first]


class DroneAnswers:
    """Estimates and velocity commands by drone; of the commands those of whom its status names as its commander."""

    def __init__(self) -> None:
        self._estimates: defaultdict[str, _Rows] = defaultdict(lambda: _Rows(ESTIMATE_WIDTH))
        self._commands: defaultdict[tuple[str, str], _Rows] = defaultdict(lambda: _Rows(COMMAND_WIDTH))
        self._commanders: defaultdict[str, list[tuple[int, str]]] = defaultdict(list)

    def add_commander(self, drone: str, t_ns: int, commander: str | None) -> None:
        """Take whom a status names; None is nobody."""
        known = self._commanders[drone]
        if not known or known[-1][1] != (commander or ""):
            known.append((t_ns, commander or ""))

    def add_estimate(self, drone: str, estimate: EstimateFields) -> None:
        heading = (estimate.yaw_rad, estimate.yaw_sigma_rad)
        parts = (estimate.position_m, estimate.velocity_m_s, heading, estimate.covariance)
        self._estimates[drone].add(estimate.t_ns, *parts)

    def add_command(self, drone: str, command: VelocityFields) -> None:
        rest = (command.yaw_rate_rad_s, float(command.frame == "world"))
        self._commands[drone, command.source].add(command.t_ns, command.velocity_m_s, rest)

    def estimates(self) -> dict[str, DroneEstimates]:
        """Return what each drone's estimator published."""
        return {drone: _estimates(*rows.by_time()) for drone, rows in self._estimates.items()}

    def commands(self) -> dict[str, VelocityCommands]:
        """Return what each drone's commanders sent, in the order of time."""
        kept: defaultdict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        for (drone, source), rows in self._commands.items():
            t_ns, values = rows.by_time()
            obeyed = _obeyed(t_ns, source, self._commanders[drone])
            kept[drone].append((t_ns[obeyed], values[obeyed]))
        return {drone: _commands(parts) for drone, parts in kept.items()}


def _obeyed(t_ns: np.ndarray, source: str, commanders: list[tuple[int, str]]) -> np.ndarray:
    """Return which commands (C,) are of the commander by the next status, or were sent while none was named."""
    if not commanders:
        return np.ones(len(t_ns), bool)
    since_ns = np.array([t for t, _ in commanders])
    place = np.searchsorted(since_ns, t_ns, side="right") - 1
    named = np.array([name for _, name in commanders])
    following = named[np.minimum(place + 1, len(named) - 1)]
    now = named[np.maximum(place, 0)]
    return (now == source) | ((now == "") & np.isin(following, ("", source)))


def _estimates(t_ns: np.ndarray, rows: np.ndarray) -> DroneEstimates:
    p_W, v_W, yaw, sigma, covariance = np.split(rows.astype(np.float64), (3, 6, 7, 8), axis=1)
    return DroneEstimates(t_ns, p_W, v_W, yaw[:, 0], sigma[:, 0], covariance.reshape(-1, 6, 6))


def _commands(parts: list[tuple[np.ndarray, np.ndarray]]) -> VelocityCommands:
    t_ns, first = np.unique(np.concatenate([times for times, _ in parts]), return_index=True)
    rows = np.concatenate([values for _, values in parts])[first].astype(np.float64)
    return VelocityCommands(t_ns, rows[:, :3], rows[:, 3], rows[:, 4] > 0)
