"""A drone that flies by a reference of its own, asked from Python: `sim.drone("drone1").goto((1, 2, 3))`."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from zsim.contract import keys

Ask = Callable[..., dict[str, Any]]
"""`ask` of a `Simulation` or a `Federation`: key, op and arguments; RequestRefusedError with the reason."""


class PilotedDrone:
    """The requests to the pilot of one drone; see docs/references.md.

    Each acts from the next gate on, and raises RequestRefusedError with the reason: the drone has no `reference` in the
    scenario, is not in the air, or cannot fly what is asked.

    Attributes:
        name: of the drone.
    """

    def __init__(self, name: str, ask: Ask) -> None:
        self.name = name
        self._ask, self._key = ask, keys.drone_control(name)

    def goto(
        self,
        position_m: Sequence[float] | Sequence[Sequence[float]] | np.ndarray,
        yaw_deg: float | None = None,
        over_s: float | None = None,
        *,
        speed_m_s: float | None = None,
        radius_m: float | None = None,
    ) -> float:
        """Fly to a place in W, or through several, to rest at the last one; return the simulated time [s] of arrival.

        Args:
            position_m: (3,), or (n, 3) of places one after the other.
            yaw_deg: heading there; None for the present one.
            over_s: how long, to one place; less than the drone's limits need is lengthened. With the same one, all
                drones fly by one function of time.
            speed_m_s: cruise speed; None, or more than the drone's limits allow, for as fast as these let it.
            radius_m: from within which of a place it turns towards the next one; None or 0: it rests at each.
        """
        places = np.asarray(position_m, float)
        where = "places_m" if places.ndim == 2 else "position_m"
        given = {"yaw_deg": yaw_deg, "over_s": over_s, "speed_m_s": speed_m_s, "radius_m": radius_m}
        asked = {where: places.tolist(), **{name: value for name, value in given.items() if value is not None}}
        return float(self._ask(self._key, "goto", **asked)["until_s"])

    def follow(self, **path: Any) -> float | None:
        """Fly to the beginning of a path, then the path; return the simulated time [s] of its end, None if it has none.

        Args:
            path: fields of a reference as in a scenario, but for those of its times, gains and file:
                `minimum_snap=[{"at_s": 0, "position_m": [0, 0, 2]}, …]`, `circle={"radius_m": 2, "period_s": 10}`, `fit=True`, `origin_m=…`.
        """
        return self._ask(self._key, "follow", **path)["until_s"]

    def hold(self) -> None:
        """Come to rest."""
        self._ask(self._key, "hold")

    def land(self) -> None:
        """Land where it is."""
        self._ask(self._key, "land")

    def takeoff(self) -> None:
        """Take off again after a landing."""
        self._ask(self._key, "takeoff")

    def __repr__(self) -> str:
        return f"<PilotedDrone {self.name}>"
