"""What flying from a page depends on: what is known of the drone and the run, and what the page is answered. Pure."""

from typing import NamedTuple

from zsim.math.rotation import Vector
from zsim_bridges.console.flying.flown_velocity import DronePose

RATE_MAX = 5.0  # × real time; chosen: faster, nobody steers by hand, and the firmware takes the pauses for silence


class DroneSight(NamedTuple):
    """What is known of a drone.

    Attributes:
        state: of its firmware; empty before it was seen.
        commander: who flies it.
        pose: by its estimator; None where there is no estimate of the present.
    """

    state: str = ""
    commander: str | None = None
    pose: DronePose | None = None


class RunSight(NamedTuple):
    """What is known of the run.

    Attributes:
        off: why nothing can be flown; empty where something can.
        silence: that the world does not answer, in words; empty where it does. A drone is taken all the same.
        rate: simulated per wall second, as measured.
        paused: whether it stands still.
    """

    off: str = ""
    rate: float = 1.0
    paused: bool = False
    silence: str = ""


class FlightAnswer(NamedTuple):
    """What a page shows of the drone that it flies.

    Attributes:
        drone: its name; empty for none.
        state: none, taking or flying.
        text: why it is not flown, or what it does.
        over: whether it may be taken over from who flies it.
        commander: who that is.
        id: of the page's request to take it.
        goal: the place to which it flies [m; W]; None for none.
    """

    drone: str = ""
    state: str = "none"
    text: str = ""
    over: bool = False
    commander: str = ""
    id: str = ""
    goal: Vector | None = None


def too_fast(rate: float) -> str:
    """Return why nobody can fly by hand at a rate; empty where somebody can."""
    if rate <= RATE_MAX:
        return ""
    return f"time goes {rate:.1f} × as fast as the wall clock; to fly by hand set the rate to {RATE_MAX:g} or less"
