"""The check of a drone before it takes off: battery, upright, estimator, link, who controls it. Pure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from zsim_agents.formation.flight_check import EngagementLimits
from zsim_bridges.console.monitoring.alarms import (
    BATTERY_EMPTY_PERCENT,
    BATTERY_LOW_PERCENT,
    LATE_MS,
    DroneCondition,
)

TILT_MAX_DEG = 30.0  # of a drone that takes off; chosen: steeper than any ground, far less than its side or back
LINK_SILENT_S = 3.0  # wall; drivers publish the state of a link once a second
LIMITS = EngagementLimits()  # those by which a formation's controller takes off


class Check(NamedTuple):
    """One point of the check.

    Attributes:
        name: what is looked at.
        text: with figures, and what is allowed where it is not as it must be.
        ok: whether it is as it should be.
        blocks: whether no take-off is offered where it is not.
    """

    name: str
    text: str
    ok: bool = True
    blocks: bool = False


def preflight_checks(drone: DroneCondition, in_formation: bool, foreign: str = "") -> tuple[Check, ...]:
    """Return the check of a drone.

    Args:
        drone: its condition.
        in_formation: whether a controller flies it, which needs its estimator.
        foreign: who flies it, where that is neither this console nor its formation's controller.
    """
    checks = [_battery(drone), _upright(drone), _estimator(drone, in_formation)]
    if drone.is_external:
        checks.append(_link(drone))
    control = f"flown by {foreign}; must be given back" if foreign else drone.commander or "free"
    return (*checks, Check("control", control, not foreign, blocks=in_formation))


def _battery(drone: DroneCondition) -> Check:
    percent = drone.battery_percent
    if percent < BATTERY_EMPTY_PERCENT:
        return Check("battery", f"{percent:.0f} %; must be {BATTERY_EMPTY_PERCENT:.0f} % or more", False, True)
    if percent < BATTERY_LOW_PERCENT:
        return Check("battery", f"{percent:.0f} %; low", False)
    return Check("battery", f"{percent:.0f} %")


def _upright(drone: DroneCondition) -> Check:
    tilt_deg = drone.tilt_deg or 0.0
    if tilt_deg > TILT_MAX_DEG:
        return Check("upright", f"tilted by {tilt_deg:.0f}°; must be {TILT_MAX_DEG:.0f}° or less", False, True)
    return Check("upright", f"{tilt_deg:.0f}°")


def _estimator(drone: DroneCondition, in_formation: bool) -> Check:
    sigma_m, yaw_deg, yaw_max_deg = drone.sigma_m, drone.yaw_sigma_deg, math.degrees(LIMITS.yaw_sigma_max_rad)
    if sigma_m is None:
        return Check("estimator", "no estimate of the present", False, in_formation)
    if sigma_m > LIMITS.sigma_max_m:
        text = f"σ of position is {sigma_m:.1f} m; must be {LIMITS.sigma_max_m:g} m or less"
        return Check("estimator", text, False, in_formation)
    if yaw_deg is not None and yaw_deg > yaw_max_deg:
        text = f"σ of heading is {yaw_deg:.0f}°; must be {yaw_max_deg:.0f}° or less"
        return Check("estimator", text, False, in_formation)
    if drone.lag_ms is not None and drone.lag_ms > LATE_MS:
        return Check("estimator", f"{drone.lag_ms:.0f} ms late", False)
    return Check("estimator", f"σ {sigma_m:.2f} m")


def _link(drone: DroneCondition) -> Check:
    if drone.link_state is None or drone.link_age_s is None:
        return Check("link", "no driver yet", False, True)
    if drone.link_age_s > LINK_SILENT_S:
        return Check("link", f"its driver has been silent for {drone.link_age_s:.0f} s", False, True)
    connected = drone.link_state in ("connected", "armed")
    return Check("link", drone.link_state, connected, blocks=True)


def takeoff_refusal(drone: str, checks: Sequence[Check]) -> str:
    """Return why a drone that is on the ground may not take off; empty where it may."""
    failed = [f"{check.name} {check.text}" for check in checks if check.blocks and not check.ok]
    return f"{drone}: {', '.join(failed)}" if failed else ""
