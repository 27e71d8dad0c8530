"""What a page says over its socket of actions, as JSON."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from zsim_bridges.console.flying.flown_velocity import Stick

NAME_MAX = 64  # characters of a drone's name, or of a page's
PLACE_MAX_M = 1e5  # of a place on the plan view; the fence is far nearer
SPEED_MAX_M_S = 100.0  # of a stick; the drones' own limits are far lower

Name = Annotated[str, Meta(max_length=NAME_MAX)]
Deflection = Annotated[float, Meta(ge=-1.0, le=1.0)]
Metres = Annotated[float, Meta(ge=-PLACE_MAX_M, le=PLACE_MAX_M)]


class _Action(Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    pass


class LookFrom(_Action, frozen=True, tag="look"):
    """Let the page's camera follow the formation, keep all of it in view, and look from somewhere."""

    page: Name
    follows: bool
    fits: bool
    direction: Literal["", "reset", "top", "side"] = ""


class LookAtPlan(_Action, frozen=True, tag="plan"):
    """Send the view from above; `whole`: with what does not change."""

    page: Name
    whole: bool = False


class ChooseDrone(_Action, frozen=True, tag="choose"):
    """Choose a drone on the page itself."""

    page: Name
    drone: Name


class SelectDrone(_Action, frozen=True, tag="select"):
    """Select a drone on the page itself for one command with others, or no longer."""

    page: Name
    drone: Name


class PlayRecord(_Action, frozen=True, tag="play"):
    """Let a replay go on from an instant, pause, resume, do a step, or change its pace; of operators only."""

    op: Literal["seek", "pause", "resume", "step", "rate"]
    value: Annotated[float, Meta(ge=0.0, le=1e9)] = 1.0
    """Of seek simulated seconds, of step gates, of rate simulated per wall seconds."""


class TakeDrone(_Action, frozen=True, tag="take"):
    """Take a drone, to fly it; `over` from whoever flies it; of operators only, as all below.

    To be repeated until it is answered; what has the same `id` is carried out once.
    """

    drone: Name
    over: bool = False
    id: Name = ""


class SteerDrone(_Action, frozen=True, tag="steer"):
    """Fly the drone that was taken; not `held`: let it hover. To be repeated: who is silent does not fly."""

    held: bool = False
    forward: Deflection = 0.0
    left: Deflection = 0.0
    up: Deflection = 0.0
    turn: Deflection = 0.0
    speed_m_s: Annotated[float, Meta(ge=0.0, le=SPEED_MAX_M_S)] = 1.0

    def stick(self) -> Stick | None:
        """Return where the stick is, None where it is not held."""
        return Stick(self.forward, self.left, self.up, self.turn, self.speed_m_s) if self.held else None


class GoToPlace(_Action, frozen=True, tag="go"):
    """Send the drone that was taken to a place, at the height that it has unless `z_m` is given."""

    x_m: Metres
    y_m: Metres
    z_m: Metres | None = None


class LeaveDrone(_Action, frozen=True, tag="leave"):
    """Give the drone back."""


FlyDrone = TakeDrone | SteerDrone | GoToPlace | LeaveDrone
PageAction = LookFrom | LookAtPlan | ChooseDrone | SelectDrone | PlayRecord | FlyDrone
DECODER = msgspec.json.Decoder(PageAction)
